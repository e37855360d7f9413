"""Goal proposals from the lanes: a goal for each maneuver that can be completed in time. Frame: world, m.

Straight, left and right follow the lanes from the one that the agent is on. Lane changes end on those beside it. A
U-turn follows a lane that turns round, or a half circle into the opposite lanes where a left turn is possible.
Maneuvers are named by the change of heading (`scenario.maneuver`), so following a road that bends by more than 30
degrees is a turn. A goal lies where a usual driver is when the simulation ends, or at the end of a turn that is then
under way. Lights, signs and other agents are ignored.

Cyclists get straight, left and right and may use bicycle lanes. Pedestrians do not follow lanes and get no proposals.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rlftsim.goals.maneuvers.lane_paths import (
    MAX_LANE_DISTANCE_M,
    LanePath,
    Lanes,
    Pose,
    ease_m,
    lanes_for,
    own_lanes,
    paths_from,
    shortened,
)
from rlftsim.goals.maneuvers.reach import BRISK, HORIZON_S, Reach, reach_along
from rlftsim.goals.maneuvers.road_lines import crosses_forbidden_line
from rlftsim.goals.maneuvers.side_paths import LONGEST_UTURN_M, change_length_m, lane_change_paths, uturn_paths
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS, STRAIGHT_RAD, Maneuver, maneuver_of_turn
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, ObjectType, Scenario

RoadTest = Callable[[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"], Float[np.ndarray, "3"]], Float[np.ndarray, "S"]]
"""Distance by which a box sticks out beyond the road edge along a path, m, negative on the road.

Arguments: path on the ground, headings (rad), size of the box (length, width, height)."""

NEAREST_GOAL_M = 6.0
"""Goals nearer than this are not proposed: the agent hardly moves."""
SPARE_M = 20.0
"""Paths are searched this far beyond reach, to see if a turn is over."""
SETTLED_M = 6
SETTLED_RAD = np.radians(8.0)
"""A turn is over where the path bends less than that over so many meters."""
LANE_CHANGE_OFFSET_M = 2.0
"""A lane change ends at least so far from every path along the own lane."""
STILL_BESIDE_M = 6.0
"""The own lane is at most so far when a lane change is complete. Otherwise the lanes have parted in a junction."""
CLIPPED_M = 0.3
"""Distance that a corner may stick out on the way: a box that follows a lane's middle cuts corners, drivers do not."""
PARKED_MPS = 0.5
PARKED_ASIDE_M = 1.2
KINDS = (ObjectType.VEHICLE, ObjectType.CYCLIST)
LANE_CHANGES = ((Maneuver.LANE_CHANGE_LEFT, 1), (Maneuver.LANE_CHANGE_RIGHT, -1))
"""Each with its side, 1 = left."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A maneuver and the goal that it leads to."""

    object_id: int
    maneuver: Maneuver
    position: Float[np.ndarray, "2"]
    """The goal."""
    way: Float[np.ndarray, "S 3"]
    """Path to the goal; begins at the agent."""
    is_logged: bool = False
    """True for the maneuver of the log."""


@dataclass(frozen=True, eq=False)
class CurrentAgent:
    """An agent at the current step."""

    object_id: int
    kind: ObjectType
    pose: Pose
    speed_mps: float
    size: Float[np.ndarray, "3"]
    top_history_mps: float

    @classmethod
    def of(cls, scenario: Scenario, track: int) -> "CurrentAgent":
        """The agent of a track that is valid at the current step; its pose is on the ground.

        Args:
            scenario: its scenario.
            track: index of the track.
        """
        tracks = scenario.tracks
        size = tracks.size[track, CURRENT_STEP].astype(np.float64)
        # Logged positions are centers of boxes, lanes lie on the ground.
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
    """One goal for each maneuver that the lanes allow, in the order of `BENCHMARK_MANEUVERS`; the future is not used.

    Args:
        scenario: the map and the history.
        track: index of a simulated track.
        road_test: tests if a path leaves the road; None = paths are not tested.
    """
    if no_proposal_reason(scenario, track) is not None:
        return ()
    agent = CurrentAgent.of(scenario, track)
    lanes = lanes_for(lane_graph(scenario), agent.kind)
    found = sorted(_candidates(scenario, agent, lanes), key=lambda c: c.merit)
    best: dict[Maneuver, Proposal] = {}
    for candidate in found:
        if candidate.maneuver in best:
            continue
        path = candidate.path
        if road_test is not None:
            outside = road_test(path.points, path.heading, agent.size)  # [S], m, negative on the road
            # The goal's box is wholly on the road. On the way corners may stick out a little, and as far as at the
            # start.
            if not (outside[-1] <= 0 and outside.max() <= max(CLIPPED_M, float(outside[0]) + CLIPPED_M)):
                continue
        best[candidate.maneuver] = Proposal(agent.object_id, candidate.maneuver, path.points[-1, :2], path.points)
    return tuple(best[m] for m in BENCHMARK_MANEUVERS if m in best)


def no_proposal_reason(scenario: Scenario, track: int) -> str | None:
    """Reason that the lanes propose nothing for a simulated track, in words; None if they may propose something.

    Args:
        scenario: the map and the history.
        track: index of a simulated track.
    """
    agent = CurrentAgent.of(scenario, track)
    if agent.kind not in KINDS:
        return f"a {agent.kind.name.lower()} does not follow lanes"
    lanes = lanes_for(lane_graph(scenario), agent.kind)
    own = own_lanes(lanes, agent.pose)
    if not own:
        return f"no lane within {MAX_LANE_DISTANCE_M:g} m runs in its direction of travel"
    aside = float(np.linalg.norm(lanes.graph.points[own[0], :2] - agent.pose.position[:2]))
    if agent.top_history_mps < PARKED_MPS and aside > PARKED_ASIDE_M:
        return "it stands beside its lane, probably parked"
    return None


def own_paths(agent: CurrentAgent, lanes: Lanes, *, length_m: float) -> list[LanePath]:
    """Paths along the lanes that an agent is on.

    Args:
        agent: at the current step.
        lanes: those that it may use.
        length_m: greatest length of a path.
    """
    ease = ease_m(agent.speed_mps)
    return paths_from(lanes, agent.pose, own_lanes(lanes, agent.pose), length_m=length_m, ease_m=ease)


def distance_to(paths: Iterable[LanePath], point: Float[np.ndarray, "3"]) -> float:
    """Distance to the nearest point of any path, in the plane, m.

    Args:
        paths: at least one.
        point: world frame.
    """
    return min(float(np.linalg.norm(path.points[:, :2] - point[:2], axis=1).min()) for path in paths)


# ---- candidates
# --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A path up to its goal."""

    maneuver: Maneuver
    path: LanePath
    is_cut_short: bool
    """The goal lies before a turn that cannot be completed."""

    @property
    def merit(self) -> tuple[bool, float]:
        """Sort key: complete paths first, then those that turn most like their maneuver."""
        return self.is_cut_short, abs(float(self.path.turn[-1]) - self.maneuver.usual_turn_rad)


def _candidates(scenario: Scenario, agent: CurrentAgent, lanes: Lanes) -> Iterator[_Candidate]:
    # No path needs to be longer than the fastest driver gets.
    top = max(agent.speed_mps, BRISK.over_limit * float(lanes.speed_limit_mps[lanes.usable].max()))
    gained = BRISK.acceleration_mps2 * HORIZON_S / 2
    length_m = HORIZON_S * min(top, agent.speed_mps + gained) + SPARE_M
    # 1. Along the own lane and those it continues into: straight, left, right, and lanes that turn round.
    own = own_paths(agent, lanes, length_m=length_m)
    yield from _turns(own, agent)
    if agent.kind != ObjectType.VEHICLE:
        return
    # 2. Into the lanes beside.
    yield from _lane_changes(scenario, agent, lanes, own, length_m)
    # 3. Round by a half circle, at the places where a left turn is possible.
    if agent.size[0] <= LONGEST_UTURN_M:
        left_turns = [path for path in own if (np.abs(path.turn - np.pi / 2) < np.pi / 4).any()]
        for path in left_turns:
            for way in uturn_paths(lanes, path, length_m=length_m):
                yield from (c for c in _turns([way], agent) if c.maneuver == Maneuver.LEFT_UTURN)


def _turns(paths: Iterable[LanePath], agent: CurrentAgent) -> Iterator[_Candidate]:
    """Candidates that follow paths as they are."""
    for path in paths:
        reach = reach_along(path, agent.speed_mps)
        goal = _settled_goal(path, reach)
        if goal is None:
            continue
        maneuver = maneuver_of_turn(float(path.turn[goal]))
        if maneuver is not None:
            yield _Candidate(maneuver, shortened(path, goal), goal < int(min(reach.usual_m, path.length_m)))


def _lane_changes(
    scenario: Scenario, agent: CurrentAgent, lanes: Lanes, own: list[LanePath], length_m: float
) -> Iterator[_Candidate]:
    for path in own:
        speed = reach_along(path, agent.speed_mps).usual_m / HORIZON_S
        for maneuver, side in LANE_CHANGES:
            for way, complete in lane_change_paths(lanes, path, side=side, speed_mps=speed, length_m=length_m):
                # The goal is as far as a usual agent gets, but after the change is complete, and before any turn.
                reach = reach_along(way, agent.speed_mps)
                goal = max(int(reach.usual_m), complete)
                if not reach.least_m <= goal <= min(reach.most_m, way.length_m) or abs(way.turn[goal]) >= STRAIGHT_RAD:
                    continue
                changed = way.points[complete - int(change_length_m(speed)) : goal + 1]
                has_left = distance_to(own, way.points[goal]) >= LANE_CHANGE_OFFSET_M
                is_beside = distance_to(own, way.points[complete]) <= STILL_BESIDE_M
                if has_left and is_beside and not crosses_forbidden_line(scenario, changed):
                    yield _Candidate(maneuver, shortened(way, goal), False)


def _settled_goal(path: LanePath, reach: Reach) -> int | None:
    """Index of the goal on a path; None if nothing is in reach.

    The end of usual driving, or further on, where a turn is over. If that is out of reach, before the turn.
    """
    low = int(np.ceil(max(reach.least_m, NEAREST_GOAL_M)))
    high = int(min(reach.most_m, path.length_m))
    if high < low:
        return None
    usual = min(max(int(reach.usual_m), low), high)
    # Settled where the path has hardly bent over the last meters and hardly will over the next [S].
    turn, last = path.turn, len(path.turn) - 1
    index = np.arange(last + 1)
    ahead = np.abs(turn[np.minimum(index + SETTLED_M, last)] - turn)
    behind = np.abs(turn - turn[np.maximum(index - SETTLED_M // 2, 0)])
    settled = np.flatnonzero((ahead <= SETTLED_RAD) & (behind <= SETTLED_RAD))
    beyond = settled[(settled >= usual) & (settled <= high)]
    before = settled[(settled < usual) & (settled >= low)]
    if len(beyond):
        return int(beyond[0])
    return int(before[-1]) if len(before) else usual
