"""The ego asked for manoeuvres: the recorded one, another one that the lanes allow, or either."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from rlftsim.errors import DataError
from rlftsim.experiments.attainment import Attained, held_out, measure_attainment
from rlftsim.experiments.catalogue import published
from rlftsim.experiments.catalogue.controllability import (
    SEED_NOTE,
    WAYS,
    bands_of,
    cell,
    contestants,
    estimate,
    gain_words,
    paired_gain,
    shares_by_scenario,
)
from rlftsim.experiments.catalogue.goal_conditioning import GUIDED, START
from rlftsim.experiments.findings import Experiment, Findings, TextTable, budget_note
from rlftsim.experiments.goal_proposals import RECORDED, entry_of, propose
from rlftsim.experiments.workshop import Workshop
from rlftsim.goals.goals_file import GoalEntry, GoalsFile, read_goals, write_goals
from rlftsim.goals.manoeuvre import Manoeuvre
from rlftsim.goals.placing import track_of
from rlftsim.intervals import MeanInterval
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.figure import Panel, draw_panels

NAME = "maneuver-controllability"
ONCE = {"passed_once": "goals passed in some rollout [%]", "reached_once": "goals reached in some rollout [%]"}
"""Shares of the goals. The paper does not say how it counts several rollouts of a goal; its shares are those of whole goals."""
IS_IN: dict[str, Callable[[Attained], bool]] = {
    "ground truth": lambda one: one.entry.label.endswith(RECORDED),
    "alternative only": lambda one: not one.entry.label.endswith(RECORDED),
}
MIXED, ALTERNATIVE = "mixed", "alternative only"
CONDITIONS = ("ground truth", MIXED, ALTERNATIVE)
"""Mixed: half of the goals of a scenario recorded, half alternative."""


@dataclass(frozen=True)
class Measured:
    """What became of every goal, by row."""

    attained: Mapping[str, tuple[Attained, ...]]


def goals_path(workshop: Workshop) -> Path:
    """The goals file of a workshop; a person may edit it."""
    return workshop.out / f"{NAME}.goals.json"


def propose_goals(dataset: ScenarioDataset, scenario_ids: Sequence[str]) -> GoalsFile:
    """Recorded and alternative manoeuvres of every ego that has both: the first are the goals, the others the alternatives."""
    recorded, alternatives = [], []
    for scenario_id in scenario_ids:
        scenario = dataset.by_id(scenario_id)
        proposals = propose(scenario, scenario.ego_index)
        kept = [entry_of(scenario, proposal) for proposal in proposals]
        is_recorded = [proposal.is_recorded for proposal in proposals]
        if any(is_recorded) and not all(is_recorded):
            recorded += [entry for entry, yes in zip(kept, is_recorded) if yes]
            alternatives += [entry for entry, yes in zip(kept, is_recorded) if not yes]
    return GoalsFile(tuple(recorded), tuple(alternatives))


def measure(workshop: Workshop) -> Measured:
    """Everybody's attainment of every goal.

    Raises:
        DataError: no ego has two manoeuvres to choose from, or the goals file was edited and makes no sense.
    """
    dataset, ids = held_out(workshop)
    path = goals_path(workshop)
    if not path.exists():
        write_goals(path, propose_goals(dataset, ids))
    file = read_goals(path)
    goals = [goal for goal in (*file.goals, *file.alternatives) if goal.scenario_id in ids]
    for goal in goals:
        _manoeuvre(goal.label, str(goal))
        _require_ego(goal, dataset.by_id(goal.scenario_id))
    if all(goal.label.endswith(RECORDED) for goal in goals):
        raise DataError(
            f"{path}: not one ego of {len(ids)} scenarios may do anything but what it did: take more scenarios."
        )
    return Measured(measure_attainment(workshop, contestants(), goals, name=NAME))


def conclude(measured: Measured, workshop: Workshop) -> Findings:
    """Shares by condition and by manoeuvre, beside the paper's."""
    rows = list(measured.attained)
    overall = {way: {row: _by_condition(measured, row, way) for row in rows} for way in (*WAYS, *ONCE)}
    return Findings(
        title="Manoeuvre controllability: the ego is asked for what it did, or for something else",
        tables=(
            *(_condition_table(title, overall[way]) for way, title in (WAYS | ONCE).items()),
            *(_manoeuvre_table(measured, condition) for condition in IS_IN),
            published.MANOEUVRES,
        ),
        verdicts=tuple(_verdict(measured, row, way) for way in (*WAYS, "passed_once") for row in GUIDED),
        notes=(
            budget_note(workshop),
            SEED_NOTE,
            f"The goals are in {NAME}.goals.json beside this table: recorded manoeuvres with their recorded ends, alternatives as the lanes propose them. "
            "Edit them, and the same command measures the edited ones.",
            "Only the ego has a goal, and only scenarios count in which it has a recorded and an alternative manoeuvre. Every goal is "
            "given alone; mixed is half the one, half the other.",
            "Lights, signs and other agents are not looked at when goals are proposed: some cannot be met without a violation.",
        ),
        numbers={
            "conditions": {way: {row: {c: _plain(m) for c, m in zip(CONDITIONS, overall[way][row])} for row in rows} for way in overall},
            "manoeuvres": {way: {row: {c: {m.value: _plain(e) for m, e in _by_manoeuvre(measured, row, way, c).items()} for c in IS_IN} for row in rows} for way in WAYS},
            "goals": [{"scenario": one.entry.scenario_id, "label": one.entry.label} for one in measured.attained[rows[0]]],
        },
        figure=_figure(measured, rows),
    )  # fmt: skip


def _manoeuvre(label: str, place: str) -> Manoeuvre:
    """The manoeuvre that a label names.

    Raises:
        DataError: it names none.
    """
    try:
        return Manoeuvre(label.removesuffix(RECORDED))
    except ValueError:
        known = ", ".join(m.value for m in Manoeuvre)
        raise DataError(f"{place}: label {label!r} names no manoeuvre: known are {known}, each with {RECORDED!r} if recorded.") from None  # fmt: skip


def _require_ego(goal: GoalEntry, scenario: Scenario) -> None:
    """Refuse goals of others.

    Raises:
        DataError: another agent is asked, or the goal is impossible.
    """
    if track_of(goal, scenario) != scenario.ego_index:
        ego = int(scenario.tracks.object_id[scenario.ego_index])
        raise DataError(
            f"{goal}: agent {goal.agent_id} is not the ego of scenario {scenario.scenario_id}, only the ego is asked here: "
            f"write agent {ego}, or remove the entry."
        )


def _shares(measured: Measured, row: str, way: str, condition: str) -> dict[str, float]:
    """Mean share of the rollouts over a scenario's goals of a condition, by scenario."""
    if condition == MIXED:
        one, other = (_shares(measured, row, way, name) for name in IS_IN)
        return {scenario_id: (one[scenario_id] + other[scenario_id]) / 2 for scenario_id in one if scenario_id in other}
    return shares_by_scenario(filter(IS_IN[condition], measured.attained[row]), way)


def _by_condition(measured: Measured, row: str, way: str) -> list[MeanInterval]:
    return [estimate(_shares(measured, row, way, c).values()) for c in CONDITIONS]


def _by_manoeuvre(measured: Measured, row: str, way: str, condition: str) -> dict[Manoeuvre, MeanInterval]:
    values: dict[Manoeuvre, list[float]] = {m: [] for m in Manoeuvre}
    for one in measured.attained[row]:
        if IS_IN[condition](one):
            values[_manoeuvre(one.entry.label, str(one.entry))].append(getattr(one, way))
    return {m: estimate(own) for m, own in values.items()}


def _condition_table(title: str, rows: Mapping[str, Sequence[MeanInterval]]) -> TextTable:
    cells = tuple((row, *(cell(share) for share in shares)) for row, shares in rows.items())
    counts = [share.count for share in next(iter(rows.values()))]
    note = f"Ego of {max(counts)} held-out scenarios; mean ± standard error over scenarios."
    return TextTable(f"Ours: {title} ↑", ("", *CONDITIONS), cells, note)


def _manoeuvre_table(measured: Measured, condition: str) -> TextTable:
    """Passed and reached for each manoeuvre."""
    cells = []
    for row in measured.attained:
        passed, reached = (_by_manoeuvre(measured, row, way, condition) for way in WAYS)
        cells.append((row, *(f"{cell(passed[m])} / {cell(reached[m])}" if passed[m].count else "–" for m in Manoeuvre)))
    counts = _by_manoeuvre(measured, next(iter(measured.attained)), "passed", condition)
    headings = ("", *(f"{m.value.replace('_', ' ')} ({counts[m].count})" for m in Manoeuvre))
    return TextTable(f"Ours: {condition}, passed / reached [%] ↑ (goals)", headings, tuple(cells))


def _verdict(measured: Measured, row: str, way: str) -> str:
    """A variant against the model without goals, alternatives only."""
    before, after = (_shares(measured, name, way, ALTERNATIVE) for name in (START, row))
    gain, mean = paired_gain(before, after), estimate(before.values()).mean
    times = f" ({(mean + gain.mean) / mean:.2f} times)" if mean > 0 else ""
    return f"{row} against {START}, {way.replace('_', ' ')}, alternatives only{times}: {gain_words(gain)}"


def _plain(share: MeanInterval) -> dict[str, object]:
    return {"mean": share.mean, "standard_error": share.standard_error, "interval": share.interval, "count": share.count}  # fmt: skip


def _figure(measured: Measured, rows: Sequence[str]) -> Figure:
    """Conditions side by side, both ways below each other, manoeuvres along the axis."""
    shown = [m for m in Manoeuvre if any(_by_manoeuvre(measured, rows[0], "passed", c)[m].count for c in IS_IN)]
    panels = []
    for way, label in WAYS.items():
        for condition in IS_IN:
            curves = {row: [_by_manoeuvre(measured, row, way, condition)[m] for m in shown] for row in rows}
            panels.append(Panel(f"{condition}, {label.removesuffix(' [%]')}", bands_of(curves)))
    ticks = [m.value.replace("_", "\n") for m in shown]
    return draw_panels(
        panels, title="The ego asked for manoeuvres", x_label="", y_label="rollouts [%], 95 % interval", ticks=ticks,
        columns=len(IS_IN), is_joined=False,
    )  # fmt: skip


EXPERIMENT = Experiment(
    question="Can the ego be asked for a manoeuvre, even for one that it did not make?",
    measure=measure,
    conclude=conclude,
)
