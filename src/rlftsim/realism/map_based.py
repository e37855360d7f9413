"""Signed distance to the road edge, as the official evaluator defines it.

For each bottom corner of a box the segment nearest in space (heights stretched) is chosen, and the distance to it in
the plane is signed by the side of the edge that the corner lies on. Road edges are packed once per scenario, the
search over them is exact. Frame: world, float32.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.realism.agents import Trajectories
from rlftsim.realism.rounding import compute_sqrt
from rlftsim.realism.segment_search import ChunkedSegments, chunk_segments, find_nearest_segment, join_chunks
from rlftsim.scenario.types import ROAD_EDGE_TYPES, MapFeatures

HEIGHT_STRETCH = 3.0
"""Factor on heights when the nearest road edge is chosen, so that agents below a bridge do not get its edge."""
CLOSED_SQUARED_M2 = 1.0
"""Polylines whose ends are nearer than this (squared, in space) are closed."""
GROUP_STEPS = 8
"""Steps of one agent whose corners share a list of nearby road edges in the search."""


@dataclass(frozen=True, eq=False)
class Polylines:
    """L polylines with two or more points, in file order; p points and s segments in all."""

    feature: Int64[np.ndarray, "L"]
    """Index of its map feature."""
    points: Float[np.ndarray, "p 3"]
    first: Int64[np.ndarray, "L"]
    """Index of a polyline's first point."""
    count: Int64[np.ndarray, "L"]
    """Its number of points."""


def select_polylines(features: MapFeatures, types: tuple[int, ...]) -> Polylines:
    """Polylines of the given types that have at least one segment.

    Args:
        features: of the map.
        types: `MapFeatureType` values.
    """
    chosen = features.indices_of(types)
    count = np.diff(features.offsets)[chosen]
    chosen, count = chosen[count >= 2], count[count >= 2]
    first = np.cumsum(count) - count
    source = np.repeat(features.offsets[chosen] - first, count) + np.arange(count.sum())
    return Polylines(chosen, features.points[source].astype(np.float32), first, count)


def _cut_segments(
    polylines: Polylines,
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"], Int64[np.ndarray, "s"]]:
    """Both ends of every segment, and its polyline."""
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
    is_known: Bool[Tensor, "B"] | None = None
    """False for a scenario without road edges; None = all have some."""


def join_road_edges(parts: Sequence[RoadEdges | None]) -> RoadEdges | None:
    """Road edges of several scenarios side by side; None if none of them has any."""
    known = [part for part in parts if part is not None]
    if not known:
        return None
    num_segments = [0 if part is None else len(part.previous) for part in parts]
    first = [0, *itertools.accumulate(len(part.previous) for part in known)]
    is_known = torch.tensor([part is not None for part in parts], device=known[0].start.device)
    return RoadEdges(
        segments=join_chunks([part and part.segments for part in parts], num_segments),
        start=torch.cat([part.start for part in known]),
        delta=torch.cat([part.delta for part in known]),
        previous=torch.cat([part.previous + i for part, i in zip(known, first)]),
        next=torch.cat([part.next + i for part, i in zip(known, first)]),
        is_known=is_known if len(known) < len(parts) else None,
    )


def _link_neighbors(polylines: Polylines) -> tuple[Int64[np.ndarray, "s"], Int64[np.ndarray, "s"]]:
    """Index of the segment before and after each segment.

    At the ends a segment is its own neighbor, which leaves its sign as it is. A closed polyline wraps around only if
    it has as many points as the longest one: the official code wraps in an array padded to that length, where the
    neighbor in any shorter polyline is padding, which it ignores.
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
    """Road edges of every kind, packed; None if the map has none with at least two points.

    Args:
        features: of the map.
        device: where the tensors go.
    """
    polylines = select_polylines(features, ROAD_EDGE_TYPES)
    if len(polylines.count) == 0:
        return None
    start, end, owner = _cut_segments(polylines)
    bounds = (np.minimum(start, end), np.maximum(start, end))
    previous, following = _link_neighbors(polylines)
    return RoadEdges(
        segments=chunk_segments(start, end, owner, bounds, axis_scale=(1.0, 1.0, HEIGHT_STRETCH), device=device),
        start=torch.from_numpy(start[:, :2].copy()).to(device),
        delta=torch.from_numpy((end - start)[:, :2].copy()).to(device),
        previous=torch.from_numpy(previous).to(device),
        next=torch.from_numpy(following).to(device),
    )


def _measure_road_edge(
    points: Float[Tensor, "P 3"], segments: ChunkedSegments, chunk: Int64[Tensor, "P"]
) -> Float[Tensor, "P U"]:
    """Squared distance, heights stretched, to the point of each segment that is nearest in the plane."""
    dx, dy, dz = (axis[chunk] for axis in segments.delta)  # [P, U]
    to_x, to_y, to_z = (points[:, axis, None] - segments.start[axis][chunk] for axis in range(3))
    along = to_x * dx + to_y * dy
    along.div_(segments.squared_length[chunk]).clamp_(0.0, 1.0)
    off_x, off_y, off_z = to_x.sub_(along * dx), to_y.sub_(along * dy), to_z.sub_(along * dz)
    off_z.mul_(HEIGHT_STRETCH)
    return off_x.square_().add_(off_y.square_()).add_(off_z.square_())


def _cross(ax: Tensor, ay: Tensor, bx: Tensor, by: Tensor) -> Tensor:
    return ax * by - ay * bx


def _compute_signed_distance(
    x: Float[Tensor, "..."], y: Float[Tensor, "..."], edges: RoadEdges, segment: Int64[Tensor, "..."]
) -> Float[Tensor, "..."]:
    """Distance in the plane to the nearest segment, negative to its left (on the road)."""
    # 1. Distance to the segment. `along` < 0 or > 1: the nearest point is one of its ends.
    start, delta = edges.start[segment], edges.delta[segment]
    to_x, to_y, dx, dy = x - start[..., 0], y - start[..., 1], delta[..., 0], delta[..., 1]
    squared_length = dx * dx + dy * dy
    along = (to_x * dx + to_y * dy) / torch.where(squared_length > 0, squared_length, 1.0)
    clipped = along.clamp(0.0, 1.0)
    off_x, off_y = to_x - clipped * dx, to_y - clipped * dy
    distance = compute_sqrt(off_x * off_x + off_y * off_y)
    # 2. Sides of the segment and of its neighbor at that end: -1 left, +1 right, 0 on the line.
    is_before = along < 0
    neighbor = torch.where(is_before, edges.previous[segment], torch.where(along > 1, edges.next[segment], segment))
    next_start, (next_dx, next_dy) = edges.start[neighbor], edges.delta[neighbor].unbind(-1)
    side = _cross(to_x, to_y, dx, dy).sign()
    other_side = _cross(x - next_start[..., 0], y - next_start[..., 1], next_dx, next_dy).sign()
    # 3. Beyond an end the corner of both segments decides: at a convex one the right side wins, else the left one.
    bend = _cross(dx, dy, next_dx, next_dy)
    bend = torch.where(is_before, -bend, bend)  # from the earlier to the later segment
    corner = torch.where(bend > 0, torch.maximum(side, other_side), torch.minimum(side, other_side))
    return torch.where(neighbor == segment, side, corner) * distance


def compute_point_distance_to_road_edge(
    groups: Float[Tensor, "G Q 3"], edges: RoadEdges, *, max_pairs: int, scenario: Int64[Tensor, "G"] | None = None
) -> Float[Tensor, "G Q"]:
    """Signed distance of points to the nearest road edge, m, negative on the road (left of the edge).

    Args:
        groups: x, y, z of points, G groups of Q nearby ones.
        edges: packed road edges.
        max_pairs: memory bound, see `find_nearest_segment`.
        scenario: of each group, where the edges are those of several.
    """
    segment = find_nearest_segment(groups, edges.segments, _measure_road_edge, max_pairs=max_pairs, scenario=scenario)
    return _compute_signed_distance(groups[..., 0], groups[..., 1], edges, segment)


def compute_distance_to_road_edge(
    agents: Trajectories,
    size: Float[Tensor, "E 3"],
    edges: RoadEdges,
    *,
    max_pairs: int,
    scenario: Int64[Tensor, "E"] | None = None,
) -> Float[Tensor, "N E T"]:
    """Signed distance of agents to the road edge, m: that of the bottom corner farthest off (or least on) the road.

    Args:
        agents: states of the evaluated agents, [N, E, T].
        size: length, width, height.
        edges: packed road edges.
        max_pairs: memory bound, see `find_nearest_segment`.
        scenario: of each agent, where the edges are those of several.
    """
    half_length, half_width, half_height = (size / 2)[:, :, None].unbind(1)  # [E, 1] each
    along = torch.stack([half_length, -half_length, -half_length, half_length], -1)  # [E, 1, 4]
    across = torch.stack([half_width, half_width, -half_width, -half_width], -1)
    cos, sin = agents.heading.cos()[..., None], agents.heading.sin()[..., None]
    x = cos * along - sin * across + agents.x[..., None]  # [N, E, T, 4]
    y = sin * along + cos * across + agents.y[..., None]
    z = (agents.z - half_height)[..., None].expand_as(x)
    corners = torch.stack([x, y, z], dim=-1)  # [N, E, T, 4, 3]
    # The corners of a few steps lie close together: they make a group.
    steps = math.gcd(corners.shape[2], GROUP_STEPS)
    groups = corners.view(*corners.shape[:2], -1, 4 * steps, 3)  # [N, E, T / steps, 4 steps, 3]
    of_group = None if scenario is None else scenario[:, None].expand(groups.shape[:3]).flatten()
    distance = compute_point_distance_to_road_edge(groups.flatten(0, 2), edges, max_pairs=max_pairs, scenario=of_group)
    return distance.view(x.shape).amax(-1)
