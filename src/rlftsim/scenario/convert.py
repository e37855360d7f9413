"""Files of a data source to a data set: a shard per unit of work, in parallel, resumable.

Beside a finished shard lies a receipt, written last, that names the sources of the shard. A later run takes over the
shards that agree with receipt, sources and checksum, and makes all others again. So the moment of an interruption does
not matter.
"""

import hashlib
import json
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TypeAlias

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.buckets import fetch, find_files, is_url, validate_folder
from rlftsim.jobs.documents import parse_json, read_json
from rlftsim.jobs.files import check_result_file, remove_temporaries
from rlftsim.jobs.folder import Lease, check_folder, check_name
from rlftsim.jobs.items import ResultFormat, Stopped, run_items
from rlftsim.jobs.runner import Runner, check_finished, choose_runner, select_items, usable_cores
from rlftsim.scenario.dataset import (
    INCOMPLETE,
    INDEX,
    MANIFEST,
    SHARDS,
    Manifest,
    ShardEntry,
    names_of_shards,
    parse_manifest,
    read_manifest,
    shard_entry_from_json,
    write_index_and_manifest,
    write_json,
)
from rlftsim.scenario.shards import SCHEMA_VERSION, ShardWriter, hash_file
from rlftsim.scenario.source import BytesRead, DataSource, Tally, Unit, read_unit, units_of_urls
from rlftsim.scenario.sources import AUTO, DEFAULT_SOURCE, find_source
from rlftsim.scenario.tfrecord import OnError, SkippedRecord
from rlftsim.scenario.types import Scenario

_INCOMPLETE_TEXT = "A conversion runs here or was interrupted: run the same command again, it goes on."
_RECEIPTS = "*.arrow.json"


@dataclass(frozen=True)
class ConvertReport:
    """Outcome of a conversion."""

    destination: Path
    converted: int
    """Scenarios of these sources that are in the data set now, those of an earlier run included."""
    skipped: tuple[SkippedRecord, ...]
    """Files and records of these sources that could not be used."""
    duplicates: tuple[SkippedRecord, ...]
    """Records left out because an earlier one has the same scenario id, those of other sources included."""
    shards_written: int
    shards_reused: int
    counts: Mapping[str, int]
    """Scenarios of the whole data set by split."""
    tallies: Mapping[str, int]
    """Numbers of what the data source counted in these sources."""


@dataclass(frozen=True)
class _Task:
    """A unit of a source and the shard that is made from the unit."""

    unit: Unit
    shard: str
    """Path of the shard inside the data set."""
    split: str
    folder: Path
    on_error: OnError
    finished: "_FinishedShard | None" = None

    def agrees(self, entry: ShardEntry) -> bool:
        """True if a shard has the split of the task, and the size of the sources as they are now."""
        return (entry.split, entry.source_bytes) == (self.split, self.unit.size)


@dataclass(frozen=True)
class _FinishedShard:
    """A shard that an earlier run or another share finished."""

    entry: ShardEntry
    settings: Mapping[str, object]
    """Of the data source that read the sources, see `DataSource.describe`; perhaps also those of other sources."""

    def select_settings(self, names: Iterable[str]) -> dict[str, object]:
        """The settings of some names; None for a name that the shard lacks."""
        return {name: self.settings.get(name) for name in names}


_Outcome: TypeAlias = tuple[ShardEntry, bool | None]
"""A finished shard, and True if it is reused; None for a shard that another share has taken over or made."""


class _Shards(ResultFormat[_Task, _Outcome]):
    """Shards of the data set, as receipts and manifest name them.

    Args:
        folder: Folder of the data set.
        source: Data source of the command, whose settings all shards of the same files must share.
    """

    def __init__(self, folder: Path, source: DataSource) -> None:
        self._folder, self._settings = folder, _plain(source.describe())

    @cached_property
    def finished(self) -> dict[str, _FinishedShard]:
        """Finished shards by path, read once, when they are first asked for."""
        return _find_finished(self._folder)

    def is_finished(self, item: _Task) -> bool:
        """False: tasks compare checksums themselves, many at a time."""
        return False

    def count_units(self, item: _Task) -> int:
        """Bytes of the sources, see `ResultFormat`."""
        return item.unit.size

    def describe(self, item: _Task) -> str:
        """Name of the unit, see `ResultFormat`."""
        return item.unit.name

    def read(self, item: _Task) -> _Outcome | None:
        """The shard of another share, by size and split: each share has compared the checksums of its shards.

        Raises:
            ConfigError: The shard was read with other settings.
        """
        shard = self.finished.get(item.shard)
        if shard is None:
            return None
        stored = shard.select_settings(self._settings)
        if stored != self._settings:
            raise ConfigError(
                f"{self._folder / item.shard} was converted with other options "
                f"({_describe_difference(stored, self._settings)}): give all shares the same, or another destination."
            )
        return (shard.entry, None) if item.agrees(shard.entry) else None


def convert(
    source: str | os.PathLike[str],
    destination: str | os.PathLike[str],
    *,
    reader: str = AUTO,
    split: str | None = None,
    on_error: OnError = "skip",
    jobs: int | None = None,
    runner: Runner | None = None,
    license_note: str | None = None,
    options: Mapping[str, object] | None = None,
    show_progress: bool = True,
) -> ConvertReport:
    """Convert files of a data source to a data set that stands alone.

    Interrupted in any way, the same call goes on. Other files may be added to a data set by converting them to the same
    folder; a source that changed is converted again. The same sources give the same bytes.

    Args:
        source: File, folder or glob by which the data source finds its files; also tfrecords in a bucket (s3://...).
        destination: Folder of the data set: new, empty, or with a data set or an unfinished conversion of ours.
        reader: Name of the data source, such as "womd" (see `sources.SOURCES`); "auto" = by the contents of the files.
        split: Name of the split; None = as the data source has it, for WOMD training, validation or testing by the name
            of the file or its folder, else "unknown".
        on_error: "skip" leaves bad files and records out and reports them, "stop" raises at the first.
        jobs: Number of processes that work at the same time; None = as many as usable cores.
        runner: Runner of the work in place of such processes, see `rlftsim.jobs.runner`.
        license_note: License of the data, for the manifest; None = that of the data source.
        options: Arguments of the data source's class, such as {"window": "first"} for "av2".
        show_progress: False prints neither progress nor the time left.

    Raises:
        DataError: No files to read or none readable, a destination with other contents or without write access; under
            "stop" also the first bad file or record.
        SetAside: Units that killed their process again and again; all others are converted.
        Unfinished: `runner` is a share, which is done, while others are not.
        ConfigError: An unknown data source or option, fewer than one process, a split without a name, or shares with
            other options.
    """
    if jobs is not None and jobs < 1:
        raise ConfigError(f"jobs must be at least 1, got {jobs}: leave it out for one per core.")
    if split is not None:
        check_name(split, "a split's name")
    # 1. Refuse a destination that holds anything but a data set or an unfinished conversion.
    folder = validate_folder(destination)
    check_folder(folder, "data set")
    if folder.exists() and not (folder / INCOMPLETE).exists():
        if (folder / MANIFEST).exists():
            read_manifest(folder)  # raises where it cannot be added to
        elif any(not path.name.startswith(INCOMPLETE) for path in folder.iterdir()):  # shares may begin just now
            raise DataError(f"{folder} is not empty and not a data set: choose another destination")

    # 2. One task per unit of the source.
    if is_url(source):
        data_source = find_source(DEFAULT_SOURCE if reader == AUTO else reader, source, options)
        units = units_of_urls(find_files(str(source), "*tfrecord*"))
    else:
        data_source = find_source(reader, source, options)
        units = data_source.find(source)
    tasks = []
    for unit in units:
        label = split or unit.split
        # files of two splits may have the same name: a split's shards have a folder of their own
        name = unit.name if unit.name.startswith(f"{label}/") else f"{label}/{unit.name}"
        tasks.append(_Task(unit, f"{SHARDS}/{name}.arrow", label, folder, on_error))
    repeated = [shard for shard, count in Counter(task.shard for task in tasks).items() if count > 1]
    if repeated:
        raise DataError(f"{source}: its data source has two units of one name for {repeated[0]}: names must differ.")

    # 3. Make the shards that earlier runs have not finished, then index and manifest.
    runner = runner or choose_runner(jobs or usable_cores(), len(tasks), on_death=on_error)
    selected = {task.shard for task in select_items(runner, tasks)}
    shards = _Shards(folder, data_source)
    for task in tasks:
        if task.shard not in selected:
            shards.read(task)  # refuses those of other shares that were read with other settings
    # The folder is marked as unfinished until the mark is removed.
    with Lease(folder / INCOMPLETE, runner, "is converting to", _INCOMPLETE_TEXT) as lease:
        outputs = [folder / name for task in tasks for name in (task.shard, f"{task.shard}.json")]
        outputs += [folder / INDEX, folder / MANIFEST]
        if lease.is_alone:
            remove_temporaries(outputs)
        finished = _find_finished(folder)
        outcomes = run_items(
            "convert", [replace(task, finished=finished.get(task.shard)) for task in tasks],
            partial(_convert_unit, source=data_source),
            format=_Shards(folder, data_source), lease=lease, unit="bytes", show_progress=show_progress,
        )  # fmt: skip
        num_changed = sum(not task.agrees(entry) for task, (entry, _) in zip(tasks, outcomes))
        check_finished(runner, num_changed, len(tasks), "convert")  # sources that changed meanwhile
        remove_temporaries(outputs)  # of processes that were killed
        earlier = _earlier_manifest(folder)
        manifest = _finish(folder, [entry for entry, _ in outcomes], data_source, license_note, lease)
        lease.remove()
    return _report(folder, outcomes, manifest, earlier.duplicates)


def _find_finished(folder: Path) -> dict[str, _FinishedShard]:
    """Shards that earlier runs finished, by path: from the manifest and the receipts of runs that got no further."""
    earlier = _earlier_manifest(folder)
    shards = {entry.file: _FinishedShard(entry, earlier.provenance) for entry in earlier.shards}
    for path in sorted((folder / SHARDS).rglob(_RECEIPTS)):
        check_result_file(path)
        with suppress(DataError, ConfigError, KeyError, TypeError):  # a damaged one counts for nothing
            receipt = read_json(path, "convert again")
            settings = receipt.pop("settings")
            if receipt.pop("schema_version") == SCHEMA_VERSION:
                entry = shard_entry_from_json(receipt)
                shards[entry.file] = _FinishedShard(entry, settings)
    return {file: shard for file, shard in shards.items() if (folder / file).exists()}


def _describe_difference(stored: object, expected: object, name: str = "") -> str:
    """Values that differ between two trees of plain settings, in words.

    Args:
        stored: Settings of a shard, or the value under a name in them.
        expected: Settings of this command, or the value under the same name.
        name: Name of the value, empty for the whole trees.
    """
    if not (isinstance(stored, dict) and isinstance(expected, dict)):
        return f"{name} {json.dumps(stored)} there, {json.dumps(expected)} here"
    names = [key for key in {**expected, **stored} if stored.get(key) != expected.get(key)]
    return "; ".join(_describe_difference(stored.get(key), expected.get(key), key) for key in names)


def _plain(settings: Mapping[str, object]) -> dict[str, object]:
    """Settings as JSON gives them back."""
    return parse_json(json.dumps(settings), "give plain values", source="settings of the source")


def _earlier_manifest(folder: Path) -> Manifest:
    """Manifest of the data set that is added to; an empty manifest where none can be read."""
    try:
        return parse_manifest(folder)
    except DataError:
        return Manifest(shards=(), num_scenarios=0, counts={}, index_sha256="", license_note="")


def _convert_unit(
    task: _Task, advance: Callable[[int], None], is_stopped: Callable[[], bool], *, source: DataSource
) -> _Outcome:
    """Make the shard of a task, or take over a finished one.

    Args:
        task: Unit of the source, the shard to make, and the finished shard of that name.
        advance: Callback for the number of bytes that were read or need not be.
        is_stopped: True once the shard is not needed any more; asked after each item.
        source: Reader of the unit, with the options of the command.

    Raises:
        DataError: Under "stop", a bad file or record; always: the shard cannot be written.
        Stopped: `is_stopped` was true.
    """
    # 1. Take over the shard of an earlier run if it is whole and made from these very files; remote ones are compared
    # by size alone, as their checksums would take as long as fetching them.
    settings = _plain(source.describe())
    stored = task.finished.entry if task.finished and task.finished.select_settings(settings) == settings else None
    if task.unit.url:
        if stored is not None and task.agrees(stored) and hash_file(task.folder / task.shard) == stored.sha256:
            advance(task.unit.size)
            return stored, True
        with tempfile.TemporaryDirectory() as folder:
            local = Path(folder) / Path(task.unit.url).name
            fetch(task.unit.url, local)
            unit = replace(task.unit, files=(local,), url="", url_bytes=0)
            return _convert_unit(replace(task, unit=unit, finished=None), advance, is_stopped, source=source)
    size, digest = _fingerprint(task.unit.files, settings)
    if (
        stored is not None
        and (stored.source_bytes, stored.source_sha256, stored.split) == (size, digest, task.split)
        and not (stored.skipped and task.on_error == "stop")
        and hash_file(task.folder / task.shard) == stored.sha256
    ):
        advance(size)
        return stored, True

    # 2. Read and write record by record, so that memory does not grow with the file.
    skipped: list[SkippedRecord] = []
    tallies: Counter[str] = Counter()
    num_read = 0
    with ShardWriter(task.folder / task.shard) as writer:
        for record, item in read_unit(source, task.unit, on_error=task.on_error):
            match item:
                case Scenario():
                    writer.add(item, task.split, record)
                case SkippedRecord():
                    skipped.append(item)
                case BytesRead():
                    advance(item)
                    num_read += item
                case Tally():
                    tallies[item.event] += item.count
            if is_stopped():
                raise Stopped
    # bytes between records, and all of them for a source that does not count
    advance(size - num_read)

    # 3. Leave a receipt: from now on the shard counts as finished.
    if len(task.unit.files) == 1:  # the same bytes wherever the sources lie
        skipped = [replace(record, file=task.unit.name) for record in skipped]
    entry = ShardEntry(
        file=task.shard,
        sha256=hash_file(task.folder / task.shard),
        num_rows=writer.num_rows,
        split=task.split,
        source=task.unit.name,
        source_bytes=size,
        source_sha256=digest,
        skipped=tuple(skipped),
        tallies=dict(sorted(tallies.items())),
    )
    receipt = {**asdict(entry), "settings": settings, "schema_version": SCHEMA_VERSION}
    write_json(task.folder / f"{task.shard}.json", receipt)
    return entry, False


def _fingerprint(files: tuple[Path, ...], settings: Mapping[str, object]) -> tuple[int, str]:
    """Bytes of some files and the SHA-256; of several files or with settings, that of all checksums and settings."""
    try:
        size = sum(file.stat().st_size for file in files)
        digests = [hash_file(file) for file in files]
    except OSError as error:
        raise DataError(f"{error.filename}: cannot be read: {error.strerror}") from error
    if settings:
        digests.append(json.dumps(settings, sort_keys=True))
    return size, digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


def _finish(folder: Path, new: list[ShardEntry], source: DataSource, note: str | None, lease: Lease) -> Manifest:
    """Write index and manifest of the new shards and those that were there, and remove the receipts."""
    # shards of earlier runs that this call does not touch stay in the data set
    earlier_shards = {file: shard.entry for file, shard in _find_finished(folder).items()}
    entries = earlier_shards | {entry.file: entry for entry in new}
    if not any(entry.num_rows for entry in entries.values()):
        # leave nothing behind, as if the command had not been given
        for file in entries:
            (folder / file).unlink(missing_ok=True)
            (folder / f"{file}.json").unlink(missing_ok=True)
        for path in (*sorted((folder / SHARDS).rglob("*"), reverse=True), folder / SHARDS):
            with suppress(OSError):  # a file, or a folder with one that is not ours
                path.rmdir()
        lease.remove()  # before, the same call gives the same answer
        with suppress(OSError):
            folder.rmdir()
        causes = [record for entry in new for record in entry.skipped]
        first = f"; first of {len(causes)} causes: {causes[0]}" if causes else ""
        raise DataError(f"not one scenario could be converted{first}")
    earlier = _earlier_manifest(folder)
    note = note or source.license_note
    # of several sources every license applies
    note = earlier.license_note if note in earlier.license_note else f"{earlier.license_note} {note}".lstrip()
    provenance = {**earlier.provenance, **source.describe()}
    manifest = write_index_and_manifest(folder, entries.values(), license_note=note, provenance=provenance)
    # only now: until the manifest is there the receipts are the only memory of finished shards
    for receipt in (folder / SHARDS).rglob(_RECEIPTS):
        receipt.unlink()
    return manifest


def _report(
    folder: Path, outcomes: list[_Outcome], manifest: Manifest, earlier_duplicates: Sequence[SkippedRecord]
) -> ConvertReport:
    """Report on the units of this call; a data set may hold more, and other shares may have made most of them."""
    entries = [entry for entry, _ in outcomes]
    all_names = names_of_shards(manifest.shards)
    names = {all_names[entry.file] for entry in entries}
    duplicates = [record for record in manifest.duplicates if record.file in names]
    # a shard of this call that comes first in the index makes duplicates of scenarios that were there before
    earlier_records = {*earlier_duplicates}
    replaced = [r for r in manifest.duplicates if r.file not in names and r not in earlier_records]
    tallies: Counter[str] = Counter()
    for entry in entries:
        tallies.update(entry.tallies)
    return ConvertReport(
        destination=folder,
        converted=sum(entry.num_rows for entry in entries) - len(duplicates),
        skipped=tuple(record for entry in entries for record in entry.skipped),
        duplicates=(*duplicates, *replaced),
        shards_written=sum(is_reused is False for _, is_reused in outcomes),
        shards_reused=sum(is_reused is True for _, is_reused in outcomes),
        counts=manifest.counts,
        tallies=dict(sorted(tallies.items())),
    )
