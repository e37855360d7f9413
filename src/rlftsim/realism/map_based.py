"""Distance to the road edge, as the official evaluator defines it.

Road edges are packed once per scenario; the search over them is exact. Frame: world, float32.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from rlftsim.realism.agents import Trajectories
from rlftsim.realism.rounding import compute_sqrt
from rlftsim.realism.segment_search import ChunkedSegments, chunk_segments, find_nearest_segment
from rlftsim.scenario.types import ROAD_EDGE_TYPES, MapFeatures

HEIGHT_STRETCH = 3.0
"""Heights count this much more when the nearest road edge is chosen, so that a bridge's edge is not taken below it."""
CLOSED_SQUARED_M2 = 1.0
GROUP_STEPS = 8
"""Steps of one agent whose corners share a list of nearby road edges."""


@dataclass(frozen=True, eq=False)
class Polylines:
    """Polylines with two or more points, in file order; s segments in all."""

    feature: Int64[np.ndarray, "L"]
    """Index among the map features."""
    points: Float[np.ndarray, "p 3"]
    first: Int64[np.ndarray, "L"]
    """Index of a polyline's first point."""
    count: Int64[np.ndarray, "L"]
    """Its number of points."""


def select_polylines(features: MapFeatures, types: tuple[int, ...]) -> Polylines:
    """The polylines of the given types that have a segment at all."""
    chosen = features.indices_of(types)
    count = np.diff(features.offsets)[chosen]
    chosen, count = chosen[count >= 2], count[count >= 2]
    first = np.cumsum(count) - count
    source = np.repeat(features.offsets[chosen] - first, count) + np.arange(count.sum())
    return Polylines(chosen, features.points[source].astype(np.float32), first, count)


def _cut_segments(
    polylines: Polylines,
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"], Int64[np.ndarray, "s"]]:
    """First and last point of every segment and its polyline's index."""
    starts = np.delete(np.arange(len(polylines.points)), polylines.first + polylines.count - 1)
    owner = np.repeat(np.arange(len(polylines.count)), polylines.count - 1)
    return polylines.points[starts], polylines.points[starts + 1], owner


@dataclass(frozen=True, eq=False)
class RoadEdges:
    """Road edges of a scenario, ready to be searched."""

    segments: ChunkedSegments
    start: Float[Tensor, "s 2"]
    """Segment starts and directions once more by plain index: what the sign rule needs of the winner's neighbours."""
    delta: Float[Tensor, "s 2"]
    previous: Int64[Tensor, "s"]
    """Segment before, or the segment itself where there is none."""
    next: Int64[Tensor, "s"]
    """Segment after, likewise."""


def _link_neighbors(polylines: Polylines) -> tuple[Int64[np.ndarray, "s"], Int64[np.ndarray, "s"]]:
    """Index of the segment before and after each segment.

    At the ends a segment is its own neighbour, which leaves its sign as it is. A closed polyline wraps around only if
    it has as many points as the longest one: the official code wraps in an array padded to that length, where the
    neighbour of any shorter polyline is padding, and padding does not count.
    """
    num_segments = polylines.count - 1
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
    """Pack the road edges of every kind; None if the map has none with at least two points."""
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
    """Squared distance in space with heights stretched, to the point of the segment nearest in the plane."""
    dx, dy, dz = (axis[chunk] for axis in segments.delta)
    to_x, to_y, to_z = (points[:, axis, None] - segments.start[axis][chunk] for axis in range(3))
    along = to_x * dx + to_y * dy
    along.div_(segments.squared_length[chunk]).clamp_(0.0, 1.0)
    off_x, off_y, off_z = to_x.sub_(along * dx), to_y.sub_(along * dy), to_z.sub_(along * dz)
    off_z.mul_(HEIGHT_STRETCH)
    return off_x.square_().add_(off_y.square_()).add_(off_z.square_())


def _cross(ax: Tensor, ay: Tensor, bx: Tensor, by: Tensor) -> Tensor:
    return ax * by - ay * bx


def _compute_side(x: Tensor, y: Tensor, edges: RoadEdges, segment: Int64[Tensor, "..."]) -> Float[Tensor, "..."]:
    """-1 left of the segment's line (on the road), +1 right of it, 0 on it."""
    start, delta = edges.start[segment], edges.delta[segment]
    return _cross(x - start[..., 0], y - start[..., 1], delta[..., 0], delta[..., 1]).sign()


def _compute_signed_distance(
    x: Float[Tensor, "..."], y: Float[Tensor, "..."], edges: RoadEdges, segment: Int64[Tensor, "..."]
) -> Float[Tensor, "..."]:
    """Distance in the plane to the chosen segment, signed by the side of it or, beyond an end, of the corner there."""
    start, delta = edges.start[segment], edges.delta[segment]
    to_x, to_y, dx, dy = x - start[..., 0], y - start[..., 1], delta[..., 0], delta[..., 1]
    squared_length = dx * dx + dy * dy
    along = (to_x * dx + to_y * dy) / torch.where(squared_length > 0, squared_length, 1.0)
    clipped = along.clamp(0.0, 1.0)
    off_x, off_y = to_x - clipped * dx, to_y - clipped * dy
    distance = compute_sqrt(off_x * off_x + off_y * off_y)
    is_before = along < 0
    neighbor = torch.where(is_before, edges.previous[segment], torch.where(along > 1, edges.next[segment], segment))
    side, other_side = _cross(to_x, to_y, dx, dy).sign(), _compute_side(x, y, edges, neighbor)
    bend = _cross(dx, dy, edges.delta[neighbor][..., 0], edges.delta[neighbor][..., 1])
    bend = torch.where(is_before, -bend, bend)  # from the earlier to the later segment
    corner = torch.where(bend > 0, torch.maximum(side, other_side), torch.minimum(side, other_side))
    return torch.where(neighbor == segment, side, corner) * distance


def compute_point_distance_to_road_edge(
    groups: Float[Tensor, "G Q 3"], edges: RoadEdges, *, max_pairs: int
) -> Float[Tensor, "G Q"]:
    """Signed distance of points to the nearest road edge, m, negative on the road (left of the edge).

    Args:
        groups: x, y, z of points in groups of neighbours.
        edges: Packed road edges.
        max_pairs: Bound on the pairs held at once, see `find_nearest_segment`.
    """
    segment = find_nearest_segment(groups, edges.segments, _measure_road_edge, max_pairs=max_pairs)
    return _compute_signed_distance(groups[..., 0], groups[..., 1], edges, segment)


def compute_distance_to_road_edge(
    agents: Trajectories, size: Float[Tensor, "E 3"], edges: RoadEdges, *, max_pairs: int
) -> Float[Tensor, "N E T"]:
    """Signed distance of agents to the road edge, m: that of the bottom corner farthest off (or least on) the road.

    Args:
        agents: Evaluated agents' states, [N, E, T].
        size: Length, width, height.
        edges: Packed road edges.
        max_pairs: Bound on the pairs held at once.
    """
    half = (size / 2)[:, :, None]  # [E, 3, 1]
    along = half[:, :1] * half.new_tensor([1.0, -1.0, -1.0, 1.0])  # [E, 1, 4]
    across = half[:, 1:2] * half.new_tensor([1.0, 1.0, -1.0, -1.0])
    cos, sin = agents.heading.cos()[..., None], agents.heading.sin()[..., None]
    x = cos * along - sin * across + agents.x[..., None]  # [N, E, T, 4]
    y = sin * along + cos * across + agents.y[..., None]
    z = (agents.z - half[:, 2])[..., None].expand_as(x)
    corners = torch.stack([x, y, z], dim=-1)
    steps = math.gcd(corners.shape[2], GROUP_STEPS)
    distance = compute_point_distance_to_road_edge(corners.view(-1, 4 * steps, 3), edges, max_pairs=max_pairs)
    return distance.view(x.shape).amax(-1)
