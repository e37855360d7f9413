"""Anybody's recordings as Parquet tables in a folder: the contract is in docs/extending.md, "Your own recordings".

    tracks.parquet      one row per object and step
    map.parquet         one row per point of a map feature
    scenarios.parquet   one row per scenario: its ego, the objects to predict, its license
    lanes.parquet       optional: links between lanes
    lights.parquet      optional: states of traffic lights

A scenario that breaks the contract is left out with the table, the row and the cause.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree

from rlftsim.errors import DataError, in_short
from rlftsim.geometry import wrapped
from rlftsim.jobs.tables import read_parquet
from rlftsim.scenario.consistency import describe_contradictions
from rlftsim.scenario.polylines import Heights, densify
from rlftsim.scenario.source import BytesRead, Item, Unit, units_of_files
from rlftsim.scenario.tfrecord import SkippedRecord
from rlftsim.scenario.types import (
    CURRENT_STEP,
    HISTORY_STEPS,
    LANE_TYPES,
    MEDIAN_SIZE_M,
    OTHER_SIZE_M,
    ROAD_EDGE_TYPES,
    STEP_S,
    TOTAL_STEPS,
    LaneTopology,
    LightState,
    LightStates,
    MapFeatures,
    MapFeatureType,
    ObjectType,
    Scenario,
    Tracks,
)

TRACKS, MAP, SCENARIOS, LANES, LIGHTS = (f"{n}.parquet" for n in ("tracks", "map", "scenarios", "lanes", "lights"))
LONGEST_HOLE_S = 0.5
"""States are interpolated between two rows of an object that are no farther apart."""
LARGEST_JUMP_M = 5.0
"""Largest move in 0.1 s."""
MOVING_MPS, REVERSED_S = 3.0, 1.0
"""A vehicle that drives backwards faster and longer than this has its heading turned around."""
NEAR_LANE_M = 10.0
WRONG_SIDE = 0.75
"""Road edges that have nearby lanes on their right along more than this fraction run the wrong way."""
MOST_PREDICTED = 8
_MAX_COORDINATE_M = 1e7
_EPSILON_S = 1e-6
_WORDS, _NUMBERS, _WHOLE = "text", "numbers", "whole numbers"
_EITHER, _TRUTH = "names or whole numbers", "True or False"
_LISTS, _WORD_LISTS = "lists of whole numbers", "lists of words"
_SCHEMAS: Mapping[str, tuple[dict[str, str], dict[str, str]]] = {
    TRACKS: (
        {"scenario_id": _WORDS, "object_id": _WHOLE, "type": _EITHER, "step": _WHOLE}
        | dict.fromkeys(("x", "y", "heading", "vx", "vy"), _NUMBERS),
        dict.fromkeys(("z", "length", "width", "height"), _NUMBERS),
    ),
    MAP: (
        {"feature_id": _WHOLE, "type": _EITHER, "x": _NUMBERS, "y": _NUMBERS},
        {"scenario_id": _WORDS, "map_id": _WORDS, "z": _NUMBERS},
    ),
    SCENARIOS: (
        {"scenario_id": _WORDS, "ego_id": _WHOLE},
        {"map_id": _WORDS, "license": _WORDS, "step_s": _NUMBERS, "first_step": _WHOLE}
        | {"predict": _LISTS, "interest": _LISTS, "guessed": _WORD_LISTS},
    ),
    LANES: (
        {"lane_id": _WHOLE},
        {"scenario_id": _WORDS, "map_id": _WORDS, "speed_limit_mph": _NUMBERS, "interpolating": _TRUTH}
        | dict.fromkeys(("entry", "exit", "left", "right"), _LISTS),
    ),
    LIGHTS: (
        {"scenario_id": _WORDS, "step": _WHOLE, "lane_id": _WHOLE, "state": _EITHER},
        dict.fromkeys(("x", "y", "z"), _NUMBERS),
    ),
}
"""Columns of each table that are needed, and those that may be left out. Others are ignored."""


@dataclass(frozen=True, eq=False)
class _Rows:
    """Columns of some rows of a table, with their numbers in it."""

    table: str
    number: Int64[np.ndarray, "n"]
    columns: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.number)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def take(self, rows: np.ndarray) -> "_Rows":
        return _Rows(self.table, self.number[rows], {name: column[rows] for name, column in self.columns.items()})

    def error(self, row: int | np.integer, cause: str) -> DataError:
        return DataError(f"{self.table}: row {self.number[row]}: {cause}")


class TablesSource:
    """The data source "tables": a folder of Parquet tables, or a folder of such folders."""

    license_note = "The license of the recordings applies to this data set."
    """`find` puts those of `scenarios.parquet` here."""

    def detects(self, path: str | os.PathLike[str]) -> bool:
        """True where there is a table of tracks beside one of scenarios."""
        return any(file.with_name(SCENARIOS).exists() for file in _find_tracks(path))

    def find(self, path: str | os.PathLike[str]) -> list[Unit]:
        """One unit per folder with a `tracks.parquet`."""
        tracks = _find_tracks(path)
        if not os.path.isdir(path):
            raise DataError(f"{path}: no such folder; name the one that {TRACKS} is in, or one above it")
        if not tracks:
            raise DataError(f"{path}: no {TRACKS} in this folder or in one below it")
        notes = []
        for file in tracks:
            try:
                notes += _read_table(file.with_name(SCENARIOS)).columns.get("license", np.zeros(0)).tolist()
            except DataError:
                continue  # `read` says what is wrong with it
        given = list(dict.fromkeys(note for note in notes if note))
        self.license_note = " ".join(given) or type(self).license_note
        folders = units_of_files([file.parent for file in tracks])
        return [
            Unit(unit.name, tuple(p for p in map(unit.files[0].joinpath, _SCHEMAS) if p.exists()), unit.split)
            for unit in folders
        ]

    def read(self, unit: Unit) -> Iterator[Item]:
        """The scenarios of a folder in the order of `scenarios.parquet`."""
        folder = unit.files[0].parent
        tables = {name: _read_table(folder / name) for name in (TRACKS, MAP, SCENARIOS)}
        tables |= {name: _read_table(folder / name) for name in (LANES, LIGHTS) if (folder / name).exists()}
        scenarios = tables[SCENARIOS]
        if not len(scenarios):
            raise DataError(f"{SCENARIOS} has no rows: each row makes a scenario")
        if "scenario_id" not in tables[MAP] and "map_id" not in scenarios:
            raise DataError(f"{SCENARIOS} has no column map_id, which the maps in {MAP} are named by")
        parts = {name: _by_key(table) for name, table in tables.items()}
        for record in range(len(scenarios)):
            row = scenarios.take(np.array([record]))
            scenario_id = row["scenario_id"][0]
            try:
                yield _read_scenario(row, {n: _find_part(tables[n], parts[n], row) for n in tables if n != SCENARIOS})
            except DataError as error:
                yield SkippedRecord(unit.name, record, f"scenario {scenario_id}: {error}")
        yield BytesRead(sum(file.stat().st_size for file in unit.files))

    def describe(self) -> dict[str, object]:
        """The version of the contract; what is guessed differs from scenario to scenario and is in the index."""
        return {"tables": {"contract": 1}}


def _find_tracks(path: str | os.PathLike[str]) -> list[Path]:
    return sorted(Path(path).rglob(TRACKS)) if Path(path).is_dir() else []


def _read_scenario(row: _Rows, parts: Mapping[str, _Rows]) -> Scenario:
    """Scenario of a row of `scenarios.parquet`.

    Args:
        row: the row.
        parts: rows of the other tables that belong to it; optional tables may be missing.
    """
    guessed = {word for word in row["guessed"][0] or () if word} if "guessed" in row else set()
    step_s = float(row["step_s"][0]) if "step_s" in row else STEP_S
    if not 0.001 <= step_s <= LONGEST_HOLE_S:
        raise row.error(0, f"step_s is {step_s:g}, it must lie between 0.001 and {LONGEST_HOLE_S:g} seconds")
    rows = parts[TRACKS]
    ego_id = row["ego_id"][0]
    ego_rows = np.flatnonzero(rows["object_id"] == ego_id)
    if not len(ego_rows):
        raise row.error(0, f"no ego: object {ego_id} has no rows in {TRACKS}")
    if "map_id" in row and not len(parts[MAP]):
        raise row.error(0, f"map {row['map_id'][0]} has no rows in {MAP}")
    first_step = int(row["first_step"][0]) if "first_step" in row else int(rows["step"][ego_rows].min())
    if "z" in rows and "z" not in parts[MAP] and len(parts[MAP]):
        raise row.error(0, f"{TRACKS} has heights (z) and {MAP} has none: give both or neither")
    map_features = _read_map(parts[MAP], parts.get(LANES))
    tracks, missing = _read_tracks(rows, first_step, step_s, map_features if "z" in parts[MAP] else None)
    guessed |= missing if "z" in parts[MAP] else missing | {"z"}
    ego = int(np.flatnonzero(tracks.object_id == ego_id)[0]) if ego_id in tracks.object_id else -1
    if ego < 0 or not tracks.valid[ego, CURRENT_STEP]:
        raise row.error(0, f"no ego: object {ego_id} is not there 1 s after step {first_step}, the current step")
    _refuse_edges_that_run_backwards(parts[MAP], map_features)
    contradictions = describe_contradictions(tracks, map_features, guessed)
    if contradictions:
        raise DataError(
            f"{TRACKS}: {contradictions}: vx and vy are m/s along x and y of the same frame, headings radians "
            f"counter-clockwise from +x, z m as the map's, and step_s in {SCENARIOS} the seconds between two steps"
        )
    if "predict" in row and row["predict"][0] is not None:
        predicted = _find_indices(row, "predict", tracks)
    else:
        predicted = _choose_predicted(tracks, ego)
        guessed.add("predict")
    interest = _find_indices(row, "interest", tracks) if "interest" in row and row["interest"][0] is not None else []
    lights = _read_lights(parts.get(LIGHTS), first_step, step_s, tracks.valid.shape[1], map_features)
    return Scenario(
        scenario_id=str(row["scenario_id"][0]),
        timestamps_s=np.round(np.arange(tracks.valid.shape[1]) * STEP_S, 1),
        tracks=tracks,
        map_features=map_features,
        lights=lights,
        ego_index=ego,
        tracks_to_predict=np.array(predicted, np.int32),
        difficulty=np.zeros(len(predicted), np.int8),
        objects_of_interest=tracks.object_id[np.array(interest, np.int64)],
        source="tables",
        guessed=frozenset(guessed),
    )


def _read_tracks(rows: _Rows, first_step: int, step_s: float, ground: MapFeatures | None) -> tuple[Tracks, set[str]]:
    """Tracks at 10 Hz, and the words for what is guessed of them.

    Args:
        rows: of one scenario.
        first_step: step of the recording at which the scenario begins.
        step_s: seconds from one step of the recording to the next.
        ground: map with heights, for tracks that have none; None = the ground is at height 0.
    """
    # 1. What does not depend on the grid.
    _refuse_impossible_numbers(rows)
    for name in (name for name in ("length", "width", "height") if name in rows):
        bad = np.flatnonzero(rows[name] <= 0)
        if len(bad):
            raise rows.error(bad[0], f"{name} is {rows[name][bad[0]]:g}, it must be above zero")
    order = np.lexsort((rows["step"], rows["object_id"]))
    rows = rows.take(order)
    same = rows["object_id"][1:] == rows["object_id"][:-1]  # as the row before
    again = np.flatnonzero(same & (rows["step"][1:] == rows["step"][:-1]))
    if len(again):
        raise rows.error(again[0] + 1, f"object {rows['object_id'][again[0]]} has a second row for step "
                         f"{rows['step'][again[0]]}")  # fmt: skip
    kind = _read_numbers(rows, "type", ObjectType)
    other = np.flatnonzero(same & (kind[1:] != kind[:-1]))
    if len(other):
        raise rows.error(other[0] + 1, f"object {rows['object_id'][other[0]]} has a second type")
    seconds = (rows["step"] - first_step) * step_s  # [n]
    gap_s = np.diff(seconds)
    position = np.column_stack([rows["x"], rows["y"]])
    moved = np.linalg.norm(np.diff(position, axis=0), axis=1)
    far = np.flatnonzero(same & (gap_s <= LONGEST_HOLE_S + _EPSILON_S) & (moved > LARGEST_JUMP_M * gap_s / STEP_S))
    if len(far):
        raise rows.error(far[0] + 1, f"object {rows['object_id'][far[0]]} jumps {moved[far[0]]:.1f} m in "
                         f"{gap_s[far[0]]:.2f} s")  # fmt: skip

    # 2. The grid: 9 s, or exactly 1 s where the future is withheld.
    last_s = seconds.max(initial=0.0)
    if last_s > TOTAL_STEPS * STEP_S - STEP_S - _EPSILON_S:
        num_steps = TOTAL_STEPS
    elif abs(last_s - CURRENT_STEP * STEP_S) < STEP_S / 2:
        num_steps = HISTORY_STEPS
    else:
        raise DataError(f"{rows.table}: {max(last_s, 0):.1f} s from step {first_step} on, 9 s are needed "
                        "(1 s where the future is withheld)")  # fmt: skip
    grid = np.arange(num_steps) * STEP_S

    # 3. States on the grid, object by object.
    starts = np.flatnonzero(np.append(True, ~same)) if len(rows) else np.zeros(0, int)
    has_size = all(name in rows for name in ("length", "width", "height"))
    guesses = np.array([MEDIAN_SIZE_M.get(ObjectType(int(k)), OTHER_SIZE_M) for k in kind[starts]]).reshape(-1, 3)
    shape = (len(starts), num_steps)
    states, size, valid = np.zeros((*shape, 6)), np.zeros((*shape, 3)), np.zeros(shape, bool)
    names = ("x", "y", "heading", "vx", "vy", "z")
    for track, (start, stop) in enumerate(zip(starts, [*starts[1:], len(rows)])):
        own = slice(start, stop)
        valid[track], before = _sampled(seconds[own], grid)
        for column, name in enumerate(name for name in names if name in rows):
            values = np.unwrap(rows[name][own]) if name == "heading" else rows[name][own]
            states[track, :, column] = np.interp(grid, seconds[own], values)
        size[track] = guesses[track]
        for column, name in enumerate(("length", "width", "height")):
            if name in rows:
                size[track, :, column] = rows[name][own][before]
        backwards = _first_backwards(states[track], valid[track]) if kind[start] != ObjectType.PEDESTRIAN else None
        if backwards is not None:
            raise rows.error(start + before[backwards], f"object {rows['object_id'][start]} moves against its heading "
                             f"faster than {MOVING_MPS:g} m/s for more than {REVERSED_S:g} s")  # fmt: skip
    if "z" in rows:
        z = states[..., 5]
    else:
        # boxes that stand on the ground
        z = size[..., 2] / 2
        if ground is not None:
            z[valid] += Heights(ground.points.astype(np.float64)).at(states[valid][:, :2])
    kept = valid.any(1)
    tracks = Tracks(
        object_id=rows["object_id"][starts][kept],
        object_type=kind[starts].astype(np.int8)[kept],
        position=(np.concatenate([states[..., :2], z[..., None]], -1) * valid[..., None]).astype(np.float32)[kept],
        heading=(wrapped(states[..., 2]) * valid).astype(np.float32)[kept],
        velocity=(states[..., 3:5] * valid[..., None]).astype(np.float32)[kept],
        size=(size * valid[..., None]).astype(np.float32)[kept],
        valid=valid[kept],
    )
    return tracks, {word for word, is_given in (("z", "z" in rows), ("size", has_size)) if not is_given}


def _sampled(
    seconds: Float[np.ndarray, "n"], grid: Float[np.ndarray, "S"]
) -> tuple[Bool[np.ndarray, "S"], Int64[np.ndarray, "S"]]:
    """True where an object has a state: at a row or in a short hole between two. And its row at or before each time."""
    before = np.clip(np.searchsorted(seconds, grid + _EPSILON_S, side="right") - 1, 0, None)
    after = np.clip(before + 1, None, len(seconds) - 1)
    at_row = np.abs(seconds[before] - grid) <= _EPSILON_S
    between = (seconds[before] < grid) & (grid < seconds[after])
    return at_row | (between & (seconds[after] - seconds[before] <= LONGEST_HOLE_S + _EPSILON_S)), before


def _first_backwards(states: Float[np.ndarray, "S 6"], valid: Bool[np.ndarray, "S"]) -> int | None:
    """First step of a stretch over which an object moves against its heading; None if there is none."""
    moved = np.diff(states[:, :2], axis=0) / STEP_S  # [S-1, 2] m/s
    heading = states[:-1, 2]
    forward = moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading)
    is_back = valid[1:] & valid[:-1] & (np.hypot(*moved.T) > MOVING_MPS) & (forward < 0)
    bounds = np.flatnonzero(np.diff(is_back, prepend=False, append=False))
    long = np.flatnonzero(bounds[1::2] - bounds[::2] > REVERSED_S / STEP_S)
    return int(bounds[::2][long[0]]) if len(long) else None


def _choose_predicted(tracks: Tracks, ego: int) -> list[int]:
    """Up to eight objects nearest to the ego at the current step that are always there and move, in track order."""
    moved = np.linalg.norm(tracks.position[:, -1, :2] - tracks.position[:, CURRENT_STEP, :2], axis=1)
    fits = tracks.valid.all(1) & (moved > 1.0) & (tracks.object_type != ObjectType.OTHER)
    fits[ego] = False
    distance = np.linalg.norm(tracks.position[:, CURRENT_STEP, :2] - tracks.position[ego, CURRENT_STEP, :2], axis=1)
    nearest = np.argsort(np.where(fits, distance, np.inf), kind="stable")[: min(MOST_PREDICTED, int(fits.sum()))]
    return sorted(nearest.tolist())


def _find_indices(row: _Rows, name: str, tracks: Tracks) -> list[int]:
    """Track indices of a list of object ids."""
    index = {int(object_id): k for k, object_id in enumerate(tracks.object_id)}
    for object_id in row[name][0]:
        if object_id not in index:
            raise row.error(0, f"{name} lists object {object_id}, which has no state in the scenario")
    ids = list(row[name][0])
    if len(set(ids)) < len(ids):
        raise row.error(0, f"{name} lists object {max(ids, key=ids.count)} twice")
    return [index[object_id] for object_id in ids]


def _read_map(rows: _Rows, lanes: _Rows | None) -> MapFeatures:
    """Map features in the order of their first rows."""
    kind = _read_numbers(rows, "type", MapFeatureType)
    _refuse_impossible_numbers(rows)
    points = np.column_stack([rows["x"], rows["y"], rows["z"] if "z" in rows else np.zeros(len(rows))])
    ids, first, owner = np.unique(rows["feature_id"], return_index=True, return_inverse=True)
    by_feature = np.split(np.argsort(owner, kind="stable"), np.cumsum(np.bincount(owner, minlength=len(ids)))[:-1])
    features = []
    for place in np.argsort(first):
        own = by_feature[place]
        if (kind[own] != kind[own[0]]).any():
            raise rows.error(own[np.argmax(kind[own] != kind[own[0]])], f"feature {ids[place]} has a second type")
        polygons = (MapFeatureType.CROSSWALK, MapFeatureType.SPEED_BUMP, MapFeatureType.DRIVEWAY)
        needed = 1 if kind[own[0]] == MapFeatureType.STOP_SIGN else 3 if kind[own[0]] in polygons else 2
        if len(own) < needed:
            raise rows.error(own[0], f"feature {ids[place]} has {len(own)} points, it needs {needed}")
        features.append((int(ids[place]), int(kind[own[0]]), points[own]))
    return MapFeatures.of(features, _read_topology(lanes, features))


def _read_topology(rows: _Rows | None, features: Sequence[tuple[int, int, np.ndarray]]) -> LaneTopology:
    """Links between lanes of the map; links to lanes that are not in it are left out."""
    if rows is None:
        return LaneTopology()
    place = {feature_id: k for k, (feature_id, kind, _) in enumerate(features) if kind in LANE_TYPES}
    last = {feature_id: len(points) - 1 for feature_id, _, points in features}
    links: dict[str, list[tuple[int, ...]]] = {"entry": [], "exit": [], "neighbors": []}
    speed_limit, interpolating = np.zeros(len(features), np.float32), np.zeros(len(features), bool)
    _check_repeated(rows, "lane_id")
    for row, lane in enumerate(rows["lane_id"].tolist()):
        if lane not in place:
            raise rows.error(row, f"lane {lane} is no lane of {MAP}")
        for name in ("entry", "exit"):
            links[name] += [(lane, other) for other in _list(rows, name, row) if other in place]
        for side, name in enumerate(("left", "right")):
            links["neighbors"] += [
                (lane, side, other, 0, last[lane], 0, last[other]) for other in _list(rows, name, row) if other in place
            ]
        limit = rows["speed_limit_mph"][row] if "speed_limit_mph" in rows else np.nan  # NaN = unknown
        if np.isinf(limit):
            raise rows.error(row, f"speed_limit_mph is {limit:g}")
        speed_limit[place[lane]] = np.nan_to_num(limit)
        interpolating[place[lane]] = bool(rows["interpolating"][row]) if "interpolating" in rows else False
    return LaneTopology(
        entry_lanes=np.array(links["entry"], np.int64).reshape(-1, 2),
        exit_lanes=np.array(links["exit"], np.int64).reshape(-1, 2),
        neighbors=np.array(links["neighbors"], np.int64).reshape(-1, 7),
        speed_limit_mph=speed_limit,
        interpolating=interpolating,
    )


def _list(rows: _Rows, name: str, row: int) -> list[int]:
    return list(rows[name][row] or ()) if name in rows else []


def _refuse_edges_that_run_backwards(rows: _Rows, features: MapFeatures) -> None:
    """Check that road edges have the road on their left: outer ones run counter-clockwise, those of islands clockwise.

    Raises:
        DataError: one has the nearest lanes on its right along most of its length.
    """
    lanes = [densify(features.polyline(k)[:, :2].astype(np.float64), 1.0) for k in features.find_indices(LANE_TYPES)]
    if not lanes:
        return
    lane_points = np.concatenate(lanes)
    tree = KDTree(lane_points)
    for index in features.find_indices(ROAD_EDGE_TYPES):
        edge = densify(features.polyline(index)[:, :2].astype(np.float64), 1.0)
        middle, along = (edge[1:] + edge[:-1]) / 2, np.diff(edge, axis=0)
        distance, nearest = tree.query(middle)
        towards = lane_points[nearest] - middle
        is_near = distance < NEAR_LANE_M
        is_right = along[:, 0] * towards[:, 1] - along[:, 1] * towards[:, 0] < 0
        if is_right[is_near].sum() > WRONG_SIDE * max(is_near.sum(), 1):
            feature_id = features.feature_id[index]
            raise rows.error(
                np.flatnonzero(rows["feature_id"] == feature_id)[0],
                f"road edge {feature_id} has the lanes on its right (outer edges run counter-clockwise, those of "
                "islands clockwise): reverse its points",
            )


def _read_lights(
    rows: _Rows | None, first_step: int, step_s: float, num_steps: int, features: MapFeatures
) -> LightStates:
    """Lights at 10 Hz: of each lane the last state that is not older than a step of the recording."""
    found = []
    if rows is not None:
        _refuse_impossible_numbers(rows)
        _check_repeated(rows, "lane_id", "step")
        state = _read_numbers(rows, "state", LightState)
        seconds = (rows["step"] - first_step) * step_s
        place = {int(features.feature_id[k]): k for k in features.find_indices(LANE_TYPES)}
        for lane in np.unique(rows["lane_id"]):
            own = np.flatnonzero(rows["lane_id"] == lane)
            own = own[np.argsort(seconds[own], kind="stable")]
            if int(lane) not in place:
                raise rows.error(own[0], f"lane {lane} is no lane of {MAP}")
            start = features.polyline(place[int(lane)])[0]
            for step in range(num_steps):
                row = np.searchsorted(seconds[own], step * STEP_S + _EPSILON_S, side="right") - 1
                if row >= 0 and step * STEP_S - seconds[own[row]] < max(step_s, STEP_S) - _EPSILON_S:
                    point = [rows[c][own[row]] if c in rows else start[k] for k, c in enumerate("xyz")]
                    found.append((step, int(lane), int(state[own[row]]), *point))
    found.sort(key=lambda light: light[:2])
    columns = np.array(found, np.float64).reshape(-1, 6)
    return LightStates(
        columns[:, 0].astype(np.int32),
        np.array([light[1] for light in found], np.int64),
        columns[:, 2].astype(np.int8),
        columns[:, 3:].astype(np.float32),
    )


def _refuse_impossible_numbers(rows: _Rows) -> None:
    """Raise a `DataError` at the first NaN, infinite or huge number in a column of numbers."""
    needed, optional = _SCHEMAS[rows.table]
    for name in (name for name, kind in (needed | optional).items() if kind == _NUMBERS and name in rows):
        bad = np.flatnonzero(~(np.abs(rows[name]) < _MAX_COORDINATE_M))  # NaN is not less, either
        if len(bad):
            raise rows.error(bad[0], f"{name} is {rows[name][bad[0]]:g}")


def _check_repeated(rows: _Rows, *names: str) -> None:
    """Raise a `DataError` at the first row that has the same values in some columns as a row before it."""
    keys = np.column_stack([rows[name] for name in names])
    _, first, owner = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    again = np.flatnonzero(first[owner.reshape(-1)] != np.arange(len(rows)))
    if len(again):
        cells = ", ".join(f"{name} {rows[name][again[0]]}" for name in names)
        raise rows.error(again[0], f"a second row with {cells}: every row needs its own")


def _read_numbers(rows: _Rows, name: str, kinds: type[IntEnum]) -> Int64[np.ndarray, "n"]:
    """Numbers of a column of numbers or names."""
    known: dict[Any, int] = {kind.name.lower(): int(kind) for kind in kinds} | {int(kind): int(kind) for kind in kinds}
    values, inverse = np.unique(rows[name], return_inverse=True)
    plain = [value.lower() if isinstance(value, str) else int(value) for value in values.tolist()]
    for number, value in enumerate(plain):
        if value not in known:
            words = ", ".join(kind.name.lower() for kind in kinds)
            raise rows.error(np.argmax(inverse == number), f"{name} {in_short(values[number])} is none of {words}")
    return np.array([known[value] for value in plain], np.int64)[inverse]


def _by_key(table: _Rows) -> dict[tuple[str, str], np.ndarray]:
    """Rows of a table by the column that says what they belong to, and its value."""
    found: dict[tuple[str, str], np.ndarray] = {}
    for key in (key for key in ("scenario_id", "map_id") if key in table):
        values, owner = np.unique(table[key].astype(str), return_inverse=True)
        order = np.argsort(owner, kind="stable")
        parts = np.split(order, np.cumsum(np.bincount(owner, minlength=len(values)))[:-1]) if len(values) else []
        found |= {(key, str(value)): part for value, part in zip(values, parts)}
    return found


def _find_part(table: _Rows, parts: Mapping[tuple[str, str], np.ndarray], row: _Rows) -> _Rows:
    """Rows of a table that belong to a scenario, by its own id or that of its map."""
    keys = [(key, str(row[key][0])) for key in ("scenario_id", "map_id") if key in row and key in table]
    return table.take(next((parts[key] for key in keys if key in parts), np.zeros(0, np.int64)))


def _read_table(path: Path) -> _Rows:
    """A table with its known columns in the types of the contract.

    Raises:
        DataError: it is missing or damaged, or a column is missing, of another type or has empty cells.
    """
    try:
        table = read_parquet(path, "write it again")
    except FileNotFoundError:
        raise DataError(f"{path.name}: there is no such table beside {TRACKS}") from None
    needed, optional = _SCHEMAS[path.name]
    for name in needed:
        if name not in table.schema.names:
            raise DataError(f"{path.name} has no column {name}")
    if path.name in (MAP, LANES) and not {"scenario_id", "map_id"} & set(table.schema.names):
        raise DataError(f"{path.name} has no column scenario_id or map_id")
    columns = {}
    for name, kind in (needed | optional).items():
        if name in table.schema.names:
            columns[name] = _read_column(path.name, name, table[name], kind)
    return _Rows(path.name, np.arange(table.num_rows), columns)


def _read_column(table: str, name: str, column: pa.ChunkedArray, kind: str) -> np.ndarray:
    """A column as an array: float64, int64, bool, or objects for text and lists."""
    types, found = pa.types, column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    is_list = types.is_list(found) or types.is_large_list(found)
    inside = found.value_type if is_list else found
    is_text, is_text_inside = (
        types.is_string(one) or types.is_large_string(one) or types.is_string_view(one) for one in (found, inside)
    )
    fits = {
        _WORDS: is_text or types.is_integer(found) or types.is_null(found),
        _NUMBERS: types.is_floating(found) or types.is_integer(found),
        _WHOLE: types.is_integer(found),
        _LISTS: (is_list and types.is_integer(inside)) or types.is_null(inside),
        _WORD_LISTS: (is_list and is_text_inside) or types.is_null(inside),
        _EITHER: is_text or types.is_integer(found),
        _TRUTH: types.is_boolean(found),
    }[kind]
    if not fits:
        raise DataError(f"{table}: column {name} is {column.type}, it must have {kind}")
    # empty lists and licenses are allowed, empty numbers are NaN, which is refused where it matters
    if column.null_count and kind not in (_LISTS, _WORD_LISTS, _NUMBERS) and name != "license":
        row = np.flatnonzero(column.is_null().to_numpy())[0]
        raise DataError(f"{table}: row {row}: {name} is empty")
    try:
        if kind == _NUMBERS:
            return column.cast(pa.float64()).to_numpy()
        if kind == _WHOLE:
            return column.cast(pa.int64()).to_numpy()
        if kind == _TRUTH:
            return column.to_numpy()
        values = np.empty(len(column), object)
        values[:] = column.to_pylist()
        return np.array([str(v) if v is not None else None for v in values], object) if kind == _WORDS else values
    except pa.ArrowException as error:
        raise DataError(f"{table}: column {name}: {error}") from None
