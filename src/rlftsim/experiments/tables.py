"""Tables and figures of an experiment's rows.

tables.build_table("Ours", rows.values(), SCORES)     a table, mean ± standard error
tables.to_numbers(rows.values(), SCORES)              the same for machines
tables.draw_gains(base, [tuned, imitated])            paired differences with intervals
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from rlftsim.evaluation.columns import Column
from rlftsim.evaluation.compare import compare
from rlftsim.experiments.rows import RMM, Row
from rlftsim.viewer.figure import Band, Interval, draw_intervals


@dataclass(frozen=True)
class TextTable:
    """A table of formatted cells; the first column names the rows."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """The table in Markdown, without title and note."""
        # Names to the left, numbers to the right.
        dashes = ["---", *["--:"] * (len(self.headings) - 1)]
        return "\n".join("| " + " | ".join(cells) + " |" for cells in (self.headings, dashes, *self.rows))

    @property
    def paragraphs(self) -> list[str]:
        """Title, table and note as paragraphs of a Markdown page."""
        return [f"## {self.title}", self.markdown(), *([self.note] if self.note else [])]

    def for_terminal(self) -> Table:
        """The table for `print_wide`."""
        table = Table(title=self.title, caption=self.note or None, title_justify="left", caption_justify="left")
        for i, heading in enumerate(self.headings):
            table.add_column(heading, justify="right" if i else "left", no_wrap=not i)
        for cells in self.rows:
            table.add_row(*cells)
        return table


def build_table(title: str, rows: Iterable[Row], columns: Sequence[Column]) -> TextTable:
    """Table of scores: mean ± standard error over scenarios, of each scenario's mean over the seeds.

    Args:
        title: Title above the table.
        rows: Rows that were evaluated on the same scenarios in the same way; the facts of the note are the first row's.
        columns: Scores to show, such as `evaluation.columns.SCORES`.
    """
    rows = list(rows)
    first, seeds = rows[0].mean, max(len(row.by_seed) for row in rows)
    over_seeds = f", means over {seeds} seeds where a row has them" if seeds > 1 else ""
    # Seeds are averaged within each scenario first: the error is over scenarios, and more seeds do not shrink it.
    cells = [(row.name, *(c.cell(row.mean.mean_and_error(c.source)) for c in columns)) for row in rows]
    note = (
        f"{len(first)} held-out scenarios, {first.config.num_rollouts} rollouts each, metric {first.config.metric}; "
        f"mean ± standard error over scenarios{over_seeds}. {first.data_note}"
    ).rstrip()
    return TextTable(title, ("", *(c.label for c in columns)), tuple(cells), note)


def to_numbers(rows: Iterable[Row], columns: Sequence[Column]) -> dict[str, Any]:
    """Means with standard errors and 95 % intervals, and the mean of every seed, by row and column.

    Args:
        rows: Rows that were evaluated on the same scenarios.
        columns: Scores to list; keys are the column names of evaluations ("meta_metric").
    """
    return {
        row.name: {
            column.source: {
                **asdict(row.mean.mean_and_error(column.source)),
                "by_seed": [evaluation.mean_and_error(column.source).mean for evaluation in row.by_seed],
            }
            for column in columns
        }
        for row in rows
    }


def draw_gains(base: Row, rows: Iterable[Row]) -> Figure:
    """Figure of paired differences in RMM with 95 % intervals.

    Args:
        base: Row to compare with, such as the base model.
        rows: Rows to draw, from top to bottom; the first is highlighted.
    """
    intervals = []
    for number, row in enumerate(rows):
        gain = compare(base.mean, row.mean)[RMM]
        # Color 0 is highlighted, 4 is gray.
        intervals.append(Interval(row.name, gain.difference, *gain.interval, color=4 if number else 0))
    label = "gain in RMM over the base model, 95 % interval"
    return draw_intervals(intervals, title="Against the base model", x_label=label, zero=True)


def build_gain_band(
    name: str, start: Row, points: Sequence[tuple[float, Row]], *, level: float = 0.0, color: int = 0
) -> Band:
    """Curve of paired gains in RMM with 95 % intervals, from no gain at x = 0 on.

    Args:
        name: Name of the curve in the legend.
        start: Row that the gains are measured from. Scenarios being harder or easier in all rows is not in the band.
        points: Position on the horizontal axis (above 0) and row of each further point, from left to right.
        level: Height of the start on the vertical axis; 0 draws plain gains.
        color: Index into `viewer.figure.COLORS`.
    """
    gains = [compare(start.mean, row.mean)[RMM] for _, row in points]
    middle = level + np.array([0.0, *(gain.difference for gain in gains)])  # [1 + points]
    limits = level + np.array([(0.0, 0.0), *(gain.interval for gain in gains)])  # [1 + points, 2]
    return Band(name, np.array([0.0, *(x for x, _ in points)]), middle, limits[:, 0], limits[:, 1], color=color)
