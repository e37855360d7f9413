"""What somebody may do next, read off the lanes: a goal for each manoeuvre that can be completed in time. Frame: world, metres.

Straight, left and right follow the lanes from the one that the agent is on; lane changes end on those beside it; a U-turn follows a lane
that turns round, or a half circle into the opposite lanes where one may turn left. Named by the change of heading (`goals.manoeuvre`), so
following a road that bends by more than 30 degrees is a turn. A goal lies where a usual driver is when the simulation ends, or at the end of a
turn that is then under way. Lights, signs and other agents are not looked at.

Cyclists get straight, left and right and may use bicycle lanes. Pedestrians do not follow lanes and get nothing.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.goals.crossing import crosses_forbidden_line
from rlftsim.goals.lane_paths import (
    LanePath,
    Lanes,
    Pose,
    ease_m,
    lanes_for,
    own_lanes,
    paths_from,
    shortened,
)
from rlftsim.goals.manoeuvre import STRAIGHT_RAD, Manoeuvre, manoeuvre_of_turn
from rlftsim.goals.reach import BRISK, HORIZON_S, Reach, reach_along
from rlftsim.goals.side_paths import LONGEST_UTURN_M, change_length_m, lane_change_paths, uturn_paths
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, ObjectType, Scenario

RoadTest = Callable[[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"], Float[np.ndarray, "3"]], Float[np.ndarray, "S"]]
"""How far the box of somebody sticks out beyond the road edge, m, negative on the road: from its path (on the ground), headings and size."""

NEAREST_GOAL_M = 6.0
"""A goal nearer than that is no manoeuvre."""
SPARE_M = 20.0
"""Paths are looked at this far beyond reach, to see whether a turn is over."""
SETTLED_M = 6
SETTLED_RAD = np.radians(8.0)
"""A turn is over where the way bends less than that over so many metres."""
LANE_CHANGE_OFFSET_M = 2.0
"""A lane change ends at least so far from every way along the own lane."""
STILL_BESIDE_M = 6.0
"""When a lane change is complete, the own lane is at most so far: otherwise it was none, the lanes have parted in a junction."""
CLIPPED_M = 0.3
"""So much may a corner of the box stick out on the way: a box that follows a lane's middle cuts corners that a driver would not."""
PARKED_MPS = 0.5
PARKED_ASIDE_M = 1.2
KINDS = (ObjectType.VEHICLE, ObjectType.CYCLIST)


@dataclass(frozen=True, eq=False)
class Proposal:
    """A manoeuvre and where it leads."""

    object_id: int
    manoeuvre: Manoeuvre
    position: Float[np.ndarray, "2"]
    """The goal."""
    way: Float[np.ndarray, "S 3"]
    """How to get there; begins at the agent."""
    is_recorded: bool = False
    """Whether this is what the record shows."""


@dataclass(frozen=True, eq=False)
class Driver:
    """Somebody at the current step."""

    object_id: int
    kind: ObjectType
    pose: Pose
    speed_mps: float
    size: Float[np.ndarray, "3"]
    top_history_mps: float

    @classmethod
    def of(cls, scenario: Scenario, track: int) -> "Driver":
        """A track that is valid at the current step; its pose is on the ground."""
        tracks = scenario.tracks
        size = tracks.size[track, CURRENT_STEP].astype(np.float64)
        position = tracks.position[track, CURRENT_STEP].astype(np.float64) - [0.0, 0.0, size[2] / 2]
        speeds = np.linalg.norm(tracks.velocity[track, :HISTORY_STEPS], axis=-1)
        return cls(
            object_id=int(tracks.object_id[track]),
            kind=ObjectType(int(tracks.object_type[track])),
            pose=Pose(position, float(tracks.heading[track, CURRENT_STEP])),
            speed_mps=float(speeds[CURRENT_STEP]),
            size=size,
            top_history_mps=float(speeds[tracks.valid[track, :HISTORY_STEPS]].max()),
        )


def propose_from_lanes(scenario: Scenario, track: int, road_test: RoadTest | None = None) -> tuple[Proposal, ...]:
    """One goal for each manoeuvre that the lanes allow, in the order of `Manoeuvre`; nothing of the future is looked at.

    Args:
        scenario: the map and the history.
        track: index of a simulated track.
        road_test: says what is off the road; None = the map is not asked.
    """
    if why_nothing(scenario, track) is not None:
        return ()
    driver = Driver.of(scenario, track)
    lanes = lanes_for(lane_graph(scenario), driver.kind)
    found = sorted(_candidates(scenario, driver, lanes), key=lambda c: c.merit)
    best: dict[Manoeuvre, Proposal] = {}
    for candidate in found:
        if candidate.manoeuvre not in best and _is_on_road(candidate.path, driver, road_test):
            way = candidate.path.points
            best[candidate.manoeuvre] = Proposal(driver.object_id, candidate.manoeuvre, way[-1, :2], way)
    return tuple(best[m] for m in Manoeuvre if m in best)


def why_nothing(scenario: Scenario, track: int) -> str | None:
    """Why the lanes propose nothing for a simulated track, in words; None if they may."""
    driver = Driver.of(scenario, track)
    if driver.kind not in KINDS:
        return f"a {driver.kind.name.lower()} does not follow lanes"
    lanes = lanes_for(lane_graph(scenario), driver.kind)
    own = own_lanes(lanes, driver.pose)
    if not own:
        return "it is on no lane that leads its way"
    aside = float(np.linalg.norm(lanes.graph.points[own[0], :2] - driver.pose.position[:2]))
    if driver.top_history_mps < PARKED_MPS and aside > PARKED_ASIDE_M:
        return "it stands beside its lane, probably parked"
    return None


# ---- candidates --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A path up to its goal."""

    manoeuvre: Manoeuvre
    path: LanePath
    is_cut_short: bool
    """The goal lies before a turn that cannot be completed."""

    @property
    def merit(self) -> tuple[bool, float]:
        """Less is better: clear cases first."""
        return self.is_cut_short, abs(float(self.path.turn[-1]) - self.manoeuvre.usual_turn_rad)


def own_paths(driver: Driver, lanes: Lanes, *, length_m: float) -> list[LanePath]:
    """Ways along the lanes that somebody is on."""
    ease = ease_m(driver.speed_mps)
    return paths_from(lanes, driver.pose, own_lanes(lanes, driver.pose), length_m=length_m, ease_m=ease)


def _candidates(scenario: Scenario, driver: Driver, lanes: Lanes) -> Iterator[_Candidate]:
    length_m = _furthest_m(driver, lanes)
    own = own_paths(driver, lanes, length_m=length_m)
    yield from _turns(own, driver)
    if driver.kind != ObjectType.VEHICLE:
        return
    yield from _lane_changes(scenario, driver, lanes, own, length_m)
    if driver.size[0] <= LONGEST_UTURN_M:
        yield from _uturns(driver, lanes, own, length_m)


def _furthest_m(driver: Driver, lanes: Lanes) -> float:
    """No path needs to be longer."""
    top = max(driver.speed_mps, BRISK.over_limit * float(lanes.speed_limit_mps[lanes.usable].max()))
    gained = BRISK.acceleration_mps2 * HORIZON_S / 2
    return HORIZON_S * min(top, driver.speed_mps + gained) + SPARE_M


def _turns(paths: Iterable[LanePath], driver: Driver) -> Iterator[_Candidate]:
    """Straight on, left, right and round along the lanes themselves."""
    for path in paths:
        reach = reach_along(path, driver.speed_mps)
        goal = _settled_goal(path, reach)
        if goal is None:
            continue
        manoeuvre = manoeuvre_of_turn(float(path.turn[goal]))
        if manoeuvre is not None:
            yield _Candidate(manoeuvre, shortened(path, goal), goal < int(min(reach.usual_m, path.length_m)))


def _lane_changes(
    scenario: Scenario, driver: Driver, lanes: Lanes, own: list[LanePath], length_m: float
) -> Iterator[_Candidate]:
    for path in own:
        speed = reach_along(path, driver.speed_mps).usual_m / HORIZON_S
        for manoeuvre, side in ((Manoeuvre.LANE_CHANGE_LEFT, 1), (Manoeuvre.LANE_CHANGE_RIGHT, -1)):
            for way, complete in lane_change_paths(lanes, path, side=side, speed_mps=speed, length_m=length_m):
                goal = _lane_change_goal(way, complete, driver)
                if goal is None:
                    continue
                changed = way.points[complete - int(change_length_m(speed)) : goal + 1]
                has_left = distance_to(own, way.points[goal]) >= LANE_CHANGE_OFFSET_M
                is_beside = distance_to(own, way.points[complete]) <= STILL_BESIDE_M
                if has_left and is_beside and not crosses_forbidden_line(scenario, changed):
                    yield _Candidate(manoeuvre, shortened(way, goal), False)


def _lane_change_goal(way: LanePath, complete: int, driver: Driver) -> int | None:
    """Where the change ends: as far as usual, the lane reached, still going straight."""
    reach = reach_along(way, driver.speed_mps)
    goal = max(int(reach.usual_m), complete)
    if goal > min(reach.most_m, way.length_m) or goal < reach.least_m:
        return None
    return goal if abs(way.turn[goal]) < STRAIGHT_RAD else None


def _uturns(driver: Driver, lanes: Lanes, own: list[LanePath], length_m: float) -> Iterator[_Candidate]:
    """Round at the places where one may turn left."""
    for path in own:
        turned = np.abs(path.turn - np.pi / 2) < np.pi / 4
        if not turned.any():
            continue
        for way in uturn_paths(lanes, path, length_m=length_m):
            yield from (c for c in _turns([way], driver) if c.manoeuvre == Manoeuvre.LEFT_UTURN)


def _settled_goal(path: LanePath, reach: Reach) -> int | None:
    """Where usual driving ends, or further on where a turn is over; if that is out of reach, before the turn. None where nothing fits."""
    low = int(np.ceil(max(reach.least_m, NEAREST_GOAL_M)))
    high = int(min(reach.most_m, path.length_m))
    if high < low:
        return None
    usual = min(max(int(reach.usual_m), low), high)
    settled = np.flatnonzero(_is_settled(path))
    beyond = settled[(settled >= usual) & (settled <= high)]
    before = settled[(settled < usual) & (settled >= low)]
    if len(beyond):
        return int(beyond[0])
    return int(before[-1]) if len(before) else usual


def _is_settled(path: LanePath) -> Bool[np.ndarray, "S"]:
    """Where the way has hardly bent over the last metres and hardly will over the next."""
    turn, last = path.turn, len(path.turn) - 1
    index = np.arange(last + 1)
    ahead = np.abs(turn[np.minimum(index + SETTLED_M, last)] - turn)
    behind = np.abs(turn - turn[np.maximum(index - SETTLED_M // 2, 0)])
    return (ahead <= SETTLED_RAD) & (behind <= SETTLED_RAD)


def distance_to(paths: Iterable[LanePath], point: Float[np.ndarray, "3"]) -> float:
    """To the nearest point of any path."""
    return min(float(np.linalg.norm(path.points[:, :2] - point[:2], axis=1).min()) for path in paths)


def _is_on_road(path: LanePath, driver: Driver, road_test: RoadTest | None) -> bool:
    """Whether the box stays on the road, but for corners on the way, and is wholly on it at the goal."""
    if road_test is None:
        return True
    outside = road_test(path.points, path.heading, driver.size)
    return bool(outside[-1] <= 0 and outside.max() <= max(CLIPPED_M, float(outside[0]) + CLIPPED_M))
