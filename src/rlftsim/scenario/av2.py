"""Argoverse 2 motion forecasting: a Parquet file of tracks and a JSON map for each scenario.

Layout: `<split>/<uuid>/scenario_<uuid>.parquet` and `<split>/<uuid>/log_map_archive_<uuid>.json`. A recording has 110
steps at 10 Hz, of which a window of 91 becomes a scenario. The test split has the first 50 only.

The data have no box sizes and no heights of tracks: both are guessed, and `Scenario.guessed` says so. Lights, stop
signs and speed limits are missing in the data and in the scenarios.
"""

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.tables import read_parquet
from rlftsim.scenario.av2_map import Ground, read_map
from rlftsim.scenario.rows import Rows, Schema, read_rows
from rlftsim.scenario.source import BytesRead, Item, Tally, Unit, list_files
from rlftsim.scenario.tfrecord import SkippedRecord
from rlftsim.scenario.types import (
    CURRENT_STEP,
    HISTORY_STEPS,
    MEDIAN_SIZE_M,
    OTHER_SIZE_M,
    STEP_S,
    LightStates,
    ObjectType,
    Scenario,
    Tracks,
)

RECORDED_STEPS, OBSERVED_STEPS = 110, 50
Window = Literal["last", "first", "both", "av2"]
WINDOWS: Mapping[str, tuple[tuple[int, int], ...]] = {
    "last": ((19, 110),),
    "first": ((0, 91),),
    "both": ((0, 91), (19, 110)),
    "av2": ((39, 110),),
}
"""First step of each window and the step after the last. "av2" has the data set's current step, 49, and the 60
future steps, which are too few for the realism meta-metric."""
TEST_WINDOW = ((39, 50),)
OBJECT_TYPES = {
    "vehicle": ObjectType.VEHICLE,
    "bus": ObjectType.VEHICLE,
    "pedestrian": ObjectType.PEDESTRIAN,
    "cyclist": ObjectType.CYCLIST,
    "motorcyclist": ObjectType.CYCLIST,
}
UNUSED_OBJECT_TYPES = ("static", "background", "construction", "riderless_bicycle", "unknown")
"""Left out, or `ObjectType.OTHER` with `keep_other`."""
EGO, UNNAMED = "ego", "other"
SIZES_M = {
    "vehicle": MEDIAN_SIZE_M[ObjectType.VEHICLE],
    "bus": (12.0, 2.9, 3.2),
    "pedestrian": MEDIAN_SIZE_M[ObjectType.PEDESTRIAN],
    "cyclist": MEDIAN_SIZE_M[ObjectType.CYCLIST],
    "motorcyclist": (2.1, 0.9, 1.7),
    UNNAMED: OTHER_SIZE_M,
    EGO: (4.87, 1.85, 1.48),
}
"""Length, width and height where no file of sizes is given; the ego has the size of the recording vehicles."""
SPLITS = {"train": "training", "val": "validation", "test": "testing"}
FOCAL, SCORED = 3, 2
_CUT_TRACKS = "tracks to predict not evaluated, as they leave the ground that the map covers"
_SCHEMA: Schema = (
    dict.fromkeys(("track_id", "object_type", "scenario_id"), "text")
    | dict.fromkeys(("position_x", "position_y", "heading", "velocity_x", "velocity_y"), "numbers")
    | dict.fromkeys(("start_timestamp", "end_timestamp"), "numbers")
    | dict.fromkeys(("object_category", "timestep", "num_timestamps"), "whole numbers")
    | {"observed": "True or False"},
    dict.fromkeys(("city", "slice_id", "focal_track_id"), "text or nothing") | {"map_id": "numbers"},
)


class Av2Source:
    """The data source "av2": Argoverse 2 motion forecasting.

    Args:
        window: Steps that become a scenario: "last" (19 to 109), "first" (0 to 90), "both" (two scenarios) or "av2" (39
            to 109, for displacement errors as in the literature; cannot be scored). Test scenarios give steps 39 to 49.
        keep_other: True keeps static objects and the like as objects of type OTHER.
        sizes: JSON file with length, width and height in meters by object type, to use instead of `SIZES_M`:
            {"bus": [11.5, 2.6, 3.1]}.

    Raises:
        ConfigError: An unknown window, or a file that holds no sizes.
    """

    license_note = (
        "Argoverse 2 Motion Forecasting Dataset (argoverse.org): CC BY-NC-SA 4.0, non-commercial use, name the source, "
        "share adaptations under the same license. What is made from it (converted data, vocabularies, weights, "
        "pictures) carries this note."
    )
    attribution = "Made from the Argoverse 2 Motion Forecasting Dataset (argoverse.org), CC BY-NC-SA 4.0."

    def __init__(
        self, window: Window = "last", keep_other: bool = False, sizes: str | os.PathLike[str] | None = None
    ) -> None:
        if window not in WINDOWS:
            raise ConfigError(f"window must be one of {', '.join(get_args(Window))}, got {window!r}.")
        self.window = window
        self.keep_other = keep_other
        self.sizes = SIZES_M if sizes is None else {**SIZES_M, **_read_sizes(Path(sizes))}

    def detects(self, path: str | os.PathLike[str]) -> bool:
        """True where at least 1 scenario has a map in the same folder."""
        return any(_find_map(file).exists() for file in find_files(path))

    def find(self, path: str | os.PathLike[str]) -> list[Unit]:
        """One unit for the scenarios of a folder whose ids begin with the same two characters.

        So a whole split becomes 256 shards, and a scenario that is added later changes a single shard.
        """
        files = find_files(path)
        if not files:
            raise DataError(f"{path}: no scenario of Argoverse 2 here (names like scenario_ID.parquet)")
        groups = defaultdict(list)
        for file in files:
            split = file.absolute().parent.parent.name
            groups[(split, _parse_id(file)[:2])].append(file)
        units = []
        for (split, start), group in sorted(groups.items()):
            paths = tuple(path for file in group for path in (file, _find_map(file)) if path.exists())
            name = f"{split}/{start}" if split in SPLITS else start
            units.append(Unit(name, paths, SPLITS.get(split, "unknown")))
        return units

    def read(self, unit: Unit) -> Iterator[Item]:
        """Scenarios of a unit by id, and the cause for each that cannot be used."""
        record = 0
        for file in (file for file in unit.files if file.suffix == ".parquet"):
            try:
                for scenario, num_cut in read_scenario(file, self):
                    yield scenario
                    record += 1
                    if num_cut:
                        yield Tally(_CUT_TRACKS, num_cut)
            except DataError as error:
                yield SkippedRecord(_parse_id(file), record, str(error))
                record += 1
            yield BytesRead(sum(path.stat().st_size for path in (file, _find_map(file)) if path.exists()))

    def describe(self) -> dict[str, object]:
        """Guessed and missing values, and the settings."""
        return {
            "av2": {
                "guessed": ["size", "z"],
                "missing": ["lights", "stop signs", "speed limits"],
                "sizes_m": {name: list(size) for name, size in self.sizes.items()},
                "window": self.window,
                "keep_other": self.keep_other,
            }
        }


def find_files(path: str | os.PathLike[str]) -> list[Path]:
    """Parquet files of scenarios at a path, by id: a file, a folder with its subfolders, or a glob of either."""
    files = [path for path in list_files(path) if path.name.startswith("scenario_") and path.suffix == ".parquet"]
    return sorted(files, key=lambda file: (_parse_id(file), str(file)))


def read_scenario(file: Path, source: Av2Source) -> Iterator[tuple[Scenario, int]]:
    """Windows of a recording as scenarios, and how many tracks to predict were left out of each.

    Such a track leaves the ground that the map covers where the map is cut out of the city's: nearby road edges would
    wrongly make the track off-road.

    Args:
        file: Parquet file of a scenario, with the map in the same folder.
        source: Data source whose window and sizes are used.

    Raises:
        DataError: A file is missing or damaged, not of the published schema, or has impossible values.
    """
    rows = _read_rows(file)
    num_steps = _count_steps(rows)
    if not _find_map(file).exists():
        raise DataError(f"{file.name}: there is no {_find_map(file).name} beside it")
    map_features, ground = read_map(_find_map(file))
    windows = WINDOWS[source.window] if num_steps == RECORDED_STEPS else TEST_WINDOW
    recording, categories, ego = _read_tracks(rows, num_steps, source, ground)
    for first, end in windows:
        suffix = f"-{first}" if len(windows) > 1 else ""
        indices = np.flatnonzero(recording.valid[:, first:end].any(1))
        tracks = recording.select(indices).cut(slice(first, end))
        category, ego_indices = categories[indices], np.flatnonzero(indices == ego)
        if not len(ego_indices) or not tracks.valid[ego_indices[0], CURRENT_STEP]:
            raise DataError(f"the ego (track AV) is not there at the current step ({first + CURRENT_STEP})")
        predicted, num_cut = [], 0
        for track in np.flatnonzero((category >= SCORED) & tracks.valid[:, CURRENT_STEP]):
            path = tracks.position[track, HISTORY_STEPS - 1 :][tracks.valid[track, HISTORY_STEPS - 1 :]]
            is_cut = ground.leaves_through_cut(path[:, :2].astype(np.float64))
            num_cut += is_cut
            if not is_cut:
                predicted.append(track)
        scenario = Scenario(
            scenario_id=f"{rows['scenario_id'][0]}{suffix}",
            timestamps_s=np.round(np.arange(tracks.valid.shape[1]) * STEP_S, 1),
            tracks=tracks,
            map_features=map_features,
            lights=LightStates.of([]),
            ego_index=int(ego_indices[0]),
            tracks_to_predict=np.array(predicted, np.int32),
            difficulty=np.zeros(len(predicted), np.int8),
            objects_of_interest=tracks.object_id[category == FOCAL],
            source="av2",
            guessed=frozenset(("size", "z")),
        )
        yield scenario, num_cut


def _read_rows(file: Path) -> Rows:
    """Rows of a Parquet file of the published schema."""
    remedy = "get the file again"
    table = read_parquet(file, remedy, missing=f"{file.name} is missing: {remedy}")
    try:
        for name in table.schema.names:
            if not any(name in columns for columns in _SCHEMA) and not name.startswith("__index_level_"):
                raise DataError(f"{file.name} has the unknown column {name}")
        rows = read_rows(file.name, table, _SCHEMA)
    except DataError as error:
        raise DataError(f"{error}: its schema is not the published one") from None
    if not len(rows):
        raise DataError(f"{file.name} has no rows")
    return rows


def _count_steps(rows: Rows) -> int:
    """Number of recorded steps, 110, or 50 where the future is withheld."""
    for name in ("scenario_id", "num_timestamps", "start_timestamp", "end_timestamp"):
        if (rows[name] != rows[name][0]).any():
            raise DataError(f"{rows.table}: {name} must be the same in all rows")
    announced = int(rows["num_timestamps"][0])
    step = rows["timestep"]
    num_steps = int(step.max()) + 1
    allowed = (RECORDED_STEPS, OBSERVED_STEPS)
    if announced not in allowed or num_steps not in allowed or num_steps > announced:
        num_rejected = announced if announced not in allowed else num_steps
        allowed_text = f"{RECORDED_STEPS} ({OBSERVED_STEPS} in the test split)"
        raise DataError(f"{rows.table} has {num_rejected} steps instead of {allowed_text}")
    rows.check(step < 0, "timestep is {}", step)
    is_contrary = rows["observed"] != (step < OBSERVED_STEPS)
    rows.check(is_contrary, "the row contradicts itself: timestep {}, observed {}", step, rows["observed"])
    # the grid is exactly 0.1 s, so the ends must be as far apart as the number of steps says
    seconds, expected = (rows["end_timestamp"][0] - rows["start_timestamp"][0]) / 1e9, (announced - 1) * STEP_S
    if not abs(seconds / expected - 1) <= 0.01:
        raise DataError(f"{rows.table}: {announced} steps last {seconds:.3f} s instead of {expected:.1f} s")
    return num_steps


def _read_tracks(rows: Rows, num_steps: int, source: Av2Source, ground: Ground) -> tuple[Tracks, np.ndarray, int]:
    """Tracks of all steps in the order of the file, the categories, and the index of the ego."""
    names, first_row, owner = np.unique(rows["track_id"].astype(str), return_index=True, return_inverse=True)
    order = np.argsort(first_row)  # file order
    names, first_row, owner = names[order], first_row[order], np.argsort(order)[owner]
    step = rows["timestep"]
    for name in ("object_type", "object_category"):
        rows.check(rows[name] != rows[name][first_row][owner], f"track {{}} has a second {name}", names[owner])
    cells, counts = np.unique(owner * num_steps + step, return_counts=True)
    if (counts > 1).any():
        track, timestep = divmod(int(cells[counts > 1][0]), num_steps)
        raise DataError(f"{rows.table}: track {names[track]} has two rows for timestep {timestep}")
    motion_columns = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
    motion = np.column_stack([rows[name] for name in motion_columns])  # [rows, 5]
    is_impossible = ~(np.abs(motion).max(1) < 1e7)  # NaN, too
    cause = "track {} has a NaN, infinite or impossible value at timestep {}"
    rows.check(is_impossible, cause, names[owner], step)
    labels = rows["object_type"][first_row]
    unknown_labels = [label for label in labels if label not in OBJECT_TYPES and label not in UNUSED_OBJECT_TYPES]
    if unknown_labels:
        raise DataError(f"{rows.table}: unknown object_type {unknown_labels[0]!r}")
    if "AV" not in names:
        raise DataError(f"{rows.table} has no ego: no track AV")

    # states [O, S]; zeros where a track is not seen
    shape = (len(names), num_steps)
    states, valid = np.zeros((*shape, 5)), np.zeros(shape, bool)
    states[owner, step], valid[owner, step] = motion, True
    size_names = np.where(names == "AV", EGO, [label if label in OBJECT_TYPES else UNNAMED for label in labels])
    size = np.array([source.sizes[name] for name in size_names])  # [O, 3]
    z = np.zeros(shape)
    z[valid] = ground.heights.at(states[valid][:, :2])
    z += size[:, 2:] / 2  # centers of boxes that stand on the ground
    position = np.concatenate([states[..., :2], z[..., None]], -1) * valid[..., None]
    is_used = source.keep_other | (size_names != UNNAMED)
    tracks = Tracks(
        object_id=_object_ids(rows.table, names),
        object_type=np.array([OBJECT_TYPES.get(label, ObjectType.OTHER) for label in labels], np.int8),
        position=position.astype(np.float32),
        heading=states[..., 2].astype(np.float32),
        velocity=states[..., 3:].astype(np.float32),
        size=np.where(valid[..., None], size[:, None], 0.0).astype(np.float32),
        valid=valid,
    )
    category = rows["object_category"][first_row][is_used]
    return tracks.select(is_used), category, int(np.flatnonzero(names[is_used] == "AV")[0])


def _object_ids(table: str, names: np.ndarray) -> np.ndarray:
    """Track ids as numbers; the ego's is 0, or above the highest id where 0 is taken."""
    invalid = [name for name in names if name != "AV" and not (name.isdecimal() and len(name) < 19)]
    if invalid:
        raise DataError(f"{table}: track id {str(invalid[0])!r} is no number")
    ids = np.array([-1 if name == "AV" else int(name) for name in names], np.int64)
    ids[ids == -1] = ids.max() + 1 if (ids == 0).any() else 0
    if len(np.unique(ids)) < len(ids):
        raise DataError(f"{table}: two track ids are the same number")
    return ids


def _parse_id(file: Path) -> str:
    return file.stem.removeprefix("scenario_")


def _find_map(file: Path) -> Path:
    return file.with_name(f"log_map_archive_{_parse_id(file)}.json")


def _read_sizes(path: Path) -> dict[str, tuple[float, float, float]]:
    """Sizes by kind from a JSON file."""
    example = '{"vehicle": [4.6, 2.0, 1.6]}'
    remedy = f"sizes are written like {example}"
    sizes = read_json(path, remedy, error=ConfigError, missing=f"{path}: no such file: {remedy}.")
    for object_type, size in sizes.items():
        if object_type not in SIZES_M:
            raise ConfigError(f"{path}: no kind {object_type!r}: known are {', '.join(SIZES_M)}.")
        is_size = isinstance(size, list) and len(size) == 3
        if not is_size or not all(type(v) in (int, float) and 0 < v < 100 for v in size):
            raise ConfigError(
                f"{path}: the size of {object_type} is {size}: write length, width, height in meters, {example}."
            )
    return {object_type: (float(size[0]), float(size[1]), float(size[2])) for object_type, size in sizes.items()}
