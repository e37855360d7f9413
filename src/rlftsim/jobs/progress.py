"""Progress of long work (a bar with an ETA on a terminal, occasional lines elsewhere), the package's log, and
tables."""

import logging
import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal, Protocol, runtime_checkable

from rich.console import Console
from rich.measure import Measurement
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from rlftsim.errors import printable, shorten

SECONDS_BETWEEN_LINES = 30.0
FILE_WIDTH = 200
"""Width of a table that is not printed on a terminal, in characters, unless the variable COLUMNS says another one."""


class _StandardError(logging.StreamHandler):  # type: ignore[type-arg]
    """Handler that looks up standard error at each message, because tests and notebooks replace standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        # The stream of the moment: the one at import may be closed by now.
        self.stream = sys.stderr
        super().emit(record)

    def format(self, record: logging.LogRecord) -> str:
        return _printable_lines(super().format(record))


log = logging.getLogger("rlftsim")
"""Messages of the package, printed plainly on standard error; `logging.getLogger("rlftsim")` changes that."""
if not log.handlers:
    log.addHandler(_StandardError())
    log.setLevel(logging.INFO)
    log.propagate = False


class _PlainConsole(Console):
    """Console that shows a space in place of each control character of a text: names come from users' files."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Text without control characters; lines stay lines."""
        return super().render_str(_printable_lines(text), **options)


def _printable_lines(text: str) -> str:
    """A text without control characters; lines stay lines."""
    return "\n".join(map(printable, text.split("\n")))


def print_line(text: object, file: Any = None) -> None:
    """Print a line without control characters, and without the middle of a long one: users' files hold any name.

    Args:
        text: Line, or an object that is shown by its text; a line break in it becomes a space.
        file: Stream of text; None = standard output.
    """
    print(shorten(str(text)), file=file)


def print_lines(text: str) -> None:
    """Print a text without control characters, such as a model's card; lines stay lines, and long ones stay whole.

    Args:
        text: Lines.
    """
    print(_printable_lines(text))


def print_wide(*tables: Table) -> None:
    """Print tables as wide as the terminal or as COLUMNS says, else `FILE_WIDTH` wide in files. Nothing is cut: what
    has no room goes on in the next line. Brackets in texts are not markup."""
    width = None if Console().is_terminal or "COLUMNS" in os.environ else FILE_WIDTH
    console = _PlainConsole(width=width, markup=False, emoji=False)
    for table in tables:
        table.title_justify = table.caption_justify = "left"
        for column in table.columns:
            column.overflow = "fold"
            # a label that may not be broken would be cut where it does not fit beside the numbers
            unlimited = console.options.update(max_width=10**6)
            column.no_wrap &= Measurement.get(console, unlimited, table).minimum <= console.width
        console.print(table)


@runtime_checkable
class ProgressUpdate(Protocol):
    """Callback of long work."""

    def __call__(self, count: int = 1, note: str = "") -> None:
        """Report progress.

        Args:
            count: Number of units that were finished since the last call.
            note: Text to show next to the bar.
        """
        ...


@contextmanager
def progress_bar(
    title: str, total: int, done: int = 0, *, unit: Literal["things", "bytes"] = "things", show: bool = True
) -> Iterator[ProgressUpdate]:
    """Show the progress of a piece of work; yields the function to call after each unit.

    Args:
        title: Name of the work, in front of the bar.
        total: Number of units in the whole work.
        done: Number of units that an earlier run has finished, which do not count for the estimate of time.
        unit: Unit of the numbers; bytes are shown as kB, MB or GB.
        show: False prints neither a bar nor lines.
    """
    if not (show and sys.stderr.isatty()):
        yield _lines(title, total, done, show)
        return
    # Without markup: titles hold names of files with brackets.
    amount = DownloadColumn() if unit == "bytes" else MofNCompleteColumn()
    columns = (
        TextColumn("{task.description}", markup=False), BarColumn(), amount, TimeElapsedColumn(),
        TextColumn("ETA"), TimeRemainingColumn(), TextColumn("{task.fields[note]}", markup=False),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=total, completed=done, note="")

        def advance(count: int = 1, note: str = "") -> None:
            bar.update(task, advance=count, note=note)

        yield advance


def _lines(title: str, total: int, done: int, show: bool) -> ProgressUpdate:
    """Progress without a terminal: a line every half minute and at the end."""
    start = last = time.monotonic()
    num_done = done

    def advance(count: int = 1, note: str = "") -> None:
        nonlocal num_done, last
        num_done += count
        moment = time.monotonic()
        # Work that is done may go on reporting nothing, as an archive at its last bytes does: its end is said once.
        is_last = num_done == total and (count > 0 or total == 0)
        if show and (is_last or (num_done < total and moment - last >= SECONDS_BETWEEN_LINES)):
            last = moment
            # Units of earlier runs took no time in this one, so they do not count for the estimate.
            # Before the first unit of this run there is no estimate; work of no units, such as an empty file, is done.
            eta = f" in {moment - start:.0f} s"
            if num_done < total:
                left = (moment - start) / (num_done - done) * (total - num_done) if num_done > done else math.inf
                eta = f", about {left:.0f} s to go" if math.isfinite(left) else ""
            fraction = num_done / total if total else 1.0
            print_line(f"{title}: {fraction:.0%}{eta}  {note}".rstrip(), file=sys.stderr)

    return advance
