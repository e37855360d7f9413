"""Arrow shards: files of scenarios, a row each, all arrays an encoded column, memory-mapped for random access.

A shard also holds rows of the index, so the index can be rebuilt from the shards alone. Each row has a checksum over
the encoded arrays that is checked whenever the row is read.
"""

import hashlib
import os
from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pyarrow as pa

from rlftsim.errors import DataError
from rlftsim.jobs.files import errors_name, temporary_path
from rlftsim.jobs.tables import map_arrow
from rlftsim.scenario.codec import decode_array, encode_array
from rlftsim.scenario.maneuver import classify_ego_maneuver
from rlftsim.scenario.types import LaneTopology, LightStates, MapFeatures, ObjectType, Scenario, Tracks

SCHEMA_VERSION = 1
_ROWS_PER_BATCH = 16

# Dtype of every array of a scenario, in the order of the columns, and components of vectors: a column per component,
# because components lie on different grids.
_ARRAYS: Mapping[str, tuple[str, ...]] = {
    "timestamps_s": ("float64",),
    "tracks_to_predict": ("int32",),
    "difficulty": ("int8",),
    "objects_of_interest": ("int64",),
    "tracks.object_id": ("int64",),
    "tracks.object_type": ("int8",),
    "tracks.valid": ("bool",),
    "tracks.position": ("float32", "x", "y", "z"),
    "tracks.heading": ("float32",),
    "tracks.velocity": ("float32", "x", "y"),
    "tracks.size": ("float32", "length", "width", "height"),
    "map.feature_id": ("int64",),
    "map.feature_type": ("int8",),
    "map.offsets": ("int64",),
    "map.points": ("float32", "x", "y", "z"),
    "map.polygon_rest": ("float32", "x", "y", "z"),
    "topology.entry_lanes": ("int64",),
    "topology.exit_lanes": ("int64",),
    "topology.neighbors": ("int64",),
    "topology.boundaries": ("int64",),
    "topology.stop_sign_lanes": ("int64",),
    "topology.speed_limit_mph": ("float32",),
    "topology.interpolating": ("bool",),
    "lights.step": ("int32",),
    "lights.lane_id": ("int64",),
    "lights.state": ("int8",),
    "lights.stop_point": ("float32", "x", "y", "z"),
}
_ARRAY_DTYPES = {
    f"{name}.{component}" if component else name: dtype
    for name, (dtype, *components) in _ARRAYS.items()
    for component in components or [""]
}
AGENT_COLUMNS = ("num_vehicles", "num_pedestrians", "num_cyclists", "num_others")
"""Counts that add up to a scenario's simulated agents."""
_COUNTS = ("num_steps", *AGENT_COLUMNS, "num_evaluated", "num_map_features", "num_map_points", "num_light_states")
INDEX_FIELDS = (
    *(pa.field(name, pa.string()) for name in ("scenario_id", "split")),
    *(pa.field(name, pa.int32()) for name in _COUNTS),
    *(pa.field(name, pa.string()) for name in ("ego_maneuver", "source", "guessed")),
)
"""Columns of the index that are stored in every row of a shard, see `compute_index_row`."""
_ROW_FIELDS = (("source_record", pa.int32()), ("ego_index", pa.int32()), ("checksum", pa.uint32()))
_SCHEMA = pa.schema(
    [*INDEX_FIELDS, *_ROW_FIELDS, *((name, pa.binary()) for name in _ARRAY_DTYPES)],
    metadata={"format": "rlftsim scenarios", "schema_version": str(SCHEMA_VERSION)},
)


def compute_index_row(scenario: Scenario, split: str) -> dict[str, str | int]:
    """Row of a scenario in the index of a data set, by the names of `INDEX_FIELDS`.

    Agents are counted at the current step. `guessed` has the words of `Scenario.guessed` in alphabetical order, with
    spaces between them.

    Args:
        scenario: Scenario whose contents are counted.
        split: Name of the split that the scenario belongs to, such as "training".
    """
    agent_types = scenario.tracks.object_type[scenario.simulated_indices]
    count = {object_type: int((agent_types == object_type).sum()) for object_type in ObjectType}
    return {
        "scenario_id": scenario.scenario_id,
        "split": split,
        "num_steps": scenario.num_steps,
        "num_vehicles": count[ObjectType.VEHICLE],
        "num_pedestrians": count[ObjectType.PEDESTRIAN],
        "num_cyclists": count[ObjectType.CYCLIST],
        "num_others": count[ObjectType.OTHER] + count[ObjectType.UNSET],
        "num_evaluated": len(scenario.evaluated_indices),
        "num_map_features": len(scenario.map_features),
        "num_map_points": len(scenario.map_features.points),
        "num_light_states": len(scenario.lights.step),
        "ego_maneuver": classify_ego_maneuver(scenario).value,
        "source": scenario.source,
        "guessed": " ".join(sorted(scenario.guessed)),
    }


class ShardWriter:
    """Writes a shard under a temporary name until `close`; a shard that is not closed never gets the final name.

    As a context manager the shard is closed at the end of the block, and discarded after an error.

    Args:
        path: Shard file to write; `close` replaces an existing file.

    Raises:
        DataError: The file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.num_rows = 0
        self._temporary = temporary_path(self.path)
        with errors_name(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self._temporary, "wb")  # noqa: SIM115 (closed by close and discard)
            self._writer = pa.ipc.new_file(self._file, _SCHEMA)
        self._pending: list[Mapping[str, object]] = []

    def __enter__(self) -> "ShardWriter":
        return self

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        try:
            if error_type is None:
                self.close()
        finally:
            self.discard()  # after `close` no file is left

    def add(self, scenario: Scenario, split: str, source_record: int | None = None) -> None:
        """Append a scenario.

        Args:
            scenario: Scenario that has passed `check_scenario`.
            split: Name of the scenario's split, such as "training".
            source_record: Number of the record in the file of the source, from 0; None without such a file.

        Raises:
            DataError: The file cannot be written (a full disk, say).
        """
        # every array separately: each has the encoding that suits the values
        encoded = {name: None if array is None else encode_array(array) for name, array in _to_arrays(scenario).items()}
        row = compute_index_row(scenario, split) | {"source_record": source_record}
        row |= {"ego_index": scenario.ego_index, "checksum": _checksum(encoded)}
        self._pending.append(row | encoded)
        self.num_rows += 1
        if len(self._pending) == _ROWS_PER_BATCH:
            self._flush()

    def close(self) -> None:
        """Finish the shard: only now does the file appear under the final name.

        Raises:
            DataError: The file cannot be written.
        """
        self._flush()
        with errors_name(self.path):
            self._writer.close()
            self._file.flush()
            # on disk before the rename: after a power cut a file under the final name is still complete
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self._temporary, self.path)

    def discard(self) -> None:
        """Throw away the files written so far."""
        with suppress(OSError):  # on a full disk closing fails too, because it flushes
            self._file.close()
        self._temporary.unlink(missing_ok=True)

    def _flush(self) -> None:
        if self._pending:
            with errors_name(self.path):
                self._writer.write_batch(pa.RecordBatch.from_pylist(self._pending, schema=_SCHEMA))
            self._pending = []


class ShardReader:
    """Random access to the scenarios of a shard, memory-mapped.

    Args:
        path: Shard file that `ShardWriter` wrote; the shard stays open.

    Raises:
        DataError: The file is missing, damaged, or of another schema version.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            self._table = map_arrow(self.path, _WAY_OUT)
        except FileNotFoundError:
            raise DataError(f"shard {self.path} is missing: {_REMEDY}") from None
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
        """Columns of `INDEX_FIELDS` and `source_record`, a row per scenario; a copy in memory."""
        schema = pa.schema([*INDEX_FIELDS, pa.field("source_record", pa.int32())])
        return pa.table({name: self._table[name].to_pylist() for name in schema.names}, schema=schema)

    def read(self, row: int) -> Scenario:
        """Decode a row. Arrays are read-only, because values computed from a scenario are cached.

        Raises:
            DataError: The row is damaged.
        """
        try:
            encoded = {name: self._table[name][row].as_buffer() for name in _ARRAY_DTYPES}
            # the checksum first: nothing of a damaged row is decoded
            if _checksum(encoded) != self._table["checksum"][row].as_py():
                raise ValueError("its checksum does not match")
            # None only where `types.py` allows it, which the checksum has just confirmed
            arrays = {name: None if data is None else decode_array(data) for name, data in encoded.items()}
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
        for group in (scenario, *scenario.tables.values()):
            for value in vars(group).values():
                if isinstance(value, np.ndarray):
                    value.flags.writeable = False
        return scenario


_REMEDY = "run the conversion or generation that made it again"
_WAY_OUT = f"delete the file and {_REMEDY}"


def check_scenario(scenario: Scenario) -> None:
    """Check that a scenario keeps the rules of `types.py`: it can be stored, simulated and scored.

    Raises:
        DataError: The id is no file name, an array has another dtype or other axes, a valid state or map point is not
            finite, a position is too far out for float32, or `Scenario.check_consistency` refuses; names the scenario
            and the value.
    """
    scenario.check_scenario_id()
    try:
        scenario.check_array_shapes()
        for name, array in _to_arrays(scenario).items():
            dtype = getattr(array, "dtype", type(array).__name__)
            if array is not None and dtype != _ARRAY_DTYPES[name]:
                raise DataError(f"{name} is {dtype}, it must be {_ARRAY_DTYPES[name]}")
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
    """CRC-32C of all encoded arrays in order, without arrays that a scenario lacks."""
    crc = 0
    for data in encoded.values():
        if data is not None:
            crc = google_crc32c.extend(crc, bytes(data))
    return crc


def _to_arrays(scenario: Scenario) -> dict[str, np.ndarray | None]:
    """Arrays of a scenario in the order of the columns.

    The codec uses that neighbors along the last axis are alike. So components of vectors are separate columns, and
    tables [rows, columns] are transposed, because the entries of a column resemble each other.
    """
    groups = {"": scenario, **scenario.tables}
    arrays: dict[str, np.ndarray | None] = {}
    for name, (_, *components) in _ARRAYS.items():
        group, _, attribute = name.rpartition(".")
        array = getattr(groups[group], attribute)
        for index, component in enumerate(components):
            arrays[f"{name}.{component}"] = None if array is None else array[..., index]
        if not components:
            arrays[name] = array.T if group == "topology" and array is not None else array
    return arrays


def _from_arrays(plain: Mapping[str, Any], arrays: Mapping[str, np.ndarray | None]) -> Scenario:
    """Inverse of `_to_arrays`, with the values of a row that are no arrays."""
    groups: dict[str, dict[str, Any]] = defaultdict(dict)
    for name, (_, *components) in _ARRAYS.items():
        group, _, attribute = name.rpartition(".")
        columns = [arrays[f"{name}.{component}"] for component in components] or [arrays[name]]
        array = columns[0]
        if array is not None and components:
            array = np.stack(columns, axis=-1)  # type: ignore[arg-type]
        elif array is not None and group == "topology":
            array = np.ascontiguousarray(array.T)
        groups[group][attribute] = array
    return Scenario(
        **groups[""],
        tracks=Tracks(**groups["tracks"]),
        map_features=MapFeatures(**groups["map"], topology=LaneTopology(**groups["topology"])),
        lights=LightStates(**groups["lights"]),
        **{**plain, "guessed": frozenset(plain["guessed"].split())},
    )
