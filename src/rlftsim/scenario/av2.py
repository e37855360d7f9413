"""Argoverse 2 motion forecasting: a Parquet file of tracks and a JSON map for each scenario.

Layout: `<split>/<uuid>/scenario_<uuid>.parquet` and `log_map_archive_<uuid>.json` beside it. A recording has 110 steps
at 10 Hz, of which a window of 91 becomes a scenario. The test split has the first 50 only.

The data have no box sizes and no heights of tracks: both are guessed, and `Scenario.guessed` says so. They have no
lights, stop signs and speed limits: the scenarios have none.
"""

import glob
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pyarrow as pa

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.tables import read_parquet
from rlftsim.scenario.av2_map import Ground, read_map
from rlftsim.scenario.source import BytesRead, Item, Tally, Unit
from rlftsim.scenario.tfrecord import SkippedRecord
from rlftsim.scenario.types import (
    CURRENT_STEP,
    HISTORY_STEPS,
    MEDIAN_SIZE_M,
    OTHER_SIZE_M,
    STEP_S,
    LightStates,
    MapFeatures,
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
"""First step of each window and the step after its last. That of "av2" has the data set's own current step, 49, and its
60 future steps, which are too few for the realism meta-metric."""
TEST_WINDOW = ((39, 50),)
KINDS = {
    "vehicle": ObjectType.VEHICLE,
    "bus": ObjectType.VEHICLE,
    "pedestrian": ObjectType.PEDESTRIAN,
    "cyclist": ObjectType.CYCLIST,
    "motorcyclist": ObjectType.CYCLIST,
}
OTHER_KINDS = ("static", "background", "construction", "riderless_bicycle", "unknown")
"""Left out, or `ObjectType.OTHER` with `keep_other`."""
EGO, OTHER = "ego", "other"
SIZES_M = {
    "vehicle": MEDIAN_SIZE_M[ObjectType.VEHICLE],
    "bus": (12.0, 2.9, 3.2),
    "pedestrian": MEDIAN_SIZE_M[ObjectType.PEDESTRIAN],
    "cyclist": MEDIAN_SIZE_M[ObjectType.CYCLIST],
    "motorcyclist": (2.1, 0.9, 1.7),
    OTHER: OTHER_SIZE_M,
    EGO: (4.87, 1.85, 1.48),
}
"""Length, width and height where no file of sizes is given; for the ego those of the make of the recording vehicles."""
SPLITS = {"train": "training", "val": "validation", "test": "testing"}
FOCAL, SCORED = 3, 2
_COLUMNS = {
    **dict.fromkeys(("track_id", "object_type", "scenario_id", "focal_track_id", "city", "slice_id"), str),
    **dict.fromkeys(("position_x", "position_y", "heading", "velocity_x", "velocity_y"), float),
    **dict.fromkeys(("start_timestamp", "end_timestamp"), float),
    **dict.fromkeys(("object_category", "timestep", "num_timestamps", "map_id"), int),
    "observed": bool,
}
_NEEDED = [name for name in _COLUMNS if name not in ("city", "slice_id", "map_id", "focal_track_id")]
_ARROW_KINDS = {
    str: lambda kind: pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_null(kind),
    float: lambda kind: pa.types.is_floating(kind) or pa.types.is_integer(kind),
    int: lambda kind: pa.types.is_integer(kind),
    bool: lambda kind: pa.types.is_boolean(kind),
}


class Av2Source:
    """The data source "av2": Argoverse 2 motion forecasting.

    Args:
        window: steps that become a scenario: "last" (19 to 109), "first" (0 to 90), "both" (two scenarios) or "av2" (39
            to 109, for displacement errors as in the literature; cannot be scored). Test scenarios give steps 39 to 49.
        keep_other: True keeps static objects and the like as objects of type OTHER.
        sizes: JSON file with length, width and height in meters by kind, to use instead of `SIZES_M`:
            {"bus": [11.5, 2.6, 3.1]}.

    Raises:
        ConfigError: an unknown window, or a file of sizes that is none.
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
        """True where at least one scenario has its map beside it."""
        return any(_parse_map(file).exists() for file in find_files(path))

    def find(self, path: str | os.PathLike[str]) -> list[Unit]:
        """One unit for the scenarios of a folder whose ids begin with the same two characters.

        So a whole split becomes 256 shards, and a scenario that is added later changes one of them.
        """
        files = find_files(path)
        if not files:
            raise DataError(f"{path}: no scenario of Argoverse 2 here (names like scenario_ID.parquet)")
        groups = defaultdict(list)
        for file in files:
            split = file.absolute().parent.parent.name
            groups[(split, _read_id(file)[:2])].append(file)
        return [
            Unit(
                f"{split}/{start}" if split in SPLITS else start,
                tuple(part for file in group for part in (file, _parse_map(file)) if part.exists()),
                SPLITS.get(split, "unknown"),
            )
            for (split, start), group in sorted(groups.items())
        ]

    def read(self, unit: Unit) -> Iterator[Item]:
        """The scenarios of a unit by id, those that cannot be used with their cause."""
        record = 0
        for file in (file for file in unit.files if file.suffix == ".parquet"):
            try:
                for scenario, num_cut in read_scenario(file, self):
                    yield scenario
                    record += 1
                    if num_cut:
                        yield Tally(
                            "tracks to predict not evaluated, as they leave the ground that the map covers", num_cut
                        )
            except DataError as error:
                yield SkippedRecord(_read_id(file), record, str(error))
                record += 1
            yield BytesRead(sum(part.stat().st_size for part in (file, _parse_map(file)) if part.exists()))

    def describe(self) -> dict[str, object]:
        """Guessed sizes, what is missing, and the settings."""
        return {
            "av2": {
                "guessed": ["size", "z"],
                "missing": ["lights", "stop signs", "speed limits"],
                "sizes_m": {kind: list(size) for kind, size in self.sizes.items()},
                "window": self.window,
                "keep_other": self.keep_other,
            }
        }


def find_files(path: str | os.PathLike[str]) -> list[Path]:
    """Parquet files of scenarios at a path, by id: a file, a folder with its subfolders, or a glob of either."""
    places = [Path(path)] if os.path.exists(path) else [Path(name) for name in glob.glob(str(path), recursive=True)]
    found = {
        file
        for place in places
        for file in (place.rglob("scenario_*.parquet") if place.is_dir() else [place])
        if file.name.startswith("scenario_") and file.suffix == ".parquet"
    }
    return sorted(found, key=lambda file: (_read_id(file), str(file)))


def read_scenario(file: Path, source: Av2Source) -> Iterator[tuple[Scenario, int]]:
    """The windows of a recording as scenarios, and how many tracks to predict were left out of each.

    Such a track leaves the ground that the map covers where the map is cut out of the city's: nearby road edges would
    make it off-road, which it is not.

    Args:
        file: Parquet file of a scenario; its map is beside it.
        source: window and sizes.

    Raises:
        DataError: a file is missing or damaged, not of the published schema, or has impossible values.
    """
    columns = _read_columns(file)
    num_steps = _count_steps(file, columns)
    if not _parse_map(file).exists():
        raise DataError(f"{file.name}: there is no {_parse_map(file).name} beside it")
    map_features, ground = read_map(_parse_map(file))
    windows = WINDOWS[source.window] if num_steps == RECORDED_STEPS else TEST_WINDOW
    whole, category, ego = _read_tracks(file, columns, num_steps, source, ground)
    for first, end in windows:
        suffix = f"-{first}" if len(windows) > 1 else ""
        scenario_id = f"{columns['scenario_id'][0]}{suffix}"
        yield _cut_window(scenario_id, whole, category, ego, slice(first, end), map_features, ground)


def _cut_window(
    scenario_id: str,
    whole: Tracks,
    category: np.ndarray,
    ego: int,
    window: slice,
    map_features: MapFeatures,
    ground: Ground,
) -> tuple[Scenario, int]:
    """Scenario of some steps of a recording, see `read_scenario`."""
    valid = whole.valid[:, window]
    kept = np.flatnonzero(valid.any(1))
    tracks = Tracks(
        object_id=whole.object_id[kept],
        object_type=whole.object_type[kept],
        position=whole.position[kept][:, window],
        heading=whole.heading[kept][:, window],
        velocity=whole.velocity[kept][:, window],
        size=whole.size[kept][:, window],
        valid=valid[kept],
    )
    category, own = category[kept], np.flatnonzero(kept == ego)
    if not len(own) or not tracks.valid[own[0], CURRENT_STEP]:
        raise DataError(f"the ego (track AV) is not there at the current step ({window.start + CURRENT_STEP})")
    predicted, num_cut = [], 0
    for track in np.flatnonzero((category >= SCORED) & tracks.valid[:, CURRENT_STEP]):
        path = tracks.position[track, HISTORY_STEPS - 1 :][tracks.valid[track, HISTORY_STEPS - 1 :]]
        is_cut = ground.leaves_through_cut(path[:, :2].astype(np.float64))
        num_cut += is_cut
        if not is_cut:
            predicted.append(track)
    scenario = Scenario(
        scenario_id=scenario_id,
        timestamps_s=np.round(np.arange(tracks.valid.shape[1]) * STEP_S, 1),
        tracks=tracks,
        map_features=map_features,
        lights=LightStates(
            np.zeros(0, np.int32), np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros((0, 3), np.float32)
        ),
        ego_index=int(own[0]),
        tracks_to_predict=np.array(predicted, np.int32),
        difficulty=np.zeros(len(predicted), np.int8),
        objects_of_interest=tracks.object_id[category == FOCAL],
        source="av2",
        guessed=frozenset(("size", "z")),
    )
    return scenario, num_cut


def _read_columns(file: Path) -> dict[str, np.ndarray]:
    """Columns of a Parquet file, all of the published schema and of its types."""
    try:
        table = read_parquet(file, "get the file again")
    except FileNotFoundError:
        raise DataError(f"{file.name} is missing: get the file again") from None
    names = [name for name in table.schema.names if not name.startswith("__index_level_")]
    unknown = [name for name in names if name not in _COLUMNS]
    missing = [name for name in _NEEDED if name not in names]
    if unknown or missing:
        cause = f"the unknown column {unknown[0]}" if unknown else f"no column {missing[0]}"
        raise DataError(f"{file.name} has {cause}: its schema is not the published one")
    if not table.num_rows:
        raise DataError(f"{file.name} has no rows")
    columns = {}
    for name in names:
        column = table[name]
        if not _ARROW_KINDS[_COLUMNS[name]](column.type):
            raise DataError(f"{file.name}: column {name} is {column.type}: its schema is not the published one")
        if column.null_count and name in _NEEDED:
            raise DataError(f"{file.name}: column {name} has empty values")
        columns[name] = column.to_numpy()
    return columns


def _count_steps(file: Path, columns: Mapping[str, np.ndarray]) -> int:
    """Number of recorded steps, 110, or 50 where the future is withheld."""
    for name in ("scenario_id", "num_timestamps", "start_timestamp", "end_timestamp"):
        if (columns[name] != columns[name][0]).any():
            raise DataError(f"{file.name}: {name} must be the same in all rows")
    announced = int(columns["num_timestamps"][0])
    step = columns["timestep"]
    num_steps = int(step.max()) + 1
    allowed = (RECORDED_STEPS, OBSERVED_STEPS)
    if announced not in allowed or num_steps not in allowed or num_steps > announced:
        found = announced if announced not in allowed else num_steps
        wanted = f"{RECORDED_STEPS} ({OBSERVED_STEPS} in the test split)"
        raise DataError(f"{file.name} has {found} steps instead of {wanted}")
    if step.min() < 0:
        raise DataError(f"{file.name}: row {int(step.argmin())} has the timestep {int(step.min())}")
    wrong = np.flatnonzero(columns["observed"] != (step < OBSERVED_STEPS))
    if len(wrong):
        raise DataError(f"{file.name}: row {wrong[0]} contradicts itself: timestep {step[wrong[0]]}, observed "
                        f"{columns['observed'][wrong[0]]}")  # fmt: skip
    # the grid is exactly 0.1 s, so the ends must be as far apart as the number of steps says
    seconds, expected = (columns["end_timestamp"][0] - columns["start_timestamp"][0]) / 1e9, (announced - 1) * STEP_S
    if not abs(seconds / expected - 1) <= 0.01:
        raise DataError(f"{file.name}: {announced} steps last {seconds:.3f} s instead of {expected:.1f} s")
    return num_steps


def _read_tracks(
    file: Path, columns: Mapping[str, np.ndarray], num_steps: int, source: Av2Source, ground: Ground
) -> tuple[Tracks, np.ndarray, int]:
    """Tracks of all steps in the order of the file, their categories, and the index of the ego."""
    names, first_row, owner = np.unique(columns["track_id"].astype(str), return_index=True, return_inverse=True)
    order = np.argsort(first_row)  # file order
    names, first_row, owner = names[order], first_row[order], np.argsort(order)[owner]
    step = columns["timestep"].astype(np.int64)
    for name in ("object_type", "object_category"):
        wrong = np.flatnonzero(columns[name] != columns[name][first_row][owner])
        if len(wrong):
            raise DataError(f"{file.name}: row {wrong[0]}: track {names[owner[wrong[0]]]} has a second {name}")
    cells, counts = np.unique(owner * num_steps + step, return_counts=True)
    if (counts > 1).any():
        track, when = divmod(int(cells[counts > 1][0]), num_steps)
        raise DataError(f"{file.name}: track {names[track]} has two rows for timestep {when}")
    parts = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
    motion = np.column_stack([columns[name].astype(np.float64) for name in parts])  # [rows, 5]
    wrong = np.flatnonzero(~(np.abs(motion) < 1e7).all(1))  # NaN is not, either
    if len(wrong):
        raise DataError(
            f"{file.name}: row {wrong[0]}: track {names[owner[wrong[0]]]} has a NaN, infinite or impossible value at "
            f"timestep {step[wrong[0]]}"
        )
    kinds = columns["object_type"][first_row]
    unknown = [kind for kind in kinds if kind not in KINDS and kind not in OTHER_KINDS]
    if unknown:
        raise DataError(f"{file.name}: unknown object_type {unknown[0]!r}")
    if "AV" not in names:
        raise DataError(f"{file.name} has no ego: no track AV")

    # states [O, S]; zeros where a track is not seen
    shape = (len(names), num_steps)
    states, valid = np.zeros((*shape, 5)), np.zeros(shape, bool)
    states[owner, step], valid[owner, step] = motion, True
    size = np.array(
        [source.sizes[EGO if name == "AV" else kind if kind in KINDS else OTHER] for name, kind in zip(names, kinds)]
    )  # [O, 3]
    z = np.zeros(shape)
    z[valid] = ground.heights.at(states[valid][:, :2])
    z += size[:, 2:] / 2  # centers of boxes that stand on the ground
    position = np.concatenate([states[..., :2], z[..., None]], -1) * valid[..., None]
    kept = np.array([source.keep_other or kind in KINDS or name == "AV" for name, kind in zip(names, kinds)])
    tracks = Tracks(
        object_id=_object_ids(file, names)[kept],
        object_type=np.array([KINDS.get(kind, ObjectType.OTHER) for kind in kinds], np.int8)[kept],
        position=position.astype(np.float32)[kept],
        heading=states[kept][..., 2].astype(np.float32),
        velocity=states[kept][..., 3:].astype(np.float32),
        size=np.where(valid[..., None], size[:, None], 0.0).astype(np.float32)[kept],
        valid=valid[kept],
    )
    category = columns["object_category"][first_row][kept]
    return tracks, category, int(np.flatnonzero(names[kept] == "AV")[0])


def _object_ids(file: Path, names: np.ndarray) -> np.ndarray:
    """Track ids as numbers; that of the ego is 0, or one above all others where 0 is taken."""
    wrong = [name for name in names if name != "AV" and not (name.isdecimal() and len(name) < 19)]
    if wrong:
        raise DataError(f"{file.name}: track id {str(wrong[0])!r} is no number")
    ids = np.array([-1 if name == "AV" else int(name) for name in names], np.int64)
    ids[ids == -1] = ids.max() + 1 if (ids == 0).any() else 0
    if len(np.unique(ids)) < len(ids):
        raise DataError(f"{file.name}: two track ids are the same number")
    return ids


def _read_id(file: Path) -> str:
    return file.stem.removeprefix("scenario_")


def _parse_map(file: Path) -> Path:
    return file.with_name(f"log_map_archive_{_read_id(file)}.json")


def _read_sizes(path: Path) -> dict[str, tuple[float, float, float]]:
    """Sizes by kind from a JSON file."""
    example = '{"vehicle": [4.6, 2.0, 1.6]}'
    try:
        given = read_json(path, f"sizes are written like {example}", error=ConfigError)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file: sizes are written like {example}.") from None
    for kind, size in given.items():
        if kind not in SIZES_M:
            raise ConfigError(f"{path}: no kind {kind!r}: known are {', '.join(SIZES_M)}.")
        is_size = isinstance(size, list) and len(size) == 3
        if not is_size or not all(type(v) in (int, float) and 0 < v < 100 for v in size):
            raise ConfigError(
                f"{path}: the size of {kind} is {size}: write length, width, height in meters, {example}."
            )
    return {kind: (float(size[0]), float(size[1]), float(size[2])) for kind, size in given.items()}
