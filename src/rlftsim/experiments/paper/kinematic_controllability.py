"""Goals of the ego on the logged path, earlier or later than the logged endpoint."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rlftsim.errors import DataError
from rlftsim.evaluation.goal_attainment import Attained
from rlftsim.experiments.paper import controllability
from rlftsim.experiments.paper.controllability import RATES, ROWS, Attainment
from rlftsim.experiments.paper.goal_conditioning import GUIDED, START
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.scenario.types import STEP_S, TOTAL_STEPS, Scenario

NAME = "kinematic-controllability"
OFFSETS_S = (-3, -2, -1, 0, 1, 2, 3)
"""The paper's H: the ego's logged position that much before the end, or its extrapolated one that much after it."""
LAST_STEP = TOTAL_STEPS - 1
YAW_RATE_STEPS = 5
"""Steps at the end of the log from which the yaw rate is estimated."""
MAX_CURVATURE_PER_M = 0.2
"""A car turns no tighter, however its logged heading jitters."""


def find_goal(scenario: Scenario, offset_s: int) -> GoalEntry | None:
    """Logged position of the ego, or an extrapolation at constant speed and steering; None where the log has neither.

    Args:
        scenario: Scenario with a logged future; without a future there is no goal.
        offset_s: Seconds after the end of the log; negative seconds lie before the end.
    """
    tracks, ego = scenario.tracks, scenario.ego_index
    # Up to the end of the log its own positions; after it an extrapolation from the last one.
    step = LAST_STEP + min(offset_s, 0) * round(1 / STEP_S)
    if not scenario.has_future or not tracks.valid[ego, step]:
        return None
    position = tracks.position[ego, step, :2].astype(np.float64)
    if offset_s > 0:
        position = position + _extrapolate_ego(scenario, offset_s)
    return GoalEntry(scenario.scenario_id, int(tracks.object_id[ego]), *map(float, position), label=f"{offset_s:+d} s")


def _extrapolate_ego(scenario: Scenario, seconds: int) -> Float[np.ndarray, "2"]:
    """Displacement of the ego after the end of the log by a bicycle model of constant speed and steering: an arc."""
    tracks, ego = scenario.tracks, scenario.ego_index
    last_steps = slice(LAST_STEP - YAW_RATE_STEPS, LAST_STEP + 1)
    speed = float(np.linalg.norm(tracks.velocity[ego, LAST_STEP]))
    heading = np.unwrap(tracks.heading[ego, last_steps].astype(np.float64))
    is_logged = tracks.valid[ego, last_steps].all()
    yaw_rate = (heading[-1] - heading[0]) / (YAW_RATE_STEPS * STEP_S) if is_logged else 0.0
    # The logged heading of a standing car jitters; an unbounded rate would turn it on the spot.
    yaw_rate = float(np.clip(yaw_rate, -MAX_CURVATURE_PER_M * speed, MAX_CURVATURE_PER_M * speed))
    # The chord of an arc has the length 2 r sin(half the turn) and points half the turn aside. np.sinc(x) is
    # sin(pi x) / (pi x), which also holds for a straight line.
    half_turn = yaw_rate * seconds / 2
    chord, direction = speed * seconds * np.sinc(half_turn / np.pi), heading[-1] + half_turn
    return chord * np.array([np.cos(direction), np.sin(direction)])


def run(suite: ExperimentSuite) -> Attainment:
    """Outcome of every goal, by row.

    Raises:
        DataError: No scenario's ego is logged to the end.
    """
    dataset, ids = controllability.open_held_out(suite)
    goals = [goal for i in ids for h in OFFSETS_S if (goal := find_goal(dataset.by_id(i), h)) is not None]
    if not goals:
        raise DataError(f"{suite.data}: the ego of not one of {len(ids)} scenarios is logged to the end.")
    return controllability.measure_attainment(suite, ROWS, goals, name=NAME)


def summarize(attained: Attainment, suite: ExperimentSuite) -> ExperimentResult:
    """Rates against the offset, and verdicts over all offsets but 0.

    Args:
        attained: Outcomes that `run` returned; the labels of the goals have the offsets.
        suite: Suite with the budget for the notes; no model is trained or evaluated here.
    """

    labels = {f"{h:+d} s": h for h in OFFSETS_S}

    def compute_rates(outcomes: Sequence[Attained], rate: str, *compared: str) -> dict[str, float]:
        return controllability.compute_scenario_rates((a for a in outcomes if a.entry.label in compared), rate)

    curves, verdicts = {}, []
    for rate in RATES:
        curves[rate] = controllability.estimate_curves(
            attained, labels, lambda outcomes, label, rate=rate: compute_rates(outcomes, rate, label).values()
        )
        moved_labels = [label for label, h in labels.items() if h]
        start_rates, *rates = (compute_rates(attained[row], rate, *moved_labels) for row in (START, *GUIDED))
        for row, row_rates in zip(GUIDED, rates):
            verdict = controllability.format_verdict(start_rates, row_rates)
            verdicts.append(f"{row} against {START}, {rate}, H ≠ 0: {verdict}")
    return ExperimentResult(
        title="Kinematic controllability: goals of the ego that it would pass earlier or later",
        tables=tuple(
            controllability.build_rate_table(f"Ours: {heading} ↑ against H", curves[rate], "percentage of rollouts, ")
            for rate, heading in RATES.items()
        ),
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
                    {"offset_s": labels[label], "mean": m.mean, "interval": m.interval, "scenarios": m.count}
                    for label, m in curve.items()
                ]
                for row, curve in by_row.items()
            }
            for rate, by_row in curves.items()
        },
        figure=controllability.draw_rates(
            {heading: curves[rate] for rate, heading in RATES.items()},
            title="Goals of the ego, earlier or later on its path",
            x_label="H [s]",
            ticks=[f"{h:+d}" for h in OFFSETS_S],
        ),
    )


EXPERIMENT = Experiment(
    "Can the ego be given goals that lie earlier or later on its path than its logged endpoint?",
    run,
    summarize,
    needs_goals=True,
)
