"""`rs.simulate`: the closed loop for scenarios, policies and goals in any form."""

from collections.abc import Mapping
from dataclasses import replace

import torch

from rlftsim.errors import ConfigError, DataError, whole_number
from rlftsim.evaluation.evaluate import frozen_copy
from rlftsim.goals.maneuvers.reach import HORIZON_S
from rlftsim.goals.placement import FASTEST_MPS
from rlftsim.goals.types import Goals, PointById
from rlftsim.jobs.progress import progress_bar
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, Sampling, get_device, is_goal_conditioned, is_training
from rlftsim.rollout.simulate import simulate as simulate_batch
from rlftsim.rollout.types import RolloutProvenance, Rollouts
from rlftsim.scenario.any_form import AnyScenarios, Name
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.verbs.inputs import to_batch, to_policy, to_sampling


def simulate(
    policy: Policy | Name,
    scenarios: AnyScenarios,
    *,
    num_rollouts: int = 32,
    seed: int = 0,
    goals: Goals | PointById | Mapping[str, PointById] | None = None,
    sampling: Sampling | None = None,
) -> Rollouts:
    """Simulate 8 seconds of every scenario: all agents, the ego included, move by the policy.

    The same seed gives the same rollouts as `rlftsim simulate`, whatever other scenarios are handed over with one.

    Args:
        policy: Policy, simulated as in evaluation mode, or a name for `load_policy`.
        scenarios: One scenario, several, a batch or a data set, all of which are in memory at once; a name of a data
            set stands for its split validation. Only history, map and lights are used.
        num_rollouts: Number N of futures of every scenario.
        seed: Seed of all randomness.
        goals: Points that agents drive to, meters in the world frame: {object_id: (x, y)}, and for several scenarios
            {scenario_id: {object_id: (x, y)}}. Or goals of the whole batch as tensors.
        sampling: Temperature and truncation; None samples the whole distribution.

    Returns:
        Rollouts with padding up to the scenario with the most agents. They know their scenarios and seed
        (`provenance`), and `trajectory(object_id)` gives an agent's poses in the world frame.

    Raises:
        ConfigError: No scenario, fewer than one rollout, goals for a policy that is not goal-conditioned, for
            scenarios that were not handed over or in another frame.
        DataError: A goal of an agent that is not simulated, out of its reach, or not two finite numbers.
    """
    num_rollouts, seed = whole_number("num_rollouts", num_rollouts, 1), whole_number("seed", seed)
    sampling = to_sampling(sampling)
    policy = to_policy(policy)
    if is_training(policy):  # with dropout a seed would not say what happens
        policy = frozen_copy(policy)
    batch = to_batch(scenarios, get_device(policy))
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
            scenario_goals = None
            if has_goals[row]:
                rows = slice(row, row + 1)
                scenario_goals = replace(placed, position=placed.position[rows], goal_mask=placed.goal_mask[rows])
            simulated.append(
                simulate_batch(
                    policy, scenario_batch, num_rollouts=num_rollouts, seed=seed, goals=scenario_goals,
                    sampling=sampling,
                )
            )  # fmt: skip
            advance()
    # All batches of one scenario are padded alike (`split`), so they can be joined along axis B.
    provenance = RolloutProvenance(
        scenarios=batch.scenarios,
        frame=batch.frame,
        policy=type(policy).__name__,
        policy_fingerprint=fingerprint_policy(policy),
        seed=seed,
        temperature=sampling.temperature,
        top_k=sampling.top_k,
    )
    tensors = ("position", "heading", "decision", "decision_mask", "log_prob")
    if simulated[0].draws is not None:
        tensors = (*tensors, "draws")
    joined = {name: torch.cat([getattr(rollouts, name) for rollouts in simulated]) for name in tensors}
    all_goals = placed.repeat(num_rollouts) if any(has_goals) else None
    return replace(simulated[0], **joined, goals=all_goals, provenance=provenance)


def _check_reach(goals: Goals, batch: ScenarioBatch) -> None:
    """Refuse goals that nothing reaches in 8 seconds: mostly points of another frame.

    Raises:
        DataError: Such a goal; names the agent.
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
