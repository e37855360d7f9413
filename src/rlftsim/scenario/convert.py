"""Tfrecord files to a data set: one shard per file, in parallel, resumable.

A shard that is done has a receipt beside it, written after it, that says what it was made from. A later run takes over
a shard whose receipt, source and checksum agree and makes the others anew, so it does not matter when a run was
interrupted or how.
"""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rlftsim.errors import ConfigError, DataError
from rlftsim.progress import progress_bar
from rlftsim.scenario.dataset import (
    INCOMPLETE,
    MANIFEST,
    SHARDS,
    Manifest,
    ShardEntry,
    parse_manifest,
    read_manifest,
    shard_entry_from_json,
    write_index_and_manifest,
    write_json,
)
from rlftsim.scenario.shards import SCHEMA_VERSION, ShardWriter, hash_file
from rlftsim.scenario.tfrecord import RECORD_OVERHEAD_BYTES, OnError, SkippedRecord, read_records
from rlftsim.scenario.womd import find_tfrecords, scenario_or_report
from rlftsim.workers import run_tasks, usable_cores

WOMD_LICENCE_NOTE = (
    "Waymo Open Dataset material: Waymo Dataset License Agreement for Non-Commercial Use (waymo.com/open/terms). "
    "This work was made using the Waymo Open Dataset, provided by Waymo LLC."
)
_SPLIT = re.compile(r"training|validation|testing")
_INCOMPLETE_TEXT = "A conversion runs here or was interrupted: run the same command again, it goes on.\n"


@dataclass(frozen=True)
class ConvertReport:
    """What a conversion did."""

    destination: Path
    converted: int
    """Scenarios of these sources that are in the data set now, those of an earlier run included."""
    skipped: tuple[SkippedRecord, ...]
    """Files and records of these sources that could not be used."""
    duplicates: tuple[SkippedRecord, ...]
    """Records left out because an earlier one has the same scenario id."""
    shards_written: int
    shards_reused: int
    counts: Mapping[str, int]
    """Scenarios of the whole data set by split."""


@dataclass(frozen=True)
class _Task:
    """One source file to one shard."""

    source: Path
    name: str
    """Path of the source below the common folder of all sources."""
    shard: str
    """Path of the shard inside the data set."""
    split: str
    folder: Path
    on_error: OnError
    known: ShardEntry | None


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
    split: str | None = None,
    on_error: OnError = "skip",
    jobs: int | None = None,
    licence_note: str = WOMD_LICENCE_NOTE,
    show_progress: bool = True,
) -> ConvertReport:
    """Convert WOMD tfrecord files to a data set that needs them no more.

    Interrupted in any way, the same call goes on where it was. A data set may be added to by converting other files to
    it; a source that changed is converted again. The same sources give the same bytes.

    Args:
        source: tfrecord file, folder or glob, as in `find_tfrecords`.
        destination: folder of the data set: new, empty, or a data set or unfinished conversion of ours.
        split: name of the split; None = training, validation or testing by the name of the file or its folder, else
            "unknown".
        on_error: "skip" leaves bad files and records out and reports them, "stop" raises at the first.
        jobs: processes that work at the same time; None = one per usable core.
        licence_note: what the manifest of a new data set says about the licence.
        show_progress: whether to draw a progress bar with the time left on stderr.

    Raises:
        DataError: nothing to read, nothing readable in it, or a destination with something else in it; under "stop"
            also the first bad file or record.
        ConfigError: fewer than one process, or a split without a name.
    """
    if jobs is not None and jobs < 1:
        raise ConfigError(f"jobs must be at least 1, got {jobs}: leave it out for one per core.")
    if split is not None and not split.strip():
        raise ConfigError("the split has no name: leave it out to read it off the folder or file.")
    folder = Path(destination)
    _check_destination(folder)
    tasks = _plan(find_tfrecords(source), folder, split, on_error)
    with _claim(folder):
        tasks = _prepare(folder, tasks)
        outcomes = _run(tasks, jobs or usable_cores(), show_progress)
        manifest = _finish(folder, [outcome.entry for outcome in outcomes], licence_note)
    return _report(folder, outcomes, manifest)


def infer_split(path: Path) -> str:
    """Split that a file's name or else its folder's name tells: training, validation, testing or unknown."""
    for name in (path.name, path.absolute().parent.name):
        match = _SPLIT.search(name)
        if match:
            return match.group()
    return "unknown"


def _check_destination(folder: Path) -> None:
    if not folder.exists() or (folder / INCOMPLETE).exists():
        return
    if not folder.is_dir():
        raise DataError(f"{folder} is a file, not a folder: choose another destination")
    if (folder / MANIFEST).exists():
        read_manifest(folder)
    elif any(folder.iterdir()):
        raise DataError(f"{folder} is not empty and not a data set: choose another destination")


def _plan(sources: list[Path], folder: Path, split: str | None, on_error: OnError) -> list[_Task]:
    common = os.path.commonpath([source.absolute().parent for source in sources])
    tasks = []
    for source in sources:
        name = source.absolute().relative_to(common).as_posix()
        label = split or infer_split(source)
        # files of two splits may have the same name: a split's shards have a folder of their own
        place = name if name.startswith(f"{label}/") else f"{label}/{name}"
        tasks.append(_Task(source, name, f"{SHARDS}/{place}.arrow", label, folder, on_error, None))
    return tasks


@contextmanager
def _claim(folder: Path) -> Iterator[None]:
    """Mark the folder as unfinished for the time of the block, and after it if it fails. One process at a time.

    Raises:
        DataError: another process converts to this folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / INCOMPLETE, "w", encoding="utf-8") as marker:
        _lock(marker.fileno(), folder)
        marker.write(_INCOMPLETE_TEXT)
        marker.flush()
        yield
        (folder / INCOMPLETE).unlink()


def _lock(descriptor: int, folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # no such locks on this platform: then nobody may convert twice at the same time
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise DataError(
            f"another process is converting to {folder}: wait for it or choose another destination"
        ) from error


def _prepare(folder: Path, tasks: list[_Task]) -> list[_Task]:
    """Remove what an interrupted run left half-written and tell each task what is known of its shard."""
    for leftover in folder.rglob("*.tmp"):
        leftover.unlink()
    known = _known_entries(folder)
    return [replace(task, known=known.get(task.shard)) for task in tasks]


def _known_entries(folder: Path) -> dict[str, ShardEntry]:
    """Shards that earlier runs finished, by path: from the manifest and the receipts of runs that got no further."""
    earlier = _earlier_manifest(folder)
    entries = {entry.file: entry for entry in earlier.shards} if earlier else {}
    for path in sorted((folder / SHARDS).rglob("*.arrow.json")):
        receipt = json.loads(path.read_text(encoding="utf-8"))
        if receipt.pop("schema_version") == SCHEMA_VERSION:
            entry = shard_entry_from_json(receipt)
            entries[entry.file] = entry
    return {file: entry for file, entry in entries.items() if (folder / file).exists()}


def _earlier_manifest(folder: Path) -> Manifest | None:
    """Manifest of the data set that is added to, if it is one and can be read."""
    try:
        return parse_manifest(folder)
    except DataError:
        return None


def _receipt_path(folder: Path, shard: str) -> Path:
    return folder / f"{shard}.json"


def _convert_file(task: _Task, advance: Callable[[int], None], is_stopped: Callable[[], bool]) -> _Outcome:
    """Make the shard of a task, or take over a finished one.

    Args:
        task: what to convert.
        advance: called with the number of bytes dealt with.
        is_stopped: asked after each record.

    Raises:
        DataError: under "stop", a bad file or record; always: the shard cannot be written.
        _Stopped: as asked for.
    """
    size, digest = task.source.stat().st_size, hash_file(task.source)
    finished = _finished_entry(task, size, digest)
    if finished is not None:
        advance(size)
        return _Outcome(finished, reused=True)
    skipped: list[SkippedRecord] = []
    try:
        num_rows = _write_shard(task, skipped, advance, is_stopped)
    except OSError as error:
        raise DataError(f"cannot write {task.folder / task.shard}: {error.strerror or error}") from error
    entry = ShardEntry(
        file=task.shard,
        sha256=hash_file(task.folder / task.shard),
        num_rows=num_rows,
        split=task.split,
        source=task.name,
        source_bytes=size,
        source_sha256=digest,
        skipped=tuple(replace(record, file=task.name) for record in skipped),
    )
    write_json(_receipt_path(task.folder, task.shard), {**asdict(entry), "schema_version": SCHEMA_VERSION})
    return _Outcome(entry, reused=False)


def _finished_entry(task: _Task, size: int, digest: str) -> ShardEntry | None:
    """Entry of the task's shard if it is there, whole, and made from this very source."""
    entry = task.known
    if entry is None or (entry.source_bytes, entry.source_sha256, entry.split) != (size, digest, task.split):
        return None
    if entry.skipped and task.on_error == "stop":
        return None
    return entry if hash_file(task.folder / task.shard) == entry.sha256 else None


def _write_shard(
    task: _Task, skipped: list[SkippedRecord], advance: Callable[[int], None], is_stopped: Callable[[], bool]
) -> int:
    """Convert record by record; returns the number of scenarios written."""
    writer = ShardWriter(task.folder / task.shard)
    how = {"on_error": task.on_error, "report": skipped.append}
    try:
        for record, data in read_records(task.source, **how):
            scenario = scenario_or_report(task.source, record, data, **how)
            if scenario is not None:
                writer.add(scenario, task.split, record)
            advance(len(data) + RECORD_OVERHEAD_BYTES)
            if is_stopped():
                raise _Stopped
        writer.close()
    except BaseException:
        writer.discard()
        raise
    return writer.num_rows


def _run(tasks: list[_Task], jobs: int, show_progress: bool) -> list[_Outcome]:
    """Convert all files; returns their outcomes in the order of `tasks`. Stopped, files in progress are given up, finished ones stay."""
    total = sum(task.source.stat().st_size for task in tasks)
    with progress_bar("converting", total, unit="bytes", show=show_progress) as advance:
        return run_tasks(_convert_file, tasks, jobs=jobs, advance=advance)


def _finish(folder: Path, new: list[ShardEntry], licence_note: str) -> Manifest:
    """Index and manifest of the new shards and those that were there; the receipts go."""
    entries = {**_known_entries(folder), **{entry.file: entry for entry in new}}
    if not any(entry.num_rows for entry in entries.values()):
        _clear(folder)
        causes = [record for entry in new for record in entry.skipped]
        first = f"; first of {len(causes)} causes: {causes[0]}" if causes else ""
        raise DataError(f"not one scenario could be converted{first}")
    earlier = _earlier_manifest(folder)
    manifest = write_index_and_manifest(
        folder,
        entries.values(),
        licence_note=earlier.licence_note if earlier else licence_note,
        provenance=earlier.provenance if earlier else None,
    )
    for receipt in (folder / SHARDS).rglob("*.arrow.json"):
        receipt.unlink()
    return manifest


def _clear(folder: Path) -> None:
    """Leave nothing of a conversion without a single scenario."""
    shutil.rmtree(folder / SHARDS, ignore_errors=True)
    (folder / INCOMPLETE).unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


def _report(folder: Path, outcomes: list[_Outcome], manifest: Manifest) -> ConvertReport:
    entries = [outcome.entry for outcome in outcomes]
    sources = {entry.source for entry in entries}
    duplicates = tuple(record for record in manifest.duplicates if record.file in sources)
    return ConvertReport(
        destination=folder,
        converted=sum(entry.num_rows for entry in entries) - len(duplicates),
        skipped=tuple(record for entry in entries for record in entry.skipped),
        duplicates=duplicates,
        shards_written=sum(not outcome.reused for outcome in outcomes),
        shards_reused=sum(outcome.reused for outcome in outcomes),
        counts=manifest.counts,
    )
