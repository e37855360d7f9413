"""Result of an exam: tables, verdicts, a page, JSON, and the lines of the ledger."""

import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from rlftsim.evaluation.columns import DRIFT_COLUMNS, TERMINAL_COLUMNS, Column, find_direction
from rlftsim.evaluation.compare import FEW_CLUSTERS, PairedDifference
from rlftsim.experiments.exam import MARGINS, ExamConfig, ExamResult, ExamRow, Ledger, Margin
from rlftsim.experiments.results import format_origin
from rlftsim.experiments.tables import TextTable, build_table
from rlftsim.jobs.documents import to_finite
from rlftsim.jobs.files import write_text
from rlftsim.training.run_folder import describe_environment, to_plain

COLUMNS = (
    *TERMINAL_COLUMNS,
    *(column for column in DRIFT_COLUMNS if column.source in ("speed_gap", "speed_gap_all", "unlogged_stop_rate")),
)
"""Columns of the tables; the JSON and the ledger have all."""


def write_exam(result: ExamResult, config: ExamConfig, ledger: Ledger) -> tuple[Sequence[TextTable], Sequence[str]]:
    """Write exam.md and exam.json of an exam, then the lines of the ledger.

    Args:
        result: Rows that `take_exam` measured.
        config: Models, scenarios and settings of the measurement.
        ledger: Ledger that the look is added to, a line per row.

    Returns:
        Tables and verdicts.
    """
    environment = describe_environment()
    means_table = build_table("Means", [result.base, *(row.mean for row in result.rows)], COLUMNS)
    all_tables = (means_table, build_changes_table(result), build_margins_table(result))
    lines = [row.verdict for row in result.rows] + [format_next_run(row) for row in result.rows if len(row.by_run) > 1]
    if len(config.temperatures) > 1:
        lines.append(f"On the split tune the base is most realistic at temperature {result.temperature:g}.")
    entries = [build_ledger_entry(row, result, config, environment["commit"]) for row in result.rows]
    values = {"exam": result.name, "verdicts": lines, "rows": entries, "environment": environment}
    write_text(result.folder / "exam.json", json.dumps(to_finite(values), indent=1) + "\n")
    write_text(result.folder / "exam.md", format_page(result, all_tables, lines, environment))
    ledger.append([to_finite(entry) for entry in entries])
    return all_tables, lines


def build_changes_table(result: ExamResult) -> TextTable:
    """Difference of every column from the base, with interval and word as in `format_change`."""
    rows = [
        (column.label, *(format_change(row.changes[column.source], column) for row in result.rows))
        for column in COLUMNS
    ]
    note = f"95 % intervals by {describe_bootstrap(result)}."
    return TextTable("Against the base", ("", *(row.name for row in result.rows)), tuple(rows), note)


def format_change(change: PairedDifference, column: Column) -> str:
    """Difference with interval in the column's unit, and a word where chance does not explain the difference."""
    if not math.isfinite(change.difference):
        return "–"
    direction = find_direction(column.source)
    is_gain = (change.difference > 0) == (direction == "higher")
    word = " (changed)" if direction == "log" else " (better)" if is_gain else " (worse)"
    numbers = f"{format_signed(column, change.difference)} {format_interval(column, change.interval)}"
    return f"{numbers}{word if change.is_difference else ''}"


def build_margins_table(result: ExamResult) -> TextTable:
    """Word of each margin and the one-sided bounds that decide the word."""
    columns = {column.source: column for column in COLUMNS}
    rows = []
    for margin in MARGINS:
        column = columns[margin.column]
        if margin.is_relative:
            column = Column(column.source, column.heading, column.meaning, "%")
        bounds = (margin.bounds(row.change(margin.column, alpha=0.1)) for row in result.rows)
        words = (row.margins[margin.column] for row in result.rows)
        cells = [f"{word} {format_interval(column, limits)}" for word, limits in zip(words, bounds)]
        rows.append((f"{column.heading} {format_margin(margin, column)}", *cells))
    note = "A margin holds if both one-sided 95 % bounds (in brackets) are inside, and is missed if both are outside."
    return TextTable("Margins", ("", *(row.name for row in result.rows)), tuple(rows), note)


def format_margin(margin: Margin, column: Column) -> str:
    """A margin in the column's unit."""
    unit = f" {column.unit}" if column.unit else ""
    if math.isinf(margin.lowest):
        return f"≤ {format_signed(column, margin.highest)}{unit}"
    if math.isinf(margin.highest):
        return f"≥ {format_signed(column, margin.lowest)}{unit}"
    return f"within {column.text(margin.highest)}{unit}"


def format_signed(column: Column, value: float) -> str:
    """Difference in the column's unit, with a sign."""
    return f"{'+' if value >= 0 else ''}{column.text(value)}"


def format_interval(column: Column, interval: Sequence[float]) -> str:
    """Both ends of an interval in the column's unit; "[unknown]" without an interval."""
    return (
        f"[{', '.join(format_signed(column, end) for end in interval)}]" if math.isfinite(interval[0]) else "[unknown]"
    )


def describe_bootstrap(result: ExamResult) -> str:
    """Units of the intervals' bootstrap, in words."""
    row = max(result.rows, key=lambda row: len(row.by_run))
    num_clusters, num_runs = len(set(row.by_run[0].clusters)), len(row.by_run)
    runs = " and runs" if num_runs > 1 else ""
    caution = f"; fewer than {FEW_CLUSTERS} say little about others" if num_clusters < FEW_CLUSTERS else ""
    return f"bootstrap over {num_clusters} street networks or recordings{runs}{caution}"


def format_next_run(row: ExamRow) -> str:
    """Gain of each run, and the interval of the next run."""
    gains, (low, high) = row.gains, row.next_run.interval
    listed = ", ".join(f"{gain:+.4f}" for gain in gains)
    return f"{row.name}: RMM by run {listed}; the next run lies in [{low:+.4f}, {high:+.4f}] with 95 %."


def build_ledger_entry(row: ExamRow, result: ExamResult, config: ExamConfig, commit: str | None) -> dict[str, Any]:
    """Row for machines, an entry of the ledger."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit,
        "exam": result.name,
        "looks": result.looks.get(row.name),
        "recipe": row.name,
        "models": [model.name for model in row.models],
        "fingerprints": [model.fingerprint for model in row.models],
        "seeds": [model.seed for model in row.models],
        "bases": list(config.bases),
        "num_scenarios": len(row.by_run[0]),
        "num_clusters": len(set(row.by_run[0].clusters)),
        "evaluation": to_plain(row.by_run[0].config),
        "verdict": row.verdict,
        "margins": row.margins,
        "gain_by_run": row.gains.tolist(),
        "next_run": row.next_run.interval,
        "columns": {
            column: {
                "base": round(change.mean_a, 6),
                "mean": round(change.mean_b, 6),
                "difference": round(change.difference, 6),
                "interval": [round(end, 6) for end in change.interval],
                "p_value": float(f"{change.p_value:.3g}"),
            }
            for column, change in row.changes.items()
        },
    }


def format_page(
    result: ExamResult, all_tables: Sequence[TextTable], lines: Sequence[str], environment: dict[str, Any]
) -> str:
    """The page for people, in Markdown."""
    looks = ", ".join(f"{recipe} {count}" for recipe, count in result.looks.items())
    paragraphs = [f"# Exam {result.name}", "\n".join(f"* {line}" for line in lines)]
    paragraphs += [paragraph for table in all_tables for paragraph in table.paragraphs]
    paragraphs += ["## Notes", f"* Looks at this exam: {looks}.\n* Made with {format_origin(environment)}."]
    return "\n\n".join(paragraphs) + "\n"
