"""Distance to the road edge and traffic light violations, as the official evaluator defines them.

The map's parts are packed once per scenario (`build_road_edges`, `build_signals`); the searches over them are exact.
Frame: world, float32.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.realism.agents import Trajectories
from rlftsim.realism.segment_search import ChunkedSegments, chunk_segments, find_nearest_segment
from rlftsim.scenario.types import ROAD_EDGE_TYPES, TOTAL_STEPS, LightState, LightStates, MapFeatures, MapFeatureType

HEIGHT_STRETCH = 3.0
"""Heights count this much more when the nearest road edge is chosen, so that a bridge's edge is not taken from below."""
CLOSED_SQUARED_M2 = 1.0
RED_STATES = (LightState.ARROW_STOP, LightState.STOP)
"""Flashing stop is not red."""


@dataclass(frozen=True, eq=False)
class _Polylines:
    """Polylines with two or more points, in file order; s segments in all."""

    feature: Int64[np.ndarray, "L"]
    """Index among the map features."""
    points: Float[np.ndarray, "p 3"]
    first: Int64[np.ndarray, "L"]
    """Index of a polyline's first point."""
    count: Int64[np.ndarray, "L"]
    """Its number of points."""


def _select_polylines(features: MapFeatures, types: tuple[int, ...]) -> _Polylines:
    chosen = features.indices_of(types)
    count = np.diff(features.offsets)[chosen]
    chosen, count = chosen[count >= 2], count[count >= 2]
    first = np.cumsum(count) - count
    source = np.repeat(features.offsets[chosen] - first, count) + np.arange(count.sum())
    return _Polylines(chosen, features.points[source].astype(np.float32), first, count)


def _cut_segments(
    polylines: _Polylines,
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


def _link_neighbors(polylines: _Polylines) -> tuple[Int64[np.ndarray, "s"], Int64[np.ndarray, "s"]]:
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
    polylines = _select_polylines(features, ROAD_EDGE_TYPES)
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
    """Distance in space with heights stretched, to the point of the segment nearest in the plane."""
    dx, dy, dz = (axis[chunk] for axis in segments.delta)
    to_x, to_y, to_z = (points[:, axis, None] - segments.start[axis][chunk] for axis in range(3))
    along = to_x * dx + to_y * dy
    along.div_(segments.squared_length[chunk]).clamp_(0.0, 1.0)
    off_x, off_y, off_z = to_x.sub_(along * dx), to_y.sub_(along * dy), to_z.sub_(along * dz)
    off_z.mul_(HEIGHT_STRETCH)
    return off_x.square_().add_(off_y.square_()).add_(off_z.square_()).sqrt_()


def _cross(ax: Tensor, ay: Tensor, bx: Tensor, by: Tensor) -> Tensor:
    return ax * by - ay * bx


def _compute_side(x: Tensor, y: Tensor, edges: RoadEdges, segment: Int64[Tensor, "..."]) -> Float[Tensor, "..."]:
    """-1 left of the segment's line (on the road), +1 right of it, 0 on it."""
    start, delta = edges.start[segment], edges.delta[segment]
    return _cross(x - start[..., 0], y - start[..., 1], delta[..., 0], delta[..., 1]).sign()


def _compute_signed_distance(
    x: Float[Tensor, "..."], y: Float[Tensor, "..."], edges: RoadEdges, segment: Int64[Tensor, "..."]
) -> Float[Tensor, "..."]:
    """Distance in the plane to the chosen segment, signed by the side of it or, beyond its ends, of the corner there."""
    start, delta = edges.start[segment], edges.delta[segment]
    to_x, to_y, dx, dy = x - start[..., 0], y - start[..., 1], delta[..., 0], delta[..., 1]
    squared_length = dx * dx + dy * dy
    along = (to_x * dx + to_y * dy) / torch.where(squared_length > 0, squared_length, 1.0)
    clipped = along.clamp(0.0, 1.0)
    off_x, off_y = to_x - clipped * dx, to_y - clipped * dy
    distance = (off_x * off_x + off_y * off_y).sqrt()
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


GROUP_STEPS = 8
"""Steps of one agent whose corners share a list of nearby road edges."""


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


@dataclass(frozen=True, eq=False)
class Signals:
    """Traffic lights of surface-street lanes over the steps of a record, and the lanes to find agents on.

    S steps (91), J signals.
    """

    lanes: ChunkedSegments
    lane_of_segment: Int64[Tensor, "s"]
    lane: Int64[Tensor, "J"]
    """Index of a signal's lane among the surface-street lanes, as in `lane_of_segment`."""
    is_red: Bool[Tensor, "S J"]
    stop_start: Float[Tensor, "S J 2"]
    """The segment of the signal's lane nearest to its stop point: start and direction over squared length."""
    stop_direction: Float[Tensor, "S J 2"]
    stop_squared_length: Float[Tensor, "S J"]
    stop_progress: Float[Tensor, "S J"]
    """Where the stop point projects on that segment, in segment lengths."""


def _measure_lane(
    points: Float[Tensor, "P 2"], segments: ChunkedSegments, chunk: Int64[Tensor, "P"]
) -> Float[Tensor, "P U"]:
    """The official rule, which is not a distance: it steps from the segment's start away from the projection.

    It amounts to the nearest segment start, with starts ahead of or abreast of the point preferred. It is never below
    the distance to the segment's start.
    """
    dx, dy = (axis[chunk] for axis in segments.delta)
    to_x, to_y = (points[:, axis, None] - segments.start[axis][chunk] for axis in range(2))
    along = ((to_x * dx + to_y * dy) / segments.squared_length[chunk]).clamp_(0.0, 1.0)
    off_x, off_y = to_x + along * dx, to_y + along * dy
    return (off_x * off_x + off_y * off_y).sqrt_()


def _cut_lane_segments(
    lanes: _Polylines,
) -> tuple[Float[np.ndarray, "s 2"], Float[np.ndarray, "s 2"], Int64[np.ndarray, "s"]]:
    """Segments of lanes in the plane, with the one the official code adds to every lane but the longest.

    Lanes are padded with zeros to the longest one there and a segment counts if its start is real: a shorter lane gets
    a segment from its last point to the world's origin.
    """
    ends = np.append(lanes.points[1:, :2], np.zeros((1, 2), np.float32), axis=0)
    last = lanes.first + lanes.count - 1
    ends[last] = 0.0
    keep = np.ones(len(lanes.points), bool)
    keep[last] = lanes.count < lanes.count.max()
    owner = np.repeat(np.arange(len(lanes.count)), lanes.count)
    return lanes.points[keep, :2], ends[keep], owner[keep]


def _tabulate_lights(
    lights: LightStates,
) -> tuple[Int64[np.ndarray, "J"], Int64[np.ndarray, "S J"], Float[np.ndarray, "S J 2"]]:
    """Lane ids, states and stop points per step; where a light is not observed state 0 (unknown) and point (0, 0)."""
    lane_ids, column = np.unique(lights.lane_id, return_inverse=True)
    state = np.zeros((TOTAL_STEPS, len(lane_ids)), np.int64)
    stop = np.zeros((TOTAL_STEPS, len(lane_ids), 2), np.float32)
    within = lights.step < TOTAL_STEPS
    state[lights.step[within], column[within]] = lights.state[within]
    stop[lights.step[within], column[within]] = lights.stop_point[within, :2]
    return lane_ids, state, stop


def _project_stop_points(
    lanes: tuple[Float[np.ndarray, "s 2"], Float[np.ndarray, "s 2"], Int64[np.ndarray, "s"]],
    lane: Int64[np.ndarray, "J"],
    stop: Float[np.ndarray, "S J 2"],
) -> tuple[Float[np.ndarray, "S J 2"], Float[np.ndarray, "S J 2"]]:
    """Start and direction of the segment of each signal's own lane nearest to its stop point, by the lane rule."""
    start, direction = np.empty_like(stop), np.empty_like(stop)
    for signal, lane_index in enumerate(lane):
        first, last = np.searchsorted(lanes[2], [lane_index, lane_index + 1])
        own_start, own_direction = lanes[0][first:last], lanes[1][first:last] - lanes[0][first:last]
        points, which = np.unique(stop[:, signal], axis=0, return_inverse=True)
        to_point = points[:, None] - own_start  # [u, n, 2]
        squared_length = (own_direction * own_direction).sum(-1)
        along = (to_point * own_direction).sum(-1) / np.where(squared_length > 0, squared_length, np.float32(1))
        off = to_point + np.clip(along, 0, 1)[..., None] * own_direction
        nearest = np.sqrt((off * off).sum(-1)).argmin(-1)[which.reshape(-1)]
        start[:, signal], direction[:, signal] = own_start[nearest], own_direction[nearest]
    return start, direction


def build_signals(features: MapFeatures, lights: LightStates, device: torch.device) -> Signals | None:
    """Pack traffic lights and surface-street lanes; None where nothing can be violated."""
    lanes = _select_polylines(features, (MapFeatureType.LANE_SURFACE_STREET,))
    lane_ids, state, stop = _tabulate_lights(lights)
    row_of_id = {int(features.feature_id[feature]): row for row, feature in enumerate(lanes.feature)}
    known = np.array([int(lane_id) in row_of_id for lane_id in lane_ids], bool)
    if not known.any():
        return None
    lane = np.array([row_of_id[int(lane_id)] for lane_id in lane_ids[known]], np.int64)
    segments = _cut_lane_segments(lanes)
    start, direction = _project_stop_points(segments, lane, stop[:, known])
    squared_length = (direction * direction).sum(-1)
    squared_length = np.where(squared_length > 0, squared_length, np.float32(1))
    progress = ((stop[:, known] - start) * direction).sum(-1) / squared_length
    chunks = chunk_segments(*segments, (segments[0], segments[0]), axis_scale=(1.0, 1.0), device=device)
    arrays = (segments[2], lane, np.isin(state[:, known], RED_STATES), start, direction, squared_length, progress)
    return Signals(chunks, *(torch.from_numpy(array).to(device) for array in arrays))


def _find_crossings(
    x: Float[Tensor, "N E T1"], y: Float[Tensor, "N E T1"], signals: Signals, first_step: int
) -> Bool[Tensor, "N E T J"]:
    """Whether an agent passes a red light's stop point along its lane, anywhere sideways, between a step and the last."""
    steps = slice(first_step, first_step + x.shape[-1])
    start, direction = signals.stop_start[steps], signals.stop_direction[steps]
    along = (x[..., None] - start[..., 0]) * direction[..., 0] + (y[..., None] - start[..., 1]) * direction[..., 1]
    progress = along / signals.stop_squared_length[steps]
    stop = signals.stop_progress[steps]
    crossed = (progress[..., :-1, :] < stop[:-1]) & (progress[..., 1:, :] > stop[1:])
    return crossed & signals.is_red[steps][1:]


def compute_traffic_light_violation(
    x: Float[Tensor, "N E T1"],
    y: Float[Tensor, "N E T1"],
    valid: Bool[Tensor, "#N E T"],
    signals: Signals,
    *,
    first_step: int,
    max_pairs: int,
) -> Bool[Tensor, "N E T"]:
    """Whether an agent's centre crosses the stop point of a red light while on that light's lane.

    Args:
        x: Centres at T + 1 steps, the first of which is only the step before.
        y: Likewise.
        valid: Validity at the last T steps.
        signals: Packed lights and lanes.
        first_step: Step of the record that x and y begin with.
        max_pairs: Bound on the pairs held at once.
    """
    crossings = _find_crossings(x, y, signals, first_step) & valid[..., None]
    violation = crossings.new_zeros(crossings.shape[:-1])
    # The lane matters for the few crossings only.
    rollout, agent, step = crossings.any(-1).nonzero().unbind(-1)
    if len(rollout) == 0:
        return violation
    points = torch.stack([x[rollout, agent, step + 1], y[rollout, agent, step + 1]], dim=-1)
    segment = find_nearest_segment(points[:, None], signals.lanes, _measure_lane, max_pairs=max_pairs)
    on_lane = signals.lane_of_segment[segment] == signals.lane
    violation[rollout, agent, step] = (crossings[rollout, agent, step] & on_lane).any(-1)
    return violation
