"""Tokenization of maps: pieces of polylines of up to 5 m, each with a position, a heading and a type.

M map tokens. The rules (polylines, their types, 5 m windows) are those of the public SMART code, in array form.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int8, Int64
from torch import Tensor

from rlftsim.geometry import rotate
from rlftsim.scenario.batch import ScenarioBatch, origin_of
from rlftsim.scenario.derived import cached_on_scenario
from rlftsim.scenario.types import CURRENT_STEP, LightState, MapFeatureType, Scenario

SPACING_M = 0.5
WINDOW = 11
"""Points of a window: 5 m."""
MAX_GAP_M = 3.0
"""Polylines are cut where consecutive points are farther apart."""
NO_MAP_POSITION_M = 60_000.0
"""Coordinates of the single dummy token of a scenario without map: out of reach of all agents."""

NUM_TYPES, NUM_KINDS, NUM_LIGHTS = 10, 4, 5

_TYPE_OF_FEATURE = {0: 1, 1: 0, 2: 1, 3: 3, 14: 4, 15: 4, 16: 5, 18: 9, 19: 9, 20: 9}
_TYPE_OF_FEATURE |= {5: 8, 6: 6, 7: 7, 8: 8, 9: 6, 10: 6, 11: 7, 12: 8, 13: 8}
STOP_SIGN_LANE_TYPE = 2
_LIGHT_OF_STATE = {
    LightState.UNKNOWN: 1,
    LightState.ARROW_STOP: 2,
    LightState.STOP: 2,
    LightState.FLASHING_STOP: 2,
    LightState.ARROW_GO: 3,
    LightState.GO: 3,
    LightState.ARROW_CAUTION: 4,
    LightState.CAUTION: 4,
    LightState.FLASHING_CAUTION: 4,
}


@dataclass(frozen=True, eq=False)
class MapPieces:
    """The map tokens of one scenario before a vocabulary is applied. World frame, float32."""

    points: Float32[np.ndarray, "M 3 2"]
    """Start, middle and end (0, 2.5, 5 m of a whole piece)."""
    heading: Float32[np.ndarray, "M"]
    """Direction at the start, rad."""
    type: Int8[np.ndarray, "M"]
    """0 freeway, 1 street, 2 lane with stop sign, 3 bicycle lane, 4 road edge, 5 median, 6 broken line, 7 solid line,
    8 double line, 9 polygon."""
    kind: Int8[np.ndarray, "M"]
    """0 lane, 1 road edge, 2 road line, 3 polygon."""
    light: Int8[np.ndarray, "M"]
    """Traffic light of the lane at the current step: 0 none, 1 unknown, 2 stop, 3 go, 4 caution."""
    windows: Float32[np.ndarray, "W 11 2"]
    """The whole 5 m windows, each in its own frame (start at the origin, heading 0): the data of the prototypes."""


@dataclass(frozen=True, eq=False)
class MapTokens:
    """Map tokens of a batch, in its frame, padded to M."""

    position: Float[Tensor, "B M 2"]
    heading: Float[Tensor, "B M"]
    token_id: Int64[Tensor, "B M"]
    type: Int64[Tensor, "B M"]
    kind: Int64[Tensor, "B M"]
    light: Int64[Tensor, "B M"]
    token_mask: Bool[Tensor, "B M"]


def tokenize_map(batch: ScenarioBatch, prototypes: Float[Tensor, "V 11 2"]) -> MapTokens:
    """Map tokens of a batch: for each piece the nearest prototype (sum of squared distances at points 0, 5, 10).

    Args:
        batch: only its scenarios and its frame are used.
        prototypes: of the vocabulary.
    """
    pieces = [split_map(scenario) for scenario in batch.scenarios]
    width = max(len(p.heading) for p in pieces)

    def padded(arrays: list[np.ndarray], dtype: torch.dtype) -> Tensor:
        out = torch.zeros((len(arrays), width, *arrays[0].shape[1:]), dtype=dtype)
        for row, array in zip(out, arrays):
            row[: len(array)] = torch.from_numpy(array).to(dtype)
        return out.to(batch.device)

    origins = [origin_of(s, batch.frame) for s in batch.scenarios]
    centered = [(p.points - origin).astype(np.float32) for p, origin in zip(pieces, origins)]
    # The origin is subtracted before the result is rounded to float32.
    points = padded(centered, torch.float32)
    heading = padded([p.heading for p in pieces], torch.float32)
    # Each piece in its own frame, flattened, against the prototypes; `argmin` takes the lowest index on ties.
    local = rotate(points - points[:, :, :1], -heading[..., None]).flatten(2)  # [B, M, 6]
    table = prototypes.to(batch.device)[:, [0, 5, 10]].flatten(1)  # [V, 6]
    nearest = [torch.cdist(rows, table, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1) for rows in local]
    return MapTokens(
        position=points[:, :, 0],
        heading=heading,
        token_id=torch.stack(nearest),
        type=padded([p.type for p in pieces], torch.int64),
        kind=padded([p.kind for p in pieces], torch.int64),
        light=padded([p.light for p in pieces], torch.int64),
        token_mask=padded([np.ones(len(p.heading), bool) for p in pieces], torch.bool),
    )


@cached_on_scenario
def split_map(scenario: Scenario) -> MapPieces:
    """A scenario's map in pieces of up to 5 m; cached with the scenario.

    A scenario without any usable polyline gets one dummy piece far away from everything.
    """
    features = scenario.map_features
    # 1. Polylines by kind (lanes, road edges, road lines, polygons), each kind in file order.
    families = ((0, 1, 2, 3), (14, 15, 16), tuple(range(5, 14)), (18, 19, 20))
    order = [(int(i), kind) for kind, types in enumerate(families) for i in features.indices_of(types)]
    stop_lanes = set(features.topology.stop_sign_lanes[:, 1].tolist())
    # 2. Light of each lane at the current step; of a lane that is listed twice, the last one.
    now = scenario.lights.step == CURRENT_STEP
    states = (_LIGHT_OF_STATE.get(LightState(s), 1) for s in scenario.lights.state[now].tolist())
    lights = dict(zip(scenario.lights.lane_id[now].tolist(), states))
    # 3. Pieces of each polyline, with their labels: number, type, kind, light.
    groups: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    labels: list[tuple[int, int, int, int]] = []
    for index, kind in order:
        polyline = features.polyline(index)
        if len(polyline) < 2:
            continue
        feature_type = int(features.feature_type[index])
        lane_id = int(features.feature_id[index])
        if kind == 3:
            polyline = _polygon_sides(features.polygon(index))
        type_ = _TYPE_OF_FEATURE[feature_type]
        if kind == 0 and lane_id in stop_lanes and feature_type != MapFeatureType.LANE_BIKE:
            type_ = STOP_SIGN_LANE_TYPE
        points, heading, windows = _cut(polyline[:, :2])
        groups.append((points, heading, windows))
        labels.append((len(heading), type_, kind, lights.get(lane_id, 0) if kind == 0 else 0))
    if not sum(count for count, *_ in labels):
        zeros, far = np.zeros(1, np.int8), np.full((1, 3, 2), NO_MAP_POSITION_M, np.float32)
        return MapPieces(far, np.zeros(1, np.float32), zeros, zeros, zeros, np.zeros((0, WINDOW, 2), np.float32))
    # 4. Labels repeated for each piece.
    counts = [count for count, *_ in labels]
    type_column, kind_column, light_column = (
        np.repeat(np.array([row[c] for row in labels], np.int8), counts) for c in (1, 2, 3)
    )
    points, heading, windows = (np.concatenate([g[i] for g in groups]) for i in range(3))
    return MapPieces(points, heading, type_column, kind_column, light_column, windows)


def _polygon_sides(polygon: Float64[np.ndarray, "n 3"]) -> Float32[np.ndarray, "m 3"]:
    """The two longer sides of a crosswalk-like polygon, each there and back, a point every meter."""
    # Float64 until here: crosswalks are cut in double precision by the public code, and rounded last.
    corners = polygon[[int(len(polygon) * fraction) for fraction in (0, 0.25, 0.5, 0.75)]]
    a, b, c, d = corners
    sides = ((a, b), (c, d)) if np.hypot(*(b - a)[:2]) > np.hypot(*(c - b)[:2]) else ((a, d), (c, b))
    lines = [_every_meter(start, end) for start, end in sides]
    return np.concatenate([part for line in lines for part in (line, line[::-1])]).astype(np.float32)


def _every_meter(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(end - start)
    if length == 0.0:
        return np.stack([start, end])
    meters = np.arange(int(length) + 1)[:, None]
    return np.concatenate([start + (end - start) / length * meters, end[None]])


def _cut(polyline: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [m, 3, 2] and headings [m] of a polyline's pieces, and its whole windows [w, 11, 2] in their own frame.

    The last point is dropped first and a polyline of at most 3 points gives nothing, as in the public SMART code.
    """
    points: list[np.ndarray] = [np.zeros((0, 3, 2))]
    headings: list[np.ndarray] = [np.zeros(0)]
    windows: list[np.ndarray] = [np.zeros((0, WINDOW, 2))]
    polyline = polyline[:-1].astype(np.float64)
    gaps = np.flatnonzero(np.hypot(*np.diff(polyline, axis=0).T) > MAX_GAP_M) + 1 if len(polyline) > 2 else None
    for run in [] if gaps is None else np.split(polyline, gaps):
        resampled = _every_half_meter(run)
        if len(resampled) < 2:
            continue
        direction = np.diff(resampled, axis=0)
        heading = np.arctan2(direction[:, 1], direction[:, 0])
        heading = np.append(heading, heading[-1])
        # Windows of 11 points share their end points: a new one begins every 10 points.
        whole = max((len(resampled) - WINDOW) // (WINDOW - 1) + 1, 0)
        starts = np.arange(whole) * (WINDOW - 1)
        picks = starts[:, None] + np.array([0, 5, 10])
        # What is left after the last window makes a shorter piece if it has at least three points of its own.
        rest = np.arange(whole * (WINDOW - 1), len(resampled))
        left = len(rest) - 1 if whole else len(rest)
        if left >= 3:
            picks = np.concatenate([picks, rest[np.linspace(0, len(rest) - 1, 3).astype(int)][None]])
        points.append(resampled[picks])
        headings.append(heading[picks[:, 0]])
        # Whole windows [w, 11, 2], rotated by minus the heading at their start.
        local = resampled[starts[:, None] + np.arange(WINDOW)] - resampled[starts][:, None]
        cos, sin = np.cos(heading[starts])[:, None], np.sin(heading[starts])[:, None]
        x, y = local[..., 0], local[..., 1]
        windows.append(np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1))
    all_points, all_headings, all_windows = (np.concatenate(p).astype(np.float32) for p in (points, headings, windows))
    return all_points, all_headings, all_windows


def _every_half_meter(run: np.ndarray) -> np.ndarray:
    """A point every 0.5 m along a polyline, and its end point."""
    # Lengths of segments are rounded to float32 and summed in float64, as in the public code.
    lengths = np.linalg.norm(np.diff(run, axis=0).astype(np.float32), axis=-1)
    along = np.concatenate([[0.0], np.cumsum(lengths, dtype=np.float64)])
    if len(run) < 2 or along[-1] == 0.0:
        return run[:1]
    at = np.append(np.arange(0.0, along[-1], SPACING_M), along[-1])
    return np.stack([np.interp(at, along, run[:, c]) for c in (0, 1)], axis=-1)
