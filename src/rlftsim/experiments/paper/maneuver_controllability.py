"""Maneuvers as goals of the ego: the logged maneuver, an alternative that the lanes allow, or either."""

from collections.abc import Callable, Mapping, Sequence

from rlftsim.evaluation.goal_attainment import Attained
from rlftsim.experiments.paper import controllability, published
from rlftsim.experiments.paper.controllability import RATES, ROWS, Attainment, estimate_mean, format_rate
from rlftsim.experiments.paper.goal_conditioning import GUIDED, START
from rlftsim.experiments.paper.maneuver_goals import NAME, find_goals, is_logged, parse_maneuver
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import TextTable
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS, Maneuver
from rlftsim.statistics import MeanInterval
from rlftsim.viewer.figure import Subplot, draw_subplots

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
ByManeuver = Mapping[tuple[str, str, str], Mapping[Maneuver, MeanInterval]]
"""Mean rate of each maneuver, by rate, row and condition."""


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
    rows = list(attained)
    overall = {
        rate: {
            row: [estimate_mean(_compute_rates(attained[row], rate, c).values()) for c in CONDITIONS] for row in rows
        }
        for rate in (*RATES, *GOAL_RATES)
    }
    by_maneuver: ByManeuver = {
        # Here the goal is the unit, not the scenario: a scenario has one goal of a maneuver or none.
        (rate, row, condition): {
            m: estimate_mean(getattr(a, rate) for a in filter(is_in, attained[row]) if parse_maneuver(a.entry) == m)
            for m in BENCHMARK_MANEUVERS
        }
        for rate in RATES
        for row in rows
        for condition, is_in in IN_CONDITION.items()
    }
    # All rows have the same goals: maneuvers without any are not drawn.
    drawn_maneuvers = [
        m for m in BENCHMARK_MANEUVERS if any(by_maneuver["passed", rows[0], c][m].count for c in IN_CONDITION)
    ]
    subplots = [
        Subplot(
            f"{condition}, {heading.removesuffix(' [%]')}",
            controllability.build_bands(
                {row: [by_maneuver[rate, row, condition][m] for m in drawn_maneuvers] for row in rows}
            ),
        )
        for rate, heading in RATES.items()
        for condition in IN_CONDITION
    ]
    return ExperimentResult(
        title="Maneuver controllability: the ego's goal is its logged maneuver, or an alternative",
        tables=(
            *(
                controllability.build_rate_table(f"Ours: {heading} ↑", CONDITIONS, overall[rate])
                for rate, heading in (RATES | GOAL_RATES).items()
            ),
            *_tabulate_maneuvers(by_maneuver, rows),
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
            "conditions": {
                rate_name: {
                    row: {c: _to_numbers(rate) for c, rate in zip(CONDITIONS, rates)} for row, rates in by_row.items()
                }
                for rate_name, by_row in overall.items()
            },
            "maneuvers": {
                rate: {
                    row: {
                        c: {m.value: _to_numbers(mean) for m, mean in by_maneuver[rate, row, c].items()}
                        for c in IN_CONDITION
                    }
                    for row in rows
                }
                for rate in RATES
            },
            "goals": [{"scenario": a.entry.scenario_id, "label": a.entry.label} for a in attained[rows[0]]],
        },
        figure=draw_subplots(
            subplots,
            title="Maneuvers as goals of the ego",
            x_label="",
            y_label="rollouts [%], 95 % interval",
            ticks=[m.value.replace("_", "\n") for m in drawn_maneuvers],
            columns=len(IN_CONDITION),
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


def _tabulate_maneuvers(by_maneuver: ByManeuver, rows: Sequence[str]) -> list[TextTable]:
    """A table for each condition: rows by maneuvers, with the number of goals of each."""

    def format_cell(row: str, condition: str, maneuver: Maneuver) -> str:
        passed, reached = (by_maneuver[rate, row, condition][maneuver] for rate in RATES)
        return f"{format_rate(passed)} / {format_rate(reached)}" if passed.count else "–"

    tables = []
    for condition in IN_CONDITION:
        counts = by_maneuver["passed", rows[0], condition]
        headings = (f"{m.value.replace('_', ' ')} ({counts[m].count})" for m in BENCHMARK_MANEUVERS)
        cells = tuple((row, *(format_cell(row, condition, m) for m in BENCHMARK_MANEUVERS)) for row in rows)
        title = f"Ours: {condition}, passed / reached [%] ↑ (goals)"
        tables.append(TextTable(title, ("", *headings), cells))
    return tables


def _format_gain(attained: Attainment, row: str, rate: str) -> str:
    """Verdict on a variant against the goal-free model, alternatives only."""
    start_rates, rates = (_compute_rates(attained[name], rate, ALTERNATIVE) for name in (START, row))
    start_mean, mean = (estimate_mean(values[i] for i in rates).mean for values in (start_rates, rates))
    factor = f" ({mean / start_mean:.2f} times)" if start_mean > 0 else ""
    verdict = controllability.format_verdict(start_rates, rates)
    return f"{row} against {START}, {rate.replace('_', ' ')}, alternatives only{factor}: {verdict}"


def _to_numbers(rate: MeanInterval) -> dict[str, object]:
    return {name: getattr(rate, name) for name in ("mean", "standard_error", "interval", "count")}


EXPERIMENT = Experiment(
    "Can the ego be given a maneuver as its goal, even one that it did not make?", run, summarize, needs_goals=True
)
