"""A scenario as the environments see it: agents, log, lanes, edges, crossings and lights as arrays.

Frame: map (centered on the scenario, meters), float64. Built once per scenario and cached with the scenario.
"""

import math
from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int64

from rlftsim.envs.compiled import compiled
from rlftsim.envs.levels import Levels, build_levels
from rlftsim.errors import EpisodeFailure
from rlftsim.scenario.lane_graph import LaneGraph, lane_graph
from rlftsim.scenario.polylines import arc_length, resample_to
from rlftsim.scenario.types import (
    CURRENT_STEP,
    ROAD_EDGE_TYPES,
    STEP_S,
    LightState,
    LightStates,
    MapFeatureType,
    Scenario,
    cached_on_scenario,
)
from rlftsim.viewer.scene import simplify

SEGMENT_LENGTH_M = 10.0
"""Longest segment of a lane or of a road edge."""
SEGMENT_POINTS = 10
RED, YELLOW, GREEN = 1, 2, 3
"""States of lights in `Lights.state`; 0 = not observed or unknown."""
_COLOR_OF_STATE = np.zeros(9, np.int64)
_COLOR_OF_STATE[[LightState.ARROW_STOP, LightState.STOP, LightState.FLASHING_STOP]] = RED
_COLOR_OF_STATE[[LightState.ARROW_CAUTION, LightState.CAUTION, LightState.FLASHING_CAUTION]] = YELLOW
_COLOR_OF_STATE[[LightState.ARROW_GO, LightState.GO]] = GREEN
_STATE_OF_COLOR = np.array([LightState.UNKNOWN, LightState.STOP, LightState.CAUTION, LightState.GO], np.int8)
AREA_TYPES = (MapFeatureType.CROSSWALK, MapFeatureType.SPEED_BUMP)


@dataclass(frozen=True, eq=False)
class LaneSegments:
    """Lanes cut into n segments of at most 10 m."""

    points: Float[np.ndarray, "n 10 2"]
    z: Float[np.ndarray, "n 10"]
    lane: Int64[np.ndarray, "n"]
    """Index of the lane in the scenario's `lane_graph`."""
    lane_type: Float[np.ndarray, "n"]
    """A `MapFeatureType` of lanes."""
    limit_mps: Float[np.ndarray, "n"]
    """Speed limit; 0 = unknown."""
    has_stop_sign: Float[np.ndarray, "n"]
    light: Int64[np.ndarray, "n"]
    """Index of the lane's light; -1 = none."""


@dataclass(frozen=True, eq=False)
class Lights:
    """T traffic lights over the S steps of an episode. Where the log has no further states, the last state holds."""

    point: Float[np.ndarray, "T 2"]
    z: Float[np.ndarray, "T"]
    lane: Int64[np.ndarray, "T"]
    """Index of the controlled lane in the `lane_graph`; -1 = not on the map."""
    state: Int64[np.ndarray, "S T"]
    age_s: Float[np.ndarray, "S T"]
    """Time since the state last changed."""
    last_observed: int
    """Last step with an observation; -1 = there is none."""

    def log(self, logged: LightStates) -> LightStates:
        """Observations of the same lights at the same steps, with the states that are here, as far as they go."""
        _, column = np.unique(logged.lane_id, return_inverse=True)
        return replace(logged, state=_STATE_OF_COLOR[self.state[np.minimum(logged.step, len(self.state) - 1), column]])


@dataclass(frozen=True, eq=False)
class Scene:
    """Simulated agents (track order, A), S steps of the log's time, and map."""

    scenario: Scenario
    ego: int
    """Row of the ego."""
    object_id: Int64[np.ndarray, "A"]
    object_type: Int64[np.ndarray, "A"]
    size: Float[np.ndarray, "A 3"]
    """Length, width, height at the current step, m."""
    z: Float[np.ndarray, "A"]
    """Height of the center at the current step, m."""
    logged: Float[np.ndarray, "A S 5"]
    """x, y, heading, vx, vy; where a state is not valid, the last valid pose (the first before it), at rest."""
    logged_z: Float[np.ndarray, "A S"]
    """Height of the center, likewise."""
    valid: Bool[np.ndarray, "A S"]
    """False beyond the end of the log."""
    graph: LaneGraph
    """Lanes in the world frame."""
    lanes: LaneSegments
    edges: Float[np.ndarray, "e 4"]
    """Segments of road edges: x0, y0, x1, y1, the drivable side on the left."""
    edges_z: Float[np.ndarray, "e"]
    """Height of the middle of each segment; zeros in scenes without levels."""
    crossings: Float[np.ndarray, "c 8"]
    """Rectangles around crosswalks and speed bumps: four corners."""
    crossings_z: Float[np.ndarray, "c"]
    lights: Lights
    levels: Levels | None
    """None = no two roads lie above each other, or heights are guessed: heights do not count."""

    @property
    def num_steps(self) -> int:
        """S: 91, or history and "now" and all steps of a longer episode."""
        return self.valid.shape[1]


@cached_on_scenario
def build_env_scene(scenario: Scenario, num_steps: int) -> Scene:
    """The scenario as arrays.

    Args:
        scenario: Scenario with a log of any length.
        num_steps: Number S of steps of the log's time; the log is cut, or held at its end.

    Raises:
        EpisodeFailure: The ego is not valid at the current step.
    """
    tracks, rows, graph = scenario.tracks, scenario.simulated_indices, lane_graph(scenario)
    if scenario.ego_index not in rows:
        raise EpisodeFailure(
            f"scenario {scenario.scenario_id}: its ego, track {tracks.object_id[scenario.ego_index]}, is not valid at "
            f"the current step ({CURRENT_STEP}) and cannot be driven: leave the scenario out."
        )
    steps = slice(min(scenario.num_steps, num_steps))
    states = np.zeros((len(rows), num_steps, 6))
    states[:, steps, :2] = tracks.position[rows, steps, :2].astype(np.float64) - scenario.origin
    states[:, steps, 2] = tracks.heading[rows, steps]
    states[:, steps, 3:5] = tracks.velocity[rows, steps]
    states[:, steps, 5] = tracks.position[rows, steps, 2]
    valid = np.zeros(states.shape[:2], bool)
    valid[:, steps] = tracks.valid[rows, steps]
    # every state that is not valid takes the last valid one, or before that the first: agents never jump to zeros
    last_valid = np.maximum.accumulate(np.where(valid, np.arange(num_steps), -1), axis=1)
    source_step = np.where(last_valid < 0, valid.argmax(1)[:, None], last_valid)  # [A, S]
    states = np.take_along_axis(states, source_step[..., None], axis=1)
    logged, logged_z = states[..., :5].copy(), states[..., 5].copy()
    logged[~valid, 3:] = 0.0
    lights = _build_lights(scenario, graph, num_steps)
    lanes = _cut_lanes(scenario, graph, lights)
    size = tracks.size[rows, CURRENT_STEP].astype(np.float64)
    undersides = np.concatenate([logged[..., :2], (logged_z - size[:, 2:] / 2)[..., None]], -1)[valid]
    lane_points = np.concatenate([lanes.points, lanes.z[..., None]], -1).reshape(-1, 3)
    levels = None if "z" in scenario.guessed else build_levels(np.concatenate([lane_points, undersides]))
    edges, edges_z = _cut_edges(scenario, levels is not None)
    crossings, crossings_z = _build_crossings(scenario)
    return Scene(
        scenario=scenario,
        ego=int(np.searchsorted(rows, scenario.ego_index)),
        object_id=tracks.object_id[rows].astype(np.int64),
        object_type=tracks.object_type[rows].astype(np.int64),
        size=size,
        z=tracks.position[rows, CURRENT_STEP, 2].astype(np.float64),
        logged=logged,
        logged_z=logged_z,
        valid=valid,
        graph=graph,
        lanes=lanes,
        edges=edges,
        edges_z=edges_z,
        crossings=crossings,
        crossings_z=crossings_z,
        lights=lights,
        levels=levels,
    )


def _build_lights(scenario: Scenario, graph: LaneGraph, num_steps: int) -> Lights:
    is_simulated = scenario.lights.step < num_steps
    log_step, log_state = scenario.lights.step[is_simulated], scenario.lights.state[is_simulated]
    lane_ids, column = np.unique(scenario.lights.lane_id, return_inverse=True)
    point = np.zeros((len(lane_ids), 3))
    point[column] = scenario.lights.stop_point.astype(np.float64) - [*scenario.origin, 0.0]
    state = np.zeros((num_steps, len(lane_ids)), np.int64)
    observed_step = np.full(state.shape, -1)
    # of several observations of a lane at a step the last one counts, as in the metric
    state[log_step, column[is_simulated]] = _COLOR_OF_STATE[np.clip(log_state, 0, 8)]
    observed_step[log_step, column[is_simulated]] = log_step
    # a light that is not observed keeps its last state
    last_observed = np.maximum.accumulate(observed_step, axis=0)
    state = np.where(last_observed >= 0, np.take_along_axis(state, np.maximum(last_observed, 0), axis=0), 0)
    steps = np.arange(num_steps)[:, None]
    is_changed = np.diff(state, axis=0, prepend=state[:1]) != 0
    last_change = np.maximum.accumulate(np.where(is_changed, steps, 0), axis=0)
    row_of_id = {int(lane_id): row for row, lane_id in enumerate(graph.lane_id)}
    lane = np.array([row_of_id.get(int(lane_id), -1) for lane_id in lane_ids], np.int64)
    return Lights(point[:, :2], point[:, 2], lane, state, STEP_S * (steps - last_change), int(log_step.max(initial=-1)))


def _cut_lanes(scenario: Scenario, graph: LaneGraph, lights: Lights) -> LaneSegments:
    segments, lane_rows = [np.zeros((0, SEGMENT_POINTS, 3))], []
    for row, line in enumerate(graph.lines):
        centered = line - [*scenario.origin, 0.0]
        count = max(1, int(np.ceil(arc_length(centered)[-1] / SEGMENT_LENGTH_M)))
        # neighbors share a point: segment k has the points 9 k .. 9 k + 9
        points = resample_to(centered, count * (SEGMENT_POINTS - 1) + 1)
        first = (SEGMENT_POINTS - 1) * np.arange(count)
        segments.append(points[first[:, None] + np.arange(SEGMENT_POINTS)])
        lane_rows += [row] * count
    lane = np.array(lane_rows, np.int64)
    light_of_lane = np.full(len(graph) + 1, -1)
    light_of_lane[lights.lane] = np.arange(len(lights.lane))
    light_of_lane[-1] = -1  # lights whose lane is not on the map
    has_stop_sign = np.isin(graph.lane_id, scenario.map_features.topology.stop_sign_lanes[:, 1])
    points = np.concatenate(segments)
    return LaneSegments(
        points=points[..., :2].copy(),
        z=points[..., 2].copy(),
        lane=lane,
        lane_type=graph.lane_type[lane].astype(np.float64),
        limit_mps=graph.speed_limit_mps[lane],
        has_stop_sign=has_stop_sign[lane].astype(np.float64),
        light=light_of_lane[lane],
    )


def _cut_edges(scenario: Scenario, has_levels: bool) -> tuple[Float[np.ndarray, "e 4"], Float[np.ndarray, "e"]]:
    """Segments of road edges, with heights."""
    features, segments, heights = scenario.map_features, [np.zeros((0, 4))], [np.zeros(0)]
    for index in features.find_indices(ROAD_EDGE_TYPES):
        line = features.polyline(index).astype(np.float64) - [*scenario.origin, 0.0]
        line = line[np.isfinite(line[:, :2]).all(1)]
        corners = simplify(line[:, :2])
        start, delta = corners[:-1], np.diff(corners, axis=0)
        counts = np.ceil(np.hypot(delta[:, 0], delta[:, 1]) / SEGMENT_LENGTH_M).astype(int).clip(1)
        owner = np.repeat(np.arange(len(counts)), counts)
        piece = np.arange(len(owner)) - (counts.cumsum() - counts)[owner]
        begin, end = (start[owner] + (k / counts[owner])[:, None] * delta[owner] for k in (piece, piece + 1))
        segments.append(np.concatenate([begin, end], axis=1))
        middle = (begin + end) / 2
        nearest = ((line[:, None, :2] - middle) ** 2).sum(-1).argmin(0) if has_levels and len(middle) else owner
        heights.append(line[nearest, 2] if has_levels else np.zeros(len(middle)))
    return np.concatenate(segments), np.concatenate(heights)


def _build_crossings(scenario: Scenario) -> tuple[Float[np.ndarray, "c 8"], Float[np.ndarray, "c"]]:
    """Rectangles parallel to the longest side of each polygon, with heights."""
    features, boxes, heights = scenario.map_features, [], []
    for index in features.find_indices(AREA_TYPES):
        polygon = features.polygon(index)
        corners = polygon[:, :2] - scenario.origin
        corners = corners[np.isfinite(corners).all(1)]
        if len(corners) < 3:
            continue
        sides = np.diff(corners, axis=0, append=corners[:1])
        longest = sides[np.linalg.norm(sides, axis=1).argmax()]
        direction = longest / max(float(np.linalg.norm(longest)), 1e-9)
        axes = np.stack([direction, [-direction[1], direction[0]]])  # rows: along, across
        low, high = (corners @ axes.T).min(0), (corners @ axes.T).max(0)
        box = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
        boxes.append((box @ axes).ravel())
        heights.append(float(polygon[:, 2].mean()))
    return np.array(boxes).reshape(-1, 8), np.array(heights, np.float64)


@compiled
@no_type_check
def compute_directions(motion):
    """Unit vectors [B, A, 2] along the headings of agents with a motion [B, A, 5]."""
    directions = np.empty((motion.shape[0], motion.shape[1], 2))
    for b in range(motion.shape[0]):
        for a in range(motion.shape[1]):
            directions[b, a, 0], directions[b, a, 1] = math.cos(motion[b, a, 2]), math.sin(motion[b, a, 2])
    return directions
