"""Goals of the ego earlier or later on its recorded way than where the record ends."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from rlftsim.errors import DataError
from rlftsim.experiments.attainment import Attained, held_out, measure_attainment
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
from rlftsim.experiments.workshop import Workshop
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.intervals import MeanInterval
from rlftsim.scenario.types import STEP_S, TOTAL_STEPS, Scenario
from rlftsim.viewer.figure import Panel, draw_panels

NAME = "kinematic-controllability"
OFFSETS_S = (-3, -2, -1, 0, 1, 2, 3)
"""The paper's H: where the recorded ego was that much before the end, or would have been that much after it."""
LAST_STEP = TOTAL_STEPS - 1
YAW_RATE_STEPS = 5
"""Steps over which the turn rate at the end is read off the record."""
MAX_CURVATURE_PER_M = 0.2
"""A car turns no tighter, however its recorded heading jitters."""


@dataclass(frozen=True)
class Measured:
    """What became of every goal, by row; offsets in the order of the goals."""

    offsets_s: tuple[int, ...]
    attained: Mapping[str, tuple[Attained, ...]]


def goal_of(scenario: Scenario, offset_s: int) -> GoalEntry | None:
    """Where the recorded ego was, or would be at constant speed and steering; None where the record does not say."""
    tracks, ego = scenario.tracks, scenario.ego_index
    step = LAST_STEP + min(offset_s, 0) * round(1 / STEP_S)
    if not scenario.has_future or not tracks.valid[ego, step]:
        return None
    position = tracks.position[ego, step, :2].astype(np.float64)
    if offset_s > 0:
        position = position + _carried_on(scenario, offset_s)
    label = f"{offset_s:+d} s"
    return GoalEntry(scenario.scenario_id, int(tracks.object_id[ego]), float(position[0]), float(position[1]), label)


def _carried_on(scenario: Scenario, seconds: int) -> Float[np.ndarray, "2"]:
    """Way of the ego after the record's end by a bicycle model whose speed and steering stay: an arc."""
    tracks, ego = scenario.tracks, scenario.ego_index
    speed = float(np.linalg.norm(tracks.velocity[ego, LAST_STEP]))
    heading = np.unwrap(tracks.heading[ego, LAST_STEP - YAW_RATE_STEPS : LAST_STEP + 1].astype(np.float64))
    is_whole = tracks.valid[ego, LAST_STEP - YAW_RATE_STEPS : LAST_STEP + 1].all()
    turn_rate = (heading[-1] - heading[0]) / (YAW_RATE_STEPS * STEP_S) if is_whole else 0.0
    turn_rate = float(np.clip(turn_rate, -MAX_CURVATURE_PER_M * speed, MAX_CURVATURE_PER_M * speed))
    half_turn = turn_rate * seconds / 2
    chord, direction = speed * seconds * np.sinc(half_turn / np.pi), heading[-1] + half_turn
    return chord * np.array([np.cos(direction), np.sin(direction)])


def measure(workshop: Workshop) -> Measured:
    """Everybody's attainment of every goal.

    Raises:
        DataError: not one scenario has an ego that is recorded to the end.
    """
    dataset, ids = held_out(workshop)
    asked = [(h, goal_of(dataset.by_id(i), h)) for i in ids for h in OFFSETS_S]
    found = [(h, goal) for h, goal in asked if goal is not None]
    if not found:
        raise DataError(f"{workshop.data}: the ego of not one of {len(ids)} scenarios is recorded to the end.")
    goals = [goal for _, goal in found]
    return Measured(tuple(h for h, _ in found), measure_attainment(workshop, contestants(), goals, name=NAME))


def conclude(measured: Measured, workshop: Workshop) -> Findings:
    """Shares against the offset, and the verdicts at its ends."""
    curves = {way: {row: _curve(measured, row, way) for row in measured.attained} for way in WAYS}
    return Findings(
        title="Kinematic controllability: the ego is asked to be there earlier or later",
        tables=tuple(_table(way, curves[way]) for way in WAYS),
        verdicts=tuple(_verdict(measured, row, way) for way in WAYS for row in GUIDED),
        notes=(
            budget_note(workshop),
            SEED_NOTE,
            "H < 0: where the recorded ego was at that time before the end; H > 0: where it would be if speed and steering stayed. Only the "
            "ego has a goal. Passed: within 2 m at any time, reached: within 2 m after 8 s.",
            "A model that sees no goals is measured against them all the same: what it attains, it attains by chance or because it is right.",
            "The paper shows this as curves without numbers: its hard variants lie above its reference model at every H, "
            "concatenation above indication.",
        ),
        numbers={
            way: {row: [{"offset_s": h, "mean": m.mean, "interval": m.interval, "scenarios": m.count} for h, m in zip(OFFSETS_S, curve)] for row, curve in curves[way].items()}
            for way in WAYS
        },
        figure=_figure(curves),
    )  # fmt: skip


def _shares(measured: Measured, row: str, way: str, offsets_s: Sequence[int]) -> dict[str, float]:
    """Shares of the rollouts by scenario at some offsets."""
    chosen = (one for h, one in zip(measured.offsets_s, measured.attained[row]) if h in offsets_s)
    return shares_by_scenario(chosen, way)


def _curve(measured: Measured, row: str, way: str) -> list[MeanInterval]:
    return [estimate(_shares(measured, row, way, (h,)).values()) for h in OFFSETS_S]


def _table(way: str, curves: Mapping[str, Sequence[MeanInterval]]) -> TextTable:
    rows = tuple((row, *(cell(share) for share in curve)) for row, curve in curves.items())
    count = max(m.count for curve in curves.values() for m in curve)
    headings = ("", *(f"{h:+d} s" for h in OFFSETS_S))
    note = f"Ego of {count} held-out scenarios; share of rollouts, mean ± standard error over scenarios."
    return TextTable(f"Ours: {WAYS[way]} ↑ against H", headings, rows, note)


def _verdict(measured: Measured, row: str, way: str) -> str:
    """A variant against the model without goals, over all offsets but 0, scenario by scenario."""
    before, after = (_shares(measured, name, way, [h for h in OFFSETS_S if h]) for name in (START, row))
    return f"{row} against {START}, {way}, H ≠ 0: {gain_words(paired_gain(before, after))}"


def _figure(curves: Mapping[str, Mapping[str, Sequence[MeanInterval]]]) -> Figure:
    panels = tuple(Panel(WAYS[way], bands_of(curves[way])) for way in WAYS)
    ticks = [f"{h:+d}" for h in OFFSETS_S]
    return draw_panels(
        panels, title="The ego asked to be there earlier or later", x_label="H [s]", y_label="rollouts [%], 95 % interval",
        ticks=ticks, columns=2,
    )  # fmt: skip


EXPERIMENT = Experiment(
    question="Can the ego be asked to be earlier or later on its way than it was?", measure=measure, conclude=conclude
)
