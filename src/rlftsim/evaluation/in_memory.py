"""Rollouts in memory, without files: `rs.simulate`."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from rlftsim.errors import ConfigError, DataError
from rlftsim.goals.lane_paths import HORIZON_S
from rlftsim.goals.placement import FASTEST_MPS
from rlftsim.goals.types import Goals
from rlftsim.jobs.progress import progress_bar
from rlftsim.rollout.entries import load_entries
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.open_world import add_visitors
from rlftsim.rollout.policy import Policy, Sampling, is_goal_conditioned
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import RolloutProvenance, Rollouts
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import CURRENT_STEP


def simulate_in_memory(
    policy: Policy,
    batch: ScenarioBatch,
    num_rollouts: int,
    seed: int,
    num_steps: int,
    sampling: Sampling,
    goals: Any,
    entries: str | None = None,
) -> Rollouts:
    """Rollouts of a batch with their provenance, simulated scenario by scenario.

    Args:
        policy: Policy in evaluation mode.
        batch: Scenarios to continue, on the policy's device.
        num_rollouts: Number N of rollouts of each scenario.
        seed: Seed of the rollouts.
        num_steps: Number of simulated steps of 0.1 s.
        sampling: Temperature and truncation of the decisions.
        goals: Points, or goals of the whole batch, as for `rs.simulate`; None = goal-free.
        entries: Name or file of the model of who enters; the scenarios of the rollouts have visitors then. None =
            nobody enters or leaves.

    Raises:
        ConfigError: Goals of a wrong type, frame, batch or number of rollouts, or without effect on the policy.
        DataError: A goal of an agent that is not simulated, a goal out of reach, or not two finite numbers.
    """
    entry_model = load_entries(entries)
    if entry_model is not None:
        batch = collate([add_visitors(scenario) for scenario in batch.scenarios], frame=batch.frame).to(batch.device)
    placed = _place_goals(goals, batch, num_rollouts)
    has_goals = placed.goal_mask.any(-1).any(-1).tolist()  # [B]
    if any(has_goals):  # else there may be no agent at all
        _check_reach(placed, batch)
        if not is_goal_conditioned(policy):
            raise ConfigError(
                f"goals have no effect: {type(policy).__name__} is not goal-conditioned: load a model that was "
                "fine-tuned with goals, or leave goals out."
            )
    # One scenario at a time, as the command line does: memory does not grow with the number of scenarios that are in
    # the loop, and no result depends on the company of a scenario.
    simulated = []
    with progress_bar("simulate", batch.num_scenarios, show=batch.num_scenarios > 1) as advance:
        for row, scenario_batch in enumerate(batch.split(1)):
            position, mask = placed.position[row : row + 1], placed.goal_mask[row : row + 1]
            scenario_goals = replace(placed, position=position, goal_mask=mask) if has_goals[row] else None
            simulated.append(
                simulate(
                    policy, scenario_batch, num_rollouts=num_rollouts, seed=seed, num_steps=num_steps,
                    goals=scenario_goals, sampling=sampling, entries=entry_model,
                )
            )  # fmt: skip
            advance()
    provenance = RolloutProvenance(
        scenarios=batch.scenarios,
        frame=batch.frame,
        policy=type(policy).__name__,
        policy_fingerprint=fingerprint_policy(policy),
        seed=seed,
        temperature=sampling.temperature,
        top_k=sampling.top_k,
    )
    # All batches of one scenario are padded alike (`split`), so they can be joined along axis B.
    tensors = ("position", "heading", "decision", "decision_mask", "log_prob")
    tensors = (*tensors, *(name for name in ("draws", "valid") if getattr(simulated[0], name) is not None))
    joined = {name: torch.cat([getattr(rollouts, name) for rollouts in simulated]) for name in tensors}
    all_goals = placed.repeat(num_rollouts) if any(has_goals) else None
    return replace(simulated[0], **joined, goals=all_goals, provenance=provenance)


def _place_goals(goals: Any, batch: ScenarioBatch, num_rollouts: int) -> Goals:
    """Goals in the frame and on the device of a batch."""
    if not isinstance(goals, Goals | Mapping | None):
        raise ConfigError(
            f"goals must be {{object_id: (x, y)}}, {{scenario_id: {{object_id: (x, y)}}}} or Goals, got {goals!r}."
        )
    placed = goals.to(batch.device) if isinstance(goals, Goals) else Goals.from_points(batch, goals or {})
    if placed.frame != batch.frame:
        raise ConfigError(
            f"goals in the {placed.frame} frame do not fit scenarios in the {batch.frame} frame: make them with "
            "rs.Goals.from_points(batch, points) and simulate the same batch, or give {object_id: (x, y)}."
        )
    num_scenarios, rollouts_with_goals, num_agents = placed.goal_mask.shape
    if (num_scenarios, num_agents) != tuple(batch.agent_mask.shape):
        raise ConfigError(
            f"goals of {num_scenarios} scenarios × {num_agents} agents do not belong to {batch.num_scenarios} × "
            f"{batch.agent_mask.shape[1]}: hand over goals of the same scenarios."
        )
    if rollouts_with_goals not in (1, num_rollouts):
        raise ConfigError(
            f"goals of {rollouts_with_goals} rollouts do not fit num_rollouts={num_rollouts}: give goals of one "
            "rollout or of as many."
        )
    return placed


def _check_reach(goals: Goals, batch: ScenarioBatch) -> None:
    """Check that goals can be reached in 8 seconds: others are mostly points of a different frame.

    Raises:
        DataError: A goal too far away; names the agent.
    """
    offset = goals.position - batch.position[:, None, :, CURRENT_STEP]  # [B, N, A, 2]
    distance = torch.where(goals.goal_mask, offset.norm(dim=-1), 0.0).amax(1)  # [B, A]
    row, agent = divmod(int(distance.argmax()), distance.shape[1])
    distance_m = float(distance[row, agent])
    if distance_m > FASTEST_MPS * HORIZON_S:
        raise DataError(
            f"goal of agent {int(batch.object_id[row, agent])} in scenario {batch.scenarios[row].scenario_id} is "
            f"{distance_m:.0f} m away, out of reach in {HORIZON_S:g} s: x and y are meters in the world frame of the "
            "log."
        )
