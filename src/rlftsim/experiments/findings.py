"""What an experiment is, and what it ends with: tables, verdicts and a figure, as Markdown, JSON and pictures."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.table import Table

from rlftsim.experiments.columns import Column, ResultRow
from rlftsim.experiments.compare import compare
from rlftsim.experiments.workshop import Row, Workshop
from rlftsim.files import write_text
from rlftsim.intervals import mean_interval
from rlftsim.training.run_folder import describe_environment, to_plain
from rlftsim.viewer.figure import Interval, draw_intervals, save_figure
from rlftsim.viewer.film import to_film
from rlftsim.viewer.page import Animation, write_page


@dataclass(frozen=True)
class TextTable:
    """A table whose cells are written already; the first column names the rows."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """As Markdown, without its title."""
        dashes = ["---", *["--:"] * (len(self.headings) - 1)]
        lines = ["| " + " | ".join(cells) + " |" for cells in (self.headings, dashes, *self.rows)]
        return "\n".join(lines)

    def for_terminal(self) -> Table:
        """For `print_wide`."""
        table = Table(title=self.title, caption=self.note or None, title_justify="left", caption_justify="left")
        for i, heading in enumerate(self.headings):
            table.add_column(heading, justify="right" if i else "left", no_wrap=not i)
        for cells in self.rows:
            table.add_row(*cells)
        return table


@dataclass(frozen=True)
class Findings:
    """What an experiment has found."""

    title: str
    tables: tuple[TextTable, ...]
    """Ours first, then what others published."""
    verdicts: tuple[str, ...] = ()
    """A line each: difference or no difference."""
    notes: tuple[str, ...] = ()
    """What one has to know to read the numbers."""
    numbers: Mapping[str, Any] = field(default_factory=dict)
    """The same for machines; what is not finite becomes null."""
    figure: Figure | None = None
    animations: tuple[Animation, ...] = ()


Measured = TypeVar("Measured")
FILMS = {".webp": 2, ".mp4": 1}
"""Endings of an animation's films and their steps between frames."""


@dataclass(frozen=True)
class Experiment(Generic[Measured]):
    """A question, how its answer is measured and what is read off the measurements."""

    question: str
    measure: Callable[[Workshop], Measured]
    """Has everything trained and evaluated that is not yet."""
    conclude: Callable[[Measured, Workshop], Findings]
    """Computes from stored results alone."""
    default_seeds: int = 1


def run_experiment(name: str, experiment: Experiment[Any], workshop: Workshop) -> Findings:
    """Do what is missing and write `out/<name>.md` and `.json`; with a figure `.png` and `.svg`; with animations `.html`, where they can be
    played with, and films of each, `-1.webp`, `-1.mp4`, ... Each whole or not at all.

    Raises:
        RlftsimError: a stage failed; the message says which and why.
    """
    findings = experiment.conclude(experiment.measure(workshop), workshop)
    if findings.figure is not None:
        for ending in ("png", "svg"):
            save_figure(workshop.out / f"{name}.{ending}", findings.figure)
    for number, animation in enumerate(findings.animations, 1):
        for ending, every in FILMS.items():
            to_film(workshop.out / f"{name}-{number}{ending}", animation, every=every)
    if findings.animations:
        write_page(workshop.out / f"{name}.html", findings.title, findings.animations, caption=experiment.question)
    write_text(workshop.out / f"{name}.json", json.dumps(_plain(name, experiment, findings, workshop), indent=1) + "\n")
    write_text(workshop.out / f"{name}.md", _markdown(name, experiment, findings, workshop))
    return findings


def result_table(title: str, rows: Sequence[Row], columns: Sequence[Column]) -> TextTable:
    """Mean ± standard error over scenarios; with several seeds, of each scenario's mean over them."""
    first = rows[0].mean
    cells = [(row.name, *(c.cell(ResultRow.of(row.mean, columns)) for c in columns)) for row in rows]
    seeds = max(len(row.by_seed) for row in rows)
    note = (
        f"{len(first)} held-out scenarios, {first.config.num_rollouts} rollouts each, metric {first.config.metric}; "
        f"mean ± standard error over scenarios{f', means over {seeds} seeds where a row has them' if seeds > 1 else ''}."
    )
    return TextTable(title, ("", *(c.label for c in columns)), tuple(cells), note)


def row_numbers(rows: Sequence[Row], columns: Sequence[Column]) -> dict[str, Any]:
    """Means with standard errors and 95 % intervals, and the mean of every seed, by row and column of the evaluations."""
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


def verdict_line(base: Row, other: Row, column: str = "meta_metric", *, alpha: float = 0.05) -> str:
    """One line: whether a row differs from another, scenario by scenario."""
    comparison = compare(base.mean, other.mean, alpha=alpha)
    return f"{other.name} against {base.name}, {comparison.pairing}: {comparison[column].verdict}"


def seed_gains(base: Row, other: Row, column: str = "meta_metric") -> Float[np.ndarray, "seeds"]:
    """How much a row's mean lies above the base's, seed by seed."""
    before = base.mean.mean_and_error(column).mean
    return np.array([evaluation.mean_and_error(column).mean - before for evaluation in other.by_seed])


def seeds_line(base: Row, other: Row) -> str:
    """The gain of every seed, and what several say together."""
    gains = seed_gains(base, other)
    what, listed = f"{other.name} minus {base.name}, RMM by seed", ", ".join(f"{gain:+.4f}" for gain in gains)
    if len(gains) == 1:
        return f"{what}: {listed}; a single seed says nothing about others."
    together = mean_interval(gains)
    low, high = together.interval
    return f"{what}: {listed}; mean {together.mean:+.4f}, 95% interval over seeds [{low:+.4f}, {high:+.4f}]."


def draw_gains(base: Row, others: Sequence[Row]) -> Figure:
    """The paired difference of every row to the base model's, the first row in colour."""
    intervals = []
    for number, row in enumerate(others):
        gain = compare(base.mean, row.mean)["meta_metric"]
        intervals.append(Interval(row.name, gain.difference, *gain.interval, colour=4 if number else 0))
    label = "gain in RMM over the base model, 95 % interval"
    return draw_intervals(intervals, title="Against the base model", x_label=label, zero=True)


def budget_note(workshop: Workshop) -> str:
    """Said under every table with fine-tuned rows."""
    return (
        f"Every fine-tuned row had the same budget: {workshop.budget}. One base model; the seeds are those of fine-tuning, "
        "evaluations share theirs."
    )


def _markdown(name: str, experiment: Experiment[Any], findings: Findings, workshop: Workshop) -> str:
    parts = [f"# {findings.title}", experiment.question]
    for table in findings.tables:
        parts += [f"## {table.title}", table.markdown(), *([table.note] if table.note else [])]
        if table is findings.tables[0]:
            parts += ["\n".join(f"* {line}" for line in findings.verdicts)] if findings.verdicts else []
            parts += [f"![{findings.title}]({name}.png)"] if findings.figure is not None else []
    for number, animation in enumerate(findings.animations, 1):
        film = f"{name}-{number}"
        parts += [
            f"## {animation.title}",
            f"{animation.caption} [Film]({film}.mp4)",
            f"![{animation.title}]({film}.webp)",
        ]
    parts += ["## What to know", "\n".join(f"* {line}" for line in (*findings.notes, *_facts(workshop)))]
    return "\n\n".join(parts) + "\n"


def _facts(workshop: Workshop) -> tuple[str, ...]:
    environment = describe_environment()
    packages = ", ".join(f"{package} {version}" for package, version in environment["packages"].items())
    return (
        f"Data: {workshop.data.name}, split {workshop.evaluation.split}.",
        f"Made with `{environment['command']}`, commit {environment['commit'] or 'of an installed package'}, on {environment['machine']}; {packages}.",
    )


def _plain(name: str, experiment: Experiment[Any], findings: Findings, workshop: Workshop) -> Any:
    return finite_or_none(
        {
            "experiment": name,
            "question": experiment.question,
            "title": findings.title,
            "verdicts": findings.verdicts,
            "notes": findings.notes,
            **findings.numbers,
            "tables": [to_plain(table) for table in findings.tables],
            "budget": to_plain(workshop.budget),
            "num_seeds": workshop.num_seeds,
            "data": str(workshop.data),
            "recipe": to_plain(workshop.recipe),
            "evaluation": to_plain(workshop.evaluation),
            "environment": describe_environment(),
        }
    )


def finite_or_none(value: Any) -> Any:
    """The same for JSON, with None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): finite_or_none(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
