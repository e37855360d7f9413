"""Files of a data source to a data set: one shard per unit of work, in parallel, resumable.

A finished shard has a receipt beside it, written after it, that holds what it was made from. A later run takes over a
shard whose receipt, source and checksum agree, and makes the others again. So it does not matter when or how a run was
interrupted.
"""

import hashlib
import json
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.buckets import fetch, find_files, is_url, validate_folder
from rlftsim.jobs.documents import parse_json, read_json
from rlftsim.jobs.files import remove_temporaries_below
from rlftsim.jobs.folder import Lease, check_folder, check_name
from rlftsim.jobs.progress import progress_bar
from rlftsim.jobs.runner import Runner, check_finished, choose_runner, usable_cores
from rlftsim.scenario.dataset import (
    INCOMPLETE,
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
from rlftsim.scenario.source import DataSource, Unit, read_unit, units_of_urls
from rlftsim.scenario.sources import AUTO, DEFAULT_SOURCE, find_source
from rlftsim.scenario.tfrecord import OnError, SkippedRecord

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
    """One unit of a source and the shard it becomes."""

    unit: Unit
    shard: str
    """Path of the shard inside the data set."""
    split: str
    folder: Path
    on_error: OnError
    known: "_Known | None" = None


@dataclass(frozen=True)
class _Known:
    """A shard that an earlier run or another share finished."""

    entry: ShardEntry
    settings: Mapping[str, object]
    """Of the data source that it was read by, see `DataSource.describe`; those of other sources may be among them."""

    def settings_of(self, source: Mapping[str, object]) -> dict[str, object]:
        """The settings under the names that a source describes itself by."""
        return {name: self.settings.get(name) for name in source}


@dataclass(frozen=True)
class _Outcome:
    entry: ShardEntry
    reused: bool


class _Stopped(Exception):
    """The run is being stopped; this shard is not wanted any more."""


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
    """Convert files of a data source to a data set that does not need them any more.

    Interrupted in any way, the same call goes on where it was. A data set may be added to by converting other files to
    it; a source that changed is converted again. The same sources give the same bytes.

    Args:
        source: file, folder or glob that the data source finds its files by; also tfrecords in a bucket (s3://...).
        destination: folder of the data set: new, empty, or a data set or unfinished conversion of ours.
        reader: name of the data source, such as "womd" (see `sources.SOURCES`); "auto" = the one that recognizes the
            files.
        split: name of the split; None = as the data source has it, for WOMD training, validation or testing by the name
            of the file or its folder, else "unknown".
        on_error: "skip" leaves bad files and records out and reports them, "stop" raises at the first.
        jobs: processes that work at the same time; None = one per usable core.
        runner: does the work in place of such processes, see `rlftsim.jobs.runner`.
        license_note: license of the data, for the manifest; None = that of the data source.
        options: of the data source, such as {"window": "first"} for "av2": arguments of its class.
        show_progress: False shows no progress bar on stderr.

    Raises:
        DataError: nothing to read, nothing readable in it, a destination with something else in it, or one that cannot
            be written to; under "stop" also the first bad file or record.
        SetAside: units that killed their process again and again; all others are converted.
        Unfinished: `runner` is a share, which is done, while others are not.
        ConfigError: an unknown data source or option of it, fewer than one process, a split without a name, or shares
            with other options.
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
        place = unit.name if unit.name.startswith(f"{label}/") else f"{label}/{unit.name}"
        tasks.append(_Task(unit, f"{SHARDS}/{place}.arrow", label, folder, on_error))
    repeated = [shard for shard, count in Counter(task.shard for task in tasks).items() if count > 1]
    if repeated:
        raise DataError(f"{source}: its data source has two units of one name for {repeated[0]}: names must differ.")

    # 3. Make the shards that earlier runs have not finished, then index and manifest.
    runner = runner or choose_runner(jobs or usable_cores(), len(tasks), on_death=on_error)
    own = runner.select(tasks)
    names = {task.shard for task in own}
    others = [task for task in tasks if task.shard not in names]
    _refuse_other_settings(others, _known_shards(folder), data_source)
    # The folder is marked as unfinished until the mark is removed.
    with Lease(folder / INCOMPLETE, runner, "is converting to", _INCOMPLETE_TEXT) as lease:
        if lease.is_alone:
            remove_temporaries_below(folder)
        known = _known_shards(folder)
        own = [replace(task, known=known.get(task.shard)) for task in own]
        total = sum(task.unit.size for task in own)
        with progress_bar("converting", total, unit="bytes", show=show_progress) as advance:
            convert_one = partial(_convert_unit, source=data_source)
            outcomes = runner.run(convert_one, own, advance=advance, describe=lambda task: task.unit.name)
        lease.finish("convert")
        # Shards of other shares are taken over by size and split: each share has compared the checksums of its own.
        known = _known_shards(folder)
        _refuse_other_settings(others, known, data_source)
        made = {file: shard.entry for file, shard in known.items()}
        made |= {outcome.entry.file: outcome.entry for outcome in outcomes}
        entries = [made[task.shard] for task in tasks if task.shard in made and _is_of(made[task.shard], task)]
        check_finished(runner, len(tasks) - len(entries), len(tasks), "convert")
        remove_temporaries_below(folder)  # of processes that were killed
        earlier = _earlier_manifest(folder)
        manifest = _finish(folder, entries, data_source, license_note, lease)
        lease.remove()
    return _report(folder, entries, outcomes, manifest, earlier.duplicates if earlier else ())


def _is_of(entry: ShardEntry, task: _Task) -> bool:
    """True if a shard has the split of a task, and the size of its sources as they are now, if they are there."""
    return (entry.split, entry.source_bytes) == (task.split, task.unit.size)


def _known_shards(folder: Path) -> dict[str, _Known]:
    """Shards that earlier runs finished, by path: from the manifest and the receipts of runs that got no further."""
    earlier = _earlier_manifest(folder)
    shards = {entry.file: _Known(entry, earlier.provenance) for entry in earlier.shards} if earlier else {}
    for path in sorted((folder / SHARDS).rglob(_RECEIPTS)):
        with suppress(DataError, ConfigError, KeyError, TypeError):  # a damaged one counts for nothing
            receipt = read_json(path, "convert again")
            settings = receipt.pop("settings")
            if receipt.pop("schema_version") == SCHEMA_VERSION:
                entry = shard_entry_from_json(receipt)
                shards[entry.file] = _Known(entry, settings)
    return {file: shard for file, shard in shards.items() if (folder / file).exists()}


def _refuse_other_settings(tasks: list[_Task], known: Mapping[str, _Known], source: DataSource) -> None:
    """Refuse to put shards of other shares together with these if they were read with other settings.

    Raises:
        ConfigError: there is such a shard.
    """
    wanted = _plain(source.describe())
    for task in tasks:
        shard = known.get(task.shard)
        found = wanted if shard is None else shard.settings_of(wanted)
        if found != wanted:
            raise ConfigError(
                f"{task.folder / task.shard} was converted with other options ({_difference(found, wanted)}): give all "
                "shares the same, or another destination."
            )


def _difference(found: object, wanted: object, name: str = "") -> str:
    """Values that differ between two trees of plain settings, in words.

    Args:
        found: of a shard.
        wanted: of this command.
        name: of the setting.
    """
    if not (isinstance(found, dict) and isinstance(wanted, dict)):
        return f"{name} {json.dumps(found)} there, {json.dumps(wanted)} here"
    names = [key for key in {**wanted, **found} if found.get(key) != wanted.get(key)]
    return "; ".join(_difference(found.get(key), wanted.get(key), key) for key in names)


def _plain(settings: Mapping[str, object]) -> dict[str, object]:
    """Settings as JSON gives them back."""
    return parse_json(json.dumps(settings), "give plain values", source="settings of the source")


def _earlier_manifest(folder: Path) -> Manifest | None:
    """Manifest of the data set that is added to, if it is one and can be read."""
    try:
        return parse_manifest(folder)
    except DataError:
        return None


def _convert_unit(
    task: _Task, advance: Callable[[int], None], is_stopped: Callable[[], bool], *, source: DataSource
) -> _Outcome:
    """Make the shard of a task, or take over a finished one.

    Args:
        task: unit and shard.
        advance: called with the number of bytes dealt with.
        is_stopped: asked after each scenario.
        source: reader of the unit.

    Raises:
        DataError: under "stop", a bad file or record; always: the shard cannot be written.
        _Stopped: `is_stopped` was true.
    """
    # 1. Take over the shard of an earlier run if it is whole and made from these very files; remote ones are compared
    # by size alone, as their checksums would take as long as fetching them.
    settings = _plain(source.describe())
    known = task.known.entry if task.known is not None and task.known.settings_of(settings) == settings else None
    if task.unit.url:
        if known is not None and _is_of(known, task) and hash_file(task.folder / task.shard) == known.sha256:
            advance(task.unit.size)
            return _Outcome(known, reused=True)
        with tempfile.TemporaryDirectory() as folder:
            local = Path(folder) / Path(task.unit.url).name
            fetch(task.unit.url, local)
            unit = replace(task.unit, files=(local,), url="", url_bytes=0)
            return _convert_unit(replace(task, unit=unit, known=None), advance, is_stopped, source=source)
    size, digest = _fingerprint(task.unit.files, settings)
    if (
        known is not None
        and (known.source_bytes, known.source_sha256, known.split) == (size, digest, task.split)
        and not (known.skipped and task.on_error == "stop")
        and hash_file(task.folder / task.shard) == known.sha256
    ):
        advance(size)
        return _Outcome(known, reused=True)

    # 2. Read and write record by record, so that memory does not grow with the file.
    skipped: list[SkippedRecord] = []
    tallies: Counter[str] = Counter()
    bytes_left = size

    def count(num_bytes: int) -> None:
        nonlocal bytes_left
        bytes_left -= num_bytes
        advance(num_bytes)

    writer = ShardWriter(task.folder / task.shard)
    try:
        scenarios = read_unit(
            source,
            task.unit,
            on_error=task.on_error,
            report=skipped.append,
            advance=count,
            tally=lambda tally: tallies.update({tally.what: tally.count}),
        )
        for record, scenario in scenarios:
            writer.add(scenario, task.split, record)
            if is_stopped():
                raise _Stopped
        writer.close()
    except BaseException:
        writer.discard()
        raise
    # bytes between records, and all of them for a source that does not count
    advance(bytes_left)

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
    return _Outcome(entry, reused=False)


def _fingerprint(files: tuple[Path, ...], settings: Mapping[str, object]) -> tuple[int, str]:
    """Bytes of some files and their SHA-256; of several files or with settings, that of all checksums and these."""
    try:
        size = sum(file.stat().st_size for file in files)
        digests = [hash_file(file) for file in files]
    except OSError as error:
        raise DataError(f"{error.filename}: cannot be read: {error.strerror}") from error
    if settings:
        digests.append(json.dumps(settings, sort_keys=True))
    return size, digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


def _finish(
    folder: Path, new: list[ShardEntry], source: DataSource, license_note: str | None, lease: Lease
) -> Manifest:
    """Write index and manifest of the new shards and those that were there, and remove the receipts."""
    # shards of earlier runs that this call does not touch stay in the data set
    earlier_shards = {file: shard.entry for file, shard in _known_shards(folder).items()}
    entries = earlier_shards | {entry.file: entry for entry in new}
    if not any(entry.num_rows for entry in entries.values()):
        # leave nothing behind, as if the command had not been given
        for file in entries:
            (folder / file).unlink(missing_ok=True)
            (folder / f"{file}.json").unlink(missing_ok=True)
        lease.remove()
        for path in (*sorted((folder / SHARDS).rglob("*"), reverse=True), folder / SHARDS, folder):
            with suppress(OSError):  # a file, or a folder with one that is not ours
                path.rmdir()
        causes = [record for entry in new for record in entry.skipped]
        first = f"; first of {len(causes)} causes: {causes[0]}" if causes else ""
        raise DataError(f"not one scenario could be converted{first}")
    earlier = _earlier_manifest(folder)
    note = license_note or source.license_note
    if earlier is not None and note not in earlier.license_note:
        note = f"{earlier.license_note} {note}"  # of several sources every license applies
    elif earlier is not None:
        note = earlier.license_note
    manifest = write_index_and_manifest(
        folder,
        entries.values(),
        license_note=note,
        provenance={**(earlier.provenance if earlier else {}), **source.describe()},
    )
    # only now: until the manifest is there the receipts are the only memory of finished shards
    for receipt in (folder / SHARDS).rglob(_RECEIPTS):
        receipt.unlink()
    return manifest


def _report(
    folder: Path,
    entries: list[ShardEntry],
    outcomes: list[_Outcome],
    manifest: Manifest,
    earlier_duplicates: Sequence[SkippedRecord],
) -> ConvertReport:
    """Report on the units of this call; a data set may hold more, and of a share's call other shares made the rest."""
    all_names = names_of_shards(manifest.shards)
    names = {all_names[entry.file] for entry in entries}
    own = [record for record in manifest.duplicates if record.file in names]
    # a shard of this call that comes first in the index makes duplicates of scenarios that were there before
    known = set(earlier_duplicates)
    replaced = [record for record in manifest.duplicates if record.file not in names and record not in known]
    tallies: Counter[str] = Counter()
    for entry in entries:
        tallies.update(entry.tallies)
    return ConvertReport(
        destination=folder,
        converted=sum(entry.num_rows for entry in entries) - len(own),
        skipped=tuple(record for entry in entries for record in entry.skipped),
        duplicates=(*own, *replaced),
        shards_written=sum(not outcome.reused for outcome in outcomes),
        shards_reused=sum(outcome.reused for outcome in outcomes),
        counts=manifest.counts,
        tallies=dict(sorted(tallies.items())),
    )
