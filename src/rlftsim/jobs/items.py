"""Lists of independent items with results in files: only items that an earlier call left undone are done now.

An item may be done anywhere, and more than once: the same item always writes the same file, whole or not at all.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, TypeVar

from rlftsim.errors import DataError
from rlftsim.jobs.files import check_result_file
from rlftsim.jobs.folder import Lease
from rlftsim.jobs.processes import Advance, Task
from rlftsim.jobs.progress import log, progress_bar
from rlftsim.jobs.runner import check_finished, select_items
from rlftsim.jobs.threads import one_thread

Item = TypeVar("Item")
Result = TypeVar("Result")
"""Result of an item, as the work on the item returns it."""
Stored = TypeVar("Stored")
"""Contents of a file, as they are read back."""


class Stopped(Exception):
    """The work is being stopped, after an error or Ctrl-C: the item at work is given up and leaves no file."""


class ResultFormat(ABC, Generic[Item, Stored]):
    """Files that hold the results of items, a file each."""

    @abstractmethod
    def read(self, item: Item) -> Stored | None:
        """Stored result of an item; None for a missing or damaged file, or a file of other work."""

    def is_finished(self, item: Item) -> bool:
        """True if an item need not be done (again)."""
        return self.read(item) is not None

    def count_units(self, item: Item) -> int:
        """Units of progress that an item stands for."""
        return 1

    def describe(self, item: Item) -> str:
        """Name of an item in messages and in the log of finished items."""
        return str(item)


def read_stored(path: Path, read: Callable[[Path], Stored]) -> Stored | None:
    """Contents of a file that holds a result; None for a missing file, or for a damaged file, which a message names.

    Args:
        path: File of the result, which may be missing.
        read: Reader of the file; raises a DataError for a damaged file.

    Raises:
        DataError: No file but a folder, a pipe or a device.
    """
    check_result_file(path)
    if not path.exists():
        return None
    try:
        return read(path)
    except DataError as error:
        log.warning(f"{path} has to be made again: {str(error).removeprefix(str(path)).lstrip(': ')}")
        return None


@dataclass(frozen=True, eq=False)
class WholeFiles(ResultFormat[Item, Path]):
    """A file for each item; the whole file is the result."""

    folder: Path
    name: Callable[[Item], str]
    """Name of an item's file, also in messages."""
    contents: Callable[[Path], object]
    """Reader of a file; raises a DataError for a damaged one."""
    units: Callable[[Item], int] | None = None
    """Units of progress that an item stands for; None = each item for a single unit."""
    _whole: set[Path] = field(default_factory=set, init=False)
    """Files that were read once, which is enough."""

    def read(self, item: Item) -> Path | None:
        """The file of an item, see `ResultFormat`."""
        path = self.folder / self.name(item)
        if path not in self._whole and read_stored(path, self.contents) is not None:
            self._whole.add(path)
        return path if path in self._whole else None

    def count_units(self, item: Item) -> int:
        """Value of `units`, see `ResultFormat`."""
        return self.units(item) if self.units else 1

    def describe(self, item: Item) -> str:
        """Name of the file, see `ResultFormat`."""
        return self.name(item)


class GroupFormat(ResultFormat[range, Stored], Generic[Stored, Result]):
    """Files with the results of several scenarios each. Handed to other processes, so a format can be pickled."""

    items_per_file: ClassVar[int] = 1
    """Scenarios in a file: for each process, what an interruption loses at most."""

    @abstractmethod
    def write(self, item: range, results: Sequence[Result]) -> None:
        """Write the file of a group, whole or not at all.

        Args:
            item: Positions of the scenarios of the group.
            results: Results of these scenarios, in the same order.
        """

    def count_units(self, item: range) -> int:
        """Number of scenarios, see `ResultFormat`."""
        return len(item)

    def describe(self, item: range) -> str:
        """First and last position, see `ResultFormat`."""
        return f"scenarios {item.start} to {item.stop - 1}"


def group_positions(num_items: int, items_per_file: int) -> list[range]:
    """Positions from 0 to a number in groups for a file each, the last of which may be smaller."""
    positions = range(num_items)
    return [positions[start : start + items_per_file] for start in range(0, num_items, items_per_file)]


def iterate_positions(group: range, advance: Advance, is_stopped: Callable[[], bool]) -> Iterator[int]:
    """Positions of a group in turn, each reported as done when the next is asked for.

    Args:
        group: Positions of the scenarios of a group.
        advance: Callback for the progress.
        is_stopped: True once the work is being stopped; asked before each position.

    Raises:
        Stopped: `is_stopped` was true.
    """
    for position in group:
        if is_stopped():
            raise Stopped
        yield position
        advance(1)


def do_group(
    work: Callable[[int], Result],
    format: GroupFormat[Any, Result],
    group: range,
    advance: Advance,
    is_stopped: Callable[[], bool],
) -> None:
    """Do the scenarios of a group in turn and write the file of the group: a `Task` with the first two bound.

    Args:
        work: Function from the position of a scenario to the result; must be picklable for other processes.
        format: Files of the groups.
        group: Positions of the scenarios of the group.
        advance: Callback for the progress.
        is_stopped: True once the work is being stopped.

    Raises:
        Stopped: `is_stopped` was true.
    """
    format.write(group, [work(position) for position in iterate_positions(group, advance, is_stopped)])


def run_items(
    title: str,
    items: Sequence[Item],
    task: Task,
    *,
    format: ResultFormat[Item, Stored],
    lease: Lease,
    unit: Literal["things", "bytes"] = "things",
    note: Callable[[], str] = str,
    show_progress: bool = True,
) -> list[Stored]:
    """Results of all items, in the items' order, once all are done; the lease is then this process's alone.

    Args:
        title: Name of the work, in front of the progress bar and at the beginning of messages.
        items: Items over all shares, finished items included.
        task: Work on an item, which writes the file; the returned value is the result, and None reads the file back.
        format: Files of the results, in a folder that all processes see.
        lease: Lock on that folder, which the shares of a run hold together, with the runner of the items.
        unit: Unit of the numbers beside the progress bar.
        note: Maker of the text beside the progress, called after each step; the default makes an empty text.
        show_progress: False prints neither progress nor the time left.

    Raises:
        SetAside: Items that ended a process again and again; all other items are done.
        Unfinished: The runner is a share, which is done, while other shares are not.
        NotYetError: Results are missing that other processes should have made, or that vanished meanwhile.
    """
    selected = select_items(lease.runner, range(len(items)))
    pending = [number for number in selected if not format.is_finished(items[number])]
    total, num_pending = (sum(format.count_units(items[n]) for n in numbers) for numbers in (selected, pending))
    with progress_bar(title, total, total - num_pending, unit=unit, show=show_progress) as advance, one_thread():
        made = lease.runner.run(
            task, [items[n] for n in pending], advance=lambda n: advance(n, note()), describe=format.describe
        )
    lease.finish(title)
    # Read back even what was just written: a resumed and an uninterrupted call go the same way from here.
    results = {number: result for number, result in zip(pending, made) if result is not None}
    stored = [results[number] if number in results else format.read(item) for number, item in enumerate(items)]
    check_finished(lease.runner, sum(result is None for result in stored), len(items), title)
    return [result for result in stored if result is not None]
