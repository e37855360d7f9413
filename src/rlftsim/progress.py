"""What a person sees of long work: a bar with an ETA on a terminal, a line now and then elsewhere; and tables at its end."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, Protocol, runtime_checkable

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

SECONDS_BETWEEN_LINES = 30.0
FILE_WIDTH = 200
"""Columns of a table that is not printed on a terminal."""


def print_wide(*tables: object) -> None:
    """Print tables, their texts as they are: brackets are no markup. In a file or a pipe they are as wide as they need to be."""
    width = None if Console().is_terminal else FILE_WIDTH
    console = Console(width=width, markup=False, emoji=False)
    for table in tables:
        console.print(table)


def say(line: str) -> None:
    """A line that a person should see at once, beside the bar."""
    print(line, file=sys.stderr, flush=True)


@runtime_checkable
class Advance(Protocol):
    """Told whenever work is done."""

    def __call__(self, count: int = 1, note: str = "") -> None:
        """`count` more units are done; `note` is shown beside the bar."""
        ...


@contextmanager
def progress_bar(
    title: str, total: int, done: int = 0, *, unit: Literal["things", "bytes"] = "things", show: bool = True
) -> Iterator[Advance]:
    """Show how far a piece of work is; yields the function to call after each piece.

    Args:
        title: what is being done.
        total: units in all.
        done: units an earlier run has done.
        unit: bytes are shown as kB, MB or GB.
        show: False = say nothing.
    """
    if not (show and sys.stderr.isatty()):
        yield _lines(title, total, done, show)
        return
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


def _lines(title: str, total: int, done: int, show: bool) -> Advance:
    """Where there is no terminal: a line every half minute and at the end."""
    start = last = time.monotonic()
    so_far = done

    def advance(count: int = 1, note: str = "") -> None:
        nonlocal so_far, last
        so_far += count
        now = time.monotonic()
        if show and (now - last >= SECONDS_BETWEEN_LINES or so_far == total):
            last = now
            left = (now - start) / (so_far - done) * (total - so_far)
            eta = f", about {left:.0f} s to go" if so_far < total else f" in {now - start:.0f} s"
            print(f"{title}: {so_far / total:.0%}{eta}  {note}".rstrip(), file=sys.stderr, flush=True)

    return advance
