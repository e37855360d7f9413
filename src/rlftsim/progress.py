"""What a person sees of long work: a bar with an ETA on a terminal, a line now and then elsewhere; and tables at its end."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

SECONDS_BETWEEN_LINES = 30.0
FILE_WIDTH = 200
"""Columns of a table that is not printed on a terminal."""


def print_wide(*tables: object) -> None:
    """Print tables; in a file or a pipe they are as wide as they need to be."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=FILE_WIDTH)
    for table in tables:
        console.print(table)


@runtime_checkable
class Advance(Protocol):
    """Told after every unit of work."""

    def __call__(self, note: str = "") -> None:
        """One unit is done; `note` is shown beside the bar."""
        ...


@contextmanager
def progress_bar(title: str, total: int, done: int = 0) -> Iterator[Advance]:
    """Show how far a piece of work is; yields the function to call after each unit."""
    if not sys.stderr.isatty():
        yield _lines(title, total, done)
        return
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("ETA"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=total, completed=done, note="")

        def advance(note: str = "") -> None:
            bar.update(task, advance=1, note=note)

        yield advance


def _lines(title: str, total: int, done: int) -> Advance:
    start, first = time.monotonic(), done
    last = start
    count = done

    def advance(note: str = "") -> None:
        nonlocal count, last
        count += 1
        now = time.monotonic()
        if now - last >= SECONDS_BETWEEN_LINES or count == total:
            last = now
            left = (now - start) / (count - first) * (total - count)
            eta = f", about {left:.0f} s to go" if count < total else f" in {now - start:.0f} s"
            print(f"{title}: {count}/{total}{eta}  {note}", file=sys.stderr, flush=True)

    return advance
