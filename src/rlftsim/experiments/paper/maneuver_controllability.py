"""Maneuvers as goals of the ego: the logged one, an alternative that the lanes allow, or either."""

from collections.abc import Callable, Mapping, Sequence

from rlftsim.evaluation.goal_attainment import Attained
from rlftsim.experiments.paper import controllability, published
from rlftsim.experiments.paper.controllability import RATES, Attainment, cell, estimate
from rlftsim.experiments.paper.goal_conditioning import GUIDED, START
from rlftsim.experiments.paper.maneuver_goals import NAME, find_goals, is_logged, maneuver_of
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import TextTable
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS, Maneuver
from rlftsim.statistics import MeanInterval
from rlftsim.viewer.figure import Subplot, draw_subplots

ONCE = {"passed_once": "goals passed in some rollout [%]", "reached_once": "goals reached in some rollout [%]"}
"""Fractions of the goals (attributes of `Attained`), and their headings. The paper does not say how it counts
several rollouts of a goal; its percentages are those of whole goals."""
MIXED, ALTERNATIVE = "mixed", "alternative only"
CONTAINS: dict[str, Callable[[Attained], bool]] = {
    "ground truth": lambda one: is_logged(one.entry),
    ALTERNATIVE: lambda one: not is_logged(one.entry),
}
"""Tests of a goal being in a condition."""
CONDITIONS = ("ground truth", MIXED, ALTERNATIVE)
"""Mixed: the mean of a scenario's logged and its alternative goals."""
ByManeuver = Mapping[tuple[str, str, str], Mapping[Maneuver, MeanInterval]]
"""Mean rate of each maneuver, by rate, row and condition."""


def run(suite: ExperimentSuite) -> dict[str, tuple[Attained, ...]]:
    """Outcome of every goal, by row. The goals are proposed and written first, unless there is a goals file.

    Raises:
        DataError: there is no ego with two maneuvers, or the goals file was edited and makes no sense.
    """
    return controllability.attain(suite, find_goals(suite), NAME)


def summarize(attained: Attainment, suite: ExperimentSuite) -> ExperimentResult:
    """Rates by condition and by maneuver, beside the paper's.

    Args:
        attained: of `run`; the labels of the goals have the maneuvers.
        suite: for the notes.
    """
    rows = list(attained)
    overall = {
        rate: {row: [estimate(_rates(attained, row, rate, c).values()) for c in CONDITIONS] for row in rows}
        for rate in (*RATES, *ONCE)
    }
    by_maneuver: ByManeuver = {
        (rate, row, condition): _by_maneuver(attained, row, rate, condition)
        for rate in RATES
        for row in rows
        for condition in CONTAINS
    }
    # All rows have the same goals: maneuvers without any are not drawn.
    shown = [m for m in BENCHMARK_MANEUVERS if any(by_maneuver["passed", rows[0], c][m].count for c in CONTAINS)]
    subplots = [
        Subplot(
            f"{condition}, {heading.removesuffix(' [%]')}",
            controllability.bands_of({row: [by_maneuver[rate, row, condition][m] for m in shown] for row in rows}),
        )
        for rate, heading in RATES.items()
        for condition in CONTAINS
    ]
    return ExperimentResult(
        title="Maneuver controllability: the ego's goal is its logged maneuver, or an alternative",
        tables=(*_condition_tables(overall), *_maneuver_tables(by_maneuver, rows), published.MANEUVERS),
        verdicts=tuple(_verdict(attained, row, rate) for rate in (*RATES, "passed_once") for row in GUIDED),
        notes=(
            suite.budget.note,
            controllability.SEED_NOTE,
            f"The goals are in {NAME}.goals.json beside this table: logged maneuvers with their logged endpoints, "
            "alternatives as the lanes propose them. Edit them, and the same command measures the edited ones.",
            "Only the ego has a goal, and only scenarios count in which it has a logged and an alternative maneuver. "
            "Every goal is given alone; mixed is half the one, half the other.",
            "Lights, signs and other agents are not considered when goals are proposed: some goals cannot be reached "
            "without a violation.",
        ),
        numbers={
            "conditions": {
                rate: {row: {c: _plain(one) for c, one in zip(CONDITIONS, ones)} for row, ones in by_row.items()}
                for rate, by_row in overall.items()
            },
            "maneuvers": {
                rate: {
                    row: {c: {m.value: _plain(e) for m, e in by_maneuver[rate, row, c].items()} for c in CONTAINS}
                    for row in rows
                }
                for rate in RATES
            },
            "goals": [{"scenario": one.entry.scenario_id, "label": one.entry.label} for one in attained[rows[0]]],
        },
        figure=draw_subplots(
            subplots,
            title="Maneuvers as goals of the ego",
            x_label="",
            y_label="rollouts [%], 95 % interval",
            ticks=[m.value.replace("_", "\n") for m in shown],
            columns=len(CONTAINS),
            is_joined=False,
        ),
    )


def _rates(attained: Attainment, row: str, rate: str, condition: str) -> dict[str, float]:
    """Mean rate over the goals of a condition, by scenario."""
    if condition == MIXED:
        # Scenarios with goals in both conditions; half and half, however many goals each has.
        one, other = (_rates(attained, row, rate, name) for name in CONTAINS)
        return {scenario_id: (one[scenario_id] + other[scenario_id]) / 2 for scenario_id in one if scenario_id in other}
    return controllability.rates_by_scenario(filter(CONTAINS[condition], attained[row]), rate)


def _by_maneuver(attained: Attainment, row: str, rate: str, condition: str) -> dict[Maneuver, MeanInterval]:
    """Mean rate over the goals of a condition, by maneuver."""
    # Here the goal is the unit, not the scenario: a scenario has one goal of a maneuver or none.
    values: dict[Maneuver, list[float]] = {m: [] for m in BENCHMARK_MANEUVERS}
    for one in filter(CONTAINS[condition], attained[row]):
        values[maneuver_of(one.entry)].append(getattr(one, rate))
    return {m: estimate(own) for m, own in values.items()}


def _condition_tables(overall: Mapping[str, Mapping[str, Sequence[MeanInterval]]]) -> list[TextTable]:
    """A table for each rate: rows by conditions."""
    tables = []
    for rate, heading in (RATES | ONCE).items():
        cells = tuple((row, *map(cell, rates)) for row, rates in overall[rate].items())
        count = max(one.count for one in next(iter(overall[rate].values())))
        note = f"Ego of {count} held-out scenarios; mean ± standard error over scenarios."
        tables.append(TextTable(f"Ours: {heading} ↑", ("", *CONDITIONS), cells, note))
    return tables


def _maneuver_tables(by_maneuver: ByManeuver, rows: Sequence[str]) -> list[TextTable]:
    """A table for each condition: rows by maneuvers, with the number of goals of each."""
    tables = []
    for condition in CONTAINS:
        counts = by_maneuver["passed", rows[0], condition]
        headings = (f"{m.value.replace('_', ' ')} ({counts[m].count})" for m in BENCHMARK_MANEUVERS)
        cells = []
        for row in rows:
            passed, reached = (by_maneuver[rate, row, condition] for rate in RATES)
            both = {m: f"{cell(passed[m])} / {cell(reached[m])}" for m in BENCHMARK_MANEUVERS if passed[m].count}
            cells.append((row, *(both.get(m, "–") for m in BENCHMARK_MANEUVERS)))
        title = f"Ours: {condition}, passed / reached [%] ↑ (goals)"
        tables.append(TextTable(title, ("", *headings), tuple(cells)))
    return tables


def _verdict(attained: Attainment, row: str, rate: str) -> str:
    """A variant against the goal-free model, alternatives only."""
    before, after = (_rates(attained, name, rate, ALTERNATIVE) for name in (START, row))
    gain, mean = controllability.paired_gain(before, after), estimate(before.values()).mean
    times = f" ({(mean + gain.mean) / mean:.2f} times)" if mean > 0 else ""
    rate = rate.replace("_", " ")
    return f"{row} against {START}, {rate}, alternatives only{times}: {controllability.gain_verdict(gain)}"


def _plain(rate: MeanInterval) -> dict[str, object]:
    names = ("mean", "standard_error", "interval", "count")
    return {name: getattr(rate, name) for name in names}


EXPERIMENT = Experiment(
    "Can the ego be given a maneuver as its goal, even one that it did not make?", run, summarize, needs_goals=True
)
