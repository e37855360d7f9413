"""Arrow shards: files of scenarios, one row each, every array an encoded column, memory-mapped for random access.

A shard also holds its rows of the index, so the index can be rebuilt from the shards alone. Each row has a checksum
over its encoded arrays that is checked whenever the row is read.
"""

import hashlib
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pyarrow as pa

from rlftsim.errors import DataError
from rlftsim.jobs.files import cannot_write, temporary_path
from rlftsim.jobs.tables import map_arrow
from rlftsim.scenario.codec import decode_array, encode_array
from rlftsim.scenario.index_row import IndexRow, compute_index_row
from rlftsim.scenario.types import LaneTopology, LightStates, MapFeatures, Scenario, Tracks

SCHEMA_VERSION = 1
_ROWS_PER_BATCH = 16

# Every array of a scenario and its dtype, in the order of the columns. `.x` and the like: one component of a vector
# per column, because the components lie on different grids.
_ARRAY_DTYPES: Mapping[str, str] = {
    "timestamps_s": "float64",
    "tracks_to_predict": "int32",
    "difficulty": "int8",
    "objects_of_interest": "int64",
    "tracks.object_id": "int64",
    "tracks.object_type": "int8",
    "tracks.valid": "bool",
    "tracks.position.x": "float32",
    "tracks.position.y": "float32",
    "tracks.position.z": "float32",
    "tracks.heading": "float32",
    "tracks.velocity.x": "float32",
    "tracks.velocity.y": "float32",
    "tracks.size.length": "float32",
    "tracks.size.width": "float32",
    "tracks.size.height": "float32",
    "map.feature_id": "int64",
    "map.feature_type": "int8",
    "map.offsets": "int64",
    "map.points.x": "float32",
    "map.points.y": "float32",
    "map.points.z": "float32",
    "map.polygon_rest.x": "float32",
    "map.polygon_rest.y": "float32",
    "map.polygon_rest.z": "float32",
    "topology.entry_lanes": "int64",
    "topology.exit_lanes": "int64",
    "topology.neighbors": "int64",
    "topology.boundaries": "int64",
    "topology.stop_sign_lanes": "int64",
    "topology.speed_limit_mph": "float32",
    "topology.interpolating": "bool",
    "lights.step": "int32",
    "lights.lane_id": "int64",
    "lights.state": "int8",
    "lights.stop_point.x": "float32",
    "lights.stop_point.y": "float32",
    "lights.stop_point.z": "float32",
}
_INDEX_TYPES = {str: pa.string(), int: pa.int32()}
INDEX_FIELDS = tuple(pa.field(field.name, _INDEX_TYPES[field.type]) for field in fields(IndexRow))
_SCHEMA = pa.schema(
    [
        *INDEX_FIELDS,
        pa.field("source_record", pa.int32()),
        pa.field("ego_index", pa.int32()),
        pa.field("checksum", pa.uint32()),
        *(pa.field(name, pa.binary()) for name in _ARRAY_DTYPES),
    ],
    metadata={"format": "rlftsim scenarios", "schema_version": str(SCHEMA_VERSION)},
)


class ShardWriter:
    """Writes one shard under a temporary name; `close` gives it its own. A shard that is not closed never gets it.

    Args:
        path: the shard. An existing one is replaced on `close`.

    Raises:
        DataError: the file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.num_rows = 0
        self._temporary = temporary_path(self.path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self._temporary, "wb")  # noqa: SIM115 (closed by close and discard)
            self._writer = pa.ipc.new_file(self._file, _SCHEMA)
        except OSError as error:
            raise cannot_write(self.path, error) from error
        self._pending: list[dict[str, object]] = []

    def add(self, scenario: Scenario, split: str, source_record: int | None = None) -> None:
        """Append a scenario.

        Args:
            scenario: a sound one, see `check_shard`.
            split: name of its split.
            source_record: number of its record in the file it was converted from; None if there is none.

        Raises:
            DataError: the scenario is unsound, or the file cannot be written (a full disk, say).
        """
        check_shard(scenario)
        # every array by itself: each gets the encoding that suits its values
        encoded = {name: None if array is None else encode_array(array) for name, array in _to_arrays(scenario).items()}
        row = {
            **asdict(compute_index_row(scenario, split)),
            "source_record": source_record,
            "ego_index": scenario.ego_index,
            "checksum": _checksum(encoded),
            **encoded,
        }
        self._pending.append(row)
        self.num_rows += 1
        if len(self._pending) == _ROWS_PER_BATCH:
            self._flush()

    def close(self) -> None:
        """Finish the shard: only now does it appear under its name.

        Raises:
            DataError: the file cannot be written.
        """
        self._flush()
        try:
            self._writer.close()
            self._file.flush()
            # on disk before the name is: after a power cut a file under its own name is still whole
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self._temporary, self.path)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def discard(self) -> None:
        """Throw away everything written so far."""
        with suppress(OSError):  # on a full disk closing fails too, because it flushes
            self._file.close()
        self._temporary.unlink(missing_ok=True)

    def _flush(self) -> None:
        if not self._pending:
            return
        try:
            self._writer.write_batch(pa.RecordBatch.from_pylist(self._pending, schema=_SCHEMA))
        except OSError as error:
            raise cannot_write(self.path, error) from error
        self._pending = []


class ShardReader:
    """Random access to the scenarios of a shard, memory-mapped.

    Args:
        path: the shard.

    Raises:
        DataError: the file is missing, damaged, or of another schema version.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            self._table = map_arrow(self.path, _WAY_OUT)
        except FileNotFoundError:
            raise DataError(f"shard {self.path} is missing: {_RUN_AGAIN}") from None
        except DataError as error:
            raise DataError(f"shard {error}") from None
        if self._table.schema != _SCHEMA:
            raise DataError(f"shard {self.path} was written with another schema version: convert again")
        for name in _SCHEMA.names:
            if name not in ("source_record", *_ARRAY_DTYPES) and self._table[name].null_count:
                raise DataError(f"shard {self.path} is damaged (column {name} has empty cells): {_WAY_OUT}")

    def __len__(self) -> int:
        return self._table.num_rows

    def index_rows(self) -> pa.Table:
        """Columns of `IndexRow` and `source_record`, one row per scenario; a copy in memory."""
        schema = pa.schema([*INDEX_FIELDS, pa.field("source_record", pa.int32())])
        return pa.table({name: self._table[name].to_pylist() for name in schema.names}, schema=schema)

    def read(self, row: int) -> Scenario:
        """Decode a row. Its arrays are read-only, because what is computed from them is kept.

        Raises:
            DataError: the row is damaged.
        """
        try:
            encoded = {name: self._table[name][row].as_buffer() for name in _ARRAY_DTYPES}
            # the checksum first: nothing of a damaged row is decoded
            if _checksum(encoded) != self._table["checksum"][row].as_py():
                raise ValueError("its checksum does not match")
            # None only where `types.py` allows it, which the checksum has just confirmed
            arrays: dict[str, Any] = {
                name: None if data is None else decode_array(data) for name, data in encoded.items()
            }
            names = ("scenario_id", "ego_index", "source", "guessed")
            plain = {name: self._table[name][row].as_py() for name in names}
            scenario = _from_arrays(plain, arrays)
            # the checksum is of the arrays alone
            scenario.check_scenario_id()
            num_tracks = len(scenario.tracks.object_id)
            if not 0 <= scenario.ego_index < num_tracks:
                raise ValueError(f"its ego is track {scenario.ego_index} of {num_tracks}")
        except (ValueError, TypeError, AttributeError, IndexError, DataError) as error:
            cause = error if isinstance(error, ValueError | DataError) else "it lacks an array, or there is no such row"
            raise DataError(f"shard {self.path}: row {row} is damaged ({cause}): {_WAY_OUT}") from error
        features = scenario.map_features
        for part in (scenario, scenario.tracks, features, features.topology, scenario.lights):
            for value in vars(part).values():
                if isinstance(value, np.ndarray):
                    value.flags.writeable = False
        return scenario


_RUN_AGAIN = "run the conversion or generation that made it again"
_WAY_OUT = f"delete the file and {_RUN_AGAIN}"


def check_shard(scenario: Scenario) -> None:
    """Check that a scenario is what `types.py` declares, so that it can be stored, simulated and scored.

    Raises:
        DataError: The id is no file name, an array has another dtype or other axes, a valid state or map point is not
            finite, a position is too far out for float32, or `Scenario.check_consistency` refuses; names the scenario
            and the value.
    """
    scenario.check_scenario_id()
    try:
        scenario.check_array_shapes()
        for name, array in _to_arrays(scenario).items():
            kind = getattr(array, "dtype", type(array).__name__)
            if array is not None and kind != _ARRAY_DTYPES[name]:
                raise DataError(f"{name} is {kind}, it must be {_ARRAY_DTYPES[name]}")
        scenario.check_consistency()
        scenario.check_finite_arrays()
        scenario.check_precision()
    except DataError as error:
        raise DataError(f"scenario {scenario.scenario_id}: {error}") from None


def hash_file(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _checksum(encoded: Mapping[str, bytes | pa.Buffer | None]) -> int:
    """CRC-32C of all encoded arrays one after another, without those that a scenario lacks."""
    crc = 0
    for data in encoded.values():
        if data is not None:
            crc = google_crc32c.extend(crc, bytes(data))
    return crc


def _to_arrays(scenario: Scenario) -> dict[str, np.ndarray | None]:
    """Arrays of a scenario in the order of the columns.

    The codec uses that neighbors along the last axis are alike. So components of vectors are columns of their own, and
    tables [rows, columns] are transposed, because a column's entries resemble each other.
    """
    tracks, features, lights = scenario.tracks, scenario.map_features, scenario.lights
    topology, rest = features.topology, features.polygon_rest
    return {
        "timestamps_s": scenario.timestamps_s,
        "tracks_to_predict": scenario.tracks_to_predict,
        "difficulty": scenario.difficulty,
        "objects_of_interest": scenario.objects_of_interest,
        "tracks.object_id": tracks.object_id,
        "tracks.object_type": tracks.object_type,
        "tracks.valid": tracks.valid,
        "tracks.position.x": tracks.position[..., 0],
        "tracks.position.y": tracks.position[..., 1],
        "tracks.position.z": tracks.position[..., 2],
        "tracks.heading": tracks.heading,
        "tracks.velocity.x": tracks.velocity[..., 0],
        "tracks.velocity.y": tracks.velocity[..., 1],
        "tracks.size.length": tracks.size[..., 0],
        "tracks.size.width": tracks.size[..., 1],
        "tracks.size.height": tracks.size[..., 2],
        "map.feature_id": features.feature_id,
        "map.feature_type": features.feature_type,
        "map.offsets": features.offsets,
        "map.points.x": features.points[:, 0],
        "map.points.y": features.points[:, 1],
        "map.points.z": features.points[:, 2],
        **{f"map.polygon_rest.{c}": None if rest is None else rest[:, i] for i, c in enumerate("xyz")},
        "topology.entry_lanes": topology.entry_lanes.T,
        "topology.exit_lanes": topology.exit_lanes.T,
        "topology.neighbors": topology.neighbors.T,
        "topology.boundaries": topology.boundaries.T,
        "topology.stop_sign_lanes": topology.stop_sign_lanes.T,
        "topology.speed_limit_mph": topology.speed_limit_mph,
        "topology.interpolating": topology.interpolating,
        "lights.step": lights.step,
        "lights.lane_id": lights.lane_id,
        "lights.state": lights.state,
        "lights.stop_point.x": lights.stop_point[:, 0],
        "lights.stop_point.y": lights.stop_point[:, 1],
        "lights.stop_point.z": lights.stop_point[:, 2],
    }


def _from_arrays(plain: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Scenario:
    """Inverse of `_to_arrays`, with the values of a row that are no arrays."""

    def _vector(name: str, components: str) -> np.ndarray:
        return np.stack([arrays[f"{name}.{component}"] for component in components.split()], axis=-1)

    def _table(name: str) -> np.ndarray:
        return np.ascontiguousarray(arrays[f"topology.{name}"].T)

    return Scenario(
        scenario_id=plain["scenario_id"],
        timestamps_s=arrays["timestamps_s"],
        tracks=Tracks(
            object_id=arrays["tracks.object_id"],
            object_type=arrays["tracks.object_type"],
            position=_vector("tracks.position", "x y z"),
            heading=arrays["tracks.heading"],
            velocity=_vector("tracks.velocity", "x y"),
            size=_vector("tracks.size", "length width height"),
            valid=arrays["tracks.valid"],
        ),
        map_features=MapFeatures(
            feature_id=arrays["map.feature_id"],
            feature_type=arrays["map.feature_type"],
            points=_vector("map.points", "x y z"),
            offsets=arrays["map.offsets"],
            polygon_rest=None if arrays["map.polygon_rest.x"] is None else _vector("map.polygon_rest", "x y z"),
            topology=LaneTopology(
                entry_lanes=_table("entry_lanes"),
                exit_lanes=_table("exit_lanes"),
                neighbors=_table("neighbors"),
                boundaries=_table("boundaries"),
                stop_sign_lanes=_table("stop_sign_lanes"),
                speed_limit_mph=arrays["topology.speed_limit_mph"],
                interpolating=arrays["topology.interpolating"],
            ),
        ),
        lights=LightStates(
            step=arrays["lights.step"],
            lane_id=arrays["lights.lane_id"],
            state=arrays["lights.state"],
            stop_point=_vector("lights.stop_point", "x y z"),
        ),
        ego_index=plain["ego_index"],
        tracks_to_predict=arrays["tracks_to_predict"],
        difficulty=arrays["difficulty"],
        objects_of_interest=arrays["objects_of_interest"],
        source=plain["source"],
        guessed=frozenset(plain["guessed"].split()),
    )
