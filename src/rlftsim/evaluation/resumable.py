"""Interruptible measurements of many scenarios: finished groups are stored in files, a later call does the others.

Evaluations and scores of rollout files are stored as `ScenarioRows` (Parquet), goal attainment, reward variances and
planners as `ScenarioValues` (JSON). Under `open_result` the groups are joined in the file of a result.
"""

import json
import math
import re
import tempfile
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import pyarrow as pa

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.results import SCHEMA, Evaluation, Provenance, Skipped
from rlftsim.jobs.buckets import validate_folder
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import check_result_file, remove_folder, remove_temporaries, write_text
from rlftsim.jobs.folder import Lease, check_folder, check_name, describe_differences, remove_locks
from rlftsim.jobs.items import GroupFormat, Result, Stored, do_group, group_positions, read_stored, run_items
from rlftsim.jobs.progress import log
from rlftsim.jobs.runner import Inline, Joining, Runner, Share, choose_runner

_GROUP_NAME = re.compile(r"\d{6,}-\d{6,}")
"""Stem of a file of `ScenarioRows`."""


class ScenarioFormat(GroupFormat[Stored, Result]):
    """Files of finished groups of scenarios in a folder, removed when the file of the result is written."""

    folder: Path
    scenario_ids: Sequence[str]
    """In the order of positions."""

    @property
    def groups(self) -> list[range]:
        """Positions of the scenarios of each file."""
        return group_positions(len(self.scenario_ids), self.items_per_file)

    @abstractmethod
    def file_names(self) -> list[str]:
        """Names of the files in the folder that groups may have written, damaged ones included."""

    @abstractmethod
    def has_other_groups(self) -> bool:
        """True if the folder holds finished groups of other scenarios or settings."""


@dataclass(frozen=True, eq=False)
class ScenarioValues(ScenarioFormat[list[Stored], Mapping[str, object]]):
    """A JSON file per scenario, `<folder>/<scenario id>.json`, also of scenarios that are measured together."""

    folder: Path
    scenario_ids: Sequence[str]
    identity: Mapping[str, Mapping[str, object]]
    """By scenario id: plain values that a file must agree with to belong to this work."""
    parse: Callable[[str, Mapping[str, Any]], Stored]
    """Reads a scenario's values; a KeyError, TypeError or ValueError means that the file is damaged."""

    def write(self, item: range, results: Sequence[Mapping[str, object]]) -> None:
        """Write the file of each scenario, see `GroupFormat`."""
        for position, values in zip(item, results):
            scenario_id = self.scenario_ids[position]
            text = json.dumps({**self.identity[scenario_id], **values})
            write_text(self.folder / f"{scenario_id}.json", f"{text}\n")

    def read(self, item: range) -> list[Stored] | None:
        """The parsed values of each scenario, see `ResultFormat`."""
        parsed = []
        for scenario_id in self.scenario_ids[item.start : item.stop]:
            check_result_file(self.folder / f"{scenario_id}.json")
            try:
                values = self._read(scenario_id)
                if not self._agrees(scenario_id, values):
                    return None
                parsed.append(self.parse(scenario_id, values))
            except (DataError, OSError, ValueError, KeyError, TypeError, AttributeError):
                return None
        return parsed

    def file_names(self) -> list[str]:
        """A name per scenario, see `ScenarioFormat`."""
        return [f"{scenario_id}.json" for scenario_id in self.scenario_ids]

    def has_other_groups(self) -> bool:
        """True if there are files of other scenarios or settings, see `ScenarioFormat`."""
        scenario_ids = {*self.scenario_ids}
        for name in (path.stem for path in self.folder.glob("*.json")):
            with suppress(DataError, FileNotFoundError):  # a damaged file holds nothing
                check_result_file(self.folder / f"{name}.json")
                if name not in scenario_ids or not self._agrees(name, self._read(name)):
                    return True
        return False

    def _agrees(self, scenario_id: str, values: Mapping[str, object]) -> bool:
        return all(values.get(name) == expected for name, expected in self.identity[scenario_id].items())

    def _read(self, scenario_id: str) -> dict[str, Any]:
        return read_json(self.folder / f"{scenario_id}.json", "measure it again", allow_nan=True)


@dataclass(frozen=True, eq=False)
class ScenarioRows(ScenarioFormat[Evaluation, Mapping[str, object] | Skipped]):
    """Rows of an evaluation: `<name>.parts/000000-000004.parquet` until all are there, then `<name>.parquet`."""

    name: str
    provenance: Provenance
    out: Path
    scenario_ids: Sequence[str]
    is_shared: bool = False
    """True refuses groups of other settings, which another share may be at; else they are replaced."""

    items_per_file: ClassVar[int] = 4

    def __post_init__(self) -> None:
        check_name(self.name, "an evaluation's name")
        if self.out.suffix == ".parquet":
            raise ConfigError(f"{self.out} is to be a folder, in which {self.name}.parquet is written: name a folder.")
        check_result_file(self.result_path)

    @property
    def result_path(self) -> Path:
        """The finished evaluation."""
        return self.out / f"{self.name}.parquet"

    @property
    def folder(self) -> Path:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Finished groups of an unfinished evaluation."""
        return self.out / f"{self.name}.parts"

    def _path(self, group: range) -> Path:
        return self.folder / f"{group.start:06d}-{group.stop:06d}.parquet"

    def write(self, item: range, results: Sequence[Mapping[str, object] | Skipped]) -> None:
        """Write rows of `SCHEMA` and scenarios without scores, see `GroupFormat`."""
        rows = [dict(result) for result in results if not isinstance(result, Skipped)]
        skipped = tuple(result for result in results if isinstance(result, Skipped))
        table = pa.Table.from_pylist(rows, schema=SCHEMA)
        Evaluation(self.name, self.provenance, table, skipped).write(self._path(item))

    def read(self, item: range) -> Evaluation | None:
        """The rows of a group, see `ResultFormat`."""
        rows = read_stored(self._path(item), Evaluation.read)
        if rows is None:
            return None
        differences = self._describe_differences(rows)
        if differences and self.is_shared:
            raise ConfigError(
                f"{self._path(item)} is of another {differences}: shares need the same options, choose another --name "
                f"or --out, or remove the folder {self.folder.name}."
            )
        if not differences and _count_scenarios(rows).total() != len(item):
            differences = "number of scenarios"
        if differences:
            log.info(f"{self._path(item)} is of another {differences}: it will be replaced.")
        return None if differences else rows

    def join(self, groups: Sequence[Evaluation]) -> Evaluation:
        """Write the evaluation of all groups, in the order of the list."""
        # the empty table: there may be no group with rows; one chunk, so that equal evaluations have equal tables
        table = pa.concat_tables([SCHEMA.empty_table(), *(group.table for group in groups)]).combine_chunks()
        skipped = tuple(scenario for group in groups for scenario in group.skipped)
        evaluation = Evaluation(self.name, self.provenance, table, skipped)
        evaluation.write(self.result_path)
        return evaluation

    def read_finished(self) -> Evaluation | None:
        """The result of an earlier call for the same scenarios; None without such a result.

        Raises:
            ConfigError: A result of other work, or with scenarios that a limit would leave out.
            DataError: Another file of this name.
        """
        stored = read_finished(self.result_path, Evaluation.read)
        if stored is None:
            return None
        # Before anything else: also a result of another policy or setting is worth more than a quick look.
        counts, limit = _count_scenarios(stored), self.provenance.config.limit
        if limit is not None:
            way_out = "name this one apart with --name, or leave the limit out."
            num_left_out = (counts - Counter(self.scenario_ids)).total()
            check_scenarios_stay(self.result_path, counts.total(), num_left_out, f"limit={limit}", way_out)
        differences = stored.provenance.differences(self.provenance)
        if differences == ["rlftsim_version"]:
            log.info(f"{self.result_path} is of another version's numbers: it will be replaced.")
            return None
        check_same_work(self.result_path, self._describe_differences(stored), "choose another --name or --out")
        # counted: a scenario may have several sets of rollouts in files, and one by a policy
        return stored if counts == Counter(self.scenario_ids) else None

    def _describe_differences(self, stored: Evaluation) -> str:
        values, current = stored.provenance.what_counts(), self.provenance.what_counts()
        names = stored.provenance.differences(self.provenance)
        return describe_differences({name: values.get(name) for name in names}, current)

    def file_names(self) -> list[str]:
        """Names of groups of any size, see `ScenarioFormat`."""
        return [path.name for path in self.folder.glob("*.parquet") if _GROUP_NAME.fullmatch(path.stem)]

    def has_other_groups(self) -> bool:
        """True if a group has other scenarios or settings, see `ScenarioFormat`."""
        scenario_ids = {*self.scenario_ids}
        stored = (read_stored(path, Evaluation.read) for path in self.folder.glob("*.parquet"))
        return any(
            rows is not None
            and bool(rows.provenance.differences(self.provenance) or _count_scenarios(rows).keys() - scenario_ids)
            for rows in stored
        )


def _count_scenarios(evaluation: Evaluation) -> Counter[str]:
    """Number of rows of each scenario of an evaluation, scenarios without scores included."""
    return Counter([*evaluation.scenario_ids, *(skipped.scenario_id for skipped in evaluation.skipped)])


def measure_scenarios(
    title: str,
    work: Callable[[int], Mapping[str, object]],
    format: ScenarioValues[Stored],
    *,
    runner: Runner,
    note: Callable[[], str] = str,
) -> list[Stored]:
    """Values of all scenarios, whose files stay in the folder: measured now, or read from there.

    Args:
        title: Name of the work, in front of the progress bar.
        work: Function from the position of a scenario to the values that are stored.
        format: Files of the scenarios.
        runner: Runner of the scenarios that are missing; changes no result.
        note: Maker of the text beside the progress, see `run_items`.

    Raises:
        NotYetError: A second process at work in the folder.
        SetAside, Unfinished: See `run_items`.
    """
    with Lease(format.folder / ".lock", runner, "works in") as lease:
        task = partial(do_group, work, format)
        groups = run_items(title, format.groups, task, format=format, lease=lease, note=note)
        remove_temporaries(format.folder / name for name in format.file_names())
        lease.remove()
    return [stored for group in groups for stored in group]


FinishedResult = TypeVar("FinishedResult")


@contextmanager
def open_result(
    path: Path, format: ScenarioFormat[Any, Any], find: Callable[[], FinishedResult | None], runner: Runner
) -> Iterator[FinishedResult | Lease]:
    """Yields the result that an earlier call has finished, or else the lock under which a new one is made and written.

    Args:
        path: File of the result.
        format: Files of finished groups, removed in the end. All stay if a longer run is unfinished in the folder: with
            further groups, or with lock files of shares while `runner` is no share.
        find: Reader of the finished result; returns None for a missing result.
        runner: Runner of the groups that are missing; changes no result.

    Raises:
        DataError: A second driver at work on this result.
    """
    check_folder(path.parent, "results")
    stamp, stored = _stamp(path), find()
    if stored is not None:
        if format.folder.exists():
            with suppress(DataError), Lease(format.folder / ".lock", Inline(), "works in"):
                _remove_groups(format, runner)
        yield stored
        return
    with Lease(format.folder / ".lock", runner, "works in") as lease:
        remove_temporaries([path])  # of a process that was killed
        # another driver may have finished since, so what would be replaced is looked at again
        stored = find() if _stamp(path) != stamp else None
        yield lease if stored is None else stored
        # Only now: an interruption between the two leaves the groups, and the next call finds the result.
        if path.exists():
            _remove_groups(format, runner)


@contextmanager
def open_evaluation(
    name: str,
    provenance: Provenance,
    out: str | PathLike[str] | None,
    scenario_ids: Sequence[str],
    *,
    runner: Runner | None,
    jobs: int,
) -> Iterator[tuple[ScenarioRows, Evaluation | Lease]]:
    """Yields the files of `out/<name>.parquet`, and the finished evaluation or the lock under which they are joined.

    Args:
        name: Name of the evaluation and of the file.
        provenance: Values that a stored result must agree with, else the call ends with an error.
        out: Folder of the result; None stores no file.
        scenario_ids: Ids of all scenarios of the evaluation, in the order of the rows.
        runner: Runner of the groups that are missing; changes no result. None = as many processes as `jobs`.
        jobs: Number of processes that share the work.

    Raises:
        ConfigError: A name that no file can have, a stored result of other work, a limit that would leave out stored
            scenarios, shares of other settings, or shares without a folder to meet in.
        DataError: A second driver at work on this evaluation.
    """
    runner = runner or choose_runner(jobs, math.ceil(len(scenario_ids) / ScenarioRows.items_per_file))
    if out is None and isinstance(runner, Share | Joining):
        raise ConfigError("shares meet in a folder: name one with --out.")
    # Processes hand their rows over in files, so even a result that is not kept needs a folder.
    with tempfile.TemporaryDirectory() as temporary_folder:
        folder = validate_folder(temporary_folder if out is None else out)
        is_shared = isinstance(runner, Share | Joining)
        rows = ScenarioRows(name, provenance, folder, scenario_ids, is_shared)
        with open_result(rows.result_path, rows, rows.read_finished, runner) as opened:
            # What cannot be joined is refused before hours of work. The first stored group tells, as each share that
            # wrote one was refused beside groups of others; to read thousands takes minutes.
            if is_shared and isinstance(opened, Lease):
                any(rows.read(group) is not None for group in rows.groups)
            yield rows, opened


def _remove_groups(format: ScenarioFormat[Any, Any], runner: Runner) -> None:
    """Remove the groups of a finished result, but not the groups of an unfinished longer run.

    A share that has ended leaves a lock file until all shares are joined: the groups may be of a longer run, too.
    """
    is_share = isinstance(runner, Share | Joining)
    has_shares = any(format.folder.glob(".lock.*-of-*")) and not is_share
    if not has_shares and not format.has_other_groups():
        remove_locks(format.folder / ".lock")
        remove_folder(format.folder, format.file_names())


def _stamp(path: Path) -> tuple[int, int] | None:
    """Time and size of a file, which change with a replacement; None for a missing file."""
    with suppress(OSError):
        status = path.stat()
        return status.st_mtime_ns, status.st_size
    return None


def check_same_work(path: Path, differences: str, way_out: str) -> None:
    """Check that a stored result is not of other work, which the new result would replace.

    Args:
        path: File of the stored result.
        differences: Values that count and differ, see `describe_differences`; empty without any.
        way_out: Flags that keep the two apart, for the message.

    Raises:
        ConfigError: Any difference.
    """
    if differences:
        raise ConfigError(f"{path} is the result of another {differences}: {way_out}, or remove the file.")


def check_scenarios_stay(path: Path, num_stored: int, num_left_out: int, choice: str, way_out: str) -> None:
    """Check that a quick look with fewer scenarios does not replace a result.

    Args:
        path: File of the stored result.
        num_stored: Number of scenarios in the stored result.
        num_left_out: Number of stored scenarios that the new result would not have.
        choice: Setting that leaves scenarios out, in the words of the message.
        way_out: End of the message.

    Raises:
        ConfigError: A stored scenario that would be left out.
    """
    if num_left_out > 0:
        raise ConfigError(
            f"{path} holds {num_stored} scenarios, and {choice} would replace them without {num_left_out} of these: "
            f"{way_out}"
        )


def read_finished(path: Path, read: Callable[[Path], FinishedResult]) -> FinishedResult | None:
    """The result in a file; None for a missing file.

    Args:
        path: File that a new result would replace.
        read: Reader of the file; raises a DataError that ends in a way out.

    Raises:
        DataError: A file that is no such result, or damaged, and that may be a user's, so it stays; or no file.
    """
    check_result_file(path)
    try:
        return read(path) if path.exists() else None
    except DataError as error:
        cause = str(error).removeprefix(f"{path}: ").rpartition(": ")[0]
        raise DataError(f"{path} is in the way ({cause}): choose another --out, or remove the file.") from None
