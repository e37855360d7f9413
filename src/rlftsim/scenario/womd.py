"""Waymo Open Motion Dataset: TFRecord files of `Scenario` messages to `Scenario` objects, without TensorFlow.

World coordinates become float32 here and nowhere else: the official evaluator rounds them so before it does anything.
What a record stores where a state is not valid is kept as it is.
"""

import glob
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rlftsim.errors import DataError
from rlftsim.scenario import womd_pb2
from rlftsim.scenario.tfrecord import OnError, SkippedRecord, log_skipped, read_records
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
_POLYGONS = ("crosswalk", "speed_bump", "driveway")


def find_tfrecords(source: str | os.PathLike[str]) -> list[Path]:
    """Files that `source` means, sorted by path.

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
                f"{path}: no tfrecord file in this folder (names like x.tfrecord or x.tfrecord-00000-of-00010)"
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
    """Read one tfrecord file as `read_scenarios` does; yields the number of the record, from 0, with its scenario."""
    for record, data in read_records(path, on_error=on_error, report=report):
        scenario = scenario_or_report(path, record, data, on_error=on_error, report=report)
        if scenario is not None:
            yield record, scenario


def scenario_or_report(
    path: str | os.PathLike[str],
    record: int,
    data: bytes,
    *,
    on_error: OnError,
    report: Callable[[SkippedRecord], None],
) -> Scenario | None:
    """Scenario of record number `record` of a file; None if it is bad, which is reported.

    Raises:
        DataError: under "stop", the record is bad: names file, record and cause.
    """
    try:
        return scenario_from_bytes(data)
    except DataError as error:
        skipped = SkippedRecord(str(path), record, str(error))
        if on_error == "stop":
            raise DataError(str(skipped)) from error
        report(skipped)
        return None


def scenario_from_bytes(record: bytes) -> Scenario:
    """Scenario of one serialized WOMD `Scenario` message with 91 steps, or 11 as in the test splits.

    Map, lights, tracks to predict and objects of interest may be missing. Map features of a kind that WOMD did not
    have when this was written are left out.

    Raises:
        DataError: the bytes are no such message; there is no ego or it is not valid at step 10; a valid state or a map
            point is not finite; the number of steps is another one; a track to predict does not exist.
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
    ego_index = _read_ego_index(message, tracks)
    scenario = Scenario(
        scenario_id=message.scenario_id,
        timestamps_s=_read_timestamps(message, num_steps),
        tracks=tracks,
        map_features=_read_map(message.map_features),
        lights=_read_lights(message.dynamic_map_states[:num_steps]),
        ego_index=ego_index,
        tracks_to_predict=_read_tracks_to_predict(message),
        difficulty=np.array([item.difficulty for item in message.tracks_to_predict], np.int8),
        objects_of_interest=np.array(message.objects_of_interest, np.int64),
    )
    scenario.refuse_not_finite()
    return scenario


def _read_tracks(message: womd_pb2.Scenario) -> Tracks:
    num_steps = len(message.tracks[0].states)
    for track in message.tracks:
        if len(track.states) != num_steps:
            raise DataError(
                f"track {track.id} has {len(track.states)} states, track {message.tracks[0].id} has {num_steps}"
            )
    if num_steps not in (HISTORY_STEPS, TOTAL_STEPS):
        raise DataError(
            f"{num_steps} steps instead of {TOTAL_STEPS} (or {HISTORY_STEPS} in a test split): "
            "take WOMD's 9-second files, not the 20-second ones"
        )
    states = np.array(
        [
            (
                s.center_x,
                s.center_y,
                s.center_z,
                s.length,
                s.width,
                s.height,
                s.heading,
                s.velocity_x,
                s.velocity_y,
                s.valid,
            )
            for track in message.tracks
            for s in track.states
        ]
    ).reshape(len(message.tracks), num_steps, 10)
    values = _to_float32(states)
    valid = states[..., 9] != 0
    object_id = np.array([track.id for track in message.tracks], np.int64)
    return Tracks(
        object_id=object_id,
        object_type=np.array([track.object_type for track in message.tracks], np.int8),
        position=np.ascontiguousarray(values[..., 0:3]),
        heading=np.ascontiguousarray(values[..., 6]),
        velocity=np.ascontiguousarray(values[..., 7:9]),
        size=np.ascontiguousarray(values[..., 3:6]),
        valid=valid,
    )


def _to_float32(values: np.ndarray) -> np.ndarray:
    """Nearest float32; what lies outside its range becomes infinite without a warning and is refused later."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _read_ego_index(message: womd_pb2.Scenario, tracks: Tracks) -> int:
    index = message.sdc_track_index
    if not message.HasField("sdc_track_index"):
        raise DataError("no ego: sdc_track_index is not set")
    if not 0 <= index < len(tracks.valid):
        raise DataError(f"no ego: sdc_track_index is {index}, but there are {len(tracks.valid)} tracks")
    if message.HasField("current_time_index") and message.current_time_index != CURRENT_STEP:
        raise DataError(f"current_time_index is {message.current_time_index} instead of {CURRENT_STEP}")
    if not tracks.valid[index, CURRENT_STEP]:
        raise DataError(f"the ego (track {tracks.object_id[index]}) is not valid at the current step ({CURRENT_STEP})")
    return index


def _read_timestamps(message: womd_pb2.Scenario, num_steps: int) -> np.ndarray:
    if len(message.timestamps_seconds) < num_steps:
        raise DataError(f"{len(message.timestamps_seconds)} timestamps for {num_steps} steps")
    return np.array(message.timestamps_seconds[:num_steps], np.float64)


def _read_tracks_to_predict(message: womd_pb2.Scenario) -> np.ndarray:
    indices = np.array([item.track_index for item in message.tracks_to_predict], np.int32)
    for index in indices[(indices < 0) | (indices >= len(message.tracks))]:
        raise DataError(f"tracks_to_predict names track index {index}, but there are {len(message.tracks)} tracks")
    return indices


def _read_lights(dynamic_states: Sequence[womd_pb2.DynamicMapState]) -> LightStates:
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


def _points_of(feature: womd_pb2.MapFeature, kind: str) -> tuple[int, Sequence[womd_pb2.MapPoint]]:
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


def _read_map(features: Sequence[womd_pb2.MapFeature]) -> MapFeatures:
    features = [feature for feature in features if feature.WhichOneof("feature_data")]
    kinds = [feature.WhichOneof("feature_data") for feature in features]
    typed_points = [_points_of(feature, kind) for feature, kind in zip(features, kinds)]
    flat = [value for _, points in typed_points for p in points for value in (p.x, p.y, p.z)]
    offsets = np.zeros(len(features) + 1, np.int64)
    np.cumsum([len(points) for _, points in typed_points], out=offsets[1:])
    feature_id = np.array([feature.id for feature in features], np.int64)
    doubles = np.array(flat, np.float64).reshape(-1, 3)
    points = _to_float32(doubles)
    is_polygon = np.repeat(np.array([kind in _POLYGONS for kind in kinds], bool), np.diff(offsets))
    return MapFeatures(
        feature_id=feature_id,
        feature_type=np.array([kind for kind, _ in typed_points], np.int8),
        points=points,
        offsets=offsets,
        topology=_read_topology(features, kinds),
        polygon_rest=_to_float32(np.where(is_polygon[:, None], doubles - points, 0.0)),
    )


def _read_topology(features: Sequence[womd_pb2.MapFeature], kinds: Sequence[str]) -> LaneTopology:
    lanes = [(feature.id, feature.lane) for feature, kind in zip(features, kinds) if kind == "lane"]
    is_lane = np.array([kind == "lane" for kind in kinds], bool)
    speed_limit = np.zeros(len(features), np.float32)
    interpolating = np.zeros(len(features), bool)
    speed_limit[is_lane] = _to_float32(np.array([lane.speed_limit_mph for _, lane in lanes], np.float64))
    interpolating[is_lane] = [lane.interpolating for _, lane in lanes]
    return LaneTopology(
        entry_lanes=_rows(2, [(lane_id, other) for lane_id, lane in lanes for other in lane.entry_lanes]),
        exit_lanes=_rows(2, [(lane_id, other) for lane_id, lane in lanes for other in lane.exit_lanes]),
        neighbors=_rows(7, [row for lane_id, lane in lanes for row in _neighbor_rows(lane_id, lane)]),
        boundaries=_rows(6, [row for lane_id, lane in lanes for row in _boundary_rows(lane_id, lane)]),
        stop_sign_lanes=_rows(
            2, [(f.id, lane) for f, kind in zip(features, kinds) if kind == "stop_sign" for lane in f.stop_sign.lane]
        ),
        speed_limit_mph=speed_limit,
        interpolating=interpolating,
    )


def _neighbor_rows(lane_id: int, lane: womd_pb2.LaneCenter) -> Iterator[tuple[int, ...]]:
    for side, neighbors in ((_LEFT, lane.left_neighbors), (_RIGHT, lane.right_neighbors)):
        for n in neighbors:
            own, other = (n.self_start_index, n.self_end_index), (n.neighbor_start_index, n.neighbor_end_index)
            yield lane_id, side, n.feature_id, *own, *other


def _boundary_rows(lane_id: int, lane: womd_pb2.LaneCenter) -> Iterator[tuple[int, ...]]:
    for side, boundaries in ((_LEFT, lane.left_boundaries), (_RIGHT, lane.right_boundaries)):
        for b in boundaries:
            yield lane_id, side, b.boundary_feature_id, b.lane_start_index, b.lane_end_index, b.boundary_type


def _rows(columns: int, rows: list[tuple[int, ...]]) -> np.ndarray:
    return np.array(rows, np.int64).reshape(-1, columns)
