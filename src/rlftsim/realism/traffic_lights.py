"""Traffic light violations, by the rules of the official evaluator of 2025.

An agent violates a light if the agent's center passes the stop point of a red light on the light's lane. Lanes and
lights are packed once per scenario; an agent's lane is looked up only where the agent passes a stop point. Frame:
world, float32, without z. Quirks of the official code that change results are reproduced and marked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from rlftsim.realism.map_based import Polylines, SegmentArrays, select_polylines
from rlftsim.realism.segment_search import ChunkedSegments, chunk_segments, find_nearest_segment, join_chunks
from rlftsim.scenario.types import TOTAL_STEPS, LightState, LightStates, MapFeatures, MapFeatureType

RED_STATES = (LightState.ARROW_STOP, LightState.STOP)
"""A flashing stop is not red."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Traffic lights of surface-street lanes over the steps of a log, and the lanes that agents may be on.

    B scenarios, S steps (91), at most J signals in a scenario, s segments.
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


def join_signals(maps: Sequence[Signals | None]) -> Signals | None:
    """Traffic lights of several scenarios side by side; None if all scenarios lack traffic lights."""
    joined = [signals for signals in maps if signals is not None]
    if not joined:
        return None

    def pad(name: str, axis: int) -> Tensor:
        """A field of all scenarios, padded with zeros along the axis of signals: padding is never red."""
        empty = getattr(joined[0], name).narrow(axis, 0, 0)
        rows = [(empty if signals is None else getattr(signals, name))[0].movedim(axis - 1, 0) for signals in maps]
        return pad_sequence(rows, batch_first=True).movedim(1, axis).contiguous()

    # Lanes keep the numbers that they have in their own scenario: a point finds no other ones.
    num_segments = [0 if signals is None else len(signals.lane_of_segment) for signals in maps]
    fields = ("is_red", "stop_start", "stop_direction", "stop_squared_length", "stop_progress")
    return Signals(
        lanes=join_chunks([signals and signals.lanes for signals in maps], num_segments),
        lane_of_segment=torch.cat([signals.lane_of_segment for signals in joined]),
        lane=pad("lane", 1),
        **{name: pad(name, 2) for name in fields},
    )


def _lane_rule(
    points: Float[Tensor, "P 2"], segments: ChunkedSegments, chunk: Int64[Tensor, "P"]
) -> Float[Tensor, "P U"]:
    """Square of the quantity that the official rule minimizes, which is not the distance to the segment.

    The rule amounts to the nearest segment start, with starts ahead of or abreast of the point preferred. The quantity
    is never below the distance to the segment's start.
    """
    # A quirk of the official code: the projection is added to the offset where a distance would subtract it.
    dx, dy = (axis[chunk] for axis in segments.delta)
    to_x, to_y = (points[:, axis, None] - segments.start[axis][chunk] for axis in range(2))
    projection = ((to_x * dx + to_y * dy) / segments.squared_length[chunk]).clamp_(0.0, 1.0)
    offset_x, offset_y = to_x + projection * dx, to_y + projection * dy
    return offset_x * offset_x + offset_y * offset_y


def _cut_lane_segments(lanes: Polylines) -> SegmentArrays:
    """Segments of lanes in the plane, with the segment that the official code adds to every lane but the longest.

    The official code pads lanes with zeros to the longest lane and counts a segment if the start is real, so a shorter
    lane gets a segment from the last point to the world's origin. Such a segment can be the nearest: it is reproduced.
    """
    ends = np.append(lanes.points[1:, :2], np.zeros((1, 2), np.float32), axis=0)
    last_point = lanes.first + lanes.count - 1
    ends[last_point] = 0.0
    is_start = np.ones(len(lanes.points), bool)
    is_start[last_point] = lanes.count < lanes.count.max()
    owner = np.repeat(np.arange(len(lanes.count)), lanes.count)
    return lanes.points[is_start, :2], ends[is_start], owner[is_start]


def _project_stop_points(
    lanes: SegmentArrays, lane: Int64[np.ndarray, "J"], stop: Float[np.ndarray, "S J 2"]
) -> tuple[Float[np.ndarray, "S J 2"], Float[np.ndarray, "S J 2"]]:
    """Start and direction of the segment of each signal's lane nearest to the stop point, by the lane rule."""
    start, direction = np.empty_like(stop), np.empty_like(stop)
    for signal, lane_index in enumerate(lane):
        first, end = np.searchsorted(lanes[2], [lane_index, lane_index + 1])
        lane_start, lane_direction = lanes[0][first:end], lanes[1][first:end] - lanes[0][first:end]
        # Most signals have the same stop point at all steps: project each distinct one once.
        points, point_index = np.unique(stop[:, signal], axis=0, return_inverse=True)
        to_point = points[:, None] - lane_start  # [u, n, 2]
        projection = (to_point * lane_direction).sum(-1) / _compute_squared_length(lane_direction)
        offset = to_point + np.clip(projection, 0, 1)[..., None] * lane_direction
        nearest = np.sqrt((offset * offset).sum(-1)).argmin(-1)[point_index.reshape(-1)]
        start[:, signal], direction[:, signal] = lane_start[nearest], lane_direction[nearest]
    return start, direction


def _compute_squared_length(direction: Float[np.ndarray, "*shape 2"]) -> Float[np.ndarray, "*shape"]:
    """Squared length of segments, 1 where zero, so that a projection on a segment of no length is 0."""
    squared_length = (direction * direction).sum(-1)
    return np.where(squared_length > 0, squared_length, np.float32(1))


def build_signals(
    features: MapFeatures, lights: LightStates, device: torch.device, num_steps: int = TOTAL_STEPS
) -> Signals | None:
    """Traffic lights and surface-street lanes, packed; None where no light can be violated.

    Args:
        features: Features of the map; only surface-street lanes count.
        lights: Logged observations of all traffic lights, any number per step.
        device: Device of the tensors, that of the agents to be measured.
        num_steps: Number S of steps of the log.
    """
    # 1. States [S, J] and stop points [S, J, 2]. A light that is not observed at a step has state 0 (unknown) and stop
    #    point (0, 0), as officially; of two observations the last one counts.
    lane_ids, column = np.unique(lights.lane_id, return_inverse=True)
    state = np.zeros((num_steps, len(lane_ids)), np.int64)
    stop = np.zeros((num_steps, len(lane_ids), 2), np.float32)
    in_time = lights.step < num_steps
    state[lights.step[in_time], column[in_time]] = lights.state[in_time]
    stop[lights.step[in_time], column[in_time]] = lights.stop_point[in_time, :2]
    # 2. Only lights of surface-street lanes can be violated.
    lanes = select_polylines(features, (MapFeatureType.LANE_SURFACE_STREET,))
    row_of_id = {int(features.feature_id[feature]): row for row, feature in enumerate(lanes.feature)}
    lane = np.array([row_of_id.get(int(lane_id), -1) for lane_id in lane_ids], np.int64)
    has_lane = lane >= 0
    if not has_lane.any():
        return None
    lane, state, stop = lane[has_lane], state[:, has_lane], stop[:, has_lane]
    # 3. Stop points as progress along the nearest segment of their own lane.
    segments = _cut_lane_segments(lanes)
    start, direction = _project_stop_points(segments, lane, stop)
    squared_length = _compute_squared_length(direction)
    progress = ((stop - start) * direction).sum(-1) / squared_length
    # 4. The lane rule is bounded by the distance to a segment's start, so boxes are those of the starts.
    chunks = chunk_segments(*segments, (segments[0], segments[0]), axis_scale=(1.0, 1.0), device=device)
    arrays = (lane, np.isin(state, RED_STATES), start, direction, squared_length, progress)
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
        x: First coordinate of the centers at T + 1 steps, m; the first is the step before the first result.
        y: Second coordinate of the centers at the same T + 1 steps, m.
        valid: Validity of the agents at the last T steps; invalid agents violate no light.
        signals: Lights and lanes of the scenario, or of several side by side.
        first_step: Step of the log that `x` and `y` begin with.
        max_pairs: Bound on the point-segment pairs in memory; changes no result.
        scenario: Scenario of each agent, where the signals are those of several scenarios.
    """

    # Values of the signals that each agent may pass, [E, T + 1, J, ...], or with E = 1 if they are shared.
    def select_agents(values: Tensor) -> Tensor:
        return (values if scenario is None else values[scenario])[:, first_step : first_step + x.shape[-1]]

    # 1. Crossings of red lights since the step before, along the light's lane and at any distance to its side.
    start, direction = select_agents(signals.stop_start), select_agents(signals.stop_direction)
    projection = (x[..., None] - start[..., 0]) * direction[..., 0] + (y[..., None] - start[..., 1]) * direction[..., 1]
    progress = projection / select_agents(signals.stop_squared_length)  # [N, E, T + 1, J]
    stop = select_agents(signals.stop_progress)
    crossings = (progress[..., :-1, :] < stop[:, :-1]) & (progress[..., 1:, :] > stop[:, 1:])
    crossings &= select_agents(signals.is_red)[:, 1:] & valid[..., None]  # [N, E, T, J]
    violation = crossings.new_zeros(crossings.shape[:-1])
    # 2. The agent's lane, which is expensive to find, only for these few crossings.
    rollout, agent, step = crossings.any(-1).nonzero().unbind(-1)
    if len(rollout) == 0:
        return violation
    points = torch.stack([x[rollout, agent, step + 1], y[rollout, agent, step + 1]], dim=-1)
    scenario = None if scenario is None else scenario[agent]
    segment = find_nearest_segment(points[:, None], signals.lanes, _lane_rule, max_pairs=max_pairs, scenario=scenario)
    lane = signals.lane if scenario is None else signals.lane[scenario]
    is_on_lane = signals.lane_of_segment[segment] == lane
    violation[rollout, agent, step] = (crossings[rollout, agent, step] & is_on_lane).any(-1)
    return violation
