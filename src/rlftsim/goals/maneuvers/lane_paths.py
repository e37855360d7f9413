"""Paths along the lanes from an agent's pose. Frame: world, m, float64.

A path begins at the agent's center and eases into the middle of a lane. S points, one every meter.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from jaxtyping import Bool, Float, Int64

from rlftsim.geometry import wrapped
from rlftsim.scenario.lane_graph import LaneGraph
from rlftsim.scenario.types import MapFeatureType, ObjectType

CRUISE_MPS = {
    MapFeatureType.LANE_UNDEFINED: 13.0,
    MapFeatureType.LANE_FREEWAY: 29.0,
    MapFeatureType.LANE_SURFACE_STREET: 13.0,
    MapFeatureType.LANE_BIKE: 6.0,
}
"""Usual speeds, for lanes without a known speed limit."""
CYCLIST_MPS = 6.0

SPACING_M = 1.0
AT_MOST_PATHS = 200
"""Paths from one start. Grids of short pieces have thousands, most of them alike."""
MAX_LANE_DISTANCE_M = 2.5
ALSO_M = 1.0
"""Lanes at most this much farther than the nearest one count as own lanes, too."""
SAME_DIRECTION_RAD = np.radians(45.0)
PARALLEL_RAD = np.radians(15.0)
NEIGHBOR_M = (2.3, 5.2)
"""Least and greatest distance to the middle of a neighboring lane."""
EASE_M, EASE_S = 15.0, 2.0
"""An agent beside the middle of its lane gets there over this distance or, if that is longer, in this time."""
SMOOTHED_M = 2
"""Directions are taken over so many meters ahead and behind: logged points jitter."""


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

    def after(self, head: "LanePath", index: int) -> "LanePath":
        """This path as the continuation of another one.

        Args:
            head: the path before.
            index: point of `head` at which this path takes over; excluded.
        """
        points = np.concatenate([head.points[:index], self.points])
        limits = np.concatenate([head.speed_limit_mps[:index], self.speed_limit_mps])
        return path_through(points, head.start_heading, limits)


@dataclass(frozen=True, eq=False)
class Lanes:
    """The lanes of a map, as an agent of one kind may use them."""

    graph: LaneGraph
    usable: Bool[np.ndarray, "n"]
    speed_limit_mps: Float[np.ndarray, "n"]
    """The posted limit, or the usual speed on such a lane."""


def lanes_for(graph: LaneGraph, kind: ObjectType) -> Lanes:
    """Lanes that an agent may use: cyclists all but freeways, vehicles all but bicycle lanes, pedestrians none.

    Args:
        graph: all lanes of the map.
        kind: of the agent.
    """
    barred = MapFeatureType.LANE_FREEWAY if kind == ObjectType.CYCLIST else MapFeatureType.LANE_BIKE
    usable = (graph.lane_type != barred) & (kind != ObjectType.PEDESTRIAN)
    usual = np.array([CRUISE_MPS[MapFeatureType(int(t))] for t in graph.lane_type])
    limit = np.where(graph.speed_limit_mps > 0, graph.speed_limit_mps, usual)
    return Lanes(graph, usable, np.minimum(limit, CYCLIST_MPS) if kind == ObjectType.CYCLIST else limit)


def own_lanes(lanes: Lanes, pose: Pose) -> list[int]:
    """Points of the graph, one per lane, of the lanes that an agent is on and drives along, nearest first.

    Args:
        lanes: the usable lanes.
        pose: of the agent.
    """
    graph = lanes.graph
    distance = np.linalg.norm(graph.points[:, :2] - pose.position[:2], axis=1)
    near = np.flatnonzero((distance <= MAX_LANE_DISTANCE_M) & lanes.usable[graph.owner])
    near = near[np.abs(wrapped(graph.heading[near] - pose.heading)) <= SAME_DIRECTION_RAD]
    nearest = nearest_of_each_lane(graph, near, distance)
    return [p for p in nearest if distance[p] <= distance[nearest[0]] + ALSO_M]


def neighbor_lanes(lanes: Lanes, pose: Pose, *, side: int) -> list[int]:
    """Points of the graph, one per lane, of the parallel lanes beside a pose, nearest first.

    Args:
        lanes: the usable lanes.
        pose: in the middle of a lane.
        side: 1 left, -1 right.
    """
    graph = lanes.graph
    ahead, sideways = in_frame_of(pose, graph.points)
    low, high = NEIGHBOR_M
    near = (
        (np.abs(ahead) <= SPACING_M) & (side * sideways >= low) & (side * sideways <= high) & lanes.usable[graph.owner]
    )
    near &= np.abs(wrapped(graph.heading - pose.heading)) <= PARALLEL_RAD
    return nearest_of_each_lane(graph, np.flatnonzero(near), np.hypot(ahead, sideways))


def in_frame_of(pose: Pose, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Offsets of points ahead of a pose and to its left, m.

    Args:
        pose: origin and direction of the frame.
        points: world frame.
    """
    cos, sin = np.cos(pose.heading), np.sin(pose.heading)
    x, y = (points[:, :2] - pose.position[:2]).T
    return x * cos + y * sin, y * cos - x * sin


def paths_from(lanes: Lanes, pose: Pose, starts: list[int], *, length_m: float, ease_m: float) -> list[LanePath]:
    """All paths along the lanes from a pose, none with the same lane twice.

    Args:
        lanes: the usable lanes.
        pose: the start.
        starts: points of the graph at which the paths join the lanes.
        length_m: greatest length; shorter where the lanes end.
        ease_m: distance over which a path comes to the middle of the lane.
    """
    # The bound is per start, so that one lane with thousands of continuations leaves room for the others.
    chains = ((start, chain) for start in starts for chain in islice(_chains(lanes, start, length_m), AT_MOST_PATHS))
    paths = (_path_along(lanes, pose, start, chain, length_m, ease_m) for start, chain in chains)
    return [path for path in paths if path is not None]


def ease_m(speed_mps: float) -> float:
    """Distance over which an agent comes to the middle of its lane, m."""
    return max(EASE_M, EASE_S * speed_mps)


def path_through(points: Float[np.ndarray, "n 3"], start_heading: float, limits: Float[np.ndarray, "n"]) -> LanePath:
    """A path through points that lie about 1 m apart, with its direction.

    Args:
        points: resampled to exactly 1 m.
        start_heading: heading of the agent, to which the turn is relative, rad.
        limits: speed limit at each point, m/s.
    """
    points, limits = _one_per_meter(points, limits)
    last = len(points) - 1
    index = np.arange(last + 1)
    way = points[np.minimum(index + SMOOTHED_M, last)] - points[np.maximum(index - SMOOTHED_M, 0)]
    # Unwrapped, so that a path that turns round has a turn of pi and not of -pi.
    direction = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    turn = direction - direction[0] + float(wrapped(direction[:1] - start_heading)[0])
    return LanePath(points, turn, start_heading, limits)


def smooth_step(x: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Cubic smooth step: 0 up to 0, 1 from 1 on, flat at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def shortened(path: LanePath, index: int) -> LanePath:
    """The path up to one of its points.

    Args:
        path: the whole path.
        index: the last point; included.
    """
    kept = slice(index + 1)
    return replace(path, points=path.points[kept], turn=path.turn[kept], speed_limit_mps=path.speed_limit_mps[kept])


def nearest_of_each_lane(
    graph: LaneGraph, points: Int64[np.ndarray, "m"], distance: Float[np.ndarray, "P"]
) -> list[int]:
    """Of some points of the graph the nearest of each lane, ordered by distance.

    Args:
        graph: all lanes.
        points: indices of the candidates.
        distance: of every point of the graph, m.
    """
    ordered = points[np.argsort(distance[points], kind="stable")]
    _, first = np.unique(graph.owner[ordered], return_index=True)
    return ordered[np.sort(first)].tolist()


def _chains(lanes: Lanes, start: int, length_m: float) -> Iterator[tuple[int, ...]]:
    """Sequences of lanes from a point on, depth first, until they are long enough or end."""
    graph = lanes.graph
    first = int(graph.owner[start])
    stack = [((first,), _length(graph.lines[first][start - graph.first[first] :]))]
    while stack:
        chain, length = stack.pop()
        onward = [n for n in graph.successors[chain[-1]] if n not in chain and lanes.usable[n]]
        if length >= length_m or not onward:
            yield chain
            continue
        stack += [((*chain, n), length + _length(graph.lines[n])) for n in reversed(onward)]


def _length(line: Float[np.ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())


def _path_along(
    lanes: Lanes, pose: Pose, start: int, chain: tuple[int, ...], length_m: float, ease_m: float
) -> LanePath | None:
    """The path along a chain of lanes; None where the lanes end at once."""
    graph = lanes.graph
    # 1. The middle of the lanes; the first point of each lane repeats the last one of the lane before.
    head = graph.lines[chain[0]][start - graph.first[chain[0]] :]
    lines = [head, *(graph.lines[n][1:] for n in chain[1:])]
    middle = np.concatenate(lines)  # [n, 3]
    if _length(middle) < 2 * SPACING_M:
        return None
    limits = np.repeat(lanes.speed_limit_mps[list(chain)], [len(line) for line in lines])
    middle, limits = (values[: int(length_m / SPACING_M) + 1] for values in _one_per_meter(middle, limits))
    # 2. The agent's offset from the middle at the start fades out along the path.
    offset = pose.position[:2] - middle[0, :2]
    left = 1.0 - smooth_step(SPACING_M * np.arange(len(middle)) / ease_m)
    middle[:, :2] += left[:, None] * offset
    return path_through(middle, pose.heading, limits)


def _one_per_meter(
    points: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]]:
    """A point every meter along a polyline, and the values there."""
    distance = np.append(0.0, np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).cumsum())
    at = np.arange(0.0, distance[-1] + 1e-6, SPACING_M)
    return np.stack([np.interp(at, distance, axis) for axis in points.T], -1), np.interp(at, distance, values)
