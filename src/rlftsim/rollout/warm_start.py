"""Scenarios that begin where a policy has tracks to, so that fine-tuning is about traffic of the policy's making.

O tracks, A simulated agents, T simulated steps.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int64

from rlftsim.errors import ConfigError, DataError
from rlftsim.geometry import boxes_overlap
from rlftsim.jobs.progress import progress_bar
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Policy, get_device
from rlftsim.rollout.simulate import lead_ego, simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import (
    CURRENT_STEP,
    FUTURE_STEPS,
    HISTORY_STEPS,
    STEP_S,
    TOTAL_STEPS,
    Scenario,
    Scenarios,
    Tracks,
)

HOP_STEPS = 20
"""Simulated steps after which agents join and leave as in the log."""
MOST_EVALUATED = 8
"""Tracks to predict of a scenario, those that travel farthest in the log."""
EVALUATED_WITHIN_M, LEAST_LOGGED = 70.0, 0.7
"""Distance of these from the ego, and share of the future that the log has of them."""


def start_from_rollouts(
    policy: Policy, scenarios: Scenarios, start_seconds: Sequence[float], *, seed: int
) -> list[Scenario]:
    """Scenarios of 9.1 s, all in memory, with the history of a rollout and the future of the log.

    A policy moves all agents but the ego from the beginning of a long log. Every two seconds an agent leaves at the
    end of the logged track, or in the space of the ego, and joins with the beginning, unless the space is taken. "Now"
    of a result is so many seconds later, with new tracks to predict.

    Args:
        policy: Policy that drives until then, in evaluation mode.
        scenarios: Scenarios with logs that go on for 8 s after the last start.
        start_seconds: Seconds of driving before "now", multiples of 2; 0 = the log's own history.
        seed: Seed of the rollouts.

    Raises:
        ConfigError: No start, or a start that is no multiple of 2 s.
        DataError: A log that does not go on for 8 s after the last start, or that lacks the ego at a start.
    """
    steps = sorted({round(seconds / STEP_S) for seconds in start_seconds})
    if not steps or steps[0] < 0 or any(step % HOP_STEPS for step in steps):
        raise ConfigError(
            f"start_seconds are multiples of {HOP_STEPS * STEP_S:g} s, at least one, got {start_seconds}."
        )
    for position in range(len(scenarios)):  # before hours of driving
        _check_log(scenarios[position], steps)
    starts = []
    with progress_bar("drive to the starts", len(scenarios)) as advance:
        for position in range(len(scenarios)):
            scenario = scenarios[position]
            starts += _drive(policy, scenario, steps, derive_seed(seed, "starts", scenario.scenario_id))
            advance()
    return starts


def _check_log(scenario: Scenario, steps: Sequence[int]) -> None:
    if scenario.num_steps < steps[-1] + TOTAL_STEPS:
        raise DataError(
            f"scenario {scenario.scenario_id}: its log of {scenario.num_steps * STEP_S:.1f} s has no 8 s after a start "
            f"at {steps[-1] * STEP_S:g} s: rlftsim synthesize --seconds makes longer ones."
        )
    missing = [step for step in steps if not scenario.tracks.valid[scenario.ego_index, step + CURRENT_STEP]]
    if missing:
        raise DataError(
            f"scenario {scenario.scenario_id}: the log lacks the ego {missing[0] * STEP_S:g} s after the beginning: "
            "leave this start or the scenario out."
        )


def _drive(policy: Policy, scenario: Scenario, steps: Sequence[int], seed: int) -> list[Scenario]:
    """The scenario at each of some steps of a rollout."""
    log = scenario.tracks
    tracks = _copy(log)
    starts = []
    for step in range(0, steps[-1] + 1, HOP_STEPS):
        world = replace(scenario, tracks=tracks)
        if step in steps:
            window = world.window(step)
            starts.append(choose_evaluated(replace(window, tracks=_copy(window.tracks))))
        if step < steps[-1]:
            now, future = step + CURRENT_STEP, slice(step + HISTORY_STEPS, step + HISTORY_STEPS + HOP_STEPS)
            window = world.window(step, HISTORY_STEPS + HOP_STEPS)  # later lights would not be read
            batch = collate([window]).to(get_device(policy))
            rollout = simulate(
                policy, batch, num_rollouts=1, seed=derive_seed(seed, step), num_steps=HOP_STEPS,
                force=lead_ego(batch, policy.steps_per_decision),
            )  # fmt: skip
            is_other = window.simulated_indices != scenario.ego_index  # [A]
            rows = window.simulated_indices[is_other]
            path = rollout.position[0, 0, : len(is_other)].cpu().numpy()[is_other] + window.origin  # [A, T, 2]
            last = tracks.position[rows, None, now, :2]
            tracks.velocity[rows, future] = np.diff(path, axis=1, prepend=last) / STEP_S
            tracks.position[rows, future, :2] = path
            tracks.position[rows, future, 2] = tracks.position[rows, now, 2:]
            tracks.heading[rows, future] = rollout.heading[0, 0, : len(is_other)].cpu().numpy()[is_other]
            tracks.size[rows, future] = tracks.size[rows, now, None]
            tracks.valid[rows, future] = True
            _join_and_leave(tracks, log, rows, scenario.ego_index, now + HOP_STEPS)
    return starts


def _copy(tracks: Tracks) -> Tracks:
    return Tracks(**{name: values.copy() for name, values in vars(tracks).items()})


def _join_and_leave(tracks: Tracks, log: Tracks, rows: Int64[np.ndarray, "A"], ego: int, now: int) -> None:
    """Make valid at a step the logged agents in free space, free of the ego and of agents that have driven."""
    is_driven = np.isin(np.arange(len(log.valid)), rows)
    tracks.valid[~log.valid[:, now:].any(1), now] = False  # a gap in the log ends nobody's way
    present = [ego]
    for row in np.argsort(~is_driven, kind="stable").tolist():  # who has tracks comes first
        if row == ego or not tracks.valid[row, now]:
            continue
        others = [ego] if is_driven[row] else present
        overlap = boxes_overlap(
            tracks.position[others, now, :2] - tracks.position[row, now, :2], tracks.heading[[row], now],
            tracks.heading[others, now], tracks.size[[row], now, :2], tracks.size[others, now, :2],
        )  # fmt: skip
        if overlap.any():
            tracks.valid[row, : now + 1] = False
        else:
            present.append(row)


def choose_evaluated(scenario: Scenario) -> Scenario:
    """The scenario with other tracks to predict: near the ego and logged, those that travel farthest.

    Args:
        scenario: Window of a long log, in which those that were chosen for its beginning may be gone.
    """
    tracks, ego = scenario.tracks, scenario.ego_index
    offset = tracks.position[:, CURRENT_STEP, :2] - tracks.position[ego, CURRENT_STEP, :2]
    future = tracks.valid[:, -FUTURE_STEPS:]
    is_nearby = tracks.valid[:, CURRENT_STEP] & (np.linalg.norm(offset, axis=-1) < EVALUATED_WITHIN_M)
    is_candidate = is_nearby & (future.mean(-1) >= LEAST_LOGGED)  # [O]
    is_candidate[ego] = False
    traveled = np.where(future, np.linalg.norm(tracks.velocity[:, -FUTURE_STEPS:], axis=-1), 0).sum(-1)
    order = np.argsort(np.where(is_candidate, -traveled, np.inf), kind="stable")
    predicted = np.sort(order[: min(MOST_EVALUATED, int(is_candidate.sum()))]).astype(np.int32)
    return replace(scenario, tracks_to_predict=predicted, difficulty=np.zeros(len(predicted), np.int8))
