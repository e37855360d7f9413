"""Maneuvers as goals of the ego: the logged maneuver, an alternative that the lanes allow, or either.

The goals are in an editable file: logged and alternative maneuvers of egos that have both.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rlftsim.errors import DataError
from rlftsim.evaluation.goal_attainment import Attained
from rlftsim.experiments.goal_proposals import LOGGED, propose, split_label, to_goal_entry
from rlftsim.experiments.paper import controllability
from rlftsim.experiments.paper.controllability import RATES, ROWS, Attainment, Curves, estimate_mean, format_rate
from rlftsim.experiments.paper.goal_conditioning import GUIDED, START
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import TextTable, load_published
from rlftsim.goals.goals_file import GoalEntry, GoalsFile, read_goals, write_goals
from rlftsim.goals.placement import find_track
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS, Maneuver
from rlftsim.statistics import MeanInterval

NAME = "maneuver-controllability"
GOAL_RATES = {"passed_once": "goals passed in some rollout [%]", "reached_once": "goals reached in some rollout [%]"}
"""Fractions of the goals (attributes of `Attained`), and their headings. The paper does not say how it counts
several rollouts of a goal; its percentages are those of whole goals."""
GROUND_TRUTH, MIXED, ALTERNATIVE = "ground truth", "mixed", "alternative only"
IN_CONDITION: Mapping[str, Callable[[Attained], bool]] = {
    GROUND_TRUTH: lambda outcome: is_logged(outcome.entry),
    ALTERNATIVE: lambda outcome: not is_logged(outcome.entry),
}
"""Tests of a goal being in a condition."""
CONDITIONS = (GROUND_TRUTH, MIXED, ALTERNATIVE)
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
            load_published("maneuvers"),
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


def goals_path(suite: ExperimentSuite) -> Path:
    """Path of a suite's goals file, which may be edited by hand."""
    return suite.out / f"{NAME}.goals.json"


def propose_goals(dataset: ScenarioDataset, scenario_ids: Sequence[str]) -> GoalsFile:
    """Logged and alternative maneuvers of every ego that has both. The logged maneuvers are the file's goals.

    Args:
        dataset: Scenarios with logged futures.
        scenario_ids: Ids of the scenarios to propose goals for, in the order of the file.
    """
    logged, alternatives = [], []
    for scenario_id in scenario_ids:
        scenario = dataset.by_id(scenario_id)
        proposals = propose(scenario, scenario.ego_index)
        # An ego without an alternative, or whose logged maneuver has no name, cannot be compared with itself.
        if {proposal.is_logged for proposal in proposals} == {True, False}:
            for proposal in proposals:
                (logged if proposal.is_logged else alternatives).append(to_goal_entry(scenario, proposal))
    return GoalsFile(tuple(logged), tuple(alternatives))


def find_goals(suite: ExperimentSuite) -> list[GoalEntry]:
    """Goals of the suite's held-out scenarios from the suite's goals file, which is written first if there is none.

    Raises:
        DataError: No ego has two maneuvers, or the file was edited and makes no sense.
    """
    dataset, ids = controllability.open_held_out(suite)
    path = goals_path(suite)
    # 1. Goals are proposed once: the file may have been edited since.
    if not path.exists():
        write_goals(path, propose_goals(dataset, ids))
    file = read_goals(path)
    goals = [goal for goal in (*file.goals, *file.alternatives) if goal.scenario_id in ids]
    # 2. All of them are checked, before anything is trained.
    for goal in goals:
        parse_maneuver(goal)
        scenario = dataset.by_id(goal.scenario_id)
        if find_track(goal, scenario) != scenario.ego_index:
            raise DataError(
                f"{goal}: agent {goal.agent_id} is not the ego of scenario {scenario.scenario_id}, and only the ego "
                f"may have a goal here: write agent {scenario.tracks.object_id[scenario.ego_index]}, or remove the "
                "entry."
            )
    if all(is_logged(goal) for goal in goals):
        raise DataError(
            f"{path}: not one ego of {len(ids)} scenarios has an alternative maneuver: take more scenarios."
        )
    return goals


def is_logged(goal: GoalEntry) -> bool:
    """True if the goal's maneuver is the logged maneuver."""
    return split_label(goal.label)[1]


def parse_maneuver(goal: GoalEntry) -> Maneuver:
    """Maneuver that a goal's label names.

    Raises:
        DataError: The label names no maneuver.
    """
    try:
        return Maneuver(split_label(goal.label)[0])
    except ValueError:
        maneuvers = ", ".join(m.value for m in BENCHMARK_MANEUVERS)
        raise DataError(
            f"{goal}: label {goal.label!r} names no maneuver: known are {maneuvers}, each with {LOGGED!r} if it "
            "is the logged one."
        ) from None


EXPERIMENT = Experiment(
    "Can the ego be given a maneuver as its goal, even one that it did not make?", run, summarize, needs_goals=True
)
