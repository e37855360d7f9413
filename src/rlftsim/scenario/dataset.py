"""A data set: a folder of Arrow shards, an index and a manifest.

A data set is complete: the source files are never opened again.

    manifest.json       schema version, shards with checksums and sources, counts, license note; written last
    index.parquet       a row per scenario: shard and row, counts of the contents
    shards/*.arrow      the scenarios
    INCOMPLETE          only while a conversion runs or after it was interrupted

Files are written under temporary names and renamed, so a file under a final name is complete.

Scenarios of a cluster share a street network or a recording. Choices are made on the split `tune`; `exam` is looked at
once. Where a data set stores no splits of these names, a fixed third of the clusters of the validation split is `exam`
and two thirds are `tune`. Of generated scenarios `tune` is all of validation, because the exam is generated, too:
`rlftsim experiment exam`.
"""

import difflib
import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache, partial
from itertools import groupby
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any, overload

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Int64, Shaped

import rlftsim
from rlftsim.errors import ConfigError, DataError, check_types, whole_number
from rlftsim.jobs.buckets import ORIGIN, fetch_shard, is_url, mirror, validate_folder
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import new_folder, write_atomically, write_text
from rlftsim.jobs.folder import check_folder
from rlftsim.jobs.tables import check_columns, read_parquet
from rlftsim.scenario.shards import (
    AGENT_COLUMNS,
    INDEX_FIELDS,
    SCHEMA_VERSION,
    ShardReader,
    ShardWriter,
    check_scenario,
    hash_file,
)
from rlftsim.scenario.synthetic import pack_path
from rlftsim.scenario.tfrecord import SkippedRecord
from rlftsim.scenario.types import Scenario

FORMAT = "rlftsim scenarios"
MANIFEST, INDEX, INCOMPLETE, SHARDS = "manifest.json", "index.parquet", "INCOMPLETE", "shards"
DEFAULT_LICENSE_NOTE = "The license of the source data applies to this data set."
SYNTHETIC = "synthetic"
"""Name of the data set that ships with the package."""
VALIDATION, TUNE, EXAM = "validation", "tune", "exam"
_AV2_WINDOW = re.compile(r"-(0|19)$")
"""End of the id of one of the two windows of a recording."""
_MAX_OPEN_SHARDS = 128  # each holds a file descriptor; systems allow 256 to 1024
INDEX_SCHEMA = pa.schema([*INDEX_FIELDS, pa.field("shard", pa.string()), pa.field("row", pa.int32())])


@dataclass(frozen=True)
class ShardEntry:
    """A shard in the manifest."""

    file: str
    """Path inside the data set's folder."""
    sha256: str
    num_rows: int
    split: str | None = None
    """Set where all rows are of one split because the source file is."""
    source: str | None = None
    """Name of the source file."""
    source_bytes: int | None = None
    source_sha256: str | None = None
    """Hash of the source: the bytes of the files, and the settings of the data source."""
    skipped: tuple[SkippedRecord, ...] = ()
    tallies: Mapping[str, int] = field(default_factory=dict)
    """Counts of the data source, by event."""


@dataclass(frozen=True)
class Manifest:
    """Contents of `manifest.json`."""

    shards: tuple[ShardEntry, ...]
    num_scenarios: int
    counts: Mapping[str, int]
    """Scenarios by split."""
    index_sha256: str
    duplicates: tuple[SkippedRecord, ...] = ()
    """Scenarios that are in a shard but not in the index, because an earlier scenario has the same id."""
    license_note: str = DEFAULT_LICENSE_NOTE
    provenance: Mapping[str, object] = field(default_factory=dict)
    """Origin of the data in plain JSON values, e.g. the seed of a generator or the values a source had to guess."""
    format: str = FORMAT
    schema_version: int = SCHEMA_VERSION
    rlftsim_version: str = rlftsim.__version__


class ScenarioDataset:
    """Scenarios of a data set's folder, by position or by id.

    As long as a scenario is in the cache the same object comes back, so values computed from a scenario can be cached
    by identity. A data set can be handed to other processes: each opens the files again.

    Args:
        folder: Folder of the data set, also in a bucket (s3://bucket/folder), of which shards are fetched when they are
            needed; "synthetic" = the data set that ships with the package.
        split: Split of the scenarios, e.g. "training"; None = all splits. "tune" and "exam" are drawn from validation
            if not stored, see the module.
        cache_size: Number of decoded scenarios in memory, about 1 MB each; the least recently used go first.
        limit: Number of scenarios, the first ones of the split; None = all.

    Raises:
        DataError: No data set in the folder, an unfinished or damaged data set, or no such split.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        split: str | None = None,
        *,
        cache_size: int = 256,
        limit: int | None = None,
    ) -> None:
        self.folder = dataset_folder(folder)
        self.split = split
        self.limit = limit
        origin = self.folder / ORIGIN
        self.url = origin.read_text(encoding="utf-8") if origin.exists() else None
        """Address of a remote data set, of which the folder holds index and manifest."""
        self.cache_size = cache_size
        self.manifest = read_manifest(self.folder)
        index = load_index(self.folder)
        if len(index) != self.manifest.num_scenarios:
            raise DataError(f"{self.folder / INDEX} does not belong to {MANIFEST}: convert again")
        self.index = index
        if split is not None:
            is_in_split = self._find_split(split)
            if split not in self.manifest.counts and not is_in_split.any():
                splits = ", ".join(self.manifest.counts) or "none"
                raise DataError(
                    f"{self.folder} has no split {split!r}, only {splits}: name one of these as the split, in Python "
                    "by load_dataset(name, split)"
                )
            self.index = index.filter(pa.array(is_in_split))
        if limit is not None:
            self.index = self.index.slice(0, limit)
        """Table with the columns of `INDEX_SCHEMA`, a row per scenario, in the order of positions."""
        self.scenario_ids: list[str] = self.index["scenario_id"].to_pylist()
        self._shard_names: list[str] = self.index["shard"].to_pylist()
        self._rows: list[int] = self.index["row"].to_pylist()
        self._position = {scenario_id: i for i, scenario_id in enumerate(self.scenario_ids)}
        self._lock = Lock()
        # shards are opened on first use and stay open, least recently used ones go
        self._reader = lru_cache(_MAX_OPEN_SHARDS)(lambda name: ShardReader(self._shard_path(name)))
        self._decoded = lru_cache(cache_size)(self._read)

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """Names of the data sources of the scenarios, in alphabetical order."""
        return tuple(sorted(set(self.index["source"].to_pylist())))

    @cached_property
    def guessed(self) -> tuple[str, ...]:
        """Values that are guessed in at least one scenario, see `Scenario.guessed`, in alphabetical order."""
        return tuple(sorted({word for words in set(self.index["guessed"].to_pylist()) for word in words.split()}))

    @cached_property
    def clusters(self) -> Shaped[np.ndarray, "scenarios"]:
        """Label of each scenario's street network (synthetic) or recording (Argoverse 2), else the scenario id.

        Scenarios of one label are not independent: statistics count labels.
        """
        return self._label_clusters()

    def find_cluster(self, scenario_id: str) -> str:
        """Label of a scenario's street network or recording."""
        return self.clusters[self._position[scenario_id]]

    @cached_property
    def num_agents(self) -> Int64[np.ndarray, "scenarios"]:
        """Simulated agents of each scenario."""
        return np.stack([self.index[name].to_numpy() for name in AGENT_COLUMNS]).sum(0, dtype=np.int64)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the files with the scenarios: equal for a copy, different for data that was converted otherwise.

        Files of further splits do not count.
        """
        files = set(self._shard_names)
        checksums = "".join(entry.sha256 for entry in self.manifest.shards if entry.file in files)
        return hashlib.blake2b(checksums.encode(), digest_size=16).hexdigest()

    def __len__(self) -> int:
        return len(self.scenario_ids)

    @overload
    def __getitem__(self, position: int | str, /) -> Scenario: ...
    @overload
    def __getitem__(self, position: slice | Iterable[int], /) -> list[Scenario]: ...
    def __getitem__(self, position: Any, /) -> Scenario | list[Scenario]:
        """Scenario at a position of the index, or with an id; a list of scenarios for a slice or several positions.

        Negative positions count from the end.

        Raises:
            ConfigError: Neither a whole number nor an id, a slice or several of these.
            IndexError: The position lies beyond the data set.
            DataError: The id is unknown, or the scenario's shard is missing or damaged.
        """
        if isinstance(position, str):
            return self.by_id(position)
        if isinstance(position, slice):
            return [self[index] for index in range(len(self))[position]]
        if isinstance(position, list | tuple) or getattr(position, "ndim", 0) == 1:
            return [self[index] for index in position]
        position = whole_number("position of a scenario", position)
        if not -len(self) <= position < len(self):
            raise IndexError(f"position {position} in a data set of {len(self)} scenarios")
        # without the lock two threads would get two objects for one scenario
        with self._lock:
            return self._decoded(position % len(self))

    def __iter__(self) -> Iterator[Scenario]:
        return (self[position] for position in range(len(self)))

    def __contains__(self, scenario: object) -> bool:
        """True for a scenario of the data set, or a scenario id."""
        return (scenario.scenario_id if isinstance(scenario, Scenario) else scenario) in self._position

    def __reduce__(self) -> tuple[Callable[..., "ScenarioDataset"], tuple[object, ...]]:
        # memory maps, locks and caches stay in their process
        options = {"cache_size": self.cache_size, "limit": self.limit}
        return partial(ScenarioDataset, **options), (self.url or self.folder, self.split)

    def __repr__(self) -> str:
        split = "" if self.split is None else f", split {self.split!r}"
        name = SYNTHETIC if self.folder == pack_path() else str(self.folder)
        return f"ScenarioDataset({name!r}{split}, {len(self)} scenarios)"

    def _label_clusters(self) -> Shaped[np.ndarray, "scenarios"]:
        """Labels of the scenarios in the index, see `clusters`."""
        networks = self._find_networks()
        columns = (self.index[name].to_pylist() for name in ("scenario_id", "source", "shard"))
        labels = [
            networks.get(shard) or (_AV2_WINDOW.sub("", scenario_id) if source == "av2" else scenario_id)
            for scenario_id, source, shard in zip(*columns)
        ]
        return np.array(labels, dtype=object)

    def _find_networks(self) -> dict[str, str]:
        """Street network by shard, of generated scenarios; empty for logged ones.

        Raises:
            DataError: The manifest's list of networks is damaged.
        """
        networks: Any = self.manifest.provenance.get("networks", ())
        try:
            return {f"shards/{entry['shard']}": "/".join(map(str, entry["seed"])) for entry in networks}
        except (TypeError, KeyError) as error:
            raise DataError(
                f"{self.folder}: the manifest's list of networks is damaged ({error}): generate again."
            ) from None

    def _find_split(self, split: str) -> Bool[np.ndarray, "scenarios"]:
        """True for the scenarios of a split, stored or drawn, see the module; all False for an unknown split."""
        stored = self.index["split"].to_numpy(zero_copy_only=False)
        if split not in (TUNE, EXAM) or split in stored:
            return stored == split
        if self._find_networks():
            return (stored == VALIDATION) & (split == TUNE)
        is_exam = np.array([is_in_exam(label) for label in self._label_clusters()], dtype=bool)
        return (stored == VALIDATION) & (is_exam == (split == EXAM))

    def _read(self, position: int) -> Scenario:
        """Scenario at a position, decoded."""
        name, row = self._shard_names[position], self._rows[position]
        scenario = self._reader(name).read(row)
        if scenario.scenario_id != self.scenario_ids[position]:
            raise DataError(
                f"{self.folder / INDEX} does not belong to the shards: row {row} of {name} is scenario "
                f"{scenario.scenario_id}, not {self.scenario_ids[position]}: convert again"
            )
        return scenario

    def _shard_path(self, name: str) -> Path:
        """Local path of a shard; of a remote data set, the path in the cache of this machine."""
        sha256 = {entry.file: entry.sha256 for entry in self.manifest.shards}.get(name)
        if sha256 is None:
            raise DataError(f"{self.folder / INDEX} names a shard {name!r} that {MANIFEST} lacks: convert again")
        if self.url is None:
            return self.folder / name
        return fetch_shard(f"{self.url}/{name}", sha256)

    def by_id(self, scenario_id: str) -> Scenario:
        """Scenario with the given id.

        Raises:
            DataError: The data set, or the split, has no such scenario.
        """
        if scenario_id not in self._position:
            split = f" (split {self.split})" if self.split else ""
            raise DataError(f"{self.folder}{split} has no scenario {scenario_id!r}")
        return self[self._position[scenario_id]]


def is_in_exam(label: str) -> bool:
    """True for a third of all labels of clusters: the same labels on any machine and in any data set."""
    return int.from_bytes(hashlib.sha256(label.encode()).digest()[:8]) % 3 == 0


def write_dataset(
    scenarios: Scenario | Iterable[Scenario],
    folder: str | os.PathLike[str],
    *,
    split: str | Callable[[Scenario], str] = "unknown",
    license_note: str = DEFAULT_LICENSE_NOTE,
    provenance: Mapping[str, object] | None = None,
    scenarios_per_shard: int = 256,
) -> Manifest:
    """Write `scenarios` as a new data set.

    Args:
        scenarios: A scenario, or several with different ids, read in turn, never all in memory.
        folder: Folder that must not exist or be empty; appears when all scenarios are written.
        split: Name of the split of all scenarios, or a function from scenario to split.
        license_note: License of the data, for the manifest.
        provenance: Origin of the data in plain JSON values, for the manifest.
        scenarios_per_shard: Number of scenarios in a shard; smaller shards are fetched and read faster.

    Returns:
        The manifest written.

    Raises:
        ConfigError: No scenario, or a value of a different type among the scenarios.
        DataError: The folder is not empty or cannot be written to, a scenario id occurs twice, an array has another
            dtype than `types.py` says, a valid state or map point is not finite (names scenario, agent and step), an
            object id occurs twice, a type is unknown, a size is not above zero, or the ego is no track.
    """
    folder = validate_folder(folder)
    check_folder(folder, "data set")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(f"{folder} is not an empty folder: choose another one or delete it")
    # the complete folder gets the name, so no reader ever sees half a data set
    with new_folder(folder) as partial:
        (partial / SHARDS).mkdir()
        scenarios = [scenarios] if isinstance(scenarios, Scenario) else scenarios
        entries = _write_shards(partial, scenarios, split, scenarios_per_shard)
        if not entries:
            raise ConfigError(f"no scenario to write to {folder}: hand over at least one.")
        write_index_and_manifest(partial, entries, license_note=license_note, provenance=provenance)
    return read_manifest(folder)


def _write_shards(
    folder: Path, scenarios: Iterable[Scenario], split: str | Callable[[Scenario], str], scenarios_per_shard: int
) -> list[ShardEntry]:
    entries, ids = [], set()
    for shard, numbered in groupby(enumerate(scenarios), lambda pair: pair[0] // scenarios_per_shard):
        with ShardWriter(folder / SHARDS / f"{shard:05d}.arrow") as writer:
            for _, scenario in numbered:
                if not isinstance(scenario, Scenario):
                    raise ConfigError(f"{type(scenario).__name__}: not a scenario: hand over scenarios to write.")
                if scenario.scenario_id in ids:
                    raise DataError(f"scenario {scenario.scenario_id} is in the data set already: ids must differ")
                check_scenario(scenario)
                writer.add(scenario, split(scenario) if callable(split) else split)
                ids.add(scenario.scenario_id)
        entries.append(describe_shard(folder, writer.path, writer.num_rows))
    return entries


def dataset_folder(name: str | os.PathLike[str]) -> Path:
    """Folder of a data set, "~" expanded; "synthetic" names the data set that ships with the package.

    Of a remote data set (s3://...), a local folder with index and manifest.
    """
    if is_url(name):
        return mirror(str(name), (INDEX, MANIFEST))
    return pack_path() if name == SYNTHETIC else Path(name).expanduser()


def describe_shard(folder: Path, path: Path, num_rows: int) -> ShardEntry:
    """Entry of the manifest for a shard of scenarios that were not converted from a file.

    Args:
        folder: Folder of the data set, which the manifest describes.
        path: Path of the shard, inside the folder.
        num_rows: Number of scenarios in the shard.
    """
    return ShardEntry(file=path.relative_to(folder).as_posix(), sha256=hash_file(path), num_rows=num_rows)


def write_index_and_manifest(
    folder: Path,
    entries: Iterable[ShardEntry],
    *,
    license_note: str = DEFAULT_LICENSE_NOTE,
    provenance: Mapping[str, object] | None = None,
) -> Manifest:
    """Write the index of the given shards, then the manifest.

    Of scenarios with the same id only the first is in the index.

    Args:
        folder: Folder of the data set, with the shards in place.
        entries: Entries of the shards, in any order.
        license_note: License of the data, for people who receive the data set.
        provenance: Origin of the data in plain JSON values, such as the seed of a generator.

    Returns:
        The manifest written.

    Raises:
        DataError: A shard is damaged, or the folder cannot be written to.
    """
    # sorted: the index must not depend on the order in which processes finished
    entries = sorted(entries, key=lambda entry: entry.file)
    table, duplicates = build_index(folder, entries)
    write_atomically(folder / INDEX, lambda path: pq.write_table(table, path, compression="zstd"))
    manifest = Manifest(
        shards=tuple(entries),
        num_scenarios=table.num_rows,
        counts=dict(sorted(Counter(table["split"].to_pylist()).items())),
        index_sha256=hash_file(folder / INDEX),
        duplicates=tuple(duplicates),
        license_note=license_note,
        provenance=dict(provenance or {}),
    )
    write_json(folder / MANIFEST, asdict(manifest))
    return manifest


def read_manifest(folder: str | os.PathLike[str]) -> Manifest:
    """Manifest of a data set.

    Raises:
        DataError: No data set in the folder, an unfinished or damaged one, or a wrong schema version.
    """
    folder = dataset_folder(folder)
    if (folder / INCOMPLETE).exists():
        raise DataError(f"the conversion to {folder} was not finished: run the same convert command again, it goes on")
    return parse_manifest(folder)


def parse_manifest(folder: Path) -> Manifest:
    """Manifest of a data set as `read_manifest` gives it, even where a conversion is unfinished."""
    if folder.is_file():
        raise DataError(f"{folder} is a file: convert it with `rlftsim convert`, then name the new folder")
    try:
        values = read_json(folder / MANIFEST, "convert again")
    except FileNotFoundError:
        raise DataError(f"{folder} is no data set: {_missing_manifest_hint(folder)}") from None
    if values.get("format") != FORMAT:
        raise DataError(f"{folder / MANIFEST} is not the manifest of a data set of scenarios")
    if values.get("schema_version") != SCHEMA_VERSION:
        version = values.get("schema_version")
        raise DataError(f"{folder} has schema version {version}, this rlftsim reads {SCHEMA_VERSION}: convert again")
    try:
        shards = tuple(shard_entry_from_json(shard) for shard in values.pop("shards"))
        duplicates = tuple(_skipped_from_json(duplicate) for duplicate in values.pop("duplicates"))
        manifest = Manifest(shards=shards, duplicates=duplicates, **values)
        check_types(manifest)
        _check_numbers("counts", manifest.counts)
        if not isinstance(manifest.provenance, Mapping):
            raise TypeError("provenance is no object")
        return manifest
    except (KeyError, TypeError, ConfigError) as error:
        raise DataError(f"{folder / MANIFEST} is damaged ({error}): convert again") from error


def _missing_manifest_hint(folder: Path) -> str:
    """Cause and remedy where a folder has no manifest."""
    if not folder.exists():
        matches = difflib.get_close_matches(str(folder), [SYNTHETIC], n=1)
        return "there is no such folder" + (f", did you mean {SYNTHETIC!r}?" if matches else "")
    # also one level down: WOMD has a folder per split
    has_source = any(next(folder.glob(pattern), None) for pattern in ("*.tfrecord*", "*/*.tfrecord*"))
    if has_source:
        return f"it has no {MANIFEST}; its tfrecord files have to be converted first, or {SYNTHETIC!r}"
    return f"it has no {MANIFEST}; name a folder that `rlftsim convert` wrote, or {SYNTHETIC!r}"


def shard_entry_from_json(values: Mapping[str, Any]) -> ShardEntry:
    """Inverse of `asdict` for a shard's entry.

    Raises:
        KeyError, TypeError, ConfigError: A value is missing, unknown or of a wrong type.
    """
    skipped = tuple(_skipped_from_json(record) for record in values["skipped"])
    entry = ShardEntry(**{**values, "skipped": skipped})
    check_types(entry)
    _check_numbers("tallies", entry.tallies)
    path = PurePosixPath(entry.file)
    if path.is_absolute() or ".." in path.parts or not entry.file.isprintable():
        raise TypeError(f"the path {entry.file[:80]!r} leads out of the folder")
    return entry


def _skipped_from_json(values: Mapping[str, Any]) -> SkippedRecord:
    record = SkippedRecord(**values)
    check_types(record)
    return record


def _check_numbers(name: str, numbers: object) -> None:
    if not isinstance(numbers, Mapping) or not all(type(number) is int for number in numbers.values()):
        raise TypeError(f"{name} are no whole numbers by name")


def write_json(path: Path, values: Mapping[str, object]) -> None:
    """Write plain values as JSON, whole or not at all.

    Args:
        path: File to write; an existing file is replaced.
        values: Values of the types that JSON has, by key.
    """
    write_text(path, json.dumps(values, indent=1, sort_keys=True) + "\n")


def load_index(folder: Path) -> pa.Table:
    """Index file of a data set.

    Raises:
        DataError: The file is missing or damaged.
    """
    index = read_parquet(folder / INDEX, "convert again", missing=f"{folder / INDEX} is missing: convert again")
    try:
        check_columns(index, INDEX_SCHEMA)
    except DataError as error:
        raise DataError(f"{folder / INDEX} does not belong to {MANIFEST} ({error}): convert again") from None
    return index


def build_index(folder: Path, entries: Iterable[ShardEntry]) -> tuple[pa.Table, list[SkippedRecord]]:
    """Index of the given shards, read from the files, and the scenarios left out because an id occurs twice.

    Args:
        folder: Folder of the data set, with the shards in place.
        entries: Entries of the shards, in the order of the index.
    """
    entries = list(entries)
    names = names_of_shards(entries)
    tables, duplicates, first_locations = [], [], {}
    for entry in entries:
        rows = ShardReader(folder / entry.file).index_rows()
        is_first = []
        ids, records, splits = (rows[column].to_pylist() for column in ("scenario_id", "source_record", "split"))
        for row, (scenario_id, record, split) in enumerate(zip(ids, records, splits)):
            # the first of equal ids is indexed; the others stay in their shards, reported as duplicates
            is_first.append(scenario_id not in first_locations)
            record = row if record is None else record
            location = f"{names[entry.file]} record {record}"
            location, first_split = first_locations.setdefault(scenario_id, (location, split))
            if is_first[-1]:
                continue
            cause = f"scenario {scenario_id} is already in {location}; the first is kept"
            if split != first_split:
                cause += f", in split {first_split}: to have it in split {split}, convert to another folder"
            duplicates.append(SkippedRecord(names[entry.file], record, cause))
        table = rows.drop_columns("source_record")
        table = table.append_column("shard", pa.array([entry.file] * len(table), pa.string()))
        table = table.append_column("row", pa.array(range(len(table)), pa.int32()))
        tables.append(table.filter(pa.array(is_first, pa.bool_())))
    return pa.concat_tables([INDEX_SCHEMA.empty_table(), *tables]).combine_chunks(), duplicates


def names_of_shards(entries: Iterable[ShardEntry]) -> dict[str, str]:
    """Name in messages by shard file: the source, or the file where the source has not exactly one shard."""
    entries = list(entries)
    num_shards = Counter(entry.source for entry in entries)
    return {entry.file: (num_shards[entry.source] == 1 and entry.source) or entry.file for entry in entries}
