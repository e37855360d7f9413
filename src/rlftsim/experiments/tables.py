"""Rows of an experiment, a model specification each, and their tables and figures.

build_table("Ours", rows.values(), SCORES)     a table, mean ± standard error
to_numbers(rows.values(), SCORES)              the same for machines
draw_gains(base, [tuned, imitated])            paired differences with intervals
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib import resources
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.table import Table

from rlftsim.errors import DataError
from rlftsim.evaluation.columns import Column
from rlftsim.evaluation.compare import compare
from rlftsim.evaluation.results import SCHEMA, SCORE_COLUMNS, Evaluation
from rlftsim.statistics import mean_interval
from rlftsim.viewer.figure import Band, Interval, draw_intervals

RMM = "meta_metric"


@dataclass(frozen=True, eq=False)
class Row:
    """Evaluations of a model specification on the same scenarios, in the order of the seeds."""

    name: str
    by_seed: tuple[Evaluation, ...]

    @cached_property
    def mean(self) -> Evaluation:
        """Each scenario's mean over the seeds."""
        return mean_of_seeds(self.name, self.by_seed)

    def against(self, reference: "Row", column: str = RMM, *, alpha: float = 0.05) -> str:
        """Verdict of a paired t-test in a line, such as "tuned against base, 40 scenarios in both: difference, ...".

        Args:
            reference: Row to compare with, such as the base model; the difference is this row minus the reference.
            column: Name of the score to compare, a column of `Evaluation`.
            alpha: Level of the test: the chance of a difference where there is none.
        """
        comparison = compare(reference.mean, self.mean, alpha=alpha)
        return f"{self.name} against {reference.name}, {comparison.pairing}: {comparison[column].verdict}"

    def gains_over(self, reference: "Row", column: str = RMM) -> Float[np.ndarray, "seeds"]:
        """Difference of the means to a reference row, for each seed of this row.

        Args:
            reference: Row to compare with; the reference's seeds are averaged.
            column: Name of the score to compare, a column of `Evaluation`.
        """
        level = reference.mean.mean_and_error(column).mean
        return np.array([evaluation.mean_and_error(column).mean - level for evaluation in self.by_seed])

    def seeds_against(self, reference: "Row") -> str:
        """Gain in RMM of every seed in a line, with a 95 % interval over the seeds where there are several.

        The interval does not answer the question of a paired t-test over scenarios, but tells the gain that a
        further run would have.
        """
        gains = self.gains_over(reference)
        line = f"{self.name} minus {reference.name}, RMM by seed: {', '.join(f'{gain:+.4f}' for gain in gains)}"
        if len(gains) == 1:
            return f"{line}; a single seed says nothing about others."
        # Student's t over seeds: with two or three of them the interval is wide, as it should be.
        mean = mean_interval(gains)
        low, high = mean.interval
        return f"{line}; mean {mean.mean:+.4f}, 95% interval over seeds [{low:+.4f}, {high:+.4f}]."


def mean_of_seeds(
    name: str, evaluations: Sequence[Evaluation], *, weights: Sequence[float] | None = None
) -> Evaluation:
    """Evaluation with mean scores over evaluations of the same scenarios, scenario by scenario.

    Args:
        name: Name of the mean in tables and messages.
        evaluations: Evaluations of the same scenarios, in the order of the seeds.
        weights: Weight of each evaluation in the mean, with a sum of 1; None = equal weights.

    Raises:
        DataError: The evaluations are of different scenarios.
    """
    first = evaluations[0]
    if any(evaluation.scenario_ids != first.scenario_ids for evaluation in evaluations):
        raise DataError(f"{name}: the evaluations of its seeds are of different scenarios: remove them to start anew.")
    # Ids and numbers of agents are the same for all seeds; only scores are averaged. NaN in one seed stays NaN.
    table = first.table
    for column in SCORE_COLUMNS:
        scores = [evaluation.values(column) for evaluation in evaluations]
        mean = np.average(scores, axis=0, weights=weights)  # [scenarios]
        table = table.set_column(table.schema.get_field_index(column), SCHEMA.field(column), pa.array(mean))
    return Evaluation(name, first.provenance, table, first.skipped)


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
        table = Table(title=self.title, caption=self.note or None)
        for i, heading in enumerate(self.headings):
            table.add_column(heading, justify="right" if i else "left", no_wrap=not i)
        for cells in self.rows:
            table.add_row(*cells)
        return table


def load_published(name: str) -> TextTable:
    """Table of the paper, to be shown beside ours, by the heading of a section of `paper/published.md`."""
    text = (resources.files("rlftsim.experiments.paper") / "published.md").read_text(encoding="utf-8")
    (_, general_note), *sections = (section.split("\n\n") for section in text.strip().split("\n\n## "))
    title, table, *notes = next(paragraphs for heading, *paragraphs in sections if heading == name)
    headings, _, *rows = (tuple(cell.strip() for cell in line.split("|")[1:-1]) for line in table.split("\n"))
    return TextTable(f"The paper: {title}", headings, tuple(rows), " ".join((general_note, *notes)))


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
