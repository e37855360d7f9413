"""Evaluations side by side: tables with standard errors, and the paired difference of two."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, Shaped
from rich import box
from rich.table import Table

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.columns import TERMINAL_COLUMNS, TERMINAL_GOAL_COLUMNS, Column, find_direction, format_estimate
from rlftsim.evaluation.results import SCORE_COLUMNS, Evaluation, find_column
from rlftsim.statistics import cluster_bootstrap, mean_interval

FEW_CLUSTERS = 10
"""Below, an interval is itself uncertain: the spread between clusters is hardly known."""


@dataclass(frozen=True)
class PairedDifference:
    """A column of two evaluations on the same scenarios; the difference is b minus a."""

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
    """Holds the true difference with probability 1 - alpha (Student's t); NaN for fewer than two scenarios, or
    clusters."""
    p_value: float
    """Two-sided, of a true difference of 0; NaN for fewer than two scenarios."""
    alpha: float
    num_clusters: int = 0
    """Street networks or recordings by which interval and p-value count; 0 = each scenario stands for itself."""

    def __repr__(self) -> str:
        return f"{self.column}: {self.mean_a:.4f} -> {self.mean_b:.4f}, {self.verdict}"

    @property
    def is_difference(self) -> bool:
        """True if the difference is more than chance at level alpha."""
        return self.p_value < self.alpha

    @property
    def verdict(self) -> str:
        """The result of the test, in words."""
        if self.count == 0:
            return "nothing to compare: no scenario has a value in both."
        if self.count == 1:
            return f"no verdict: a single scenario, which differs by {self.difference:+.4f}."
        if math.isnan(self.standard_error):
            cause = f"all {self.count} scenarios are of one cluster"
            return f"no verdict: {cause}, whose mean differs by {self.difference:+.4f}."
        # the same difference everywhere: there is no test to make
        if self.standard_error == 0:
            if self.difference == 0:
                return f"no difference: equal in all {self.count} scenarios."
            return f"difference: {self.difference:+.4f} in every one of the {self.count} scenarios."
        low, high = self.interval
        level = 100 - 100 * self.alpha
        numbers = f"{self.difference:+.4f}, {level:g}% interval [{low:+.4f}, {high:+.4f}], p = {self.p_value:.2g}"
        if not self.is_difference:
            return f"no difference at the {100 * self.alpha:g}% level: {numbers}."
        word = self._judge()
        return f"difference{'' if word == 'differs' else f', for the {word}'}: {numbers}."

    @property
    def cells(self) -> tuple[str, ...]:
        """Both means, the difference, both ends of the interval, the p-value and the verdict in a word, for tables."""
        means = [f"{mean:.4f}" if self.count else "–" for mean in (self.mean_a, self.mean_b)]
        interval = ["–" if math.isnan(end) else f"{end:+.4f}" for end in self.interval]
        difference = f"{self.difference:+.4f}" if self.count else "–"
        p_value = "–" if math.isnan(self.p_value) or not self.standard_error else f"{self.p_value:.2g}"
        return *means, difference, *interval, p_value, self._judge()

    def _judge(self) -> str:
        if self.count and self.standard_error == 0 and self.difference == 0:
            return "equal"
        if not self.is_difference:
            return "unclear"
        direction = find_direction(self.column)
        if direction == "log":  # neither more nor less is better
            return "differs"
        return "better" if (self.difference > 0) == (direction == "higher") else "worse"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two evaluations, scenario by scenario; `comparison["meta_metric"]` is the difference of a column."""

    a: Evaluation
    b: Evaluation
    num_paired: int
    num_only_a: int
    """Scenarios that only the first has; they are left out."""
    num_only_b: int
    differences: tuple[PairedDifference, ...]
    """In the order of `SCORE_COLUMNS`."""
    num_clusters: int = 0
    """Street networks or recordings that the paired scenarios are of; 0 = each scenario stands for itself."""

    def __repr__(self) -> str:
        return f"{self.b.name} against {self.a.name}, {self.pairing}; {self['meta_metric']!r}"

    def __getitem__(self, column: str) -> PairedDifference:
        """Difference of a column.

        Raises:
            ConfigError: A column that no evaluation has.
        """
        return self.differences[SCORE_COLUMNS.index(find_column(column))]

    @property
    def pairing(self) -> str:
        """Numbers of scenarios that are compared and left out, in words."""
        alone = [(self.num_only_a, self.a.name), (self.num_only_b, self.b.name)]
        left_out = "".join(f", {count} only in {name} left out" for count, name in alone if count)
        with_rmm = _with_rmm(self["meta_metric"].count, self.num_paired)
        clusters = f" of {self.num_clusters} cluster{'s' if self.num_clusters > 1 else ''}" if self.num_clusters else ""
        return f"{self.num_paired} scenario{'s' if self.num_paired != 1 else ''}{clusters} in both{with_rmm}{left_out}"

    @property
    def caution(self) -> str:
        """A sentence on intervals that few clusters make uncertain; empty with enough clusters, or without any."""
        if not 0 < self.num_clusters < FEW_CLUSTERS:
            return ""
        return (
            f"Street networks or recordings of the scenarios: {self.num_clusters}. Intervals count these, and so few "
            "say little about others."
        )


def compare(a: Evaluation, b: Evaluation, *, alpha: float = 0.05) -> Comparison:
    """Paired comparison, b against a.

    Args:
        a: Reference, e.g. the base model.
        b: Evaluation to judge, e.g. the fine-tuned model.
        alpha: Probability of calling a difference that is none.

    Returns:
        Differences with intervals and p-values. Where scenarios share street networks or recordings, these are counted
        (`cluster_bootstrap`); else the scenarios (Student's t).

    Raises:
        ConfigError: An alpha that is no probability.
        DataError: Unequal metrics or numbers of rollouts, or no scenario in common.
    """
    if not 0 < alpha < 1:
        raise ConfigError(f"alpha must lie between 0 and 1, got {alpha}: 0.05 is usual.")
    # The meta-metric depends on both. Other settings (temperature, goals) may be what is compared.
    for setting in ("metric", "num_rollouts"):
        values = [getattr(e.config, setting) for e in (a, b)]
        if values[0] != values[1]:
            raise DataError(
                f"{a.name} and {b.name} cannot be compared, {setting} is {values[0]} and {values[1]}: evaluate both "
                "alike."
            )
    rows_a, rows_b = pair_rows(a.name, a.scenario_ids, b.name, b.scenario_ids)
    clusters = a.clusters[rows_a]
    num_clusters = len(set(clusters)) if len(set(clusters)) < len(rows_a) else 0
    compare_values = partial(compare_paired, alpha=alpha, clusters=clusters if num_clusters else None)
    differences = tuple(compare_values(c, a.values(c)[rows_a], b.values(c)[rows_b]) for c in SCORE_COLUMNS)
    num_paired = len(rows_a)
    return Comparison(
        a, b, num_paired, len(a) - num_paired, len(b) - num_paired, differences, num_clusters=num_clusters
    )


def pair_rows(name_a: str, ids_a: Sequence[str], name_b: str, ids_b: Sequence[str]) -> tuple[list[int], list[int]]:
    """Rows of the scenarios that two results have, in the order of the first.

    Args:
        name_a: Name in messages of the results that give the order of the pairs.
        ids_a: Scenario of each of their rows.
        name_b: Name of the results that are paired with these.
        ids_b: Scenario of each of their rows.

    Raises:
        DataError: No scenario in common, or results with several rows of a scenario.
    """
    # scored files may hold several sets of rollouts of a scenario: nothing says which of them make a pair
    for name, ids in ((name_a, ids_a), (name_b, ids_b)):
        repeated = [scenario_id for scenario_id, count in Counter(ids).items() if count > 1]
        if repeated:
            raise DataError(f"{name}: scenario {repeated[0]} has several rows, a pair needs one: score its sets apart.")
    rows_by_id = {scenario_id: row for row, scenario_id in enumerate(ids_b)}
    rows_a = [row for row, scenario_id in enumerate(ids_a) if scenario_id in rows_by_id]
    if not rows_a:
        raise DataError(f"{name_a} ({len(ids_a)} scenarios) and {name_b} ({len(ids_b)}) have no scenario in common.")
    return rows_a, [rows_by_id[ids_a[row]] for row in rows_a]


def paired_values(a: Evaluation, b: Evaluation, column: str) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Ids of the scenarios that both have, and both columns [scenarios] there.

    Args:
        a: Evaluation that gives the order of the pairs.
        b: Evaluation that is paired with `a`.
        column: Name in `SCORE_COLUMNS`.

    Raises:
        DataError: No scenario in common.
        ConfigError: A column that no evaluation has.
    """
    ids = a.scenario_ids
    rows_a, rows_b = pair_rows(a.name, ids, b.name, b.scenario_ids)
    return [ids[row] for row in rows_a], a.values(column)[rows_a], b.values(column)[rows_b]


def compare_paired(
    column: str,
    a: Float[np.ndarray, "*runs scenarios"],
    b: Float[np.ndarray, "*runs scenarios"],
    *,
    alpha: float = 0.05,
    clusters: Shaped[np.ndarray, "scenarios"] | None = None,
) -> PairedDifference:
    """Paired t-test of two columns; scenarios without a value in both are left out.

    Args:
        column: Name of both columns, for the result.
        a: Values of the reference; NaN = no value.
        b: Values to judge, of the same scenarios in the same order.
        alpha: Probability of calling a difference that is none.
        clusters: Street network or recording of each scenario, by which interval and p-value then count; needed for
            values of several runs. None = each scenario stands for itself.
    """
    is_paired = np.isfinite(a) & np.isfinite(b)
    # a paired t-test is a t-test of the differences: scenarios differ far more than policies do
    if clusters is None:
        gain, num_clusters = mean_interval((b - a)[is_paired], alpha=alpha), 0
    else:
        gain = cluster_bootstrap(np.where(is_paired, b - a, np.nan), clusters, level=1 - alpha)
        num_clusters = len(set(clusters[np.atleast_2d(is_paired).any(0)]))
    means = (float(a[is_paired].mean()), float(b[is_paired].mean())) if gain.count else (math.nan, math.nan)
    return PairedDifference(
        column, gain.count, *means, gain.mean, gain.standard_error, gain.interval, gain.p_value, alpha, num_clusters
    )


def select_columns(*evaluations: Evaluation) -> tuple[Column, ...]:
    """Columns of a table of some evaluations: with misses where agents of some evaluation had goals."""
    have_goals = any(evaluation.config.goals != "none" for evaluation in evaluations)
    return TERMINAL_GOAL_COLUMNS if have_goals else TERMINAL_COLUMNS


def _with_rmm(count: int, num_scenarios: int) -> str:
    """Note on the scenarios that the mean meta-metric is over, if undefined for some."""
    return f" ({count} with RMM)" if count < num_scenarios else ""


def format_table(*evaluations: Evaluation) -> Table:
    """A column per evaluation: mean ± standard error over the scenarios. Arrows point in the better direction.

    Args:
        evaluations: Evaluations in the order of the columns; `select_columns` chooses the rows.
    """
    table = Table(caption=describe_data(*evaluations) or None)
    table.add_column("", no_wrap=True)
    for evaluation in evaluations:
        table.add_column(evaluation.name, justify="right")
    counts = [f"{len(evaluation)}{_with_rmm(evaluation.num_with_rmm, len(evaluation))}" for evaluation in evaluations]
    table.add_row("scenarios", *counts)
    for column in select_columns(*evaluations):
        means = [evaluation.mean_and_error(column.source) for evaluation in evaluations]
        table.add_row(column.fraction_label, *(format_estimate(mean) for mean in means))
    return table


def describe_data(*evaluations: Evaluation) -> str:
    """Sentences on the data and the goals of evaluations; empty where there is nothing to say."""
    with_goals = [evaluation.name for evaluation in evaluations if evaluation.config.goals != "none"]
    notes = list(dict.fromkeys(evaluation.data_note for evaluation in evaluations))
    if with_goals:
        notes.append(
            f"{', '.join(with_goals)}: the goals of evaluated agents were their logged final positions; an agent that "
            "never comes near its goal has missed it."
        )
    return " ".join(note for note in notes if note)


def format_comparison(comparison: Comparison) -> Table:
    """A row per column of the evaluations: both means, the difference with its interval, and the verdict."""
    a, b = comparison.a, comparison.b
    table = comparison_table(a.name, b.name, comparison.differences[0].alpha)
    table.title = f"{b.name} against {a.name}: {comparison.pairing}"
    table.caption = " ".join(filter(None, [comparison.caution, describe_data(a, b)])) or None
    for column in select_columns(a, b):
        table.add_row(column.fraction_label, *comparison[column.source].cells)
    return table


def comparison_table(name_a: str, name_b: str, alpha: float) -> Table:
    """Empty table for `PairedDifference.cells` behind a label; 80 characters are enough for all of it.

    Args:
        name_a: Heading of the reference.
        name_b: Heading of the result to judge.
        alpha: Significance level of the intervals.
    """
    table = Table(
        box=box.SIMPLE,
        padding=(0, 0),
        collapse_padding=True,
        show_edge=False,
        pad_edge=False,
    )
    table.add_column("", no_wrap=True)
    for name in (name_a, name_b, "change", f"{100 - 100 * alpha:g} %", "to", "p"):
        table.add_column(name, justify="right")
    table.add_column("verdict", no_wrap=True)
    return table
