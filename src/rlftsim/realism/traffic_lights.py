"""Traffic light violations, as the official evaluator of 2025 defines them.

An agent violates a light if its center passes the stop point of a red light on the light's lane. Lanes and lights are
packed once per scenario; an agent's lane is looked up only where it passes a stop point. Frame: world, float32,
without z. Quirks of the official code that change results are reproduced and marked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.realism.map_based import Polylines, select_polylines
from rlftsim.realism.segment_search import ChunkedSegments, chunk_segments, find_nearest_segment, join_chunks
from rlftsim.scenario.types import TOTAL_STEPS, LightState, LightStates, MapFeatures, MapFeatureType

RED_STATES = (LightState.ARROW_STOP, LightState.STOP)
"""A flashing stop is not red."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Traffic lights of surface-street lanes over the steps of a log, and the lanes that agents may be on.

    B scenarios, S steps (91), J signals at most in one scenario, s segments.
    """

    lanes: ChunkedSegments
    lane_of_segment: Int64[Tensor, "s"]
    lane: Int64[Tensor, "B J"]
    """Index of a signal's lane among the surface-street lanes, as in `lane_of_segment`."""
    is_red: Bool[Tensor, "B S J"]
    """False for padding."""
    stop_start: Float[Tensor, "B S J 2"]
    """Start of the segment of the signal's lane that is nearest to its stop point."""
    stop_direction: Float[Tensor, "B S J 2"]
    """End minus start of that segment."""
    stop_squared_length: Float[Tensor, "B S J"]
    stop_progress: Float[Tensor, "B S J"]
    """Projection of the stop point on that segment, in segment lengths."""


def join_signals(parts: Sequence[Signals | None]) -> Signals | None:
    """Traffic lights of several scenarios side by side; None if none of them has any."""
    known = [part for part in parts if part is not None]
    if not known:
        return None
    num_signals = max(part.lane.shape[1] for part in known)

    def padded(name: str, axis: int) -> Tensor:
        """A field of all scenarios, padded with zeros along the axis of signals: padding is never red."""
        shape = list(getattr(known[0], name).shape)
        shape[0], shape[axis] = len(parts), num_signals
        out = getattr(known[0], name).new_zeros(shape)
        for row, part in zip(out, parts):
            if part is not None:
                row.narrow(axis - 1, 0, part.lane.shape[1]).copy_(getattr(part, name)[0])
        return out

    # Lanes keep the numbers that they have in their own scenario: a point finds no other ones.
    fields = ("is_red", "stop_start", "stop_direction", "stop_squared_length", "stop_progress")
    return Signals(
        lanes=join_chunks(
            [part and part.lanes for part in parts],
            [0 if part is None else len(part.lane_of_segment) for part in parts],
        ),
        lane_of_segment=torch.cat([part.lane_of_segment for part in known]),
        lane=padded("lane", 1),
        **{name: padded(name, 2) for name in fields},
    )


def _lane_rule(
    points: Float[Tensor, "P 2"], segments: ChunkedSegments, chunk: Int64[Tensor, "P"]
) -> Float[Tensor, "P U"]:
    """Square of the quantity that the official rule minimizes, which is not the distance to the segment.

    It amounts to the nearest segment start, with starts ahead of or abreast of the point preferred. It is never below
    the distance to the segment's start.
    """
    # A quirk of the official code: the projection is added to the offset where a distance would subtract it.
    dx, dy = (axis[chunk] for axis in segments.delta)
    to_x, to_y = (points[:, axis, None] - segments.start[axis][chunk] for axis in range(2))
    along = ((to_x * dx + to_y * dy) / segments.squared_length[chunk]).clamp_(0.0, 1.0)
    off_x, off_y = to_x + along * dx, to_y + along * dy
    return off_x * off_x + off_y * off_y


def _cut_lane_segments(
    lanes: Polylines,
) -> tuple[Float[np.ndarray, "s 2"], Float[np.ndarray, "s 2"], Int64[np.ndarray, "s"]]:
    """Segments of lanes in the plane, with the one that the official code adds to every lane but the longest.

    The official code pads lanes with zeros to the longest one and counts a segment if its start is real, so a shorter
    lane gets a segment from its last point to the world's origin. It can be the nearest one, so it is reproduced.
    """
    ends = np.append(lanes.points[1:, :2], np.zeros((1, 2), np.float32), axis=0)
    last = lanes.first + lanes.count - 1
    ends[last] = 0.0
    keep = np.ones(len(lanes.points), bool)
    keep[last] = lanes.count < lanes.count.max()
    owner = np.repeat(np.arange(len(lanes.count)), lanes.count)
    return lanes.points[keep, :2], ends[keep], owner[keep]


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
        # Most signals have the same stop point at all steps: project each distinct one once.
        points, which = np.unique(stop[:, signal], axis=0, return_inverse=True)
        to_point = points[:, None] - own_start  # [u, n, 2]
        squared_length = (own_direction * own_direction).sum(-1)
        along = (to_point * own_direction).sum(-1) / np.where(squared_length > 0, squared_length, np.float32(1))
        off = to_point + np.clip(along, 0, 1)[..., None] * own_direction
        nearest = np.sqrt((off * off).sum(-1)).argmin(-1)[which.reshape(-1)]
        start[:, signal], direction[:, signal] = own_start[nearest], own_direction[nearest]
    return start, direction


def build_signals(features: MapFeatures, lights: LightStates, device: torch.device) -> Signals | None:
    """Traffic lights and surface-street lanes, packed; None where nothing can be violated.

    Args:
        features: of the map.
        lights: all observations.
        device: where the tensors go.
    """
    # 1. States [S, J] and stop points [S, J, 2]. A light that is not observed at a step has state 0 (unknown) and stop
    #    point (0, 0), as officially; of two observations the last one counts.
    lane_ids, column = np.unique(lights.lane_id, return_inverse=True)
    state = np.zeros((TOTAL_STEPS, len(lane_ids)), np.int64)
    stop = np.zeros((TOTAL_STEPS, len(lane_ids), 2), np.float32)
    within = lights.step < TOTAL_STEPS
    state[lights.step[within], column[within]] = lights.state[within]
    stop[lights.step[within], column[within]] = lights.stop_point[within, :2]
    # 2. Only lights of surface-street lanes can be violated.
    lanes = select_polylines(features, (MapFeatureType.LANE_SURFACE_STREET,))
    row_of_id = {int(features.feature_id[feature]): row for row, feature in enumerate(lanes.feature)}
    known = np.array([int(lane_id) in row_of_id for lane_id in lane_ids], bool)
    if not known.any():
        return None
    lane = np.array([row_of_id[int(lane_id)] for lane_id in lane_ids[known]], np.int64)
    # 3. Stop points as progress along the nearest segment of their own lane.
    segments = _cut_lane_segments(lanes)
    start, direction = _project_stop_points(segments, lane, stop[:, known])
    squared_length = (direction * direction).sum(-1)
    squared_length = np.where(squared_length > 0, squared_length, np.float32(1))
    progress = ((stop[:, known] - start) * direction).sum(-1) / squared_length
    # 4. The lane rule is bounded by the distance to a segment's start, so boxes are those of the starts.
    chunks = chunk_segments(*segments, (segments[0], segments[0]), axis_scale=(1.0, 1.0), device=device)
    arrays = (lane, np.isin(state[:, known], RED_STATES), start, direction, squared_length, progress)
    lane_of_segment = torch.from_numpy(segments[2]).to(device)
    return Signals(chunks, lane_of_segment, *(torch.from_numpy(array[None]).to(device) for array in arrays))


def compute_traffic_light_violation(
    x: Float[Tensor, "N E T1"],
    y: Float[Tensor, "N E T1"],
    valid: Bool[Tensor, "#N E T"],
    signals: Signals,
    *,
    first_step: int,
    max_pairs: int,
    scenario: Int64[Tensor, "E"] | None = None,
) -> Bool[Tensor, "N E T"]:
    """True where an agent's center crosses the stop point of a red light on that light's lane.

    Args:
        x: centers at T + 1 steps, m; the first is the step before the first result.
        y: likewise.
        valid: validity at the last T steps.
        signals: packed lights and lanes.
        first_step: step of the log that x and y begin with.
        max_pairs: memory bound, see `find_nearest_segment`.
        scenario: of each agent, where the signals are those of several.
    """

    # Values of the signals that each agent may pass, [E, T + 1, J, ...], or with E = 1 if they are shared.
    def of_agents(values: Tensor) -> Tensor:
        return (values if scenario is None else values[scenario])[:, first_step : first_step + x.shape[-1]]

    # 1. Crossings of red lights since the step before, along the light's lane and at any distance to its side.
    start, direction = of_agents(signals.stop_start), of_agents(signals.stop_direction)
    along = (x[..., None] - start[..., 0]) * direction[..., 0] + (y[..., None] - start[..., 1]) * direction[..., 1]
    progress = along / of_agents(signals.stop_squared_length)  # [N, E, T + 1, J]
    stop = of_agents(signals.stop_progress)
    crossed = (progress[..., :-1, :] < stop[:, :-1]) & (progress[..., 1:, :] > stop[:, 1:])
    crossings = crossed & of_agents(signals.is_red)[:, 1:] & valid[..., None]  # [N, E, T, J]
    violation = crossings.new_zeros(crossings.shape[:-1])
    # 2. The agent's lane, which is expensive to find, only for these few crossings.
    rollout, agent, step = crossings.any(-1).nonzero().unbind(-1)
    if len(rollout) == 0:
        return violation
    points = torch.stack([x[rollout, agent, step + 1], y[rollout, agent, step + 1]], dim=-1)
    of_point = None if scenario is None else scenario[agent]
    segment = find_nearest_segment(points[:, None], signals.lanes, _lane_rule, max_pairs=max_pairs, scenario=of_point)
    lane = signals.lane if of_point is None else signals.lane[of_point]
    on_lane = signals.lane_of_segment[segment] == lane
    violation[rollout, agent, step] = (crossings[rollout, agent, step] & on_lane).any(-1)
    return violation
