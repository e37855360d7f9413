"""The contract of a data source: units of files, and the items of each. Sources by name: `scenario.sources`."""

import glob
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from rlftsim.errors import BadRecordError, DataError
from rlftsim.jobs.files import list_folder
from rlftsim.scenario.consistency import describe_contradictions
from rlftsim.scenario.shards import check_scenario
from rlftsim.scenario.tfrecord import OnError, SkippedRecord
from rlftsim.scenario.types import Scenario

_SPLIT = re.compile(r"training|validation|testing")
CONTRADICTORY = "scenarios whose velocities, headings or heights contradict the rest: `rlftsim data verify` names them"


@dataclass(frozen=True)
class Unit:
    """A unit of work of a source, which becomes a shard of the data set."""

    name: str
    """Name that differs between the units of a path; the shard is named after the unit."""
    files: tuple[Path, ...]
    """All files of the unit. When a file changes, the unit is converted again."""
    split: str = "unknown"
    url: str = ""
    """Address of the only file, where the file is not on this machine; then `files` is empty."""
    url_bytes: int = 0

    @property
    def size(self) -> int:
        """Bytes of the files that exist."""
        return self.url_bytes + sum(file.stat().st_size for file in self.files if file.exists())


class BytesRead(int):
    """Bytes of a unit that were read since the last report: moves the progress bar. Sources may omit these reports."""


@dataclass(frozen=True)
class Tally:
    """Number of events in a unit that the user should know; sums are in the report."""

    event: str
    count: int


Item = Scenario | SkippedRecord | BytesRead | Tally
"""Yielded by a source: a scenario, the cause why a record is skipped, progress, or a count."""


@runtime_checkable
class DataSource(Protocol):
    """Reader of files of one origin.

    An optional `detects(path) -> bool` is True for files of this origin; `convert` asks when no source is named.
    Arguments of a source's class are options of `convert`. A source is pickled when several processes convert.
    """

    license_note: str
    """License of the data, for the manifest of the data set."""

    def find(self, path: str | os.PathLike[str]) -> Sequence[Unit]:
        """Units of work at a path, in a fixed order.

        Raises:
            DataError: No unit at the path.
        """
        ...

    def read(self, unit: Unit) -> Iterator[Item]:
        """Scenarios of a unit, in the same order each time.

        A bad record is yielded as a `SkippedRecord`, so that later records can still be read. A `DataError` that is
        raised costs the rest of the unit.
        """
        ...

    def describe(self) -> Mapping[str, object]:
        """Plain JSON values for the provenance in the manifest, above all guessed values.

        A unit is converted again when the values change.
        """
        ...


def read_unit(source: DataSource, unit: Unit, *, on_error: OnError) -> Iterator[tuple[int, Item]]:
    """Read a unit; yields the items of the source with the number of each record, from 0.

    Here every scenario of every source is checked, once; one that is unsound becomes a `SkippedRecord`.

    Args:
        source: Data source that reads the unit.
        unit: Unit that the source's `find` returned.
        on_error: "stop" raises at the first bad record, "skip" yields the record as a `SkippedRecord` and goes on.

    Raises:
        BadRecordError: A bad record under "stop"; the message names file, record and cause.
        DataError: A file cannot be read.
    """
    # Errors of the code that consumes the items do not pass through here: only reading is inside the `try`.
    record = 0
    try:
        for item in source.read(unit):
            if isinstance(item, Scenario):
                try:
                    check_scenario(item)
                    if describe_contradictions(item.tracks, item.map_features, item.guessed):
                        yield record, Tally(CONTRADICTORY, 1)
                except DataError as error:
                    item = SkippedRecord(unit.name, record, str(error))
            if isinstance(item, SkippedRecord) and on_error == "stop":
                raise DataError(str(item))
            yield record, item
            record += isinstance(item, Scenario | SkippedRecord)
    except DataError as error:
        if on_error == "stop":
            raise BadRecordError(str(error)) from error
        yield record, SkippedRecord(unit.name, record, str(error))
    except OSError as error:
        raise DataError(f"{error.filename or unit.name}: cannot be read: {error.strerror or error}") from error


def list_files(path: str | os.PathLike[str]) -> set[Path]:
    """Paths at a path: a file, a folder with its subfolders, or a glob of either."""
    paths = [path] if os.path.exists(path) else glob.glob(str(path), recursive=True)
    return {match for path in map(Path, paths) for match in (list_folder(path) if path.is_dir() else [path])}


def units_of_files(files: Sequence[Path]) -> list[Unit]:
    """A unit per file, named by the path below the folder that all files share.

    Args:
        files: Paths of the files, at least 1.
    """
    root = os.path.commonpath([file.absolute().parent for file in files])
    return [Unit(file.absolute().relative_to(root).as_posix(), (file,), infer_split(file)) for file in files]


def units_of_urls(sizes: Mapping[str, int]) -> list[Unit]:
    """A unit per remote file, named as by `units_of_files`.

    Args:
        sizes: Bytes of each file by address, at least 1 file.
    """
    paths = {url: Path("/" + url.partition("://")[2].lstrip("/")) for url in sizes}
    names = units_of_files(list(paths.values()))
    return [replace(unit, files=(), url=url, url_bytes=sizes[url]) for unit, url in zip(names, paths)]


def infer_split(path: Path) -> str:
    """Split by the name of a file or else of the folder: training, validation, testing or unknown."""
    match = _SPLIT.search(path.name) or _SPLIT.search(path.absolute().parent.name)
    return match.group() if match else "unknown"
