"""Paths along the lanes from an agent's pose, and the distance that it covers along one. Frame: world, m, float64.

A path begins at the agent's center and eases into the middle of a lane. Some leave the own lane: into the neighboring
lane, and back in the opposite direction. Reach is the distance by the end of a simulation, at plausible speeds.

S points, one every meter.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from jaxtyping import Bool, Float, Int64

from rlftsim.geometry import wrapped
from rlftsim.scenario.lane_graph import LaneGraph
from rlftsim.scenario.polylines import arc_length, sample_line
from rlftsim.scenario.types import FUTURE_STEPS, STEP_S, MapFeatureType, ObjectType

CRUISE_MPS = {
    MapFeatureType.LANE_UNDEFINED: 13.0,
    MapFeatureType.LANE_FREEWAY: 29.0,
    MapFeatureType.LANE_SURFACE_STREET: 13.0,
    MapFeatureType.LANE_BIKE: 6.0,
}
"""Usual speeds, for lanes without a posted speed limit."""
CYCLIST_MPS = 6.0

SPACING_M = 1.0
AT_MOST_PATHS = 200
"""Paths from a single start. Grids of short lanes have thousands, most of them alike."""
MAX_LANE_DISTANCE_M = 2.5
LANE_TOLERANCE_M = 1.0
"""Lanes at most this much farther than the nearest lane count as own lanes, too."""
SAME_DIRECTION_RAD = np.radians(45.0)
PARALLEL_RAD = np.radians(15.0)
NEIGHBOR_M = (2.3, 5.2)
"""Least and greatest distance to the middle of a neighboring lane."""
EASE_M, EASE_S = 15.0, 2.0
"""An agent off the middle of the lane gets there over this distance or, if that is longer, in this time."""
SMOOTHED_M = 2
"""Directions are taken over so many meters ahead and behind: logged points jitter."""
CHANGE_STARTS_M = (0, 10, 20, 30)
"""Where a lane change may begin; the first place with a neighboring lane is used."""
CHANGE_S = 3.5
CHANGE_M = (18.0, 100.0)
"""A lane change is as long as the drive of so many seconds, within these bounds."""
UTURN_RADIUS_M = (5.0, 15.0)
"""Radii of the U-turns of cars, at the center of the box."""
UTURN_STARTS_M = tuple(range(0, 15, 2))
"""Distances into a junction at which a U-turn may begin."""
LONGEST_UTURN_M = 7.0
"""Longer vehicles make no U-turns."""
OPPOSITE_RAD = np.radians(20.0)
TURNING_RAD, BEFORE_TURN_M = np.radians(5.0), 3
"""A turn begins so many meters before the path has turned by so much."""
HORIZON_S = FUTURE_STEPS * STEP_S
MIN_SPEED_MPS = 0.3
"""Lower bound on the speed when distances become times, so that a standing agent's arrival stays finite."""
MIN_CURVATURE = 1e-4
"""Lower bound on the curvature, rad/m, so that straight paths have a finite speed limit."""


@dataclass(frozen=True)
class Pose:
    """Position and heading (rad) of an agent or of a point of a path."""

    position: Float[np.ndarray, "3"]
    heading: float


@dataclass(frozen=True, eq=False)
class LanePath:
    """A path along lanes, S points 1 m apart."""

    points: Float[np.ndarray, "S 3"]
    turn: Float[np.ndarray, "S"]
    """Direction minus the heading at the start, turned continuously, rad."""
    start_heading: float
    speed_limit_mps: Float[np.ndarray, "S"]

    @property
    def length_m(self) -> float:
        """Length of the whole path, m."""
        return SPACING_M * (len(self.points) - 1)

    @property
    def heading(self) -> Float[np.ndarray, "S"]:
        """Direction at each point, rad; not wrapped."""
        return self.start_heading + self.turn

    @property
    def curvature(self) -> Float[np.ndarray, "S"]:
        """Change of direction per meter, rad/m."""
        return np.gradient(self.turn, SPACING_M) if len(self.turn) > 1 else np.zeros(len(self.turn))

    def pose(self, index: int) -> Pose:
        """Pose at a point of the path."""
        return Pose(self.points[index], float(self.heading[index]))

    def prepend(self, head: "LanePath", index: int) -> "LanePath":
        """This path as the continuation of the beginning of `head`.

        Args:
            head: Path that comes first; the heading at the start of `head` counts for the turn.
            index: Point of `head` at which this path takes over; excluded.
        """
        points = np.concatenate([head.points[:index], self.points])
        limits = np.concatenate([head.speed_limit_mps[:index], self.speed_limit_mps])
        return path_through(points, head.start_heading, limits)


@dataclass(frozen=True, eq=False)
class Lanes:
    """The lanes of a map for agents of a single type."""

    graph: LaneGraph
    usable: Bool[np.ndarray, "n"]
    speed_limit_mps: Float[np.ndarray, "n"]
    """The posted limit, or the usual speed on such a lane."""


def lanes_for(graph: LaneGraph, agent_type: ObjectType) -> Lanes:
    """Lanes that an agent may use: cyclists all but freeways, vehicles all but bicycle lanes, pedestrians none.

    Args:
        graph: All lanes of the map.
        agent_type: Type of the agent, which decides on lanes and speed limits.
    """
    barred = MapFeatureType.LANE_FREEWAY if agent_type == ObjectType.CYCLIST else MapFeatureType.LANE_BIKE
    usable = (graph.lane_type != barred) & (agent_type != ObjectType.PEDESTRIAN)
    cruise_mps = np.array([CRUISE_MPS[MapFeatureType(int(t))] for t in graph.lane_type])
    limit = np.where(graph.speed_limit_mps > 0, graph.speed_limit_mps, cruise_mps)
    return Lanes(graph, usable, np.minimum(limit, CYCLIST_MPS) if agent_type == ObjectType.CYCLIST else limit)


def own_lanes(lanes: Lanes, pose: Pose) -> list[int]:
    """Points of the graph, one per lane, of the lanes that an agent is on and drives along, nearest first.

    Args:
        lanes: Lanes that the agent may use.
        pose: Current pose of the agent.
    """
    graph = lanes.graph
    distance = np.linalg.norm(graph.points[:, :2] - pose.position[:2], axis=1)
    candidates = np.flatnonzero((distance <= MAX_LANE_DISTANCE_M) & lanes.usable[graph.owner])
    candidates = candidates[np.abs(wrapped(graph.heading[candidates] - pose.heading)) <= SAME_DIRECTION_RAD]
    nearest = nearest_per_lane(graph, candidates, distance)
    return [p for p in nearest if distance[p] <= distance[nearest[0]] + LANE_TOLERANCE_M]


def neighbor_lanes(lanes: Lanes, pose: Pose, *, side: int) -> list[int]:
    """Points of the graph, one per lane, of the parallel lanes beside a pose, nearest first.

    Args:
        lanes: Lanes that the agent may use.
        pose: Pose in the middle of a lane.
        side: Side of the pose: 1 left, -1 right.
    """
    graph = lanes.graph
    x, y = to_pose_frame(pose, graph.points)
    low, high = NEIGHBOR_M
    is_neighbor = (np.abs(x) <= SPACING_M) & (side * y >= low) & (side * y <= high) & lanes.usable[graph.owner]
    is_neighbor &= np.abs(wrapped(graph.heading - pose.heading)) <= PARALLEL_RAD
    return nearest_per_lane(graph, np.flatnonzero(is_neighbor), np.hypot(x, y))


def to_pose_frame(pose: Pose, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 n"]:
    """Coordinates of points in the frame of a pose, m: x ahead, y to the left.

    Args:
        pose: Origin and direction of the frame.
        points: Points in the world frame, m.
    """
    cos, sin = np.cos(pose.heading), np.sin(pose.heading)
    x, y = (points[:, :2] - pose.position[:2]).T
    return np.stack([x * cos + y * sin, y * cos - x * sin])


def paths_from(lanes: Lanes, pose: Pose, starts: list[int], *, length_m: float, ease_m: float) -> list[LanePath]:
    """All paths along the lanes from a pose, none with the same lane twice.

    Args:
        lanes: Lanes that the agent may use.
        pose: Pose at the start of every path.
        starts: Points of the graph at which the paths join the lanes.
        length_m: Greatest length of a path, m; shorter where the lanes end.
        ease_m: Distance over which a path comes to the middle of the lane, m.
    """
    # The bound is per start, so that one lane with thousands of continuations leaves room for the others.
    chains = ((start, chain) for start in starts for chain in islice(_chains(lanes, start, length_m), AT_MOST_PATHS))
    paths = (_follow_chain(lanes, pose, start, chain, length_m, ease_m) for start, chain in chains)
    return [path for path in paths if path is not None]


def ease_m(speed_mps: float) -> float:
    """Distance over which an agent comes to the middle of the lane, m."""
    return max(EASE_M, EASE_S * speed_mps)


def path_through(points: Float[np.ndarray, "n 3"], start_heading: float, limits: Float[np.ndarray, "n"]) -> LanePath:
    """A path with directions through points that lie about 1 m apart.

    Args:
        points: Points of the path in order, m; resampled to exactly 1 m.
        start_heading: Heading of the agent, to which the turn is relative, rad.
        limits: Speed limit at each point, m/s.
    """
    points, limits = _resample(points, limits)
    last = len(points) - 1
    index = np.arange(last + 1)
    chord = points[np.minimum(index + SMOOTHED_M, last)] - points[np.maximum(index - SMOOTHED_M, 0)]
    # Unwrapped, so that a path that turns round has a turn of pi and not of -pi.
    direction = np.unwrap(np.arctan2(chord[:, 1], chord[:, 0]))
    turn = direction - direction[0] + float(wrapped(direction[:1] - start_heading)[0])
    return LanePath(points, turn, start_heading, limits)


def shorten_path(path: LanePath, index: int) -> LanePath:
    """The path up to one of the points.

    Args:
        path: Path to cut, from the agent on.
        index: Last point of the result; included.
    """
    steps = slice(index + 1)
    return replace(path, points=path.points[steps], turn=path.turn[steps], speed_limit_mps=path.speed_limit_mps[steps])


def nearest_per_lane(graph: LaneGraph, points: Int64[np.ndarray, "m"], distance: Float[np.ndarray, "P"]) -> list[int]:
    """The nearest of the candidate points on each lane, ordered by distance.

    Args:
        graph: All lanes of the map.
        points: Indices of the candidates among the points of the graph.
        distance: Distance of every point of the graph, m.
    """
    points = points[np.argsort(distance[points], kind="stable")]
    _, first = np.unique(graph.owner[points], return_index=True)
    return points[np.sort(first)].tolist()


def _chains(lanes: Lanes, start: int, length_m: float) -> Iterator[tuple[int, ...]]:
    """Sequences of lanes from a point on, depth first, each until long enough or at an end."""
    graph = lanes.graph
    first = int(graph.owner[start])
    stack = [((first,), arc_length(graph.lines[first][start - graph.first[first] :])[-1])]
    while stack:
        chain, length = stack.pop()
        successors = [n for n in graph.successors[chain[-1]] if n not in chain and lanes.usable[n]]
        if length >= length_m or not successors:
            yield chain
            continue
        stack += [((*chain, n), length + arc_length(graph.lines[n])[-1]) for n in reversed(successors)]


def _follow_chain(
    lanes: Lanes, pose: Pose, start: int, chain: tuple[int, ...], length_m: float, ease_m: float
) -> LanePath | None:
    """The path along a chain of lanes; None where the lanes end at once."""
    graph = lanes.graph
    # 1. The middle of the lanes; the first point of each lane repeats the last one of the lane before.
    head = graph.lines[chain[0]][start - graph.first[chain[0]] :]
    lines = [head, *(graph.lines[n][1:] for n in chain[1:])]
    middle = np.concatenate(lines)  # [n, 3]
    if arc_length(middle)[-1] < 2 * SPACING_M:
        return None
    limits = np.repeat(lanes.speed_limit_mps[list(chain)], [len(line) for line in lines])
    middle, limits = (values[: int(length_m / SPACING_M) + 1] for values in _resample(middle, limits))
    # 2. The agent's offset from the middle at the start fades out along the path.
    offset = pose.position[:2] - middle[0, :2]
    eased = np.clip(SPACING_M * np.arange(len(middle)) / ease_m, 0.0, 1.0)
    fade = 1.0 - eased * eased * (3.0 - 2.0 * eased)  # a cubic smooth step
    middle[:, :2] += fade[:, None] * offset
    return path_through(middle, pose.heading, limits)


def _resample(
    points: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]]:
    """A point every meter along a polyline, and the values there."""
    sampled = sample_line(np.column_stack([points, values]), SPACING_M)
    return sampled[:, :3], sampled[:, 3]


def change_length_m(speed_mps: float) -> float:
    """Distance that a lane change takes at a speed, m."""
    return float(np.clip(CHANGE_S * speed_mps, *CHANGE_M))


def lane_change_paths(
    lanes: Lanes, own_path: LanePath, *, side: int, speed_mps: float, length_m: float
) -> list[tuple[LanePath, int]]:
    """Paths into the lane beside a path, each with the index at which the change is complete.

    Args:
        lanes: Lanes that the agent may use.
        own_path: Path along the own lane, from the agent on.
        side: Side of the neighboring lane: 1 left, -1 right.
        speed_mps: Speed during the change, m/s; faster changes are longer.
        length_m: Greatest length of a path, m.
    """
    change_m = change_length_m(speed_mps)
    for start in CHANGE_STARTS_M:
        if start + change_m > min(length_m, own_path.length_m + change_m):
            break
        pose = own_path.pose(start)
        entries = neighbor_lanes(lanes, pose, side=side)
        if entries:
            paths = paths_from(lanes, pose, entries, length_m=length_m - start, ease_m=change_m)
            return [(path.prepend(own_path, start), start + int(change_m / SPACING_M)) for path in paths]
    return []


def uturn_paths(lanes: Lanes, left_turn: LanePath, *, length_m: float) -> list[LanePath]:
    """U-turns to the left, by a half circle where a path turns left, into lanes of the opposite direction.

    Args:
        lanes: Lanes that the agent may use.
        left_turn: Path that turns left, from the agent on.
        length_m: Greatest length of a path, m.
    """
    # 1. The entry: a little before the path begins to turn, in the leftmost lane.
    bends = np.flatnonzero(np.abs(left_turn.turn - left_turn.turn[0]) >= TURNING_RAD)
    first = max(int(bends[0]) - BEFORE_TURN_M, 0) if len(bends) else len(left_turn.turn) - 1
    entry = left_turn.pose(first)
    if neighbor_lanes(lanes, entry, side=1):
        return []
    forward = np.array([np.cos(entry.heading), np.sin(entry.heading), 0.0])
    paths = []
    for depth in UTURN_STARTS_M:
        # 2. Straight on into the junction, then a half circle to each opposite lane within reach.
        pose = Pose(entry.position + depth * forward, entry.heading)
        straight = entry.position + SPACING_M * np.arange(depth)[:, None] * forward  # [depth, 3], last point left out
        for point, radius in _find_opposite_lanes(lanes, pose):
            half_circle = _half_circle(pose, radius)
            head = np.concatenate([left_turn.points[:first], straight, half_circle])
            limits = np.full(len(head), left_turn.speed_limit_mps[first])
            # 3. On along the opposite lane.
            end = Pose(half_circle[-1], pose.heading + np.pi)
            for tail in paths_from(lanes, end, [point], length_m=length_m - len(head) * SPACING_M, ease_m=EASE_M):
                points = np.concatenate([head, tail.points[1:]])
                limits_mps = np.append(limits, tail.speed_limit_mps[1:])
                paths.append(path_through(points, left_turn.start_heading, limits_mps))
    return paths


def _find_opposite_lanes(lanes: Lanes, pose: Pose) -> list[tuple[int, float]]:
    """Points on opposite lanes to the left, with the radius of the half circle there, nearest first."""
    graph = lanes.graph
    x, y = to_pose_frame(pose, graph.points)
    low, high = UTURN_RADIUS_M
    is_opposite = (np.abs(x) <= SPACING_M) & (y >= 2 * low) & (y <= 2 * high) & lanes.usable[graph.owner]
    is_opposite &= np.abs(wrapped(graph.heading - pose.heading - np.pi)) <= OPPOSITE_RAD
    return [(point, float(y[point]) / 2) for point in nearest_per_lane(graph, np.flatnonzero(is_opposite), y)]


def _half_circle(pose: Pose, radius: float) -> Float[np.ndarray, "n 3"]:
    """Points of a half circle to the left of a pose, beginning there."""
    angle = np.linspace(0.0, np.pi, int(np.ceil(np.pi * radius / SPACING_M)) + 1)
    # In the frame of the pose, then rotated and moved into the world.
    x, y = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    cos, sin = np.cos(pose.heading), np.sin(pose.heading)
    offset = np.stack([x * cos - y * sin, x * sin + y * cos, np.zeros_like(angle)], -1)
    return pose.position + offset


@dataclass(frozen=True)
class Drive:
    """A driving style: largest accelerations and speeds."""

    acceleration_mps2: float
    braking_mps2: float
    sideways_mps2: float
    """In curves."""
    over_limit: float
    """Factor on speed limits."""


USUAL = Drive(acceleration_mps2=1.2, braking_mps2=2.0, sideways_mps2=2.0, over_limit=1.0)
BRISK = Drive(acceleration_mps2=2.5, braking_mps2=4.0, sideways_mps2=3.5, over_limit=1.2)
"""The fastest style that is still plausible."""


@dataclass(frozen=True)
class Reach:
    """Distances along a path that are plausible after `HORIZON_S`, m."""

    min_m: float
    """Braking all the way."""
    usual_m: float
    max_m: float


def compute_reach(path: LanePath, speed_mps: float) -> Reach:
    """Smallest, usual and greatest plausible distance along a path after `HORIZON_S`.

    Args:
        path: Path that an agent can take; distances count from the first point.
        speed_mps: Speed of the agent at the first point, m/s.
    """
    max_m = min(_compute_distance(path, speed_mps, BRISK), _find_tight_curve(path, speed_mps, BRISK))
    usual_m = min(_compute_distance(path, speed_mps, USUAL), max_m)
    return Reach(min(speed_mps**2 / (2 * BRISK.braking_mps2), max_m), usual_m, max_m)


def _compute_distance(path: LanePath, speed_mps: float, drive: Drive) -> float:
    """Distance after `HORIZON_S` at the highest allowed speeds; at most the length of the path."""
    # 1. Speed that curves and limits allow at each point [S]; an agent above the limit now may keep its speed.
    curve_speed = np.sqrt(drive.sideways_mps2 / np.maximum(np.abs(path.curvature), MIN_CURVATURE))
    max_speed = np.minimum(curve_speed, np.maximum(path.speed_limit_mps * drive.over_limit, speed_mps))
    # 2. Constant acceleration is linear in (squared speed, distance), v² = v0² + 2 a s: one backward pass keeps the
    #    braking in time for what comes, one forward pass the acceleration from the start.
    squared_speed = _running_bound(max_speed[::-1] ** 2, 2 * drive.braking_mps2)[::-1]
    squared_speed[0] = min(squared_speed[0], speed_mps**2)
    # 3. Time of arrival at each point, inverted at the horizon.
    speed = np.sqrt(_running_bound(squared_speed, 2 * drive.acceleration_mps2))
    pace = SPACING_M / np.maximum((speed[1:] + speed[:-1]) / 2, MIN_SPEED_MPS)
    arrival_s = np.append(0.0, pace.cumsum())
    return float(np.interp(HORIZON_S, arrival_s, SPACING_M * np.arange(len(speed))))


def _running_bound(squared_speed: Float[np.ndarray, "S"], gain: float) -> Float[np.ndarray, "S"]:
    """Squared speeds, lowered until none exceeds an earlier squared speed by more than `gain` per meter between."""
    slope = gain * SPACING_M * np.arange(len(squared_speed))
    return np.minimum.accumulate(squared_speed - slope) + slope


def _find_tight_curve(path: LanePath, speed_mps: float, drive: Drive) -> float:
    """Distance to the first point where the curve is too tight even after full braking; else infinite."""
    squared_bound = drive.sideways_mps2 / np.maximum(np.abs(path.curvature), MIN_CURVATURE)
    squared_speed = speed_mps**2 - 2 * drive.braking_mps2 * SPACING_M * np.arange(len(squared_bound))
    steps = np.flatnonzero(squared_speed > squared_bound)
    return float(SPACING_M * steps[0]) if len(steps) else float("inf")
