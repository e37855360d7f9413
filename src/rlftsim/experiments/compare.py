"""Evaluations beside each other: tables with standard errors, and the paired difference of two."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.evaluation import SCORE_COLUMNS, Evaluation, direction_of
from rlftsim.intervals import mean_interval

TABLE_COLUMNS = (
    "meta_metric",
    "meta_metric_light_one",
    "kinematic",
    "interactive",
    "map_based",
    "min_average_displacement_error",
    "collision_rate",
    "offroad_rate",
    "traffic_light_violation_rate",
)
GOAL_COLUMNS = ("passing_miss_rate", "min_passing_miss_rate")
"""Shown where agents had goals: whether they came near them."""
_HEADINGS = {
    "meta_metric": "RMM",
    "meta_metric_light_one": "RMM, light = 1",
    "map_based": "map-based",
    "min_average_displacement_error": "minADE (m)",
    "average_displacement_error": "ADE (m)",
    "traffic_light_violation_rate": "red light rate",
    "passing_miss_rate": "goal missed",
    "min_passing_miss_rate": "in all rollouts",
}
_ARROWS = {"higher": "↑", "lower": "↓"}


@dataclass(frozen=True)
class PairedDifference:
    """One column of two evaluations on the same scenarios; the difference is b minus a."""

    column: str
    count: int
    """Scenarios with a value in both."""
    mean_a: float
    mean_b: float
    difference: float
    """Mean of the scenarios' differences; NaN where no scenario has both values."""
    standard_error: float
    """NaN for fewer than two scenarios."""
    interval: tuple[float, float]
    """Holds the true difference with probability 1 - alpha (Student's t); NaN for fewer than two scenarios."""
    p_value: float
    """Two-sided, of a true difference of 0; NaN where it cannot be told."""
    alpha: float

    @property
    def is_difference(self) -> bool:
        """Whether the difference is more than chance at level alpha."""
        return self.p_value < self.alpha

    @property
    def verdict(self) -> str:
        """What the numbers say, in words."""
        if self.count == 0:
            return "nothing to compare: no scenario has a value in both."
        if self.count == 1:
            return f"no verdict: a single scenario, which differs by {self.difference:+.4f}."
        if self.standard_error == 0:
            if self.difference == 0:
                return f"no difference: equal in all {self.count} scenarios."
            return f"difference: {self.difference:+.4f} in every one of the {self.count} scenarios."
        low, high = self.interval
        numbers = f"{self.difference:+.4f}, {100 - 100 * self.alpha:g}% interval [{low:+.4f}, {high:+.4f}], p = {self.p_value:.2g}"
        if not self.is_difference:
            return f"no difference at the {100 * self.alpha:g}% level: {numbers}."
        is_better = (self.difference > 0) == (direction_of(self.column) == "higher")
        return f"difference, for the {'better' if is_better else 'worse'}: {numbers}."


@dataclass(frozen=True)
class Comparison:
    """Two evaluations, scenario by scenario."""

    name_a: str
    name_b: str
    num_paired: int
    num_only_a: int
    """Scenarios that only the first has; they are left out."""
    num_only_b: int
    differences: tuple[PairedDifference, ...]
    """In the order of `SCORE_COLUMNS`."""

    def __getitem__(self, column: str) -> PairedDifference:
        """Difference of one column.

        Raises:
            ConfigError: there is no such column.
        """
        for difference in self.differences:
            if difference.column == column:
                return difference
        raise ConfigError(f"a comparison has no column {column!r}, only {', '.join(SCORE_COLUMNS)}.")

    @property
    def pairing(self) -> str:
        """How many scenarios are compared, and how many are not."""
        alone = [(self.num_only_a, self.name_a), (self.num_only_b, self.name_b)]
        left_out = "".join(f", {count} only in {name} left out" for count, name in alone if count)
        return f"{self.num_paired} scenario{'s' if self.num_paired != 1 else ''} in both{left_out}"


def compare(a: Evaluation, b: Evaluation, *, alpha: float = 0.05) -> Comparison:
    """Paired comparison, b against a.

    Args:
        a: what is compared with, e.g. the base model.
        b: e.g. the fine-tuned model.
        alpha: probability of calling a difference that is none.

    Raises:
        ConfigError: alpha is no probability.
        DataError: other metric or number of rollouts, or no scenario in common.
    """
    if not 0 < alpha < 1:
        raise ConfigError(f"alpha must lie between 0 and 1, got {alpha}: 0.05 is usual.")
    for setting in ("metric", "num_rollouts"):
        values = [getattr(e.config, setting) for e in (a, b)]
        if values[0] != values[1]:
            raise DataError(
                f"{a.name} and {b.name} cannot be compared, {setting} is {values[0]} and {values[1]}: evaluate both alike."
            )
    rows_a, rows_b = pair_rows(a, b)
    return Comparison(
        name_a=a.name,
        name_b=b.name,
        num_paired=len(rows_a),
        num_only_a=len(a) - len(rows_a),
        num_only_b=len(b) - len(rows_b),
        differences=tuple(
            compare_paired(column, a.values(column)[rows_a], b.values(column)[rows_b], alpha=alpha)
            for column in SCORE_COLUMNS
        ),
    )


def pair_rows(a: Evaluation, b: Evaluation) -> tuple[list[int], list[int]]:
    """Rows of the scenarios that both have, in the order of the first.

    Raises:
        DataError: they have none in common.
    """
    place = {scenario_id: row for row, scenario_id in enumerate(b.scenario_ids)}
    rows_a = [row for row, scenario_id in enumerate(a.scenario_ids) if scenario_id in place]
    if not rows_a:
        raise DataError(f"{a.name} ({len(a)} scenarios) and {b.name} ({len(b)}) have no scenario in common.")
    return rows_a, [place[a.scenario_ids[row]] for row in rows_a]


def paired_values(a: Evaluation, b: Evaluation, column: str) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Ids of the scenarios that both have, and both columns [scenarios] there.

    Raises:
        DataError: they have none in common.
        ConfigError: there is no such column.
    """
    rows_a, rows_b = pair_rows(a, b)
    return [a.scenario_ids[row] for row in rows_a], a.values(column)[rows_a], b.values(column)[rows_b]


def compare_paired(column: str, a: np.ndarray, b: np.ndarray, *, alpha: float = 0.05) -> PairedDifference:
    """Paired t-test of two columns [scenarios]; scenarios without a value in both are left out."""
    known = np.isfinite(a) & np.isfinite(b)
    a, b = a[known], b[known]
    gain = mean_interval(b - a, alpha=alpha)
    means = (float(a.mean()), float(b.mean())) if gain.count else (math.nan, math.nan)
    return PairedDifference(
        column, gain.count, *means, gain.mean, gain.standard_error, gain.interval, gain.p_value, alpha
    )


def format_table(*evaluations: Evaluation, columns: Sequence[str] | None = None) -> Table:
    """One row per evaluation: mean ± standard error over its scenarios. Arrows say which way is better.

    Args:
        evaluations: the rows.
        columns: None = `TABLE_COLUMNS`, and `GOAL_COLUMNS` where agents of some evaluation had goals.

    Raises:
        ConfigError: there is no such column.
    """
    asked = [evaluation.name for evaluation in evaluations if evaluation.config.goals != "none"]
    columns = columns or columns_of(*evaluations)
    caption = (
        f"{', '.join(asked)}: evaluated agents were asked to go where their record ends; who never comes near has missed."
        if asked
        else None
    )
    table = Table(caption=caption, caption_justify="left")
    table.add_column("policy", no_wrap=True)
    table.add_column("scenarios", justify="right")
    for column in columns:
        table.add_column(_heading(column), justify="right")
    for evaluation in evaluations:
        means = [evaluation.mean_and_error(column) for column in columns]
        cells = [_plus_minus(found.mean, found.standard_error) for found in means]
        table.add_row(evaluation.name, str(len(evaluation)), *cells)
    return table


def columns_of(*evaluations: Evaluation) -> tuple[str, ...]:
    """What a table of some evaluations shows."""
    have_goals = any(evaluation.config.goals != "none" for evaluation in evaluations)
    return (*TABLE_COLUMNS, *(GOAL_COLUMNS if have_goals else ()))


def format_comparison(comparison: Comparison, *, columns: Sequence[str] = TABLE_COLUMNS) -> Table:
    """One row per column: both means, the difference ± standard error and the verdict.

    Raises:
        ConfigError: there is no such column.
    """
    table = Table(title=f"{comparison.name_b} against {comparison.name_a}: {comparison.pairing}", title_justify="left")
    table.add_column("", no_wrap=True)
    for name in (comparison.name_a, comparison.name_b, "difference"):
        table.add_column(name, justify="right")
    table.add_column("verdict")
    for column in columns:
        row = comparison[column]
        difference = _plus_minus(row.difference, row.standard_error, sign="+")
        table.add_row(_heading(column), f"{row.mean_a:.4f}", f"{row.mean_b:.4f}", difference, row.verdict)
    return table


def _heading(column: str) -> str:
    return f"{_HEADINGS.get(column, column.replace('_', ' '))} {_ARROWS[direction_of(column)]}"


def _plus_minus(mean: float, error: float, sign: str = "") -> str:
    return f"{mean:{sign}.4f}" + ("" if math.isnan(error) else f" ± {error:.4f}")
