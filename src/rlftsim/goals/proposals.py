"""Goal proposals from the lanes: a goal for each maneuver that can be completed in time. Frame: world, m.

Straight, left and right follow the agent's lane and the lanes behind it. Lane changes end on the neighboring lanes. A
U-turn follows a lane that turns round, or a half circle into the opposite lanes where a left turn is possible.
Maneuvers are named by the change of heading (`scenario.maneuver`), so following a road that bends by more than 30
degrees is a turn. A goal lies where a usual driver is when the simulation ends, or at the end of a turn that is then
under way. Lights, signs and other agents are ignored.

Cyclists get straight, left and right and may use bicycle lanes. Pedestrians do not follow lanes and get no proposals.
`logged_maneuver` names what an agent did in the log by the same rules.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rlftsim.goals.lane_paths import (
    BRISK,
    HORIZON_S,
    LONGEST_UTURN_M,
    MAX_LANE_DISTANCE_M,
    LanePath,
    Lanes,
    Pose,
    Reach,
    change_length_m,
    compute_reach,
    ease_m,
    lane_change_paths,
    lanes_for,
    own_lanes,
    paths_from,
    shorten_path,
    uturn_paths,
)
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS, STRAIGHT_RAD, Maneuver, classify_turn
from rlftsim.scenario.polylines import arc_length
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, MapFeatureType, ObjectType, Scenario, cached_on_scenario

FORBIDDEN = (
    MapFeatureType.LINE_SOLID_DOUBLE_WHITE,
    MapFeatureType.LINE_SOLID_SINGLE_YELLOW,
    MapFeatureType.LINE_SOLID_DOUBLE_YELLOW,
)
"""A single solid white line may be crossed where WOMD was logged; it only discourages."""
GAP_M = 3.0
"""Points of a line farther apart than this are not joined: clipped maps have holes."""
RoadTest = Callable[[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"], Float[np.ndarray, "3"]], Float[np.ndarray, "S"]]
"""Distance by which a box sticks out beyond the road edge along a path, m, negative on the road.

Arguments: path on the ground, headings (rad), size of the box (length, width, height)."""
NEAREST_GOAL_M = 6.0
"""Goals nearer than this are not proposed: the agent hardly moves."""
SPARE_M = 20.0
"""Paths are searched this far beyond reach, to see if a turn is over."""
SETTLING_M = 6
SETTLING_RAD = np.radians(8.0)
"""A turn is over where the path bends less than that over so many meters."""
LANE_CHANGE_OFFSET_M = 2.0
"""A lane change ends at least so far from every path along the own lane."""
MAX_LANE_GAP_M = 6.0
"""The own lane is at most so far when a lane change is complete. Otherwise the lanes have parted in a junction."""
CLIPPED_M = 0.3
"""Distance that a corner may stick out on the way: a box that follows a lane's middle cuts corners, drivers do not."""
PARKED_MPS = 0.5
PARKED_OFFSET_M = 1.2
LANE_AGENT_TYPES = (ObjectType.VEHICLE, ObjectType.CYCLIST)
LANE_CHANGES = ((Maneuver.LANE_CHANGE_LEFT, 1), (Maneuver.LANE_CHANGE_RIGHT, -1))
"""Lane changes and sides, 1 = left."""
IN_LANE_M = 1.5
"""Greatest distance to the middle of a lane for an agent in the lane."""
BEYOND_END_M = 10.0
"""Paths along the lanes are searched so far beyond the logged distance."""


def crosses_forbidden_line(scenario: Scenario, points: Float[np.ndarray, "S 3"]) -> bool:
    """True if a path crosses a line that must not be crossed.

    Args:
        scenario: Scenario with the lines in the map.
        points: Points of the path in order, world frame, m.
    """
    start, end = _segments(scenario)  # [n, 2] each
    if not len(start) or len(points) < 2:
        return False
    # Only lines whose bounding box meets that of the path can cross it.
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    may_cross = (np.maximum(start, end) >= low).all(1) & (np.minimum(start, end) <= high).all(1)
    a, b = points[:-1, None, :2], points[1:, None, :2]  # [S - 1, 1, 2]
    c, d = start[may_cross], end[may_cross]
    # Two segments cross if each has its ends on both sides of the other.
    parts_line = _side(a, b, c) * _side(a, b, d) < 0
    parts_path = _side(c, d, a) * _side(c, d, b) < 0
    return bool((parts_line & parts_path).any())


@cached_on_scenario
def _segments(scenario: Scenario) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Both ends of every segment of a forbidden line."""
    features = scenario.map_features
    lines = [features.polyline(i)[:, :2].astype(np.float64) for i in features.find_indices(FORBIDDEN)]
    start = np.concatenate([np.zeros((0, 2)), *(line[:-1] for line in lines)])
    end = np.concatenate([np.zeros((0, 2)), *(line[1:] for line in lines)])
    is_joined = np.linalg.norm(end - start, axis=1) <= GAP_M
    return start[is_joined], end[is_joined]


def _side(
    start: Float[np.ndarray, "... 2"], end: Float[np.ndarray, "... 2"], point: Float[np.ndarray, "... 2"]
) -> Float[np.ndarray, "..."]:
    """Cross product of a segment and the offset to a point: positive to the left, negative to the right."""
    direction, offset = end - start, point - start
    return direction[..., 0] * offset[..., 1] - direction[..., 1] * offset[..., 0]


@dataclass(frozen=True, eq=False)
class Proposal:
    """A maneuver and the goal at the end."""

    object_id: int
    maneuver: Maneuver
    position: Float[np.ndarray, "2"]
    """The goal."""
    path: Float[np.ndarray, "S 3"]
    """Path to the goal; begins at the agent."""
    is_logged: bool = False
    """True for the maneuver of the log."""


@dataclass(frozen=True, eq=False)
class CurrentAgent:
    """An agent at the current step."""

    object_id: int
    object_type: ObjectType
    pose: Pose
    speed_mps: float
    size: Float[np.ndarray, "3"]
    top_history_mps: float

    @classmethod
    def from_track(cls, scenario: Scenario, track: int) -> "CurrentAgent":
        """The agent of a track that is valid at the current step; the pose is on the ground.

        Args:
            scenario: Scenario of the track; only the history is read.
            track: Index of the track in the scenario.
        """
        tracks = scenario.tracks
        size = tracks.size[track, CURRENT_STEP].astype(np.float64)
        # Logged positions are centers of boxes, lanes lie on the ground.
        position = tracks.position[track, CURRENT_STEP].astype(np.float64) - [0.0, 0.0, size[2] / 2]
        speeds = np.linalg.norm(tracks.velocity[track, :HISTORY_STEPS], axis=-1)
        return cls(
            object_id=int(tracks.object_id[track]),
            object_type=ObjectType(int(tracks.object_type[track])),
            pose=Pose(position, float(tracks.heading[track, CURRENT_STEP])),
            speed_mps=float(speeds[CURRENT_STEP]),
            size=size,
            top_history_mps=float(speeds[tracks.valid[track, :HISTORY_STEPS]].max()),
        )


def propose_from_lanes(scenario: Scenario, track: int, road_test: RoadTest | None = None) -> tuple[Proposal, ...]:
    """A goal for each maneuver that the lanes allow, in the order of `BENCHMARK_MANEUVERS`; the future is not read.

    Args:
        scenario: Scenario with map and history.
        track: Index of a simulated track in the scenario.
        road_test: Test whether a path leaves the road; None = paths are not tested.
    """
    if no_proposal_reason(scenario, track) is not None:
        return ()
    agent = CurrentAgent.from_track(scenario, track)
    lanes = lanes_for(lane_graph(scenario), agent.object_type)
    proposals: dict[Maneuver, Proposal] = {}
    for candidate in sorted(_generate_candidates(scenario, agent, lanes), key=lambda candidate: candidate.merit):
        path = candidate.path
        if candidate.maneuver not in proposals and (road_test is None or _stays_on_road(path, agent, road_test)):
            points = path.points
            proposals[candidate.maneuver] = Proposal(agent.object_id, candidate.maneuver, points[-1, :2], points)
    return tuple(proposals[maneuver] for maneuver in BENCHMARK_MANEUVERS if maneuver in proposals)


def _stays_on_road(path: LanePath, agent: CurrentAgent, road_test: RoadTest) -> bool:
    overhang = road_test(path.points, path.heading, agent.size)  # [S], m, negative on the road
    # The goal's box is wholly on the road. On the way corners may stick out a little, and as far as at the start.
    return bool(overhang[-1] <= 0 and overhang.max() <= max(CLIPPED_M, float(overhang[0]) + CLIPPED_M))


def no_proposal_reason(scenario: Scenario, track: int) -> str | None:
    """Reason that the lanes allow no proposal for a simulated track, in words; None if proposals are possible.

    Args:
        scenario: Scenario with map and history.
        track: Index of a simulated track in the scenario.
    """
    agent = CurrentAgent.from_track(scenario, track)
    if agent.object_type not in LANE_AGENT_TYPES:
        return f"a {agent.object_type.name.lower()} does not follow lanes"
    lanes = lanes_for(lane_graph(scenario), agent.object_type)
    lane_points = own_lanes(lanes, agent.pose)
    if not lane_points:
        return f"no lane within {MAX_LANE_DISTANCE_M:g} m runs in its direction of travel"
    offset_m = float(np.linalg.norm(lanes.graph.points[lane_points[0], :2] - agent.pose.position[:2]))
    if agent.top_history_mps < PARKED_MPS and offset_m > PARKED_OFFSET_M:
        return "it stands beside its lane, probably parked"
    return None


def own_paths(agent: CurrentAgent, lanes: Lanes, *, length_m: float) -> list[LanePath]:
    """Paths along the lanes that an agent is on.

    Args:
        agent: Agent at the current step, where every path begins.
        lanes: Lanes that the agent may use.
        length_m: Greatest length of a path, m.
    """
    ease = ease_m(agent.speed_mps)
    return paths_from(lanes, agent.pose, own_lanes(lanes, agent.pose), length_m=length_m, ease_m=ease)


def distance_to(paths: Iterable[LanePath], point: Float[np.ndarray, "3"]) -> float:
    """Distance to the nearest point of any path, in the plane, m.

    Args:
        paths: Paths to measure to; at least one.
        point: Point in the world frame, m; the height is ignored.
    """
    return min(float(np.linalg.norm(path.points[:, :2] - point[:2], axis=1).min()) for path in paths)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A path up to the goal."""

    maneuver: Maneuver
    path: LanePath
    is_cut_short: bool
    """The goal lies before a turn that cannot be completed."""

    @property
    def merit(self) -> tuple[bool, float]:
        """Sort key: complete paths first, then paths that turn most like the maneuver."""
        return self.is_cut_short, abs(float(self.path.turn[-1]) - self.maneuver.usual_turn_rad)


def _generate_candidates(scenario: Scenario, agent: CurrentAgent, lanes: Lanes) -> Iterator[_Candidate]:
    # No path needs to be longer than the fastest driver gets.
    top_speed = max(agent.speed_mps, BRISK.over_limit * float(lanes.speed_limit_mps[lanes.usable].max()))
    speed_gain = BRISK.acceleration_mps2 * HORIZON_S / 2
    length_m = HORIZON_S * min(top_speed, agent.speed_mps + speed_gain) + SPARE_M
    # 1. Along the own lane and those it continues into: straight, left, right, and lanes that turn round.
    paths = own_paths(agent, lanes, length_m=length_m)
    yield from _follow_paths(paths, agent)
    if agent.object_type != ObjectType.VEHICLE:
        return
    # 2. Into the lanes beside.
    yield from _change_lanes(scenario, agent, lanes, paths, length_m)
    # 3. Round by a half circle, where a left turn is possible.
    if agent.size[0] <= LONGEST_UTURN_M:
        for path in paths:
            if (np.abs(path.turn - np.pi / 2) < np.pi / 4).any():
                uturns = _follow_paths(uturn_paths(lanes, path, length_m=length_m), agent)
                yield from (candidate for candidate in uturns if candidate.maneuver == Maneuver.LEFT_UTURN)


def _follow_paths(paths: Iterable[LanePath], agent: CurrentAgent) -> Iterator[_Candidate]:
    """Candidates that follow paths unchanged."""
    for path in paths:
        reach = compute_reach(path, agent.speed_mps)
        goal = _find_goal(path, reach)
        if goal is None:
            continue
        maneuver = classify_turn(float(path.turn[goal]))
        if maneuver is not None:
            yield _Candidate(maneuver, shorten_path(path, goal), goal < int(min(reach.usual_m, path.length_m)))


def _change_lanes(
    scenario: Scenario, agent: CurrentAgent, lanes: Lanes, paths: list[LanePath], length_m: float
) -> Iterator[_Candidate]:
    for own_path in paths:
        speed = compute_reach(own_path, agent.speed_mps).usual_m / HORIZON_S
        for maneuver, side in LANE_CHANGES:
            for path, end in lane_change_paths(lanes, own_path, side=side, speed_mps=speed, length_m=length_m):
                # The goal is as far as a usual agent gets, but after the end of the change, and before any turn.
                reach = compute_reach(path, agent.speed_mps)
                goal = max(int(reach.usual_m), end)
                if not reach.min_m <= goal <= min(reach.max_m, path.length_m) or abs(path.turn[goal]) >= STRAIGHT_RAD:
                    continue
                change = path.points[end - int(change_length_m(speed)) : goal + 1]
                has_left = distance_to(paths, path.points[goal]) >= LANE_CHANGE_OFFSET_M
                is_parallel = distance_to(paths, path.points[end]) <= MAX_LANE_GAP_M
                if has_left and is_parallel and not crosses_forbidden_line(scenario, change):
                    yield _Candidate(maneuver, shorten_path(path, goal), False)


def _find_goal(path: LanePath, reach: Reach) -> int | None:
    """Index of the goal on a path; None if no goal is in reach.

    The end of usual driving, or further on, where a turn is over. If that is out of reach, before the turn.
    """
    low = int(np.ceil(max(reach.min_m, NEAREST_GOAL_M)))
    high = int(min(reach.max_m, path.length_m))
    if high < low:
        return None
    usual_end = min(max(int(reach.usual_m), low), high)
    # A turn is over where the path has hardly bent over the last meters and hardly will over the next [S].
    turn, last = path.turn, len(path.turn) - 1
    index = np.arange(last + 1)
    next_turn = np.abs(turn[np.minimum(index + SETTLING_M, last)] - turn)
    past_turn = np.abs(turn - turn[np.maximum(index - SETTLING_M // 2, 0)])
    candidates = np.flatnonzero((next_turn <= SETTLING_RAD) & (past_turn <= SETTLING_RAD))
    later_steps = candidates[(candidates >= usual_end) & (candidates <= high)]
    earlier_steps = candidates[(candidates < usual_end) & (candidates >= low)]
    if len(later_steps):
        return int(later_steps[0])
    return int(earlier_steps[-1]) if len(earlier_steps) else usual_end


def logged_maneuver(scenario: Scenario, track: int) -> Proposal | None:
    """Logged maneuver and endpoint of a vehicle or cyclist; None for hardly any motion or no logged future.

    Turns are named by the change of heading. An agent that went straight has changed lanes if the endpoint is in a
    neighboring lane and in no lane that the own lane continues into.

    Args:
        scenario: Scenario with its logged future.
        track: Index of a simulated track in the scenario.
    """
    # 1. The logged path from the current step on, and the change of heading along it.
    tracks = scenario.tracks
    if int(tracks.object_type[track]) not in LANE_AGENT_TYPES:
        return None
    steps = CURRENT_STEP + np.flatnonzero(tracks.valid[track, CURRENT_STEP:])
    path = tracks.position[track, steps].astype(np.float64)  # [S, 3]
    if np.linalg.norm(path[-1, :2] - path[0, :2]) < NEAREST_GOAL_M:
        return None
    heading = np.unwrap(tracks.heading[track, steps].astype(np.float64))
    # 2. Its name.
    maneuver = classify_turn(float(heading[-1] - heading[0]))
    if maneuver == Maneuver.STRAIGHT:
        maneuver = _find_lane_change(scenario, track, path) or maneuver
    if maneuver is None:
        return None
    return Proposal(int(tracks.object_id[track]), maneuver, path[-1, :2], path, is_logged=True)


def _find_lane_change(scenario: Scenario, track: int, path: Float[np.ndarray, "S 3"]) -> Maneuver | None:
    """Lane change at the end of a straight path, if any."""
    agent = CurrentAgent.from_track(scenario, track)
    if agent.object_type != ObjectType.VEHICLE:
        return None
    lanes = lanes_for(lane_graph(scenario), agent.object_type)
    length_m = float(arc_length(path)[-1]) + BEYOND_END_M
    paths = own_paths(agent, lanes, length_m=length_m)
    if not paths or distance_to(paths, path[-1]) < LANE_CHANGE_OFFSET_M:
        return None
    for maneuver, side in LANE_CHANGES:
        # At speed 0 the change is as short as it can be: the path is soon in the middle of the other lane.
        changes = [lane_change_paths(lanes, start, side=side, speed_mps=0.0, length_m=length_m) for start in paths]
        neighbor_paths = [neighbor_path for candidates in changes for neighbor_path, _ in candidates]
        if neighbor_paths and distance_to(neighbor_paths, path[-1]) < IN_LANE_M:
            return maneuver
    return None
