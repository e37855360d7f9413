"""Interruptible measurements of many scenarios: finished groups are kept in files, a later call does the rest.

`map_scenarios` is the loop, shared by evaluations, scores of rollout files, goal attainment, reward variances and
planners. They differ in the work on one scenario and in their files: `EvaluationParts` (Parquet) or `JsonParts`.
"""

import json
import re
import tempfile
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import pyarrow as pa

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.results import SCHEMA, Evaluation, Provenance, Skipped, join_evaluations
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import remove_folder, remove_temporaries, write_text
from rlftsim.jobs.folder import Lease, check_folder, check_name, remove_locks
from rlftsim.jobs.progress import log, progress_bar
from rlftsim.jobs.runner import Inline, Joining, Runner, Share, check_finished
from rlftsim.jobs.threads import one_thread

Result = TypeVar("Result")
"""Result of one scenario, as the work on it returns it."""
Part = TypeVar("Part")
"""Results of a group of scenarios, as they are read back."""
Stored = TypeVar("Stored")
"""A finished result."""
_GROUP_NAME = re.compile(r"\d{6,}-\d{6,}")
"""Stem of a file of `EvaluationParts`."""


class PartFiles(ABC, Generic[Result, Part]):
    """Files of finished groups in a folder. They are handed to other processes, so they can be pickled."""

    folder: Path
    group_size: ClassVar[int]
    """Scenarios in a file: for each process, what an interruption loses at most."""

    @abstractmethod
    def write(self, group: range, results: Sequence[Result]) -> None:
        """Write a finished group, whole or not at all.

        Args:
            group: positions of its scenarios.
            results: one per scenario, in this order.
        """

    @abstractmethod
    def read(self, group: range) -> Part | None:
        """A group that an earlier call finished; None if it is missing, damaged or of other work."""

    @abstractmethod
    def file_names(self, scenario_ids: Collection[str]) -> list[str]:
        """Names of the files in the folder that groups of the scenarios may have written, damaged ones included."""

    @abstractmethod
    def has_others(self, scenario_ids: Collection[str]) -> bool:
        """True if the folder holds finished groups of scenarios beside those given, or of other settings."""


def map_scenarios(
    work: Callable[[int], Result],
    num_scenarios: int,
    files: PartFiles[Result, Part],
    *,
    runner: Runner,
    title: str,
    lease: Lease | None = None,
    show_progress: bool = True,
) -> list[Part]:
    """Do the missing groups and return all of them in order.

    Args:
        work: measures the scenario at a position; can be pickled, if there is more than one job.
        num_scenarios: positions run from 0 to this.
        files: of the finished groups.
        runner: does the work. Changes no result.
        title: beside the progress bar.
        lease: on the folder of the files, if several drivers could work in it.
        show_progress: False = no progress bar.

    Raises:
        SetAside: groups that killed their process again and again; all others are done.
        Unfinished: `runner` is a share, which is done, while others are not.
        DataError: another process removed finished files meanwhile.
    """
    groups = groups_of(num_scenarios, files.group_size)
    own = runner.select(groups)
    missing = [group for group in own if files.read(group) is None]
    total, left = (sum(len(group) for group in some) for some in (own, missing))
    with progress_bar(title, total, total - left, show=show_progress) as advance, one_thread():
        runner.run(
            partial(_work_on_group, work, files),
            missing,
            advance=advance,
            describe=lambda group: f"scenarios {group.start} to {group.stop - 1}",
        )
    if lease is not None:
        lease.finish(title)
    # Read back even what was just written: a resumed and an uninterrupted call go the same way from here.
    parts = [part for part in map(files.read, groups) if part is not None]
    check_finished(runner, len(groups) - len(parts), len(groups), title)
    return parts


def groups_of(num_scenarios: int, size: int) -> list[range]:
    """Positions of the scenarios in groups, the last of which may be smaller.

    Args:
        num_scenarios: positions run from 0 to this.
        size: scenarios in a group.
    """
    positions = range(num_scenarios)
    return [positions[first : first + size] for first in range(0, num_scenarios, size)]


def _work_on_group(
    work: Callable[[int], Any],
    files: PartFiles[Any, Any],
    group: range,
    advance: Callable[[int], None],
    is_stopped: Callable[[], bool],
) -> None:
    results = []
    for position in group:
        # another process failed, or Ctrl-C: an unfinished group leaves no file
        if is_stopped():
            return
        results.append(work(position))
        advance(1)
    files.write(group, results)


@dataclass(frozen=True, eq=False)
class JsonParts(PartFiles[Mapping[str, object], Part]):
    """A file per scenario, `<folder>/<scenario id>.json`."""

    folder: Path
    scenario_ids: Sequence[str]
    """In the order of positions."""
    identity: Mapping[str, Mapping[str, object]]
    """By scenario id: plain values that a file must agree with to belong to this work."""
    information: Mapping[str, object]
    """Written into each file and not compared."""
    parse: Callable[[str, Mapping[str, Any]], Part]
    """Reads a scenario's values; a KeyError, TypeError or ValueError means that the file is damaged."""

    group_size: ClassVar[int] = 1

    def write(self, group: range, results: Sequence[Mapping[str, object]]) -> None:
        """Write the file of a scenario, see `PartFiles`."""
        scenario_id = self.scenario_ids[group.start]
        values = {**self.identity[scenario_id], **results[0], **self.information}
        write_text(self._path(scenario_id), json.dumps(values) + "\n")

    def read(self, group: range) -> Part | None:
        """The parsed values of a scenario, see `PartFiles`."""
        scenario_id = self.scenario_ids[group.start]
        try:
            values = self._read(scenario_id)
            return self.parse(scenario_id, values) if self._is_ours(scenario_id, values) else None
        except (DataError, OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def file_names(self, scenario_ids: Collection[str]) -> list[str]:
        """A name per scenario, see `PartFiles`."""
        return [f"{scenario_id}.json" for scenario_id in scenario_ids]

    def has_others(self, scenario_ids: Collection[str]) -> bool:
        """True if there are files of other scenarios or settings, see `PartFiles`."""
        for path in self.folder.glob("*.json"):
            with suppress(DataError, FileNotFoundError):  # a damaged file holds nothing
                is_ours = path.stem in scenario_ids and self._is_ours(path.stem, self._read(path.stem))
                if not is_ours:
                    return True
        return False

    def _is_ours(self, scenario_id: str, values: Mapping[str, object]) -> bool:
        return all(values.get(name) == own for name, own in self.identity[scenario_id].items())

    def _read(self, scenario_id: str) -> dict[str, Any]:
        return read_json(self._path(scenario_id), "measure it again", allow_nan=True)

    def _path(self, scenario_id: str) -> Path:
        return self.folder / f"{scenario_id}.json"


@dataclass(frozen=True, eq=False)
class EvaluationParts(PartFiles[Mapping[str, object] | Skipped, Evaluation]):
    """Rows of an evaluation: `<name>.parts/000000-000004.parquet` until all are there, then `<name>.parquet`."""

    name: str
    provenance: Provenance
    out: Path

    group_size: ClassVar[int] = 4

    def __post_init__(self) -> None:
        check_name(self.name, "an evaluation's name")
        if self.out.suffix == ".parquet":
            raise ConfigError(f"{self.out} is to be a folder, in which {self.name}.parquet is written: name a folder.")
        if self.result_path.is_dir():
            raise ConfigError(f"{self.result_path} is a folder: pass another name for the evaluation, or remove it.")

    @property
    def result_path(self) -> Path:
        """The finished evaluation."""
        return self.out / f"{self.name}.parquet"

    @property
    def folder(self) -> Path:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Finished groups of an unfinished evaluation."""
        return self.out / f"{self.name}.parts"

    def part_path(self, group: range) -> Path:
        """File of one finished group."""
        return self.folder / f"{group.start:06d}-{group.stop:06d}.parquet"

    def write(self, group: range, results: Sequence[Mapping[str, object] | Skipped]) -> None:
        """Write rows of `SCHEMA` and scenarios without scores, see `PartFiles`."""
        rows = [dict(result) for result in results if not isinstance(result, Skipped)]
        skipped = tuple(result for result in results if isinstance(result, Skipped))
        table = pa.Table.from_pylist(rows, schema=SCHEMA)
        Evaluation(self.name, self.provenance, table, skipped).write(self.part_path(group))

    def read(self, group: range) -> Evaluation | None:
        """The rows of a group, see `PartFiles`."""
        path = self.part_path(group)
        rows = read_stored(path, Evaluation.read)
        if rows is None:
            return None
        differences = rows.provenance.differences(self.provenance)
        if _ids_of(rows).total() != len(group):
            differences.append("number of scenarios")
        if differences:
            log.info(f"{path} is of another {', '.join(differences)}: discarded.")
        return None if differences else rows

    def read_finished(self, scenario_ids: Sequence[str]) -> Evaluation | None:
        """The result of an earlier call for the same scenarios; None if there is none.

        Raises:
            ConfigError: a result is there of other work, or with scenarios that a limit would leave out.
        """
        found = read_stored(self.result_path, Evaluation.read)
        if found is None:
            return None
        # Before anything else: also a result of another policy or setting is worth more than a quick look.
        limit = self.provenance.config.limit
        if limit is not None:
            num_found = _ids_of(found).total()
            way_out = "name this one apart with --name, or leave the limit out."
            num_left_out = (_ids_of(found) - Counter(scenario_ids)).total()
            check_scenarios_stay(self.result_path, num_found, num_left_out, f"limit={limit}", way_out)
        other = found.provenance.differences(self.provenance)
        if other == ["rlftsim_version"]:
            log.info(f"{self.result_path} is of another version's numbers: it will be replaced.")
            return None
        check_same_work(self.result_path, other, "choose another --name or --out")
        # counted: a scenario may have several sets of rollouts in files, and one by a policy
        return found if _ids_of(found) == Counter(scenario_ids) else None

    def file_names(self, scenario_ids: Collection[str]) -> list[str]:
        """Names of groups of any size, see `PartFiles`."""
        return [path.name for path in self.folder.glob("*.parquet") if _GROUP_NAME.fullmatch(path.stem)]

    def has_others(self, scenario_ids: Collection[str]) -> bool:
        """True if a group has other scenarios or settings, see `PartFiles`."""
        parts = (read_stored(path, Evaluation.read) for path in self.folder.glob("*.parquet"))
        return any(
            part is not None
            and bool(part.provenance.differences(self.provenance) or _ids_of(part).keys() - {*scenario_ids})
            for part in parts
        )


def _ids_of(evaluation: Evaluation) -> Counter[str]:
    """Ids of all scenarios of an evaluation, those without scores included, and the number of rows of each."""
    return Counter([*evaluation.scenario_ids, *(skipped.scenario_id for skipped in evaluation.skipped)])


def resume_evaluation(
    work: Callable[[int], Mapping[str, object] | Skipped],
    scenario_ids: Sequence[str],
    name: str,
    provenance: Provenance,
    out: Path | None,
    *,
    runner: Runner,
    title: str,
    show_progress: bool = True,
) -> Evaluation:
    """Do what is missing of an evaluation, write `out/<name>.parquet` and return it; only read it if it is there.

    Args:
        work: from the position of a scenario to its row of `SCHEMA`, or why there is none.
        scenario_ids: all scenarios of the evaluation.
        name: of the evaluation and its file.
        provenance: what a stored result must agree with to be this one.
        out: folder of the result; None keeps nothing.
        runner: does the work.
        title: beside the progress bar.
        show_progress: False = no progress bar.

    Raises:
        ConfigError: the name cannot be a file's, the stored result is of other work, a limit would leave out scenarios
            of it, or there is no folder in which shares could meet.
        DataError: another driver is at work on this evaluation.
        SetAside, Unfinished: see `map_scenarios`.
    """
    if out is None and isinstance(runner, Share | Joining):
        raise ConfigError("shares meet in a folder: name one with --out.")
    # Processes hand their rows over in files, so even a result that is not kept needs a folder.
    with tempfile.TemporaryDirectory() as nowhere:
        files = EvaluationParts(name, provenance, out or Path(nowhere))

        def make(lease: Lease) -> Evaluation:
            parts = map_scenarios(
                work, len(scenario_ids), files, runner=runner, title=title, lease=lease, show_progress=show_progress
            )
            return join_evaluations(name, provenance, parts)

        find = partial(files.read_finished, scenario_ids)
        return finish_result(find, make, files.result_path, files, scenario_ids, runner)


@runtime_checkable
class Writable(Protocol):
    """A result that is kept in one file."""

    def write(self, path: Path) -> None:
        """Write it whole or not at all."""
        ...


Kept = TypeVar("Kept", bound=Writable)


def finish_result(
    find: Callable[[], Kept | None],
    make: Callable[[Lease], Kept],
    path: Path,
    parts: PartFiles[Any, Any],
    scenario_ids: Sequence[str],
    runner: Runner,
) -> Kept:
    """The result that an earlier call finished, or the one that is made now and written; its parts are removed.

    Args:
        find: reads the finished one; None = there is none.
        make: makes it of its parts.
        path: of its file.
        parts: finished groups of it. All of them stay where the folder holds others, or lock files of shares while
            `runner` is none: then a longer run is unfinished there.
        scenario_ids: of the result.
        runner: does the work.

    Raises:
        DataError: another driver is at work on it.
    """
    check_folder(path.parent, "results")
    before, found = _stamp(path), find()
    if found is None:
        with Lease(parts.folder / ".lock", runner, "works in") as lease:
            # another driver may have finished since, so what would be replaced is looked at again
            found = find() if _stamp(path) != before else None
            if found is None:
                found = make(lease)
                remove_temporaries(path)
                found.write(path)
            # Only now: an interruption between the two leaves the parts, and the next call finds the result.
            _remove_parts(parts, scenario_ids, runner)
    elif parts.folder.exists():
        with suppress(DataError), Lease(parts.folder / ".lock", Inline(), "works in"):
            _remove_parts(parts, scenario_ids, runner)
    return found


def _remove_parts(parts: PartFiles[Any, Any], scenario_ids: Sequence[str], runner: Runner) -> None:
    """Remove the parts of a finished result, but for those of a longer run that is not.

    A share that has ended leaves its lock file until all are put together: its parts may be of a longer run, too.
    """
    is_share = isinstance(runner, Share | Joining)
    has_shares = any(parts.folder.glob(".lock.*-of-*")) and not is_share
    if not has_shares and not parts.has_others({*scenario_ids}):
        remove_locks(parts.folder / ".lock")
        remove_folder(parts.folder, parts.file_names({*scenario_ids}))


def _stamp(path: Path) -> tuple[int, int] | None:
    """Time and size of a file, which tell whether it was replaced; None where there is none."""
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_mtime_ns, about.st_size


def check_same_work(path: Path, differing: Sequence[str], way_out: str) -> None:
    """Check that a stored result is not of other work, which the new one would replace.

    Args:
        path: File of the stored result.
        differing: Names of the values that count and differ, such as the policy's fingerprint.
        way_out: Flags that keep the two apart, for the message.

    Raises:
        ConfigError: There is such a value.
    """
    if differing:
        raise ConfigError(f"{path} is the result of another {', '.join(differing)}: {way_out}, or remove the file.")


def check_scenarios_stay(path: Path, num_stored: int, num_left_out: int, choice: str, way_out: str) -> None:
    """Refuse to replace a result by one without some of its scenarios, of a quick look.

    Args:
        path: of the stored result.
        num_stored: scenarios in it.
        num_left_out: those of them that the new result would not have.
        choice: setting that leaves them out.
        way_out: end of the message.

    Raises:
        ConfigError: there are such scenarios.
    """
    if num_left_out > 0:
        raise ConfigError(
            f"{path} holds {num_stored} scenarios, and {choice} would replace them without {num_left_out} of these: "
            f"{way_out}"
        )


def read_stored(path: Path, read: Callable[[Path], Stored]) -> Stored | None:
    """A stored result; None if there is none, or a damaged one, which a message names.

    Args:
        path: of the result.
        read: raises a DataError with the way out, which is to do the work again.
    """
    if not path.exists():
        return None
    try:
        return read(path)
    except DataError as error:
        log.info(f"{error} Doing so.")
        return None
