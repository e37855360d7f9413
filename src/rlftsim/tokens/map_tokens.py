"""Tokenization of maps: pieces of polylines of up to 5 m, each with a position, a heading and a type.

M map tokens. The rules (polylines, types, 5 m windows) are those of the public SMART code, in array form. Prototypes of
three points are AlpaSim's, whose maps are cut by its rules (`catk/map_adapter.py` there): pieces of 8 m.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int8, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from rlftsim.geometry import rotate
from rlftsim.scenario.batch import ScenarioBatch, compute_origin
from rlftsim.scenario.types import CURRENT_STEP, LightState, MapFeatureType, Scenario, cached_on_scenario

SPACING_M = 0.5
WINDOW = 11
"""Points of a window: 5 m."""
TRIPLE = 3
"""Points of a piece in AlpaSim."""
TRIPLE_SPACING_M = 4.0
"""Distance of these points."""
MAX_GAP_M = 3.0
"""Polylines are cut where consecutive points are farther apart."""
NO_MAP_POSITION_M = 60_000.0
"""Coordinates of the single dummy token of a scenario without map: out of reach of all agents."""

_LABELS = ("type", "family", "light")
"""Categories of a map token."""
NUM_TYPES, NUM_FAMILIES, NUM_LIGHTS = 10, 4, 5

_FEATURE_TO_TYPE = {0: 1, 1: 0, 2: 1, 3: 3, 14: 4, 15: 4, 16: 5, 18: 9, 19: 9, 20: 9}
_FEATURE_TO_TYPE |= {5: 8, 6: 6, 7: 7, 8: 8, 9: 6, 10: 6, 11: 7, 12: 8, 13: 8}
STOP_SIGN_LANE_TYPE = 2
_STATE_TO_LIGHT = {
    LightState.UNKNOWN: 1,
    **dict.fromkeys((LightState.ARROW_STOP, LightState.STOP, LightState.FLASHING_STOP), 2),
    **dict.fromkeys((LightState.ARROW_GO, LightState.GO), 3),
    **dict.fromkeys((LightState.ARROW_CAUTION, LightState.CAUTION, LightState.FLASHING_CAUTION), 4),
}


@dataclass(frozen=True, eq=False)
class MapSegments:
    """The map tokens of a scenario before a vocabulary is applied. World frame, float32."""

    points: Float32[np.ndarray, "M 3 2"]
    """Start, middle and end (0, 2.5, 5 m of a whole piece)."""
    heading: Float32[np.ndarray, "M"]
    """Direction at the start, rad."""
    type: Int8[np.ndarray, "M"]
    """0 freeway, 1 street, 2 lane with stop sign, 3 bicycle lane, 4 road edge, 5 median, 6 broken line, 7 solid line,
    8 double line, 9 polygon."""
    family: Int8[np.ndarray, "M"]
    """0 lane, 1 road edge, 2 road line, 3 polygon."""
    light: Int8[np.ndarray, "M"]
    """Traffic light of the lane at the current step: 0 none, 1 unknown, 2 stop, 3 go, 4 caution."""
    lane_id: Int64[np.ndarray, "M"]
    """Feature id of the lane; -1 = no lane."""
    windows: Float32[np.ndarray, "W 11 2"]
    """The whole 5 m windows, each in its own frame (start at the origin, heading 0): the data of the prototypes."""


@dataclass(frozen=True, eq=False)
class MapTokens:
    """Map tokens of a batch, in the batch's frame, padded to M."""

    position: Float[Tensor, "B M 2"]
    heading: Float[Tensor, "B M"]
    token_id: Int64[Tensor, "B M"]
    type: Int64[Tensor, "B M"]
    family: Int64[Tensor, "B M"]
    light: Int64[Tensor, "B M"]
    token_mask: Bool[Tensor, "B M"]

    def select(self, mask: Bool[Tensor, "B M"]) -> "MapTokens":
        """The tokens of a mask alone, in the same order, padded to the largest number of a scenario."""
        index = (~mask).byte().argsort(dim=1, stable=True)[:, : int(mask.sum(1).max())]  # [B, m]
        row = torch.arange(len(index), device=index.device)[:, None]
        selected = MapTokens(*(values[row, index] for values in vars(self).values()))
        return replace(selected, token_mask=mask[row, index])


def tokenize_map(batch: ScenarioBatch, prototypes: Float[Tensor, "V n 2"]) -> MapTokens:
    """Map tokens of a batch: for each piece the nearest prototype (sum of squared distances at three points).

    Args:
        batch: Batch of which only the scenarios and the frame are read.
        prototypes: Map prototypes of the vocabulary, each in the frame of the first point. Three points are compared:
            the first, the middle and the last.
    """
    num_points = prototypes.shape[1]
    maps = [split_map(scenario, num_points) for scenario in batch.scenarios]
    if batch.light_step != CURRENT_STEP:
        maps = [_relight(pieces, scenario, batch.light_step) for pieces, scenario in zip(maps, batch.scenarios)]
    pad = partial(_pad, device=batch.device)
    # The origin is subtracted before the result is rounded to float32.
    origins = [compute_origin(scenario, batch.frame) for scenario in batch.scenarios]
    local_points = [(segments.points - origin).astype(np.float32) for segments, origin in zip(maps, origins)]
    points = pad(local_points, torch.float32)
    heading = pad([segments.heading for segments in maps], torch.float32)
    # Each piece in its own frame, flattened, against the prototypes; `argmin` takes the lowest index on ties.
    local = rotate(points - points[:, :, :1], -heading[..., None]).flatten(2)  # [B, M, 6]
    table = prototypes.to(batch.device)[:, [0, num_points // 2, -1]].flatten(1)  # [V, 6]
    nearest = [torch.cdist(rows, table, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1) for rows in local]
    return MapTokens(
        position=points[:, :, 0],
        heading=heading,
        token_id=torch.stack(nearest),
        **{name: pad([getattr(segments, name) for segments in maps], torch.int64) for name in _LABELS},
        token_mask=pad([np.ones(len(segments.heading), bool) for segments in maps], torch.bool),
    )


def tokenize_lights(batch: ScenarioBatch, num_points: int) -> Int64[Tensor, "B M"]:
    """Light of each map token of a batch, as in `tokenize_map`.

    Args:
        batch: Batch of which only the scenarios and the step of their lights are read.
        num_points: Points of a map prototype, which decide how maps are cut.
    """
    maps = [_relight(split_map(scenario, num_points), scenario, batch.light_step) for scenario in batch.scenarios]
    return _pad([segments.light for segments in maps], torch.int64, batch.device)


def _pad(arrays: list[np.ndarray], dtype: torch.dtype, device: torch.device) -> Tensor:
    return pad_sequence([torch.from_numpy(array).to(dtype) for array in arrays], batch_first=True).to(device)


@cached_on_scenario
def split_map(scenario: Scenario, num_points: int = WINDOW) -> MapSegments:
    """A scenario's map in pieces of up to 5 m; cached with the scenario.

    A scenario without any usable polyline gets a single dummy piece out of reach of all agents.

    Args:
        scenario: Scenario whose map and current lights are read.
        num_points: `WINDOW`, or `TRIPLE` for the pieces of AlpaSim, which has no speed bumps and no driveways.
    """
    features = scenario.map_features
    # 1. Polylines by family (lanes, road edges, road lines, polygons), each family in file order.
    polygons = (18, 19, 20) if num_points == WINDOW else (18,)
    families = ((0, 1, 2, 3), (14, 15, 16), tuple(range(5, 14)), polygons)
    order = [(int(i), family) for family, types in enumerate(families) for i in features.find_indices(types)]
    stop_lanes = set(features.topology.stop_sign_lanes[:, 1].tolist())
    # 2. Light of each lane at the current step; of a lane that is listed twice, the last one.
    lights = _find_lights(scenario, CURRENT_STEP)
    # 3. Pieces of each polyline, with labels for each piece: type, family, light.
    groups: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    labels: list[np.ndarray] = []
    lanes: list[np.ndarray] = []
    for index, family in order:
        polyline = features.polyline(index)
        if len(polyline) < 2:
            continue
        feature_type = int(features.feature_type[index])
        lane_id = int(features.feature_id[index])
        if family == 3 and num_points == WINDOW:
            polyline = _polygon_sides(features.polygon(index))
        type_ = _FEATURE_TO_TYPE[feature_type]
        if family == 0 and lane_id in stop_lanes and feature_type != MapFeatureType.LANE_BIKE:
            type_ = STOP_SIGN_LANE_TYPE
        groups.append((_cut if num_points == WINDOW else _cut_triples)(polyline[:, :2]))
        label = [type_, family, lights.get(lane_id, 0) if family == 0 else 0]
        labels.append(np.tile(np.array(label, np.int8), (len(groups[-1][1]), 1)))
        lanes.append(np.full(len(groups[-1][1]), lane_id if family == 0 else -1))
    if not sum(map(len, labels)):
        zeros, position = np.zeros(1, np.int8), np.full((1, 3, 2), NO_MAP_POSITION_M, np.float32)
        no_windows = np.zeros((0, WINDOW, 2), np.float32)
        return MapSegments(position, np.zeros(1, np.float32), zeros, zeros, zeros, np.full(1, -1), no_windows)
    points, heading, windows = (np.concatenate(columns) for columns in zip(*groups))
    type_, family, light = np.concatenate(labels).T
    return MapSegments(points, heading, type_, family, light, np.concatenate(lanes), windows)


def _find_lights(scenario: Scenario, step: int) -> dict[int, int]:
    """Light of each lane that has a light at a step."""
    is_current = scenario.lights.step == step
    states = (_STATE_TO_LIGHT.get(LightState(s), 1) for s in scenario.lights.state[is_current].tolist())
    return dict(zip(scenario.lights.lane_id[is_current].tolist(), states))


def _relight(pieces: MapSegments, scenario: Scenario, step: int) -> MapSegments:
    """The pieces with the lights of another step, at most the last of the log."""
    light = np.zeros_like(pieces.light)
    for lane, state in _find_lights(scenario, min(step, scenario.num_steps - 1)).items():
        light[(pieces.lane_id == lane) & (pieces.family == 0)] = state
    return replace(pieces, light=light)


def _polygon_sides(polygon: Float64[np.ndarray, "n 3"]) -> Float32[np.ndarray, "m 3"]:
    """The two longer sides of a crosswalk-like polygon, each in both directions, a point every meter."""
    # Float64 until here: crosswalks are cut in double precision by the public code, and rounded last.
    corners = polygon[[int(len(polygon) * fraction) for fraction in (0, 0.25, 0.5, 0.75)]]
    a, b, c, d = corners
    sides = ((a, b), (c, d)) if np.hypot(*(b - a)[:2]) > np.hypot(*(c - b)[:2]) else ((a, d), (c, b))
    lines = [_resample_side(start, end) for start, end in sides]
    return np.concatenate([points for line in lines for points in (line, line[::-1])]).astype(np.float32)


def _resample_side(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(end - start)
    if length == 0.0:
        return np.stack([start, end])
    meters = np.arange(int(length) + 1)[:, None]
    return np.concatenate([start + (end - start) / length * meters, end[None]])


def _cut(polyline: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [m, 3, 2] and headings [m] of a polyline's pieces, and all full windows [w, 11, 2] in the window's frame.

    The last point is dropped first and a polyline of at most 3 points has no piece, as in the public SMART code.
    """
    points: list[np.ndarray] = [np.zeros((0, 3, 2))]
    headings: list[np.ndarray] = [np.zeros(0)]
    windows: list[np.ndarray] = [np.zeros((0, WINDOW, 2))]
    polyline = polyline[:-1].astype(np.float64)
    gaps = np.flatnonzero(np.hypot(*np.diff(polyline, axis=0).T) > MAX_GAP_M) + 1 if len(polyline) > 2 else None
    for run in [] if gaps is None else np.split(polyline, gaps):
        resampled = _resample_line(run)
        if len(resampled) < 2:
            continue
        direction = np.diff(resampled, axis=0)
        heading = np.arctan2(direction[:, 1], direction[:, 0])
        heading = np.append(heading, heading[-1])
        # Windows of 11 points share their end points: a new one begins every 10 points.
        num_windows = max((len(resampled) - WINDOW) // (WINDOW - 1) + 1, 0)
        starts = np.arange(num_windows) * (WINDOW - 1)
        indices = starts[:, None] + np.array([0, 5, 10])
        # What is left after the last window makes a shorter piece if it has at least three points of its own.
        tail = np.arange(num_windows * (WINDOW - 1), len(resampled))
        num_own_points = len(tail) - 1 if num_windows else len(tail)
        if num_own_points >= 3:
            indices = np.concatenate([indices, tail[np.linspace(0, len(tail) - 1, 3).astype(int)][None]])
        points.append(resampled[indices])
        headings.append(heading[indices[:, 0]])
        # Whole windows [w, 11, 2], rotated by minus the heading at their start.
        local = resampled[starts[:, None] + np.arange(WINDOW)] - resampled[starts][:, None]
        cos, sin = np.cos(heading[starts])[:, None], np.sin(heading[starts])[:, None]
        x, y = local[..., 0], local[..., 1]
        windows.append(np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1))
    all_points, all_headings, all_windows = (np.concatenate(p).astype(np.float32) for p in (points, headings, windows))
    return all_points, all_headings, all_windows


def _cut_triples(polyline: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `_cut`, by AlpaSim's rules: pieces of two chords of 4 m, the last of which end where the polyline ends."""
    resampled = _resample_line(polyline.astype(np.float64), TRIPLE_SPACING_M)
    starts = np.arange(0, len(resampled) - 2, 2)
    starts = np.union1d(starts, len(resampled) - TRIPLE) if len(starts) else starts
    points = resampled[starts[:, None] + np.arange(TRIPLE)]
    direction = points[:, 1] - points[:, 0]
    heading = np.arctan2(direction[:, 1], direction[:, 0])
    return points.astype(np.float32), heading.astype(np.float32), np.zeros((0, WINDOW, 2), np.float32)


def _resample_line(run: np.ndarray, spacing_m: float = SPACING_M) -> np.ndarray:
    """A point every half meter, or in another distance, along a polyline, and the end point."""
    # Lengths of segments are rounded to float32 and summed in float64, as in the public code.
    lengths = np.linalg.norm(np.diff(run, axis=0).astype(np.float32), axis=-1)
    distance = np.concatenate([[0.0], np.cumsum(lengths, dtype=np.float64)])
    if len(run) < 2 or distance[-1] == 0.0:
        return run[:1]
    grid = np.append(np.arange(0.0, distance[-1], spacing_m), distance[-1])
    return np.stack([np.interp(grid, distance, run[:, c]) for c in (0, 1)], axis=-1)
