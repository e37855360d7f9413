"""Maneuvers as goals of the ego: the logged maneuver, an alternative that the lanes allow, or either."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rlftsim.evaluation.goal_attainment import Attained
from rlftsim.experiments.paper import controllability, published
from rlftsim.experiments.paper.controllability import RATES, ROWS, Attainment, Curves, estimate_mean, format_rate
from rlftsim.experiments.paper.goal_conditioning import GUIDED, START
from rlftsim.experiments.paper.maneuver_goals import NAME, find_goals, is_logged, parse_maneuver
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import TextTable
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS
from rlftsim.statistics import MeanInterval

GOAL_RATES = {"passed_once": "goals passed in some rollout [%]", "reached_once": "goals reached in some rollout [%]"}
"""Fractions of the goals (attributes of `Attained`), and their headings. The paper does not say how it counts
several rollouts of a goal; its percentages are those of whole goals."""
LOGGED, MIXED, ALTERNATIVE = "ground truth", "mixed", "alternative only"
IN_CONDITION: Mapping[str, Callable[[Attained], bool]] = {
    LOGGED: lambda outcome: is_logged(outcome.entry),
    ALTERNATIVE: lambda outcome: not is_logged(outcome.entry),
}
"""Tests of a goal being in a condition."""
CONDITIONS = (LOGGED, MIXED, ALTERNATIVE)
"""Mixed: the mean of a scenario's logged and its alternative goals."""
MANEUVERS = [maneuver.value for maneuver in BENCHMARK_MANEUVERS]


def run(suite: ExperimentSuite) -> Attainment:
    """Outcome of every goal, by row. The goals are proposed and written first, unless there is a goals file.

    Raises:
        DataError: No ego has two maneuvers, or the goals file was edited and makes no sense.
    """
    return controllability.measure_attainment(suite, ROWS, find_goals(suite), name=NAME)


def summarize(attained: Attainment, suite: ExperimentSuite) -> ExperimentResult:
    """Rates by condition and by maneuver, beside the paper's.

    Args:
        attained: Outcomes that `run` returned; the labels of the goals have the maneuvers.
        suite: Suite with the budget for the notes; no model is trained or evaluated here.
    """
    overall = {
        rate: controllability.estimate_curves(
            attained, CONDITIONS, lambda outcomes, c, rate=rate: _compute_rates(outcomes, rate, c).values()
        )
        for rate in (*RATES, *GOAL_RATES)
    }
    # Here the goal is the unit, not the scenario: a scenario has one goal of a maneuver or none.
    by_maneuver = {
        (rate, condition): controllability.estimate_curves(
            {row: tuple(filter(is_in, outcomes)) for row, outcomes in attained.items()},
            MANEUVERS,
            lambda outcomes, m, rate=rate: [getattr(a, rate) for a in outcomes if parse_maneuver(a.entry).value == m],
        )
        for rate in RATES
        for condition, is_in in IN_CONDITION.items()
    }
    # All rows have the same goals: maneuvers without any are not drawn.
    counted_rows = [by_maneuver["passed", condition][START] for condition in IN_CONDITION]
    drawn_maneuvers = [m for m in MANEUVERS if any(means[m].count for means in counted_rows)]
    panels = {
        f"{condition}, {RATES[rate].removesuffix(' [%]')}": {
            row: {m: curve[m] for m in drawn_maneuvers} for row, curve in curves.items()
        }
        for (rate, condition), curves in by_maneuver.items()
    }
    return ExperimentResult(
        title="Maneuver controllability: the ego's goal is its logged maneuver, or an alternative",
        tables=(
            *(
                controllability.build_rate_table(f"Ours: {heading} ↑", overall[rate])
                for rate, heading in (RATES | GOAL_RATES).items()
            ),
            *(
                _tabulate_maneuvers(condition, *(by_maneuver[rate, condition] for rate in RATES))
                for condition in IN_CONDITION
            ),
            published.load_table("maneuvers"),
        ),
        verdicts=tuple(_format_gain(attained, row, rate) for rate in (*RATES, "passed_once") for row in GUIDED),
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
            "conditions": _to_numbers(overall),
            "maneuvers": _to_numbers(
                {
                    rate: {row: {c: by_maneuver[rate, c][row] for c in IN_CONDITION} for row in attained}
                    for rate in RATES
                }
            ),
            "goals": [{"scenario": a.entry.scenario_id, "label": a.entry.label} for a in attained[START]],
        },
        figure=controllability.draw_rates(
            panels,
            title="Maneuvers as goals of the ego",
            x_label="",
            ticks=[m.replace("_", "\n") for m in drawn_maneuvers],
            is_joined=False,
        ),
    )


def _compute_rates(outcomes: Sequence[Attained], rate: str, condition: str) -> dict[str, float]:
    """Mean rate over the goals of a condition, by scenario."""
    if condition == MIXED:
        # Scenarios with goals in both conditions; half and half, however many goals each has.
        logged, alternative = (_compute_rates(outcomes, rate, name) for name in IN_CONDITION)
        return {i: (logged[i] + alternative[i]) / 2 for i in logged if i in alternative}
    return controllability.compute_scenario_rates(filter(IN_CONDITION[condition], outcomes), rate)


def _tabulate_maneuvers(condition: str, passed: Curves, reached: Curves) -> TextTable:
    """Table of a condition: rows by maneuvers, with the number of goals of each."""

    def format_cell(row: str, maneuver: str) -> str:
        if not passed[row][maneuver].count:
            return "–"
        return f"{format_rate(passed[row][maneuver])} / {format_rate(reached[row][maneuver])}"

    headings = (f"{m.replace('_', ' ')} ({mean.count})" for m, mean in passed[START].items())
    cells = tuple((row, *(format_cell(row, m) for m in MANEUVERS)) for row in passed)
    return TextTable(f"Ours: {condition}, passed / reached [%] ↑ (goals)", ("", *headings), cells)


def _format_gain(attained: Attainment, row: str, rate: str) -> str:
    """Verdict on a variant against the goal-free model, alternatives only."""
    start_rates, rates = (_compute_rates(attained[name], rate, ALTERNATIVE) for name in (START, row))
    start_mean, mean = (estimate_mean(values[i] for i in rates).mean for values in (start_rates, rates))
    factor = f" ({mean / start_mean:.2f} times)" if start_mean > 0 else ""
    verdict = controllability.format_verdict(start_rates, rates)
    return f"{row} against {START}, {rate.replace('_', ' ')}, alternatives only{factor}: {verdict}"


def _to_numbers(rates: Any) -> dict[str, Any]:
    """Nested mapping of mean rates with plain numbers as leaves."""
    if isinstance(rates, MeanInterval):
        return {name: getattr(rates, name) for name in ("mean", "standard_error", "interval", "count")}
    return {name: _to_numbers(branch) for name, branch in rates.items()}


EXPERIMENT = Experiment(
    "Can the ego be given a maneuver as its goal, even one that it did not make?", run, summarize, needs_goals=True
)
