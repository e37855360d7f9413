"""Waymo Open Motion Dataset: TFRecord files of `Scenario` messages to `Scenario` objects, without TensorFlow.

World coordinates become float32 here and nowhere else, because the official evaluator rounds them before it does
anything. Values of states that are not valid are kept.
"""

import glob
import os
import re
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rlftsim.errors import DataError
from rlftsim.scenario import womd_pb2
from rlftsim.scenario.source import BytesRead, Item, Unit, read_unit, units_of_files
from rlftsim.scenario.tfrecord import RECORD_OVERHEAD_BYTES, OnError, SkippedRecord, log_skipped, read_records
from rlftsim.scenario.types import (
    CURRENT_STEP,
    HISTORY_STEPS,
    TOTAL_STEPS,
    LaneTopology,
    LightStates,
    MapFeatures,
    MapFeatureType,
    Scenario,
    Tracks,
)

_TFRECORD_NAME = re.compile(r"\.tfrecords?(-\d+-of-\d+)?$")
_LEFT, _RIGHT = 0, 1
_STATE_FIELDS = (
    *("center_x", "center_y", "center_z", "length", "width", "height"),
    *("heading", "velocity_x", "velocity_y", "valid"),
)
_POLYGONS = ("crosswalk", "speed_bump", "driveway")


def find_tfrecords(source: str | os.PathLike[str]) -> list[Path]:
    """Files of a source, sorted by path.

    Args:
        source: a file of any name, a folder (searched with its subfolders for names like `x.tfrecord` and
            `training.tfrecord-00000-of-01000`), or a glob (`**` = any subfolders).

    Raises:
        DataError: there is no such file, or none in the folder.
    """
    path = Path(source)
    if path.is_file():
        return [path]
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if _TFRECORD_NAME.search(file.name) and file.is_file())
        if not files:
            raise DataError(
                f"{path}: no tfrecord file in this folder (names like x.tfrecord or x.tfrecord-00000-of-00010), "
                "and no other source recognizes it: name one to learn what it misses (--from av2, --from tables)"
            )
        return files
    files = sorted(Path(name) for name in glob.glob(str(source), recursive=True) if os.path.isfile(name))
    if not files:
        raise DataError(f"{source}: no such file or folder, and no file matches it as a pattern")
    return files


def read_scenarios(
    source: str | os.PathLike[str],
    on_error: OnError = "stop",
    *,
    report: Callable[[SkippedRecord], None] = log_skipped,
) -> Iterator[Scenario]:
    """Read the scenarios of tfrecord files, in the order of paths and records.

    Args:
        source: file, folder or glob, as in `find_tfrecords`.
        on_error: "stop" raises at the first bad file or record, "skip" reports it and goes on.
        report: called with each skipped record, only under "skip".

    Raises:
        DataError: no such file; under "stop" also any bad record: names file, record and cause.
    """
    for path in find_tfrecords(source):
        for _, scenario in read_scenario_file(path, on_error=on_error, report=report):
            yield scenario


def read_scenario_file(
    path: str | os.PathLike[str], *, on_error: OnError = "stop", report: Callable[[SkippedRecord], None] = log_skipped
) -> Iterator[tuple[int, Scenario]]:
    """Read one tfrecord file; yields the number of the record, from 0, with its scenario.

    Args:
        path: the file.
        on_error: "stop" raises at the first bad record, "skip" reports it and goes on.
        report: called with each skipped record, only under "skip".

    Raises:
        DataError: no such file; under "stop" also any bad record: names file, record and cause.
    """
    return read_unit(WomdSource(), Unit(str(path), (Path(path),)), on_error=on_error, report=report)


class WomdSource:
    """The data source "womd": tfrecord files of `Scenario` messages."""

    license_note = (
        "Waymo Open Dataset material: Waymo Dataset License Agreement for Non-Commercial Use (waymo.com/open/terms). "
        "This work was made using the Waymo Open Dataset, provided by Waymo LLC."
    )

    def detects(self, path: str | os.PathLike[str]) -> bool:
        """True where at least one file has the name of a tfrecord."""
        try:
            return any(_TFRECORD_NAME.search(file.name) for file in find_tfrecords(path))
        except DataError:
            return False

    def find(self, path: str | os.PathLike[str]) -> list[Unit]:
        """One unit per tfrecord file, as in `find_tfrecords`."""
        return units_of_files(find_tfrecords(path))

    def read(self, unit: Unit) -> Iterator[Item]:
        """The records of a tfrecord file in order, those that are damaged or no scenarios with their cause."""
        (path,) = unit.files
        damaged: list[SkippedRecord] = []
        for record, data in read_records(path, on_error="skip", report=damaged.append):
            # the framing reports damage before it yields the next whole record
            yield from damaged
            damaged.clear()
            try:
                yield scenario_from_bytes(data)
            except DataError as error:
                yield SkippedRecord(str(path), record, str(error))
            yield BytesRead(len(data) + RECORD_OVERHEAD_BYTES)
        yield from damaged

    def describe(self) -> dict[str, object]:
        """Nothing: no value of a record is guessed."""
        return {}


def scenario_from_bytes(record: bytes) -> Scenario:
    """Scenario of one serialized WOMD `Scenario` message with 91 steps, or 11 as in the test splits.

    Map, lights, tracks to predict and objects of interest may be missing. Map features of a kind that WOMD did not
    have when this was written are left out.

    Raises:
        DataError: the bytes are no such message; there is no ego or it is not valid at step 10; a valid state or a map
            point is not finite; the number of steps is another one; a track to predict does not exist; an object id
            occurs twice; a type is unknown; a size at step 10 is not above zero.
    """
    try:
        message = womd_pb2.Scenario.FromString(record)
    except DecodeError as error:
        raise DataError(
            "not a WOMD Scenario message: the bytes cannot be parsed (files in tf.Example format are not read)"
        ) from error
    if not message.scenario_id or not message.tracks:
        missing = "tracks" if message.scenario_id else "scenario_id"
        raise DataError(f"not a WOMD Scenario message, or an empty one: it has no {missing}")
    if not isinstance(message.scenario_id, str):  # the parser hands out bytes where they are not UTF-8
        raise DataError(f"not a WOMD Scenario message, or a damaged one: its scenario_id is {message.scenario_id!r}")
    tracks = _read_tracks(message)
    num_steps = tracks.valid.shape[1]
    # the ego must be there now: it is always evaluated, and the map frame is centered on it
    ego = message.sdc_track_index
    if not message.HasField("sdc_track_index"):
        raise DataError("no ego: sdc_track_index is not set")
    if not 0 <= ego < len(tracks.valid):
        raise DataError(f"no ego: sdc_track_index is {ego}, but there are {len(tracks.valid)} tracks")
    if message.HasField("current_time_index") and message.current_time_index != CURRENT_STEP:
        raise DataError(f"current_time_index is {message.current_time_index} instead of {CURRENT_STEP}")
    if not tracks.valid[ego, CURRENT_STEP]:
        raise DataError(f"the ego (track {tracks.object_id[ego]}) is not valid at the current step ({CURRENT_STEP})")
    if len(message.timestamps_seconds) < num_steps:
        raise DataError(f"{len(message.timestamps_seconds)} timestamps for {num_steps} steps")
    scenario = Scenario(
        scenario_id=message.scenario_id,
        timestamps_s=np.array(message.timestamps_seconds[:num_steps], np.float64),
        tracks=tracks,
        map_features=_read_map(message.map_features),
        lights=_read_lights(message.dynamic_map_states[:num_steps]),
        ego_index=ego,
        tracks_to_predict=np.array([item.track_index for item in message.tracks_to_predict], np.int32),
        difficulty=np.array([item.difficulty for item in message.tracks_to_predict], np.int8),
        objects_of_interest=np.array(message.objects_of_interest, np.int64),
        source="womd",
    )
    scenario.check_consistency()
    scenario.check_finite_arrays()
    scenario.check_precision()
    return scenario


def _read_tracks(message: womd_pb2.Scenario) -> Tracks:
    """All tracks, with the values of states that are not valid, too."""
    first = message.tracks[0]
    num_steps = len(first.states)
    for track in message.tracks:
        if len(track.states) != num_steps:
            raise DataError(f"track {track.id} has {len(track.states)} states, track {first.id} has {num_steps}")
    if num_steps not in (HISTORY_STEPS, TOTAL_STEPS):
        raise DataError(
            f"{num_steps} steps instead of {TOTAL_STEPS} (or {HISTORY_STEPS} in a test split): "
            "take WOMD's 9-second files, not the 20-second ones"
        )
    # one tuple per state, made in C: filling arrays field by field costs several times as much
    numbers_of = attrgetter(*_STATE_FIELDS)
    rows = [numbers_of(state) for track in message.tracks for state in track.states]
    # float64 holds all fields exactly, `valid` as 0 or 1
    states = np.array(rows).reshape(len(message.tracks), num_steps, -1)  # [O, S, 10] float64
    values = _to_float32(states)
    return Tracks(
        object_id=np.array([track.id for track in message.tracks], np.int64),
        object_type=np.array([track.object_type for track in message.tracks], np.int8),
        position=np.ascontiguousarray(values[..., 0:3]),
        heading=np.ascontiguousarray(values[..., 6]),
        velocity=np.ascontiguousarray(values[..., 7:9]),
        size=np.ascontiguousarray(values[..., 3:6]),
        valid=states[..., 9] != 0,
    )


def _to_float32(values: np.ndarray) -> np.ndarray:
    """Nearest float32. Values outside its range become infinite without a warning and are refused later."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _read_lights(dynamic_states: Sequence[womd_pb2.DynamicMapState]) -> LightStates:
    """All light states; the number of a `DynamicMapState` is its step."""
    # a few thousand rows at most, so a list is fast enough
    rows = [
        (step, light.lane, light.state, light.stop_point.x, light.stop_point.y, light.stop_point.z)
        for step, states in enumerate(dynamic_states)
        for light in states.lane_states
    ]
    step, lane, state, *point = zip(*rows) if rows else ((),) * 6
    return LightStates(
        step=np.array(step, np.int32),
        lane_id=np.array(lane, np.int64),
        state=np.array(state, np.int8),
        stop_point=_to_float32(np.array(point, np.float64).T.reshape(-1, 3)),
    )


def _read_map(features: Sequence[womd_pb2.MapFeature]) -> MapFeatures:
    """Map features in the order of the message, those of unknown kinds left out."""
    # a kind that womd.proto does not have yet reads as a feature without data
    features = [feature for feature in features if feature.WhichOneof("feature_data")]
    kinds = [feature.WhichOneof("feature_data") for feature in features]
    typed_points = [_parse_points(feature, kind) for feature, kind in zip(features, kinds)]
    flat = [value for _, points in typed_points for p in points for value in (p.x, p.y, p.z)]
    offsets = np.zeros(len(features) + 1, np.int64)
    np.cumsum([len(points) for _, points in typed_points], out=offsets[1:])
    doubles = np.array(flat, np.float64).reshape(-1, 3)  # [P, 3]
    points = _to_float32(doubles)
    # The rounding error of polygons. Only of finite points: infinity minus infinity would warn before the point is
    # refused by name.
    is_polygon = np.repeat(np.array([kind in _POLYGONS for kind in kinds], bool), np.diff(offsets))  # [P]
    rest = np.zeros_like(doubles)
    np.subtract(doubles, points, out=rest, where=is_polygon[:, None] & np.isfinite(points))
    return MapFeatures(
        feature_id=np.array([feature.id for feature in features], np.int64),
        feature_type=np.array([kind for kind, _ in typed_points], np.int8),
        points=points,
        offsets=offsets,
        topology=_read_topology(features, kinds),
        polygon_rest=_to_float32(rest),
    )


def _parse_points(feature: womd_pb2.MapFeature, kind: str) -> tuple[int, Sequence[womd_pb2.MapPoint]]:
    """Type of a map feature (numbers of `MapFeatureType`) and its points."""
    match kind:
        case "lane":
            return feature.lane.type, feature.lane.polyline
        case "road_line":
            return MapFeatureType.LINE_UNKNOWN + feature.road_line.type, feature.road_line.polyline
        case "road_edge":
            return MapFeatureType.EDGE_UNKNOWN + feature.road_edge.type, feature.road_edge.polyline
        case "stop_sign":
            return MapFeatureType.STOP_SIGN, [feature.stop_sign.position]
        case "crosswalk":
            return MapFeatureType.CROSSWALK, feature.crosswalk.polygon
        case "speed_bump":
            return MapFeatureType.SPEED_BUMP, feature.speed_bump.polygon
        case "driveway":
            return MapFeatureType.DRIVEWAY, feature.driveway.polygon
    raise AssertionError(f"womd.proto has a kind of map feature that is not read: {kind}")


def _read_topology(features: Sequence[womd_pb2.MapFeature], kinds: Sequence[str]) -> LaneTopology:
    """Links of all lanes as tables, the first column the lane's feature id."""
    lanes = [(feature.id, feature.lane) for feature, kind in zip(features, kinds) if kind == "lane"]
    is_lane = np.array([kind == "lane" for kind in kinds], bool)
    speed_limit = np.zeros(len(features), np.float32)
    interpolating = np.zeros(len(features), bool)
    speed_limit[is_lane] = _to_float32(np.array([lane.speed_limit_mph for _, lane in lanes], np.float64))
    interpolating[is_lane] = [lane.interpolating for _, lane in lanes]
    neighbors, boundaries = [], []
    for lane_id, lane in lanes:
        for side, found in ((_LEFT, lane.left_neighbors), (_RIGHT, lane.right_neighbors)):
            for n in found:
                own, other = (n.self_start_index, n.self_end_index), (n.neighbor_start_index, n.neighbor_end_index)
                neighbors.append((lane_id, side, n.feature_id, *own, *other))
        for side, found in ((_LEFT, lane.left_boundaries), (_RIGHT, lane.right_boundaries)):
            for b in found:
                span = (b.lane_start_index, b.lane_end_index)
                boundaries.append((lane_id, side, b.boundary_feature_id, *span, b.boundary_type))
    return LaneTopology(
        entry_lanes=_rows(2, [(lane_id, other) for lane_id, lane in lanes for other in lane.entry_lanes]),
        exit_lanes=_rows(2, [(lane_id, other) for lane_id, lane in lanes for other in lane.exit_lanes]),
        neighbors=_rows(7, neighbors),
        boundaries=_rows(6, boundaries),
        stop_sign_lanes=_rows(
            2, [(f.id, lane) for f, kind in zip(features, kinds) if kind == "stop_sign" for lane in f.stop_sign.lane]
        ),
        speed_limit_mph=speed_limit,
        interpolating=interpolating,
    )


def _rows(columns: int, rows: list[tuple[int, ...]]) -> np.ndarray:
    return np.array(rows, np.int64).reshape(-1, columns)
