"""Recordings as Parquet tables in a folder: the contract is in docs/extending.md, "Your own recordings".

    tracks.parquet      a row per object and step
    map.parquet         a row per point of a map feature
    scenarios.parquet   a row per scenario: ego, objects to predict, license
    lanes.parquet       optional: links between lanes
    lights.parquet      optional: states of traffic lights

A scenario that breaks the contract is left out with the table, the row and the cause.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree

from rlftsim.errors import DataError, in_short
from rlftsim.geometry import wrapped
from rlftsim.jobs.files import list_folder
from rlftsim.jobs.tables import read_parquet
from rlftsim.scenario.consistency import describe_contradictions
from rlftsim.scenario.polylines import Heights, densify
from rlftsim.scenario.rows import Rows, Schema, read_rows
from rlftsim.scenario.source import BytesRead, Item, Unit, units_of_files
from rlftsim.scenario.tfrecord import SkippedRecord
from rlftsim.scenario.types import (
    CURRENT_STEP,
    HISTORY_STEPS,
    LANE_TYPES,
    MEDIAN_SIZE_M,
    OTHER_SIZE_M,
    POLYGON_TYPES,
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
NEAR_LANE_M = 10.0
WRONG_SIDE = 0.75
"""Road edges that have nearby lanes on their right along more than this fraction run the wrong way."""
MAX_PREDICTED = 8
MAX_ROWS = 1_000_000
"""Of scenarios in a folder, and of a table in a scenario; repeated rows take next to no bytes of a file."""
SIZE_COLUMNS = ("length", "width", "height")
_MAX_COORDINATE_M = 1e7
_EPSILON_S = 1e-6
_SCHEMAS: Mapping[str, Schema] = {
    TRACKS: (
        {"scenario_id": "text", "object_id": "whole numbers", "type": "names or whole numbers", "step": "whole numbers"}
        | dict.fromkeys(("x", "y", "heading", "vx", "vy"), "numbers"),
        dict.fromkeys(("z", *SIZE_COLUMNS), "numbers"),
    ),
    MAP: (
        {"feature_id": "whole numbers", "type": "names or whole numbers", "x": "numbers", "y": "numbers"},
        {"scenario_id": "text", "map_id": "text", "z": "numbers"},
    ),
    SCENARIOS: (
        {"scenario_id": "text", "ego_id": "whole numbers"},
        {"map_id": "text", "license": "text or nothing", "step_s": "numbers", "first_step": "whole numbers"}
        | {"predict": "lists of whole numbers", "interest": "lists of whole numbers", "guessed": "lists of words"},
    ),
    LANES: (
        {"lane_id": "whole numbers"},
        {"scenario_id": "text", "map_id": "text", "speed_limit_mph": "numbers", "interpolating": "True or False"}
        | dict.fromkeys(("entry", "exit", "left", "right"), "lists of whole numbers"),
    ),
    LIGHTS: (
        {"scenario_id": "text", "step": "whole numbers", "lane_id": "whole numbers", "state": "names or whole numbers"},
        dict.fromkeys(("x", "y", "z"), "numbers"),
    ),
}


class TablesSource:
    """The data source "tables": a folder of Parquet tables, or a folder of such folders."""

    license_note = "The license of the recordings applies to this data set."
    """`find` puts the licenses of `scenarios.parquet` here."""

    def detects(self, path: str | os.PathLike[str]) -> bool:
        """True where a table of tracks and a table of scenarios share a folder."""
        return any(file.with_name(SCENARIOS).exists() for file in _find_tracks(path))

    def find(self, path: str | os.PathLike[str]) -> list[Unit]:
        """A unit per folder with a `tracks.parquet`."""
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
                continue  # `read` reports the damage
        licenses = list(dict.fromkeys(note for note in notes if note))
        self.license_note = " ".join(licenses) or type(self).license_note
        return [
            replace(unit, files=tuple(file for file in map(unit.files[0].joinpath, _SCHEMAS) if file.exists()))
            for unit in units_of_files([file.parent for file in tracks])
        ]

    def read(self, unit: Unit) -> Iterator[Item]:
        """Scenarios of a folder in the order of `scenarios.parquet`."""
        folder = unit.files[0].parent
        tables = {name: _read_table(folder / name) for name in (TRACKS, MAP, SCENARIOS)}
        tables |= {name: _read_table(folder / name) for name in (LANES, LIGHTS) if (folder / name).exists()}
        scenarios = tables[SCENARIOS]
        if not len(scenarios):
            raise DataError(f"{SCENARIOS} has no rows: each row makes a scenario")
        if len(scenarios) > len(tables[TRACKS]):
            raise DataError(
                f"{SCENARIOS} has {len(scenarios)} rows, {TRACKS} only {len(tables[TRACKS])}: each row makes a scenario"
            )
        if "scenario_id" not in tables[MAP] and "map_id" not in scenarios:
            raise DataError(f"{SCENARIOS} has no column map_id, which the maps in {MAP} are named by")
        row_groups = {name: _group_rows(table) for name, table in tables.items() if name != SCENARIOS}
        for record in range(len(scenarios)):
            row = scenarios.take(np.array([record]))
            try:
                selected = {name: _select_rows(tables[name], row_groups[name], row) for name in row_groups}
                yield _read_scenario(row, selected)
            except DataError as error:
                yield SkippedRecord(unit.name, record, f"scenario {row['scenario_id'][0]}: {error}")
        yield BytesRead(sum(file.stat().st_size for file in unit.files))

    def describe(self) -> dict[str, object]:
        """Version of the contract; guessed values differ from scenario to scenario and are in the index."""
        return {"tables": {"contract": 1}}


def _find_tracks(path: str | os.PathLike[str]) -> list[Path]:
    return sorted(file for file in list_folder(Path(path)) if file.name == TRACKS) if Path(path).is_dir() else []


def _read_scenario(row: Rows, tables: Mapping[str, Rows]) -> Scenario:
    """Scenario of a row of `scenarios.parquet`.

    Args:
        row: Row of the scenario, with the columns of `scenarios.parquet`.
        tables: Rows of the scenario in each further table, by file name; optional tables may be missing.
    """
    guessed = {word for word in row.first("guessed") or () if word}
    step_s = float(row.first("step_s", STEP_S))
    if not 0.001 <= step_s <= LONGEST_HOLE_S:
        raise row.error(0, f"step_s is {step_s:g}, it must lie between 0.001 and {LONGEST_HOLE_S:g} seconds")
    track_rows, map_rows = tables[TRACKS], tables[MAP]
    ego_id = row["ego_id"][0]
    ego_rows = np.flatnonzero(track_rows["object_id"] == ego_id)
    if not len(ego_rows):
        raise row.error(0, f"no ego: object {ego_id} has no rows in {TRACKS}")
    if "map_id" in row and not len(map_rows):
        raise row.error(0, f"map {row['map_id'][0]} has no rows in {MAP}")
    first_step = int(row.first("first_step", track_rows["step"][ego_rows].min()))
    if "z" in track_rows and "z" not in map_rows and len(map_rows):
        raise row.error(0, f"{TRACKS} has heights (z) and {MAP} has none: give both or neither")
    map_features = _read_map(map_rows, tables.get(LANES))
    tracks, missing = _read_tracks(track_rows, first_step, step_s, map_features if "z" in map_rows else None)
    guessed |= missing if "z" in map_rows else missing | {"z"}
    ego = int(np.flatnonzero(tracks.object_id == ego_id)[0]) if ego_id in tracks.object_id else -1
    if ego < 0 or not tracks.valid[ego, CURRENT_STEP]:
        raise row.error(0, f"no ego: object {ego_id} is not there 1 s after step {first_step}, the current step")
    _check_edge_directions(map_rows, map_features)
    contradictions = describe_contradictions(tracks, map_features, guessed)
    if contradictions:
        raise DataError(
            f"{TRACKS}: {contradictions}: vx and vy are m/s along x and y of the same frame, headings radians "
            f"counter-clockwise from +x, z m as the map's, and step_s in {SCENARIOS} the seconds between two steps"
        )
    predicted = _find_indices(row, "predict", tracks)
    if predicted is None:
        predicted = choose_predicted(tracks, ego)
        guessed.add("predict")
    interest = _find_indices(row, "interest", tracks) or []
    lights = _read_lights(tables.get(LIGHTS), first_step, step_s, tracks.valid.shape[1], map_features)
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


def _read_tracks(rows: Rows, first_step: int, step_s: float, ground: MapFeatures | None) -> tuple[Tracks, set[str]]:
    """Tracks at 10 Hz, and the words for guessed values of the tracks.

    Args:
        rows: Rows of the scenario in `tracks.parquet`, in any order.
        first_step: Step of the recording at which the scenario begins.
        step_s: Seconds from a step of the recording to the next.
        ground: Map with heights, for tracks without heights; None = the ground is at height 0.
    """
    # 1. Checks that do not depend on the grid.
    _check_numbers(rows)
    for name in SIZE_COLUMNS:
        if name in rows:
            rows.check(rows[name] <= 0, name + " is {:g}, it must be above zero", rows[name])
    rows = rows.take(np.lexsort((rows["step"], rows["object_id"])))
    ids, step = rows["object_id"], rows["step"]
    is_same_object = np.append(False, ids[1:] == ids[:-1])[: len(rows)]  # as in the row before
    has_same_step = is_same_object & (np.diff(step, prepend=step[:1]) == 0)
    rows.check(has_same_step, "object {} has a second row for step {}", ids, step)
    object_type = _read_numbers(rows, "type", ObjectType)
    has_second_type = is_same_object & (np.diff(object_type, prepend=object_type[:1]) != 0)
    rows.check(has_second_type, "object {} has a second type", ids)
    seconds = (step - first_step) * step_s  # [n]

    # 2. States on the grid, object by object.
    num_steps = _count_steps(rows.table, seconds.max(initial=0.0), first_step)
    grid = np.arange(num_steps) * STEP_S
    starts = np.flatnonzero(~is_same_object)
    has_size = all(name in rows for name in SIZE_COLUMNS)
    types = object_type[starts]
    guesses = np.array([MEDIAN_SIZE_M.get(ObjectType(int(k)), OTHER_SIZE_M) for k in types]).reshape(-1, 3)
    shape = (len(starts), num_steps)
    states, size, valid = np.zeros((*shape, 6)), np.zeros((*shape, 3)), np.zeros(shape, bool)
    names = [name for name in ("x", "y", "heading", "vx", "vy", "z") if name in rows]
    for track, (start, stop) in enumerate(zip(starts, [*starts[1:], len(rows)])):
        span = slice(start, stop)
        valid[track], row_index = _sample_rows(seconds[span], grid)
        for column, name in enumerate(names):
            values = np.unwrap(rows[name][span]) if name == "heading" else rows[name][span]
            states[track, :, column] = np.interp(grid, seconds[span], values)
        size[track] = guesses[track]
        for column, name in enumerate(SIZE_COLUMNS):
            if name in rows:
                size[track, :, column] = rows[name][span][row_index]
    if "z" in rows:
        z = states[..., 5]
    else:
        # boxes that stand on the ground
        z = size[..., 2] / 2
        if ground is not None:
            z[valid] += Heights(ground.points.astype(np.float64)).at(states[valid][:, :2])
    tracks = Tracks(
        object_id=ids[starts],
        object_type=types.astype(np.int8),
        position=(np.concatenate([states[..., :2], z[..., None]], -1) * valid[..., None]).astype(np.float32),
        heading=(wrapped(states[..., 2]) * valid).astype(np.float32),
        velocity=(states[..., 3:5] * valid[..., None]).astype(np.float32),
        size=(size * valid[..., None]).astype(np.float32),
        valid=valid,
    )
    missing = {word for word, is_present in (("z", "z" in rows), ("size", has_size)) if not is_present}
    return tracks.select(np.flatnonzero(valid.any(1))), missing


def _count_steps(table: str, last_s: float, first_step: int) -> int:
    """Steps of a scenario at 10 Hz: 91 for 9 s, or 11 for exactly 1 s, where the future is withheld."""
    if last_s > TOTAL_STEPS * STEP_S - STEP_S - _EPSILON_S:
        return TOTAL_STEPS
    if abs(last_s - CURRENT_STEP * STEP_S) < STEP_S / 2:
        return HISTORY_STEPS
    needed = "9 s are needed (1 s where the future is withheld)"
    raise DataError(f"{table}: {max(last_s, 0):.1f} s from step {first_step} on, {needed}")


def _sample_rows(
    seconds: Float[np.ndarray, "n"], grid: Float[np.ndarray, "S"]
) -> tuple[Bool[np.ndarray, "S"], Int64[np.ndarray, "S"]]:
    """True where an object has a state: at a row or in a short hole; and the last row up to each time."""
    row = np.clip(np.searchsorted(seconds, grid + _EPSILON_S, side="right") - 1, 0, None)
    next_row = np.clip(row + 1, None, len(seconds) - 1)
    at_row = np.abs(seconds[row] - grid) <= _EPSILON_S
    between = (seconds[row] < grid) & (grid < seconds[next_row])
    return at_row | (between & (seconds[next_row] - seconds[row] <= LONGEST_HOLE_S + _EPSILON_S)), row


def choose_predicted(tracks: Tracks, ego: int) -> list[int]:
    """Up to eight objects nearest to the ego at the current step that are always valid and move, in track order."""
    moved = np.linalg.norm(tracks.position[:, -1, :2] - tracks.position[:, CURRENT_STEP, :2], axis=1)
    fits = tracks.valid.all(1) & (moved > 1.0) & (tracks.object_type != ObjectType.OTHER)
    fits[ego] = False
    distance = np.linalg.norm(tracks.position[:, CURRENT_STEP, :2] - tracks.position[ego, CURRENT_STEP, :2], axis=1)
    nearest = np.argsort(np.where(fits, distance, np.inf), kind="stable")[: min(MAX_PREDICTED, int(fits.sum()))]
    return sorted(nearest.tolist())


def _find_indices(row: Rows, name: str, tracks: Tracks) -> list[int] | None:
    """Track indices of a list of object ids; None without a list."""
    ids = row.first(name)
    if ids is None:
        return None
    index = {object_id: k for k, object_id in enumerate(tracks.object_id.tolist())}
    for object_id in ids:
        if object_id not in index:
            raise row.error(0, f"{name} lists object {object_id}, which has no state in the scenario")
    if len(set(ids)) < len(ids):
        raise row.error(0, f"{name} lists object {max(ids, key=ids.count)} twice")
    return [index[object_id] for object_id in ids]


def _read_map(rows: Rows, lanes: Rows | None) -> MapFeatures:
    """Map features in the order of first rows."""
    feature_type = _read_numbers(rows, "type", MapFeatureType)
    _check_numbers(rows)
    points = np.column_stack([rows["x"], rows["y"], rows["z"] if "z" in rows else np.zeros(len(rows))])
    features = []
    for feature_id, indices in sorted(_group(rows["feature_id"]), key=lambda group: group[1][0]):
        types = feature_type[indices]
        if (types != types[0]).any():
            raise rows.error(indices[np.argmax(types != types[0])], f"feature {feature_id} has a second type")
        min_points = 1 if types[0] == MapFeatureType.STOP_SIGN else 3 if types[0] in POLYGON_TYPES else 2
        if len(indices) < min_points:
            raise rows.error(indices[0], f"feature {feature_id} has {len(indices)} points, it needs {min_points}")
        features.append((int(feature_id), int(types[0]), points[indices]))
    return MapFeatures.of(features, _read_topology(lanes, features))


def _read_topology(rows: Rows | None, features: Sequence[tuple[int, int, np.ndarray]]) -> LaneTopology:
    """Links between lanes of the map; links to further lanes are left out."""
    if rows is None:
        return LaneTopology()
    index = {feature_id: k for k, (feature_id, feature_type, _) in enumerate(features) if feature_type in LANE_TYPES}
    last = {feature_id: len(points) - 1 for feature_id, _, points in features}
    links: dict[str, list[tuple[int, ...]]] = {"entry_lanes": [], "exit_lanes": [], "neighbors": []}
    speed_limit, interpolating = np.zeros(len(features), np.float32), np.zeros(len(features), bool)
    _check_repeated(rows, "lane_id")
    for row, lane in enumerate(rows["lane_id"].tolist()):
        if lane not in index:
            raise rows.error(row, f"lane {lane} is no lane of {MAP}")
        targets = {
            name: [target for target in (rows[name][row] if name in rows else None) or () if target in index]
            for name in ("entry", "exit", "left", "right")
        }
        for name in ("entry", "exit"):
            links[f"{name}_lanes"] += [(lane, target) for target in targets[name]]
        for side, name in enumerate(("left", "right")):
            links["neighbors"] += [(lane, side, target, 0, last[lane], 0, last[target]) for target in targets[name]]
        limit = rows["speed_limit_mph"][row] if "speed_limit_mph" in rows else np.nan  # NaN = unknown
        if abs(limit) > np.finfo(np.float32).max:
            raise rows.error(row, f"speed_limit_mph is {limit:g}")
        speed_limit[index[lane]] = np.nan_to_num(limit)
        interpolating[index[lane]] = "interpolating" in rows and bool(rows["interpolating"][row])
    return LaneTopology.of(**links, speed_limit_mph=speed_limit, interpolating=interpolating)


def _check_edge_directions(rows: Rows, features: MapFeatures) -> None:
    """Check that road edges have the road on the left: outer edges run counter-clockwise, edges of islands clockwise.

    Raises:
        DataError: An edge has the nearest lanes on the right along most of the length.
    """
    lanes = [densify(features.polyline(k)[:, :2].astype(np.float64), 1.0) for k in features.find_indices(LANE_TYPES)]
    if not lanes:
        return
    lane_points = np.concatenate(lanes)
    tree = KDTree(lane_points)
    for index in features.find_indices(ROAD_EDGE_TYPES):
        edge = densify(features.polyline(index)[:, :2].astype(np.float64), 1.0)
        middle, direction = (edge[1:] + edge[:-1]) / 2, np.diff(edge, axis=0)
        distance, nearest = tree.query(middle)
        towards = lane_points[nearest] - middle
        is_close = distance < NEAR_LANE_M
        is_right = direction[:, 0] * towards[:, 1] - direction[:, 1] * towards[:, 0] < 0
        if is_right[is_close].sum() > WRONG_SIDE * max(is_close.sum(), 1):
            ids, rule = rows["feature_id"], "outer edges run counter-clockwise, those of islands clockwise"
            cause = f"road edge {{}} has the lanes on its right ({rule}): reverse its points"
            rows.check(ids == features.feature_id[index], cause, ids)


def _read_lights(
    rows: Rows | None, first_step: int, step_s: float, num_steps: int, features: MapFeatures
) -> LightStates:
    """Lights at 10 Hz: of each lane the last state that is not older than a step of the recording."""
    if rows is None:
        return LightStates.of([])
    _check_numbers(rows)
    _check_repeated(rows, "lane_id", "step")
    state = _read_numbers(rows, "state", LightState)
    seconds = (rows["step"] - first_step) * step_s
    lane_index = {int(features.feature_id[k]): k for k in features.find_indices(LANE_TYPES)}
    lights = []
    for lane, indices in _group(rows["lane_id"]):
        indices = indices[np.argsort(seconds[indices], kind="stable")]
        if int(lane) not in lane_index:
            raise rows.error(indices[0], f"lane {lane} is no lane of {MAP}")
        start = features.polyline(lane_index[int(lane)])[0]
        for step in range(num_steps):
            k = np.searchsorted(seconds[indices], step * STEP_S + _EPSILON_S, side="right") - 1
            if k >= 0 and step * STEP_S - seconds[indices[k]] < max(step_s, STEP_S) - _EPSILON_S:
                row = indices[k]
                point = [rows[c][row] if c in rows else start[axis] for axis, c in enumerate("xyz")]
                lights.append((step, int(lane), int(state[row]), *point))
    return LightStates.of(sorted(lights, key=lambda light: light[:2]))


def _check_numbers(rows: Rows) -> None:
    """Raise a `DataError` at the first NaN, infinite or huge number in a column of numbers."""
    needed, optional = _SCHEMAS[rows.table]
    for name, content in {**needed, **optional}.items():
        if content == "numbers" and name in rows:
            rows.check(~(np.abs(rows[name]) < _MAX_COORDINATE_M), name + " is {:g}", rows[name])  # NaN, too


def _check_repeated(rows: Rows, *names: str) -> None:
    """Raise a `DataError` at the first row that repeats the values of an earlier row in some columns."""
    columns = [rows[name] for name in names]
    cells = ", ".join(f"{name} {{}}" for name in names)
    order = np.lexsort(columns)
    is_repeated = np.zeros(len(rows), bool)
    is_repeated[order[1:]] = np.all([np.diff(column[order]) == 0 for column in columns], axis=0)
    rows.check(is_repeated, f"a second row with {cells}: every row needs its own", *columns)


def _read_numbers(rows: Rows, name: str, enumeration: type[IntEnum]) -> Int64[np.ndarray, "n"]:
    """Numbers of a column that holds numbers or names."""
    numbers: dict[Any, int] = {member.name.lower(): int(member) for member in enumeration}
    numbers |= {int(member): int(member) for member in enumeration}
    values, inverse = _number_keys(rows[name])
    plain = [value.lower() if isinstance(value, str) else value for value in values]
    for index, value in enumerate(plain):
        if value not in numbers:
            words = ", ".join(member.name.lower() for member in enumeration)
            raise rows.error(np.argmax(inverse == index), f"{name} {in_short(values[index])} is none of {words}")
    return np.array([numbers[value] for value in plain], np.int64)[inverse]


def _group(keys: np.ndarray) -> list[tuple[Any, Int64[np.ndarray, "_"]]]:
    """Each distinct key in ascending order, with the indices of all occurrences."""
    values, numbers = _number_keys(keys)
    order, counts = np.argsort(numbers, kind="stable"), np.bincount(numbers)
    return list(zip(values, np.split(order, np.cumsum(counts)[:-1])))


def _number_keys(keys: np.ndarray) -> tuple[list[Any], Int64[np.ndarray, "n"]]:
    """Distinct keys in ascending order, and the number of each key in that order."""
    if keys.dtype != object:
        values, numbers = np.unique(keys, return_inverse=True)
        return values.tolist(), numbers
    values = sorted(set(keys))
    number = {value: index for index, value in enumerate(values)}
    return values, np.fromiter(map(number.__getitem__, keys), np.int64, len(keys))


def _group_rows(table: Rows) -> dict[tuple[str, str], np.ndarray]:
    """Rows of a table by scenario or map: by the name of the key column, and the id."""
    keys = [key for key in ("scenario_id", "map_id") if key in table]
    return {(key, value): indices for key in keys for value, indices in _group(table[key])}


def _select_rows(table: Rows, row_groups: Mapping[tuple[str, str], np.ndarray], row: Rows) -> Rows:
    """Rows of a table that belong to a scenario, by scenario id or map id."""
    keys = [(key, str(row[key][0])) for key in ("scenario_id", "map_id") if key in row and key in table]
    indices = next((row_groups[key] for key in keys if key in row_groups), np.zeros(0, np.int64))
    if len(indices) > MAX_ROWS:
        raise DataError(f"{table.table} has {len(indices)} rows of the scenario, above {MAX_ROWS}: write fewer")
    return table.take(indices)


def _read_table(path: Path) -> Rows:
    """Table with the columns of the contract, in the types of the contract.

    Raises:
        DataError: The table is missing or damaged, or a column is missing, of another type or has empty cells.
    """
    missing = f"{path.name}: there is no such table beside {TRACKS}"
    table = read_parquet(path, "write it again", missing=missing)
    if path.name == SCENARIOS and table.num_rows > MAX_ROWS:
        raise DataError(f"{path.name} has {table.num_rows} rows, above {MAX_ROWS}: write several folders")
    rows = read_rows(path.name, table, _SCHEMAS[path.name])
    if path.name in (MAP, LANES) and "scenario_id" not in rows and "map_id" not in rows:
        raise DataError(f"{path.name} has no column scenario_id or map_id")
    return rows
