"""Signed distance to the road edge, by the rules of the official evaluator.

For each bottom corner of a box the segment nearest in space (heights stretched) is chosen, and the distance to the
segment in the plane is signed by the side of the edge that the corner lies on. Road edges are packed once per scenario,
the search is exact. Frame: world, float32.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import box_corners
from rlftsim.realism.agents import Trajectories
from rlftsim.realism.rounding import compute_sqrt
from rlftsim.realism.segment_search import ChunkedSegments, chunk_segments, find_nearest_segment, join_chunks
from rlftsim.scenario.types import ROAD_EDGE_TYPES, MapFeatures

HEIGHT_STRETCH = 3.0
"""Factor on heights when the nearest road edge is chosen, so that agents below a bridge do not get its edge."""
OUTSIDE_M = 0.3
"""A corner this far off the road leaves the drivable area, as in nuPlan."""
MAP_END_M = 30.0
"""The map has ended where no lane, and for a planner no road edge either, is as near as this."""
CLOSED_SQUARED_M2 = 1.0
"""Polylines whose ends are nearer than this (squared, in space) are closed."""
GROUP_STEPS = 8
"""Steps of one agent whose corners share a list of nearby road edges in the search."""
SegmentArrays = tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s d"], Int64[np.ndarray, "s"]]
"""Both ends and the polyline of every segment."""


@dataclass(frozen=True, eq=False)
class Polylines:
    """L polylines with two or more points, in file order; p points and s segments in all."""

    feature: Int64[np.ndarray, "L"]
    """Index of each polyline's map feature."""
    points: Float[np.ndarray, "p 3"]
    first: Int64[np.ndarray, "L"]
    """Index of a polyline's first point."""
    count: Int64[np.ndarray, "L"]
    """Number of a polyline's points."""


def select_polylines(features: MapFeatures, types: tuple[int, ...]) -> Polylines:
    """Polylines of the given types with at least two points.

    Args:
        features: Features of the map, all points in a single array.
        types: `MapFeatureType` values of the polylines, such as road edges or lanes.
    """
    feature = features.find_indices(types)
    feature = feature[np.diff(features.offsets)[feature] >= 2]
    count = np.diff(features.offsets)[feature]
    first = np.cumsum(count) - count
    source = np.repeat(features.offsets[feature] - first, count) + np.arange(count.sum())
    return Polylines(feature, features.points[source].astype(np.float32), first, count)


def _cut_segments(polylines: Polylines) -> SegmentArrays:
    """All segments of polylines."""
    # Every point but the last one of each polyline begins a segment.
    starts = np.delete(np.arange(len(polylines.points)), polylines.first + polylines.count - 1)
    owner = np.repeat(np.arange(len(polylines.count)), polylines.count - 1)
    return polylines.points[starts], polylines.points[starts + 1], owner


@dataclass(frozen=True, eq=False)
class RoadEdges:
    """Road edges of a scenario, or of B scenarios side by side, packed for the search; s segments."""

    segments: ChunkedSegments
    start: Float[Tensor, "s 2"]
    """Starts of the segments by plain index, for the sign rule, which looks at the nearest segment's neighbors."""
    delta: Float[Tensor, "s 2"]
    """End minus start."""
    previous: Int64[Tensor, "s"]
    """Index of the segment before, or of the segment itself at an end."""
    next: Int64[Tensor, "s"]
    """Index of the segment after, likewise."""
    has_edges: Bool[Tensor, "B"] | None = None
    """False for a scenario without road edges; None = all have road edges."""


def join_road_edges(maps: Sequence[RoadEdges | None]) -> RoadEdges | None:
    """Road edges of several scenarios side by side; None if all scenarios lack road edges."""
    edged_maps = [edges for edges in maps if edges is not None]
    if not edged_maps:
        return None
    num_segments = [0 if edges is None else len(edges.previous) for edges in maps]
    first = [0, *itertools.accumulate(len(edges.previous) for edges in edged_maps)]
    has_edges = torch.tensor([edges is not None for edges in maps], device=edged_maps[0].start.device)
    return RoadEdges(
        segments=join_chunks([edges and edges.segments for edges in maps], num_segments),
        start=torch.cat([edges.start for edges in edged_maps]),
        delta=torch.cat([edges.delta for edges in edged_maps]),
        previous=torch.cat([edges.previous + i for edges, i in zip(edged_maps, first)]),
        next=torch.cat([edges.next + i for edges, i in zip(edged_maps, first)]),
        has_edges=has_edges if len(edged_maps) < len(maps) else None,
    )


def _link_neighbors(polylines: Polylines) -> tuple[Int64[np.ndarray, "s"], Int64[np.ndarray, "s"]]:
    """Index of the segment before and after each segment.

    At the ends of a polyline the neighbor is the segment itself, which does not change the sign. A closed polyline
    wraps around only if no polyline has more points: the official code wraps in an array padded to the longest
    polyline, where the neighbor in any shorter polyline is padding, which that code ignores.
    """
    num_segments = polylines.count - 1  # [L]
    head = np.cumsum(num_segments) - num_segments
    tail = head + num_segments - 1
    index = np.arange(num_segments.sum())
    previous, following = index - 1, index + 1
    ends = polylines.points[polylines.first + polylines.count - 1] - polylines.points[polylines.first]
    wraps = ((ends * ends).sum(-1) < CLOSED_SQUARED_M2) & (polylines.count == polylines.count.max())
    previous[head] = np.where(wraps, tail, head)
    following[tail] = np.where(wraps, head, tail)
    return previous, following


def build_road_edges(features: MapFeatures, device: torch.device) -> RoadEdges | None:
    """Road edges of all types, packed; None if the map has no road edge with at least two points.

    Args:
        features: Features of the map; only road edges count.
        device: Device of the tensors, that of the points to be measured.
    """
    polylines = select_polylines(features, ROAD_EDGE_TYPES)
    if len(polylines.count) == 0:
        return None
    start, end, owner = _cut_segments(polylines)
    bounds = (np.minimum(start, end), np.maximum(start, end))
    chunks = chunk_segments(start, end, owner, bounds, axis_scale=(1.0, 1.0, HEIGHT_STRETCH), device=device)
    arrays = (start[:, :2].copy(), (end - start)[:, :2].copy(), *_link_neighbors(polylines))
    return RoadEdges(chunks, *(torch.from_numpy(array).to(device) for array in arrays))


def _measure_road_edge(
    points: Float[Tensor, "P 3"], segments: ChunkedSegments, chunk: Int64[Tensor, "P"]
) -> Float[Tensor, "P U"]:
    """Squared distance, heights stretched, to the point of each segment that is nearest in the plane."""
    dx, dy, dz = (axis[chunk] for axis in segments.delta)  # [P, U]
    to_x, to_y, to_z = (points[:, axis, None] - segments.start[axis][chunk] for axis in range(3))
    projection = to_x * dx + to_y * dy
    projection.div_(segments.squared_length[chunk]).clamp_(0.0, 1.0)
    squares = to_x.sub_(projection * dx).square_().add_(to_y.sub_(projection * dy).square_())
    return squares.add_(to_z.sub_(projection * dz).mul_(HEIGHT_STRETCH).square_())


def _cross(ax: Tensor, ay: Tensor, bx: Tensor, by: Tensor) -> Tensor:
    return ax * by - ay * bx


def _compute_signed_distance(
    x: Float[Tensor, "..."], y: Float[Tensor, "..."], edges: RoadEdges, segment: Int64[Tensor, "..."]
) -> Float[Tensor, "..."]:
    """Distance in the plane to the nearest segment, negative on the left side (on the road)."""
    # 1. Distance to the segment. `projection` < 0 or > 1: the nearest point is an end of the segment.
    start, delta = edges.start[segment], edges.delta[segment]
    to_x, to_y, dx, dy = x - start[..., 0], y - start[..., 1], delta[..., 0], delta[..., 1]
    squared_length = dx * dx + dy * dy
    projection = (to_x * dx + to_y * dy) / torch.where(squared_length > 0, squared_length, 1.0)
    clipped = projection.clamp(0.0, 1.0)
    offset_x, offset_y = to_x - clipped * dx, to_y - clipped * dy
    distance = compute_sqrt(offset_x * offset_x + offset_y * offset_y)
    # 2. Sides of the segment and of its neighbor at that end: -1 left, +1 right, 0 on the line.
    is_behind = projection < 0
    following = torch.where(projection > 1, edges.next[segment], segment)
    neighbor = torch.where(is_behind, edges.previous[segment], following)
    next_start, (next_dx, next_dy) = edges.start[neighbor], edges.delta[neighbor].unbind(-1)
    side = _cross(to_x, to_y, dx, dy).sign()
    neighbor_side = _cross(x - next_start[..., 0], y - next_start[..., 1], next_dx, next_dy).sign()
    # 3. Beyond an end the corner of both segments decides: at a convex one the right side wins, else the left one.
    bend = _cross(dx, dy, next_dx, next_dy)
    bend = torch.where(is_behind, -bend, bend)  # from the earlier to the later segment
    corner = torch.where(bend > 0, torch.maximum(side, neighbor_side), torch.minimum(side, neighbor_side))
    return torch.where(neighbor == segment, side, corner) * distance


def compute_point_distance_to_road_edge(
    groups: Float[Tensor, "G Q 3"], edges: RoadEdges, *, max_pairs: int, scenario: Int64[Tensor, "G"] | None = None
) -> Float[Tensor, "G Q"]:
    """Signed distance of points to the nearest road edge, m, negative on the road (left of the edge).

    Args:
        groups: x, y, z of points, m, G groups of Q points that lie close together.
        edges: Road edges of the scenario, or of several side by side.
        max_pairs: Bound on the point-segment pairs in memory; changes no result.
        scenario: Scenario of each group, where the edges are those of several scenarios.
    """
    segment = find_nearest_segment(groups, edges.segments, _measure_road_edge, max_pairs=max_pairs, scenario=scenario)
    return _compute_signed_distance(groups[..., 0], groups[..., 1], edges, segment)


def compute_distance_to_road_edge(
    agents: Trajectories,
    size: Float[Tensor, "*#steps 3"],
    edges: RoadEdges,
    *,
    max_pairs: int,
    scenario: Int64[Tensor, "E"] | None = None,
) -> Float[Tensor, "N E T"]:
    """Signed distance of agents to the road edge, m: that of the bottom corner farthest off (or least on) the road.

    Args:
        agents: States of the evaluated agents, [N, E, T].
        size: Length, width, height of the boxes, m: [E, 1, 3] at all steps, or [N, E, T, 3].
        edges: Road edges of the scenario, or of several side by side.
        max_pairs: Bound on the point-segment pairs in memory; changes no result.
        scenario: Scenario of each agent, where the edges are those of several scenarios.
    """
    length, width, height = size.unbind(-1)  # [E, 1] each
    planar = box_corners(torch.stack([agents.x, agents.y], -1), agents.heading, length, width)  # [N, E, T, 4, 2]
    z = (agents.z - height / 2)[..., None].expand(planar.shape[:-1])
    corners = torch.cat([planar, z[..., None]], -1)  # [N, E, T, 4, 3]
    # The corners of a few steps lie close together: they make a group.
    steps = math.gcd(corners.shape[2], GROUP_STEPS)
    groups = corners.view(*corners.shape[:2], -1, 4 * steps, 3)  # [N, E, T / steps, 4 steps, 3]
    scenario = None if scenario is None else scenario[:, None].expand(groups.shape[:3]).flatten()
    distance = compute_point_distance_to_road_edge(groups.flatten(0, 2), edges, max_pairs=max_pairs, scenario=scenario)
    return distance.view(z.shape).amax(-1)
