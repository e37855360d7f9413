"""GPUDrive, PufferDrive and Nocturne: a JSON file for each scenario, made from the Waymo Open Motion Dataset.

Keys tell three forms apart. The present form has `metadata`, with the ego and the tracks to predict. The early form has
no metadata, no ids of objects, and headings in degrees that are not wrapped. The form of Nocturne has no `scenario_id`,
no heights and no sub-types of roads either. Missing values are guessed, see `Scenario.guessed`.
"""

import gzip
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from rlftsim.errors import DataError, in_short
from rlftsim.geometry import wrapped
from rlftsim.jobs.documents import read_json
from rlftsim.scenario.source import BytesRead, Item, Tally, Unit, infer_split, list_files
from rlftsim.scenario.tables import choose_predicted
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
    LightState,
    LightStates,
    MapFeatures,
    MapFeatureType,
    ObjectType,
    Scenario,
    Tracks,
    to_float32,
)
from rlftsim.scenario.womd import WomdSource

SUFFIXES = (".json", ".json.gz")
HEAD_BYTES, MAX_HEADS = 4096, 8
"""Looked at to recognize files: the beginning of each, and how many."""
ROAD_TYPES: Mapping[str, Sequence[int]] = {
    "lane": LANE_TYPES,
    "road_line": range(MapFeatureType.LINE_UNKNOWN, MapFeatureType.LINE_PASSING_DOUBLE_YELLOW + 1),
    "road_edge": ROAD_EDGE_TYPES,
    **{road_type.name.lower(): (int(road_type),) for road_type in (MapFeatureType.STOP_SIGN, *POLYGON_TYPES)},
}
"""Numbers of `map_element_id` by type of road."""
USUAL_TYPES = {
    "lane": MapFeatureType.LANE_SURFACE_STREET,
    "road_line": MapFeatureType.LINE_UNKNOWN,
    "road_edge": MapFeatureType.EDGE_BOUNDARY,
}
"""Guesses for roads without a sub-type."""
OBJECT_TYPES = {object_type.name.lower(): object_type for object_type in ObjectType}
LIGHT_STATES = {state.name.lower(): state for state in LightState}
MAX_OFF_M = 0.01
"""Largest distance between a goal and the last valid position that is no difference."""
_OFF_GOALS = "tracks whose goalPosition, which is not stored, is not their last valid position"


class GpudriveSource:
    """The data source "gpudrive": JSON files of GPUDrive, PufferDrive and Nocturne."""

    license_note = WomdSource.license_note

    def detects(self, path: str | os.PathLike[str]) -> bool:
        """True where the first files begin as such files do."""
        return any(b'"objects"' in _read_head(file) for file in find_files(path)[:MAX_HEADS])

    def find(self, path: str | os.PathLike[str]) -> list[Unit]:
        """A unit for the files of a folder whose names agree up to the last underscore: those of a tfrecord.

        Of names without underscores the first two characters count.
        """
        groups = defaultdict(list)
        for file in find_files(path):
            name = file.name.partition(".")[0]
            groups[file.parent, name.rpartition("_")[0] or name[:2]].append(file)
        if not groups:
            raise DataError(f"{path}: no JSON file of GPUDrive here (names like x.json or x.json.gz)")
        root = Path(os.path.commonpath([folder.absolute() for folder, _ in groups]))
        return [
            Unit((folder.absolute().relative_to(root) / name).as_posix(), tuple(files), infer_split(files[0]))
            for (folder, name), files in groups.items()
        ]

    def read(self, unit: Unit) -> Iterator[Item]:
        """Scenarios of a unit by file, the form of each, and the cause for each that cannot be used."""
        for record, file in enumerate(unit.files):
            try:
                scenario, form, num_off = read_scenario(file)
                yield scenario
                yield Tally(f"of the {form} form, with guessed {', '.join(sorted(scenario.guessed))}", 1)
                if num_off:
                    yield Tally(_OFF_GOALS, num_off)
            except DataError as error:
                yield SkippedRecord(str(file), record, str(error))
            yield BytesRead(file.stat().st_size)

    def describe(self) -> dict[str, object]:
        """Values that all forms lack; those that some forms lack are in `Scenario.guessed`."""
        missing = ["links between lanes", "speed limits", "lanes of stop signs"]
        guessed = ["size: that of the last valid step", "timestamps: 0.1 s apart"]
        return {"gpudrive": {"guessed": guessed, "missing": missing, "dropped": ["goalPosition", "mark_as_expert"]}}


def find_files(path: str | os.PathLike[str]) -> list[Path]:
    """JSON files at a path, by path: a file, a folder with its subfolders, or a glob of either."""
    return sorted(file for file in list_files(path) if file.name.endswith(SUFFIXES) and file.is_file())


def _read_head(file: Path) -> bytes:
    try:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as stream:
            return stream.read(HEAD_BYTES)
    except (OSError, EOFError):
        return b""


def read_scenario(file: Path) -> tuple[Scenario, str, int]:
    """Scenario of a file, the name of the form, and the number of goals that are not the last valid position.

    Raises:
        DataError: The file is damaged, of none of the forms, or has impossible values.
    """
    # NaN is refused where a value is used; numbers are parsed in half the time without a check of each
    values = read_json(file, "get the file again", allow_nan=True)
    form = "present" if "metadata" in values else "early" if "scenario_id" in values else "Nocturne"
    tracks, has_z, num_off = _read_tracks(_get(values, "objects", list, "the file"), has_degrees=form != "present")
    map_features, has_subtypes = _read_map(_get(values, "roads", list, "the file"))
    guessed = {"size"} | ({"z"} if not has_z else set()) | ({"subtype"} if not has_subtypes else set())
    if form == "present":
        metadata = _get(values, "metadata", dict, "the file")
        num_tracks, named = len(tracks.valid), "tracks_to_predict"
        ego = _to_integer(metadata.get("sdc_track_index"), "sdc_track_index", num_tracks)
        entries = _get(metadata, named, list, "metadata")
        predicted = [_to_integer(_get(entry, "track_index", int, named), named, num_tracks) for entry in entries]
        difficulty = [_to_integer(_get(entry, "difficulty", int, named), "difficulty", 128) for entry in entries]
        interest = _get(metadata, "objects_of_interest", list, "metadata")
    else:
        guessed |= {"ego", "predict"}
        ego, interest = len(tracks.valid) - 1, []
        predicted = choose_predicted(tracks, ego)
        difficulty = [0] * len(predicted)
    if not tracks.valid[ego, CURRENT_STEP]:
        raise DataError(f"the ego (track {tracks.object_id[ego]}) is not valid at the current step ({CURRENT_STEP})")
    id_name = "name" if form == "Nocturne" else "scenario_id"
    scenario = Scenario(
        scenario_id=_get(values, id_name, str, "the file").removesuffix(".json"),
        timestamps_s=np.round(np.arange(tracks.valid.shape[1]) * STEP_S, 1),
        tracks=tracks,
        map_features=map_features,
        lights=_read_lights(_get(values, "tl_states", dict, "the file"), tracks.valid.shape[1]),
        ego_index=ego,
        tracks_to_predict=np.array(predicted, np.int32),
        difficulty=np.array(difficulty, np.int8),
        objects_of_interest=np.array([_to_integer(value, "objects_of_interest") for value in interest], np.int64),
        source="gpudrive",
        guessed=frozenset(guessed),
    )
    return scenario, form, num_off


def _read_tracks(objects: list[Any], *, has_degrees: bool) -> tuple[Tracks, bool, int]:
    """Tracks, whether they have heights, and how many have a goal that is not the last valid position."""
    if not objects:
        raise DataError("the file has no objects")
    has_z = _has_z(_get(objects[0], "position", list, "object 0"))
    axes = "xyz" if has_z else "xy"
    ids, types, valid, states, sizes, num_off = [], [], [], [], [], 0
    for index, entry in enumerate(objects):
        owner = f"object {index}"
        ids.append(_to_integer(entry.get("id", index) if isinstance(entry, dict) else None, f"{owner}: id"))
        name = _get(entry, "type", str, owner)
        if name not in OBJECT_TYPES:
            raise DataError(f"{owner}: type is {in_short(name)}, none of {', '.join(OBJECT_TYPES)}")
        types.append(OBJECT_TYPES[name])
        height = MEDIAN_SIZE_M.get(types[-1], OTHER_SIZE_M)[2]
        sides = [entry.get("length"), entry.get("width"), entry.get("height") if has_z else height]
        sizes.append(_to_numbers(sides, f"{owner}: length, width, height"))
        position = _read_points(_get(entry, "position", list, owner), axes, f"{owner}: position", height / 2)
        heading = _to_numbers(_get(entry, "heading", list, owner), f"{owner}: heading")
        velocity = _read_points(_get(entry, "velocity", list, owner), "xy", f"{owner}: velocity")
        is_valid = _get(entry, "valid", list, owner)
        lengths = {len(position), len(heading), len(velocity), len(is_valid)}
        if len(lengths) > 1 or lengths not in ({TOTAL_STEPS}, {HISTORY_STEPS}) or not {*map(type, is_valid)} <= {bool}:
            raise DataError(f"{owner}: not {TOTAL_STEPS} positions, headings, velocities and true or false in valid")
        valid.append(np.array(is_valid))
        states.append(np.column_stack([position, heading, velocity[:, :2]]))
        goal = _read_points([entry.get("goalPosition")], axes, f"{owner}: goalPosition", height / 2)
        last = position[valid[-1]][-1:]
        num_off += int(len(last) > 0 and not np.abs(goal - last).max() <= MAX_OFF_M)
    if len({len(steps) for steps in valid}) > 1:
        raise DataError("objects have different numbers of steps")
    is_valid, values = np.stack(valid), np.stack(states)  # [O, S], [O, S, 6]
    heading = np.deg2rad(values[..., 3]) if has_degrees else values[..., 3]
    with np.errstate(invalid="ignore"):  # what is not finite is refused by name
        values[..., 3] = wrapped(heading)
    values[~is_valid] = 0.0
    values = to_float32(values)
    size = np.where(is_valid[..., None], np.stack(sizes)[:, None], 0.0)
    tracks = Tracks(
        object_id=np.array(ids, np.int64),
        object_type=np.array(types, np.int8),
        position=values[..., :3],
        heading=values[..., 3],
        velocity=values[..., 4:],
        size=to_float32(size),
        valid=is_valid,
    )
    return tracks, has_z, num_off


def _read_map(roads: list[Any]) -> tuple[MapFeatures, bool]:
    """Map features in the order of the file, and whether all have sub-types."""
    features, has_subtypes = [], True
    for index, road in enumerate(roads):
        name, owner = _get(road, "type", str, f"road {index}"), f"road {index}"
        if name not in ROAD_TYPES:
            raise DataError(f"{owner}: type is {in_short(name)}, none of {', '.join(ROAD_TYPES)}")
        subtype = road.get("map_element_id") if name in USUAL_TYPES else ROAD_TYPES[name][0]
        if subtype is None:
            has_subtypes, subtype = False, USUAL_TYPES[name]
        if not isinstance(subtype, int) or subtype not in ROAD_TYPES[name]:
            raise DataError(f"{owner}: map_element_id is {in_short(subtype)}, which is no {name}")
        points = _get(road, "geometry", list, owner)
        line = _read_points(points, "xyz" if _has_z(points) else "xy", owner)
        features.append((_to_integer(road.get("id", index), f"{owner}: id"), int(subtype), line))
    return MapFeatures.of(features, has_polygon_rest=True), has_subtypes


def _read_lights(lanes: dict[str, Any], num_steps: int) -> LightStates:
    """States of all lights, by step."""
    rows = []
    for lane, light in lanes.items():
        owner = f"light of lane {in_short(lane)}"
        if not lane.isdecimal() or len(lane) > 18:
            raise DataError(f"{owner}: the lane is no number")
        names, steps = _get(light, "state", list, owner), _get(light, "time_index", list, owner)
        axes = [_get(light, axis, list, owner) for axis in "xyz" if axis in light or axis != "z"]
        stop_points = [_to_numbers(axis, owner) for axis in axes] + [np.zeros(len(steps))] * (3 - len(axes))
        if {len(names), *map(len, stop_points)} != {len(steps)}:
            raise DataError(f"{owner}: its lists differ in length")
        for name, step, *point in zip(names, steps, *stop_points):
            if not isinstance(name, str) or name not in LIGHT_STATES:
                raise DataError(f"{owner}: state is {in_short(name)}, none of {', '.join(LIGHT_STATES)}")
            rows.append((_to_integer(step, f"{owner}: time_index", num_steps), int(lane), LIGHT_STATES[name], *point))
    return LightStates.of(sorted(rows, key=itemgetter(0)))


def _get(values: Any, name: str, expected: type, owner: str) -> Any:
    """Member of an object, of the expected type."""
    value = values.get(name) if isinstance(values, dict) else None
    if type(value) is not expected:
        missing = isinstance(values, dict) and name not in values
        cause = f"no {name}" if missing else f"{name} is {in_short(value)}"
        raise DataError(f"{owner}: {cause}, not as GPUDrive writes files")
    return value


def _has_z(points: list[Any]) -> bool:
    return bool(points) and isinstance(points[0], dict) and "z" in points[0]


def _to_integer(value: Any, owner: str, stop: int = 2**63) -> int:
    if type(value) is not int or not 0 <= value < stop:
        raise DataError(f"{owner} is {in_short(value)}, no whole number below {stop}")
    return value


def _to_numbers(values: list[Any], owner: str) -> Float64[np.ndarray, "n"]:
    if not {*map(type, values)} <= {int, float}:
        raise DataError(f"{owner}: not all are numbers")
    return np.array(values, np.float64)


def _read_points(points: list[Any], axes: str, owner: str, z: float = 0.0) -> Float64[np.ndarray, "n 3"]:
    """Points of a file; z is that of points without heights."""
    try:
        values = list(chain.from_iterable(map(itemgetter(*axes), points)))
    except (KeyError, TypeError):
        raise DataError(f"{owner}: a point without {', '.join(axes)}") from None
    rows = _to_numbers(values, owner).reshape(-1, len(axes))
    return np.pad(rows, ((0, 0), (0, 3 - len(axes))), constant_values=z)
