"""A data set: a folder of Arrow shards, an index and a manifest.

Everything is in it; what it was made from is never opened again.

    manifest.json       schema version, shards with checksums and sources, counts, licence note; written last
    index.parquet       one row per scenario: where it is and what is in it
    shards/*.arrow      the scenarios
    INCOMPLETE          only while a conversion runs or after it was interrupted

Files are written under temporary names and renamed, so a file under its own name is whole.
"""

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

import rlftsim
from rlftsim.errors import DataError
from rlftsim.files import write_text, write_whole
from rlftsim.scenario.shards import INDEX_FIELDS, SCHEMA_VERSION, ShardReader, ShardWriter, hash_file
from rlftsim.scenario.tfrecord import SkippedRecord
from rlftsim.scenario.types import Scenario

FORMAT = "rlftsim scenarios"
MANIFEST, INDEX, INCOMPLETE, SHARDS = "manifest.json", "index.parquet", "INCOMPLETE", "shards"
DEFAULT_LICENCE_NOTE = "The licence of the source data applies to this data set."
_MAX_OPEN_SHARDS = 128  # each holds a file descriptor; systems allow 256 to 1024
INDEX_SCHEMA = pa.schema([*INDEX_FIELDS, pa.field("shard", pa.string()), pa.field("row", pa.int32())])


@dataclass(frozen=True)
class ShardEntry:
    """What the manifest says about a shard."""

    file: str
    """Path inside the data set's folder."""
    sha256: str
    num_rows: int
    split: str | None = None
    """Set where all rows are of one split because their source is."""
    source: str | None = None
    """Name of the file it was converted from."""
    source_bytes: int | None = None
    source_sha256: str | None = None
    skipped: tuple[SkippedRecord, ...] = ()


@dataclass(frozen=True)
class Manifest:
    """Contents of `manifest.json`."""

    shards: tuple[ShardEntry, ...]
    num_scenarios: int
    counts: Mapping[str, int]
    """Scenarios by split."""
    index_sha256: str
    duplicates: tuple[SkippedRecord, ...] = ()
    """Scenarios that are in a shard but not in the index, because an earlier one has the same id."""
    licence_note: str = DEFAULT_LICENCE_NOTE
    provenance: Mapping[str, object] = field(default_factory=dict)
    """How the data was made, in plain JSON values, e.g. the seed of a generator."""
    format: str = FORMAT
    schema_version: int = SCHEMA_VERSION
    rlftsim_version: str = rlftsim.__version__


class ScenarioDataset:
    """Scenarios of a data set's folder, by position or by id.

    As long as a scenario is in the cache the same object comes back, so what is derived from it can be cached by
    identity. Can be handed to other processes: each opens the files itself.

    Args:
        folder: the data set.
        split: only scenarios of this split, e.g. "training"; None = all.
        cache_size: decoded scenarios kept in memory, the least recently used go first (about 1 MB each).

    Raises:
        DataError: no data set there, an unfinished or damaged one, or it has no such split.
    """

    def __init__(self, folder: str | os.PathLike[str], split: str | None = None, *, cache_size: int = 256) -> None:
        self.folder = Path(folder)
        self.split = split
        self.cache_size = cache_size
        self.manifest = read_manifest(self.folder)
        self.index = _read_index(self.folder, self.manifest, split)
        """Table with the columns of `INDEX_SCHEMA`, one row per scenario, in the order of positions."""
        self.scenario_ids: list[str] = self.index["scenario_id"].to_pylist()
        self._shard_names: list[str] = self.index["shard"].to_pylist()
        self._rows: list[int] = self.index["row"].to_pylist()
        self._position = {scenario_id: i for i, scenario_id in enumerate(self.scenario_ids)}
        self._lock = Lock()
        self._reader = lru_cache(_MAX_OPEN_SHARDS)(lambda name: ShardReader(self.folder / name))
        self._decoded = lru_cache(cache_size)(self._decode)

    def __len__(self) -> int:
        return len(self.scenario_ids)

    def __getitem__(self, position: int) -> Scenario:
        """Scenario at a position of the index; negative positions count from the end.

        Raises:
            IndexError: there is no such position.
            DataError: its shard is missing or damaged.
        """
        if not -len(self) <= position < len(self):
            raise IndexError(f"position {position} in a data set of {len(self)} scenarios")
        with self._lock:  # or two threads would get two objects for one scenario
            return self._decoded(position % len(self))

    def __iter__(self) -> Iterator[Scenario]:
        return (self[position] for position in range(len(self)))

    def __contains__(self, scenario_id: object) -> bool:
        return scenario_id in self._position

    def __reduce__(self) -> tuple[Callable[..., "ScenarioDataset"], tuple[object, ...]]:
        return _reopen, (self.folder, self.split, self.cache_size)

    def by_id(self, scenario_id: str) -> Scenario:
        """Scenario with the given id.

        Raises:
            DataError: the data set (or its split) has none.
        """
        if scenario_id not in self._position:
            of_split = f" (split {self.split})" if self.split else ""
            raise DataError(f"{self.folder}{of_split} has no scenario {scenario_id!r}")
        return self[self._position[scenario_id]]

    def _decode(self, position: int) -> Scenario:
        return self._reader(self._shard_names[position]).read(self._rows[position])


class DatasetWriter:
    """Writes a new data set; use it as a context manager.

    The folder appears, whole, when the block ends without an error.

    Args:
        folder: must not exist or be empty.
        scenarios_per_shard: a new shard is begun after so many.
        licence_note: what the manifest says about the licence of the data.
        provenance: how the data was made, in plain JSON values.

    Raises:
        DataError: the folder is not empty.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        scenarios_per_shard: int = 256,
        licence_note: str = DEFAULT_LICENCE_NOTE,
        provenance: Mapping[str, object] | None = None,
    ) -> None:
        self.folder = Path(folder)
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise DataError(f"{self.folder} is not an empty folder: choose another one or delete it")
        self._temporary = self.folder.absolute().with_name(f".{self.folder.name}.{os.getpid()}.tmp")
        self._scenarios_per_shard = scenarios_per_shard
        self._licence_note = licence_note
        self._provenance = dict(provenance or {})
        self._entries: list[ShardEntry] = []
        self._ids: set[str] = set()
        self._shard: ShardWriter | None = None
        shutil.rmtree(self._temporary, ignore_errors=True)
        (self._temporary / SHARDS).mkdir(parents=True)

    def __enter__(self) -> "DatasetWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def add(self, scenario: Scenario, split: str = "unknown") -> None:
        """Append a scenario.

        Raises:
            DataError: there is one with this id already, or it is not as `ShardWriter.add` wants it.
        """
        if scenario.scenario_id in self._ids:
            raise DataError(f"scenario {scenario.scenario_id} is in the data set already: ids must differ")
        if self._shard is None:
            self._shard = ShardWriter(self._temporary / SHARDS / f"{len(self._entries):05d}.arrow")
        self._shard.add(scenario, split)
        self._ids.add(scenario.scenario_id)
        if self._shard.num_rows == self._scenarios_per_shard:
            self._finish_shard()

    def close(self) -> Manifest:
        """Write index and manifest and give the folder its name."""
        self._finish_shard()
        manifest = write_index_and_manifest(
            self._temporary, self._entries, licence_note=self._licence_note, provenance=self._provenance
        )
        if self.folder.exists():
            self.folder.rmdir()
        os.replace(self._temporary, self.folder)
        return manifest

    def discard(self) -> None:
        """Throw away what was written."""
        if self._shard is not None:
            self._shard.discard()
        shutil.rmtree(self._temporary, ignore_errors=True)

    def _finish_shard(self) -> None:
        if self._shard is not None:
            self._shard.close()
            self._entries.append(describe_shard(self._temporary, self._shard.path, self._shard.num_rows))
            self._shard = None


def write_dataset(
    scenarios: Iterable[Scenario],
    folder: str | os.PathLike[str],
    *,
    split: str | Callable[[Scenario], str] = "unknown",
    licence_note: str = DEFAULT_LICENCE_NOTE,
    provenance: Mapping[str, object] | None = None,
) -> Manifest:
    """Write `scenarios` as a new data set.

    Args:
        scenarios: with different ids; read one at a time.
        folder: must not exist or be empty; appears when all is written.
        split: name of the split of all of them, or a function that says it of each.
        licence_note: what the manifest says about the licence of the data.
        provenance: how the data was made, in plain JSON values.

    Returns:
        The manifest written.

    Raises:
        DataError: the folder is not empty, an id occurs twice, an array has another dtype than `types.py` says, or a valid state
            or map point is not finite.
    """
    with DatasetWriter(folder, licence_note=licence_note, provenance=provenance) as writer:
        for scenario in scenarios:
            writer.add(scenario, split(scenario) if callable(split) else split)
    return read_manifest(folder)


def describe_shard(folder: Path, path: Path, num_rows: int) -> ShardEntry:
    """Entry of the manifest for a shard of scenarios that were not converted from a file."""
    return ShardEntry(file=path.relative_to(folder).as_posix(), sha256=hash_file(path), num_rows=num_rows)


def write_index_and_manifest(
    folder: Path,
    entries: Iterable[ShardEntry],
    *,
    licence_note: str = DEFAULT_LICENCE_NOTE,
    provenance: Mapping[str, object] | None = None,
) -> Manifest:
    """Write the index of the given shards, then the manifest.

    Of scenarios with the same id only the first is in the index.
    """
    entries = sorted(entries, key=lambda entry: entry.file)
    table, duplicates = build_index(folder, entries)
    write_whole(folder / INDEX, lambda path: pq.write_table(table, path, compression="zstd"))
    manifest = Manifest(
        shards=tuple(entries),
        num_scenarios=table.num_rows,
        counts=dict(sorted(Counter(table["split"].to_pylist()).items())),
        index_sha256=hash_file(folder / INDEX),
        duplicates=tuple(duplicates),
        licence_note=licence_note,
        provenance=dict(provenance or {}),
    )
    write_json(folder / MANIFEST, asdict(manifest))
    return manifest


def read_manifest(folder: str | os.PathLike[str]) -> Manifest:
    """Manifest of a data set.

    Raises:
        DataError: no data set there, an unfinished or damaged one, or one of another schema version.
    """
    folder = Path(folder)
    if (folder / INCOMPLETE).exists():
        raise DataError(f"the conversion to {folder} was not finished: run the same convert command again, it goes on")
    return parse_manifest(folder)


def parse_manifest(folder: Path) -> Manifest:
    """Manifest of a data set as `read_manifest` gives it, even where a conversion is unfinished."""
    try:
        values = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except FileNotFoundError:
        hint = "tfrecord files have to be converted first" if folder.exists() else "there is no such folder"
        raise DataError(f"{folder} is no data set, it has no {MANIFEST}: {hint}") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{folder / MANIFEST} cannot be read ({error}): convert again") from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise DataError(f"{folder / MANIFEST} is not the manifest of a data set of scenarios")
    if values.get("schema_version") != SCHEMA_VERSION:
        found = values.get("schema_version")
        raise DataError(f"{folder} has schema version {found}, this rlftsim reads {SCHEMA_VERSION}: convert again")
    try:
        shards = tuple(shard_entry_from_json(shard) for shard in values.pop("shards"))
        duplicates = tuple(SkippedRecord(**duplicate) for duplicate in values.pop("duplicates"))
        return Manifest(shards=shards, duplicates=duplicates, **values)
    except (KeyError, TypeError) as error:
        raise DataError(f"{folder / MANIFEST} is damaged ({error}): convert again") from error


def shard_entry_from_json(values: Mapping[str, Any]) -> ShardEntry:
    """Inverse of `asdict` for a shard's entry."""
    skipped = tuple(SkippedRecord(**record) for record in values["skipped"])
    return ShardEntry(**{**values, "skipped": skipped})


def write_json(path: Path, values: Mapping[str, object]) -> None:
    """Write plain values as JSON, whole or not at all."""
    write_text(path, json.dumps(values, indent=1, sort_keys=True) + "\n")


def build_index(folder: Path, entries: Iterable[ShardEntry]) -> tuple[pa.Table, list[SkippedRecord]]:
    """Index of the given shards, read from them, and the scenarios left out because an earlier one has the same id."""
    tables, duplicates, first_place = [], [], {}
    for entry in entries:
        rows = ShardReader(folder / entry.file).index_rows()
        keep = []
        for row, (scenario_id, record) in enumerate(
            zip(*(rows[c].to_pylist() for c in ("scenario_id", "source_record")))
        ):
            place = f"{entry.source or entry.file} record {row if record is None else record}"
            keep.append(first_place.setdefault(scenario_id, place) == place)
            if not keep[-1]:
                cause = f"scenario {scenario_id} is already in {first_place[scenario_id]}; the first is kept"
                duplicates.append(SkippedRecord(entry.source or entry.file, row if record is None else record, cause))
        table = rows.drop_columns("source_record")
        table = table.append_column("shard", pa.array([entry.file] * len(table), pa.string()))
        table = table.append_column("row", pa.array(range(len(table)), pa.int32()))
        tables.append(table.filter(pa.array(keep, pa.bool_())))
    return pa.concat_tables([INDEX_SCHEMA.empty_table(), *tables]).combine_chunks(), duplicates


def _read_index(folder: Path, manifest: Manifest, split: str | None) -> pa.Table:
    try:
        index = pq.read_table(folder / INDEX)
    except (OSError, pa.ArrowException) as error:
        raise DataError(f"{folder / INDEX} cannot be read ({error}): convert again") from error
    if index.schema.names != INDEX_SCHEMA.names or len(index) != manifest.num_scenarios:
        raise DataError(f"{folder / INDEX} does not belong to {MANIFEST}: convert again")
    if split is None:
        return index
    if split not in manifest.counts:
        raise DataError(f"{folder} has no split {split!r}, only {', '.join(manifest.counts) or 'none'}")
    return index.filter(pc.field("split") == split)


def _reopen(folder: Path, split: str | None, cache_size: int) -> ScenarioDataset:
    return ScenarioDataset(folder, split, cache_size=cache_size)
