"""Goals of the ego on its logged path, earlier or later than its logged endpoint."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from rlftsim.errors import DataError
from rlftsim.evaluation.goal_attainment import Attained
from rlftsim.experiments.paper import controllability
from rlftsim.experiments.paper.controllability import RATES, Attainment, estimate
from rlftsim.experiments.paper.goal_conditioning import GUIDED, START
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.suite_goals import held_out
from rlftsim.experiments.tables import TextTable
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.scenario.types import STEP_S, TOTAL_STEPS, Scenario
from rlftsim.statistics import MeanInterval
from rlftsim.viewer.figure import Subplot, draw_subplots

NAME = "kinematic-controllability"
OFFSETS_S = (-3, -2, -1, 0, 1, 2, 3)
"""The paper's H: the ego's logged position that much before the end, or its extrapolated one that much after it."""
LAST_STEP = TOTAL_STEPS - 1
YAW_RATE_STEPS = 5
"""Steps at the end of the log from which the yaw rate is estimated."""
MAX_CURVATURE_PER_M = 0.2
"""A car turns no tighter, however its logged heading jitters."""


def goal_of(scenario: Scenario, offset_s: int) -> GoalEntry | None:
    """The ego's logged position, or its extrapolation at constant speed and steering; None where the log has neither.

    Args:
        scenario: with its future.
        offset_s: seconds after the end of the log; negative ones lie before it.
    """
    tracks, ego = scenario.tracks, scenario.ego_index
    # Up to the end of the log its own positions; after it an extrapolation from the last one.
    step = LAST_STEP + min(offset_s, 0) * round(1 / STEP_S)
    if not scenario.has_future or not tracks.valid[ego, step]:
        return None
    position = tracks.position[ego, step, :2].astype(np.float64)
    if offset_s > 0:
        position = position + _extrapolated_way(scenario, offset_s)
    return GoalEntry(scenario.scenario_id, int(tracks.object_id[ego]), *map(float, position), label=_label(offset_s))


def _label(offset_s: int) -> str:
    return f"{offset_s:+d} s"


def _extrapolated_way(scenario: Scenario, seconds: int) -> Float[np.ndarray, "2"]:
    """Displacement of the ego after the end of the log by a bicycle model of constant speed and steering:
    along an arc."""
    tracks, ego = scenario.tracks, scenario.ego_index
    last = slice(LAST_STEP - YAW_RATE_STEPS, LAST_STEP + 1)
    speed = float(np.linalg.norm(tracks.velocity[ego, LAST_STEP]))
    heading = np.unwrap(tracks.heading[ego, last].astype(np.float64))
    is_whole = tracks.valid[ego, last].all()
    yaw_rate = (heading[-1] - heading[0]) / (YAW_RATE_STEPS * STEP_S) if is_whole else 0.0
    # The logged heading of a standing car jitters; an unbounded rate would turn it on the spot.
    yaw_rate = float(np.clip(yaw_rate, -MAX_CURVATURE_PER_M * speed, MAX_CURVATURE_PER_M * speed))
    # The chord of an arc has the length 2 r sin(half the turn) and points half the turn aside. np.sinc(x) is
    # sin(pi x) / (pi x), which also holds for a straight line.
    half_turn = yaw_rate * seconds / 2
    chord, direction = speed * seconds * np.sinc(half_turn / np.pi), heading[-1] + half_turn
    return chord * np.array([np.cos(direction), np.sin(direction)])


def run(suite: ExperimentSuite) -> dict[str, tuple[Attained, ...]]:
    """Outcome of every goal, by row.

    Raises:
        DataError: there is no scenario whose ego is logged to the end.
    """
    dataset, ids = held_out(suite)
    goals = [goal for i in ids for h in OFFSETS_S if (goal := goal_of(dataset.by_id(i), h)) is not None]
    if not goals:
        raise DataError(f"{suite.data}: the ego of not one of {len(ids)} scenarios is logged to the end.")
    return controllability.attain(suite, goals, NAME)


def summarize(attained: Attainment, suite: ExperimentSuite) -> ExperimentResult:
    """Rates against the offset, and verdicts over all offsets but 0.

    Args:
        attained: of `run`; the labels of the goals have the offsets.
        suite: for the notes.
    """
    curves = {
        rate: {row: [estimate(_rates(attained, row, rate, h).values()) for h in OFFSETS_S] for row in attained}
        for rate in RATES
    }
    others = tuple(h for h in OFFSETS_S if h)
    verdicts = []
    for rate in RATES:
        before = _rates(attained, START, rate, *others)
        for row in GUIDED:
            gain = controllability.paired_gain(before, _rates(attained, row, rate, *others))
            verdicts.append(f"{row} against {START}, {rate}, H ≠ 0: {controllability.gain_verdict(gain)}")
    return ExperimentResult(
        title="Kinematic controllability: goals of the ego that it would pass earlier or later",
        tables=tuple(_table(heading, curves[rate]) for rate, heading in RATES.items()),
        verdicts=tuple(verdicts),
        notes=(
            suite.budget.note,
            controllability.SEED_NOTE,
            "H < 0: the ego's logged position that long before the end; H > 0: its extrapolation at constant speed and "
            "steering. Only the ego has a goal. Passed: within 2 m at any time, reached: within 2 m after 8 s.",
            "A model without goal conditioning is measured against the same goals: those that it attains, it attains "
            "by chance or because it predicts well.",
            "The paper shows this as curves without numbers: its hard variants lie above its reference model at "
            "every H, concatenation above indication.",
        ),
        numbers={
            rate: {
                row: [
                    {"offset_s": h, "mean": m.mean, "interval": m.interval, "scenarios": m.count}
                    for h, m in zip(OFFSETS_S, curve)
                ]
                for row, curve in curves[rate].items()
            }
            for rate in RATES
        },
        figure=draw_subplots(
            tuple(Subplot(heading, controllability.bands_of(curves[rate])) for rate, heading in RATES.items()),
            title="Goals of the ego, earlier or later on its path",
            x_label="H [s]",
            y_label="rollouts [%], 95 % interval",
            ticks=[f"{h:+d}" for h in OFFSETS_S],
            columns=2,
        ),
    )


def _rates(attained: Attainment, row: str, rate: str, *offsets_s: int) -> dict[str, float]:
    """Mean rate over the goals with some offsets, by scenario."""
    labels = {_label(h) for h in offsets_s}
    return controllability.rates_by_scenario((one for one in attained[row] if one.entry.label in labels), rate)


def _table(heading: str, curves: Mapping[str, list[MeanInterval]]) -> TextTable:
    rows = tuple((row, *map(controllability.cell, curve)) for row, curve in curves.items())
    count = max(m.count for curve in curves.values() for m in curve)
    note = f"Ego of {count} held-out scenarios; percentage of rollouts, mean ± standard error over scenarios."
    return TextTable(f"Ours: {heading} ↑ against H", ("", *map(_label, OFFSETS_S)), rows, note)


EXPERIMENT = Experiment(
    "Can the ego be given goals that lie earlier or later on its path than its logged endpoint?",
    run,
    summarize,
    needs_goals=True,
)
