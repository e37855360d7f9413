"""One scenario as the environments see it: agents, log, lanes, edges, crossings and lights as arrays.

Frame: map (centered on the scenario, meters), float64. Built once per scenario and kept with it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int64

from rlftsim.envs.levels import Levels, build_levels
from rlftsim.scenario.derived import cached_on_scenario
from rlftsim.scenario.lane_graph import LaneGraph, lane_graph
from rlftsim.scenario.polylines import arc_length, resample_to
from rlftsim.scenario.types import (
    CURRENT_STEP,
    ROAD_EDGE_TYPES,
    STEP_S,
    TOTAL_STEPS,
    LightState,
    MapFeatureType,
    Scenario,
)
from rlftsim.viewer.scene import simplify

PIECE_M = 10.0
"""Longest piece of a lane or of a road edge."""
PIECE_POINTS = 10
RED, YELLOW, GREEN = 1, 2, 3
"""States of lights in `Lights.state`; 0 = not observed or unknown."""
_COLOR_OF_STATE = np.zeros(9, np.int64)
_COLOR_OF_STATE[[LightState.ARROW_STOP, LightState.STOP, LightState.FLASHING_STOP]] = RED
_COLOR_OF_STATE[[LightState.ARROW_CAUTION, LightState.CAUTION, LightState.FLASHING_CAUTION]] = YELLOW
_COLOR_OF_STATE[[LightState.ARROW_GO, LightState.GO]] = GREEN
AREA_TYPES = (MapFeatureType.CROSSWALK, MapFeatureType.SPEED_BUMP)


@dataclass(frozen=True, eq=False)
class LanePieces:
    """Lanes cut into pieces of at most 10 m, n in all."""

    points: Float[np.ndarray, "n 10 2"]
    z: Float[np.ndarray, "n 10"]
    lane: Int64[np.ndarray, "n"]
    """Index of the lane in the scenario's `lane_graph`."""
    kind: Float[np.ndarray, "n"]
    """A `MapFeatureType` of lanes."""
    limit_mps: Float[np.ndarray, "n"]
    """Speed limit; 0 = unknown."""
    has_stop_sign: Float[np.ndarray, "n"]
    light: Int64[np.ndarray, "n"]
    """Index of the lane's light; -1 = none."""


@dataclass(frozen=True, eq=False)
class Lights:
    """T traffic lights over the 91 steps of a log. Where the log has no further states, the last one holds."""

    point: Float[np.ndarray, "T 2"]
    z: Float[np.ndarray, "T"]
    lane: Int64[np.ndarray, "T"]
    """Index of the controlled lane in the `lane_graph`; -1 = not on the map."""
    state: Int64[np.ndarray, "91 T"]
    age_s: Float[np.ndarray, "91 T"]
    """Time since the state last changed."""
    last_observed: int
    """Last step with an observation; -1 = there is none."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Simulated agents (track order, A), their log, and the map."""

    scenario: Scenario
    ego: int
    """Row of the ego."""
    object_id: Int64[np.ndarray, "A"]
    object_type: Int64[np.ndarray, "A"]
    size: Float[np.ndarray, "A 3"]
    """Length, width, height at the current step, m."""
    z: Float[np.ndarray, "A"]
    """Height of the center at the current step, m."""
    logged: Float[np.ndarray, "A 91 5"]
    """x, y, heading, vx, vy; where a state is not valid, the last valid pose (the first before it), at rest."""
    logged_z: Float[np.ndarray, "A 91"]
    """Height of the center, likewise."""
    valid: Bool[np.ndarray, "A 91"]
    """False beyond the end of a test split's log."""
    graph: LaneGraph
    """Lanes in the world frame."""
    lanes: LanePieces
    edges: Float[np.ndarray, "e 4"]
    """Pieces of road edges: x0, y0, x1, y1, the drivable side on the left."""
    edges_z: Float[np.ndarray, "e"]
    """Height of the middle of each piece; zeros in scenes without levels."""
    crossings: Float[np.ndarray, "c 8"]
    """Rectangles around crosswalks and speed bumps: four corners."""
    crossings_z: Float[np.ndarray, "c"]
    lights: Lights
    levels: Levels | None
    """None = no two roads lie above each other, or heights are guessed: they do not count."""

    def row_of(self, object_id: int) -> int | None:
        """Row of a simulated agent; None if there is no such agent."""
        found = np.flatnonzero(self.object_id == object_id)
        return int(found[0]) if len(found) else None


@cached_on_scenario
def build_env_scene(scenario: Scenario) -> Scene:
    """The scenario as arrays."""
    tracks, chosen, graph = scenario.tracks, scenario.simulated_indices, lane_graph(scenario)
    steps = min(scenario.num_steps, TOTAL_STEPS)
    states = np.zeros((len(chosen), TOTAL_STEPS, 6))
    states[:, :steps, :2] = tracks.position[chosen, :steps, :2].astype(np.float64) - scenario.origin
    states[:, :steps, 2] = tracks.heading[chosen, :steps]
    states[:, :steps, 3:5] = tracks.velocity[chosen, :steps]
    states[:, :steps, 5] = tracks.position[chosen, :steps, 2]
    valid = np.zeros(states.shape[:2], bool)
    valid[:, :steps] = tracks.valid[chosen, :steps]
    # every state that is not valid takes the last valid one, or before that the first: agents never jump to zeros
    step = np.arange(TOTAL_STEPS)
    last = np.maximum.accumulate(np.where(valid, step, -1), axis=1)
    source = np.where(last < 0, valid.argmax(1)[:, None], last)  # [A, 91]
    logged = np.take_along_axis(states, source[..., None], axis=1)
    logged, logged_z = logged[..., :5].copy(), logged[..., 5].copy()
    logged[~valid, 3:] = 0.0
    lights = _lights(scenario, graph)
    lanes = _lane_pieces(scenario, graph, lights)
    size = tracks.size[chosen, CURRENT_STEP].astype(np.float64)
    undersides = np.concatenate([logged[..., :2], (logged_z - size[:, 2:] / 2)[..., None]], -1)[valid]
    on_lanes = np.concatenate([lanes.points, lanes.z[..., None]], -1).reshape(-1, 3)
    ground = np.concatenate([on_lanes, undersides])
    levels = None if "z" in scenario.guessed else build_levels(ground)
    edges, edges_z = _edges(scenario, levels is not None)
    crossings, crossings_z = _crossings(scenario)
    return Scene(
        scenario=scenario,
        ego=int(np.searchsorted(chosen, scenario.ego_index)),
        object_id=tracks.object_id[chosen].astype(np.int64),
        object_type=tracks.object_type[chosen].astype(np.int64),
        size=size,
        z=tracks.position[chosen, CURRENT_STEP, 2].astype(np.float64),
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


def _lights(scenario: Scenario, graph: LaneGraph) -> Lights:
    log = scenario.lights
    ids, column = np.unique(log.lane_id, return_inverse=True)
    point = np.zeros((len(ids), 3))
    state = np.zeros((TOTAL_STEPS, len(ids)), np.int64)
    seen = np.zeros((TOTAL_STEPS, len(ids)), bool)
    kept = log.step < TOTAL_STEPS
    # of several observations of a lane at a step the last one counts, as in the metric
    state[log.step[kept], column[kept]] = _COLOR_OF_STATE[np.clip(log.state[kept], 0, 8)]
    seen[log.step[kept], column[kept]] = True
    point[column] = log.stop_point.astype(np.float64) - [*scenario.origin, 0.0]
    steps = np.arange(TOTAL_STEPS)[:, None]
    # a light that is not observed keeps its last state
    last = np.maximum.accumulate(np.where(seen, steps, -1), axis=0)
    state = np.where(last >= 0, np.take_along_axis(state, np.maximum(last, 0), axis=0), 0)
    changed = np.vstack([np.zeros((1, len(ids)), bool), state[1:] != state[:-1]])
    since = np.maximum.accumulate(np.where(changed, steps, 0), axis=0)
    lane_of_id = {int(lane_id): row for row, lane_id in enumerate(graph.lane_id)}
    lane = np.array([lane_of_id.get(int(lane_id), -1) for lane_id in ids], np.int64)
    observed = int(log.step[kept].max()) if kept.any() else -1
    return Lights(point[:, :2], point[:, 2], lane, state, STEP_S * (steps - since), observed)


def _lane_pieces(scenario: Scenario, graph: LaneGraph, lights: Lights) -> LanePieces:
    pieces, owner = [np.zeros((0, PIECE_POINTS, 3))], []
    for index, line in enumerate(graph.lines):
        centered = line - [*scenario.origin, 0.0]
        count = max(1, int(np.ceil(arc_length(centered)[-1] / PIECE_M)))
        # neighbors share a point: piece k has the points 9 k .. 9 k + 9
        dense = resample_to(centered, count * (PIECE_POINTS - 1) + 1)
        first = (PIECE_POINTS - 1) * np.arange(count)
        pieces.append(dense[first[:, None] + np.arange(PIECE_POINTS)])
        owner += [index] * count
    lane = np.array(owner, np.int64)
    light_of_lane = np.full(len(graph) + 1, -1)
    light_of_lane[lights.lane] = np.arange(len(lights.lane))
    light_of_lane[-1] = -1  # lights whose lane is not on the map
    stops = np.isin(graph.lane_id, scenario.map_features.topology.stop_sign_lanes[:, 1])
    points = np.concatenate(pieces)
    return LanePieces(
        points=points[..., :2].copy(),
        z=points[..., 2].copy(),
        lane=lane,
        kind=graph.lane_type[lane].astype(np.float64),
        limit_mps=graph.speed_limit_mps[lane],
        has_stop_sign=stops[lane].astype(np.float64),
        light=light_of_lane[lane],
    )


def _edges(scenario: Scenario, has_levels: bool) -> tuple[Float[np.ndarray, "e 4"], Float[np.ndarray, "e"]]:
    """Pieces of road edges, and their heights."""
    features, found, heights = scenario.map_features, [np.zeros((0, 4))], [np.zeros(0)]
    for index in features.indices_of(ROAD_EDGE_TYPES):
        line = features.polyline(index).astype(np.float64) - [*scenario.origin, 0.0]
        line = line[np.isfinite(line[:, :2]).all(1)]
        corners = simplify(line[:, :2])
        for start, end in pairwise(corners):
            count = max(1, int(np.ceil(np.linalg.norm(end - start) / PIECE_M)))
            cuts = start + np.linspace(0, 1, count + 1)[:, None] * (end - start)
            found.append(np.concatenate([cuts[:-1], cuts[1:]], axis=1))
            if has_levels:
                middle = (cuts[:-1] + cuts[1:]) / 2
                heights.append(line[((line[:, None, :2] - middle) ** 2).sum(-1).argmin(0), 2])
            else:
                heights.append(np.zeros(count))
    return np.concatenate(found), np.concatenate(heights)


def _crossings(scenario: Scenario) -> tuple[Float[np.ndarray, "c 8"], Float[np.ndarray, "c"]]:
    """Rectangles along the longest side of each polygon, and their heights."""
    features, found, heights = scenario.map_features, [], []
    for index in features.indices_of(AREA_TYPES):
        corners = features.polygon(index)[:, :2] - scenario.origin
        corners = corners[np.isfinite(corners).all(1)]
        if len(corners) < 3:
            continue
        sides = np.diff(corners, axis=0, append=corners[:1])
        longest = sides[np.linalg.norm(sides, axis=1).argmax()]
        along = longest / max(float(np.linalg.norm(longest)), 1e-9)
        axes = np.stack([along, [-along[1], along[0]]])  # rows: along, across
        low, high = (corners @ axes.T).min(0), (corners @ axes.T).max(0)
        box = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
        found.append((box @ axes).ravel())
        heights.append(float(features.polygon(index)[:, 2].mean()))
    return np.array(found).reshape(-1, 8), np.array(heights, np.float64)
