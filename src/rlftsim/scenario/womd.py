"""Waymo Open Motion Dataset: TFRecord files of `Scenario` messages to `Scenario` objects, without TensorFlow.

World coordinates become float32 here alone, because the official evaluator rounds them first. Values of states that are
not valid are kept.
"""

import glob
import os
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rlftsim.errors import DataError
from rlftsim.jobs.files import describe_type, list_folder
from rlftsim.jobs.progress import log
from rlftsim.scenario import womd_pb2
from rlftsim.scenario.source import BytesRead, Item, Unit, read_unit, units_of_files
from rlftsim.scenario.tfrecord import RECORD_OVERHEAD_BYTES, OnError, SkippedRecord, iterate_records
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
    to_float32,
)

_TFRECORD_NAME = re.compile(r"\.tfrecords?(-\d+-of-\d+)?$")
_FIRST_TYPES = {
    "lane": MapFeatureType.LANE_UNDEFINED,
    "road_line": MapFeatureType.LINE_UNKNOWN,
    "road_edge": MapFeatureType.EDGE_UNKNOWN,
}
"""Feature type that WOMD's own number 0 of a member stands for."""
_STATE_FIELDS = (
    *("center_x", "center_y", "center_z", "length", "width", "height"),
    *("heading", "velocity_x", "velocity_y", "valid"),
)


def find_tfrecords(source: str | os.PathLike[str]) -> list[Path]:
    """Files of a source, sorted by path.

    Args:
        source: File of any name, a folder (searched with subfolders for names like `x.tfrecord` and
            `training.tfrecord-00000-of-01000`), or a glob (`**` = any subfolders).

    Raises:
        DataError: No such file, or no tfrecord file in the folder.
    """
    path = Path(source)
    if path.is_file():
        return [path]
    if path.is_dir():
        files = sorted(file for file in list_folder(path) if _TFRECORD_NAME.search(file.name) and file.is_file())
        if not files:
            raise DataError(
                f"{path}: no tfrecord file in this folder (names like x.tfrecord or x.tfrecord-00000-of-00010), "
                "and no other source recognizes it: name one to learn what it misses (--from av2, gpudrive, tables)"
            )
        return files
    files = sorted(Path(name) for name in glob.glob(str(source), recursive=True) if os.path.isfile(name))
    if not files:
        raise DataError(f"{source}: {describe_type(path)}, and no file matches it as a pattern")
    return files


def read_scenarios(
    source: str | os.PathLike[str], on_error: OnError = "stop", *, report: Callable[[SkippedRecord], None] | None = None
) -> Iterator[Scenario]:
    """Read the scenarios of tfrecord files, in the order of paths and records.

    Args:
        source: File, folder or glob, as in `find_tfrecords`.
        on_error: "stop" raises at the first bad file or record, "skip" reports the damage and goes on.
        report: Function called with each skipped record, only under "skip"; None = a warning of the logger `rlftsim`.

    Raises:
        DataError: No such file; under "stop" also a bad record: the message names file, record and cause.
    """
    for path in find_tfrecords(source):
        for _, item in read_unit(WomdSource(), Unit(str(path), (path,)), on_error=on_error):
            if isinstance(item, Scenario):
                yield item
            elif isinstance(item, SkippedRecord):
                (report or partial(log.warning, "skipped %s"))(item)


class WomdSource:
    """The data source "womd": tfrecord files of `Scenario` messages."""

    license_note = (
        "Waymo Open Dataset material: Waymo Dataset License Agreement for Non-Commercial Use (waymo.com/open/terms). "
        "This work was made using the Waymo Open Dataset, provided by Waymo LLC."
    )

    def detects(self, path: str | os.PathLike[str]) -> bool:
        """True where at least 1 file has the name of a tfrecord."""
        try:
            return any(_TFRECORD_NAME.search(file.name) for file in find_tfrecords(path))
        except DataError:
            return False

    def find(self, path: str | os.PathLike[str]) -> list[Unit]:
        """A unit per tfrecord file, as in `find_tfrecords`."""
        return units_of_files(find_tfrecords(path))

    def read(self, unit: Unit) -> Iterator[Item]:
        """Records of a tfrecord file in order, and the cause for each that is damaged or no scenario."""
        (path,) = unit.files
        for record, data in enumerate(iterate_records(path)):
            if isinstance(data, SkippedRecord):
                yield data
                continue
            try:
                yield _parse_scenario(data)
            except DataError as error:
                yield SkippedRecord(str(path), record, str(error))
            yield BytesRead(len(data) + RECORD_OVERHEAD_BYTES)

    def describe(self) -> dict[str, object]:
        """Empty: no value of a record is guessed."""
        return {}


def scenario_from_bytes(record: bytes) -> Scenario:
    """Scenario of a serialized WOMD `Scenario` message with 91 steps, or 11 as in the test splits.

    Map, lights, tracks to predict and objects of interest may be missing. Map features of types newer than
    womd.proto are left out.

    Raises:
        DataError: The bytes are no such message; the ego is missing or not valid at step 10; a valid state or a map
            point is not finite; the number of steps is another one; a track to predict does not exist; an object id
            occurs twice; a type is unknown; a size at step 10 is not above zero.
    """
    scenario = _parse_scenario(record)
    scenario.check_consistency()
    scenario.check_finite_arrays()
    scenario.check_precision()
    return scenario


def _parse_scenario(record: bytes) -> Scenario:
    """Scenario of a message whose values have not been checked, see `scenario_from_bytes`."""
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
    return Scenario(
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
    read_state = attrgetter(*_STATE_FIELDS)
    rows = [read_state(state) for track in message.tracks for state in track.states]
    # float64 holds all fields exactly, `valid` as 0 or 1
    states = np.array(rows).reshape(len(message.tracks), num_steps, -1)  # [O, S, 10] float64
    values = to_float32(states)
    return Tracks(
        object_id=np.array([track.id for track in message.tracks], np.int64),
        object_type=np.array([track.object_type for track in message.tracks], np.int8),
        position=np.ascontiguousarray(values[..., 0:3]),
        heading=np.ascontiguousarray(values[..., 6]),
        velocity=np.ascontiguousarray(values[..., 7:9]),
        size=np.ascontiguousarray(values[..., 3:6]),
        valid=states[..., 9] != 0,
    )


def _read_lights(dynamic_states: Sequence[womd_pb2.DynamicMapState]) -> LightStates:
    """All light states; the number of a `DynamicMapState` is the step."""
    # a few thousand rows at most, so a list is fast enough
    rows = [
        (step, light.lane, light.state, light.stop_point.x, light.stop_point.y, light.stop_point.z)
        for step, states in enumerate(dynamic_states)
        for light in states.lane_states
    ]
    return LightStates.of(rows)


def _read_map(features: Sequence[womd_pb2.MapFeature]) -> MapFeatures:
    """Map features in the order of the message, those of unknown kinds left out."""
    # a feature type that womd.proto does not have yet reads as a feature without data
    features = [feature for feature in features if feature.WhichOneof("feature_data")]
    members = [feature.WhichOneof("feature_data") for feature in features]
    rows = []
    for feature, member in zip(features, members):
        feature_type, points = _read_points(feature, member)
        rows.append((feature.id, feature_type, np.array([(p.x, p.y, p.z) for p in points], np.float64).reshape(-1, 3)))
    return MapFeatures.of(rows, _read_topology(features, members), has_polygon_rest=True)


def _read_points(feature: womd_pb2.MapFeature, member: str) -> tuple[int, Sequence[womd_pb2.MapPoint]]:
    """Type of a map feature (numbers of `MapFeatureType`) and the points."""
    data = getattr(feature, member)
    if member == "stop_sign":
        return MapFeatureType.STOP_SIGN, [data.position]
    if member in _FIRST_TYPES:
        return _FIRST_TYPES[member] + data.type, data.polyline
    return MapFeatureType[member.upper()], data.polygon  # crosswalk, speed bump or driveway


def _read_topology(features: Sequence[womd_pb2.MapFeature], members: Sequence[str]) -> LaneTopology:
    """Links of all lanes as tables, the first column the lane's feature id."""
    lanes = [(feature.id, feature.lane) for feature, member in zip(features, members) if member == "lane"]
    is_lane = np.array([member == "lane" for member in members], bool)
    speed_limit = np.zeros(len(features), np.float32)
    interpolating = np.zeros(len(features), bool)
    speed_limit[is_lane] = to_float32(np.array([lane.speed_limit_mph for _, lane in lanes], np.float64))
    interpolating[is_lane] = [lane.interpolating for _, lane in lanes]
    neighbors, boundaries = [], []
    for lane_id, lane in lanes:
        for side, links in enumerate((lane.left_neighbors, lane.right_neighbors)):
            for n in links:
                spans = (n.self_start_index, n.self_end_index, n.neighbor_start_index, n.neighbor_end_index)
                neighbors.append((lane_id, side, n.feature_id, *spans))
        for side, links in enumerate((lane.left_boundaries, lane.right_boundaries)):
            for b in links:
                span = (b.lane_start_index, b.lane_end_index)
                boundaries.append((lane_id, side, b.boundary_feature_id, *span, b.boundary_type))
    signs = [feature for feature, member in zip(features, members) if member == "stop_sign"]
    return LaneTopology.of(
        entry_lanes=[(lane_id, link) for lane_id, lane in lanes for link in lane.entry_lanes],
        exit_lanes=[(lane_id, link) for lane_id, lane in lanes for link in lane.exit_lanes],
        neighbors=neighbors,
        boundaries=boundaries,
        stop_sign_lanes=[(sign.id, lane_id) for sign in signs for lane_id in sign.stop_sign.lane],
        speed_limit_mph=speed_limit,
        interpolating=interpolating,
    )
