"""The challenge's rule about closed loop: the statement of an entry, and a check of the policy."""

import torch
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.rollout.check import POSE_TOLERANCE_M
from rlftsim.rollout.edge_scenes import without_future
from rlftsim.rollout.noise import draw_noise
from rlftsim.rollout.policy import Policy, Sampling, get_device
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import FUTURE_STEPS, STEP_S, Scenario

MAX_STEPS_PER_DECISION = 10
"""Inference may be called as rarely as once a second, with interpolation to 10 Hz."""


def statement(policy: Policy, sampling: Sampling) -> str:
    """Statement that an entry makes with the closed-loop flag, as far as this code can vouch for the policy.

    Args:
        policy: Policy whose rollouts are submitted; gives the seconds between decisions.
        sampling: Temperature and truncation of the submitted rollouts, quoted in the statement.
    """
    stride = policy.steps_per_decision
    limit = "" if sampling.top_k is None else f", top {sampling.top_k}"
    return f"""The challenge takes outputs of "individual next-state prediction inference calls", each conditioned on
the preceding states, made at least once a second. The ego's next state must be independent of the others'
given the past. How these rollouts are made:
* the policy decides every {stride * STEP_S:g} s, {FUTURE_STEPS // stride} times in 8 s, from the states so far;
* every agent's decision is drawn independently given the common past (temperature {sampling.temperature:g}{limit});
* it sees the log up to the current step only: no future, no goals;
* nothing drawn at the start of a rollout is shared by the ego and other agents;
* every rollout that is drawn is submitted: none is selected, repaired or drawn again by its outcome.
The code makes sure of the first and the last three points. That the policy itself draws agents independently is
for you to know."""


def check_closed_loop(policy: Policy, scenario: Scenario) -> None:
    """Check that a policy can make the statement.

    Args:
        policy: Policy whose rollouts will be submitted.
        scenario: Any scenario, to try the policy on.

    Raises:
        ConfigError: A policy that decides less than once a second, reads the logged future, or couples the draws of
            ego and other agents at the start of a rollout.
    """
    stride = policy.steps_per_decision
    if stride > MAX_STEPS_PER_DECISION:
        raise ConfigError(
            f"the policy decides every {stride * STEP_S:g} s: the challenge wants an inference call at least once "
            "a second."
        )
    if scenario.has_future:  # in a test split there is none that could be read
        informed, blind = (
            simulate(policy, collate([variant]).to(get_device(policy)), num_rollouts=1, seed=0).position
            for variant in (scenario, without_future(scenario))
        )
        if not torch.allclose(informed, blind, rtol=0.0, atol=POSE_TOLERANCE_M):
            raise ConfigError(
                "the policy's rollouts change where the logged future is taken away: the challenge wants each state "
                "to follow from the states before it. Let `encode` read no step behind the current one."
            )
    if not policy.initial_noise_size:
        return
    batch = collate([scenario]).to(get_device(policy))
    noise = draw_noise(batch, range(1), seed=0, purpose="begin", per_agent=policy.initial_noise_size)
    is_ego = torch.from_numpy(scenario.simulated_indices == scenario.ego_index).to(batch.device)  # [A]
    with torch.no_grad():
        context = policy.encode(batch)
        draws, ego_draws = (
            policy.begin(context, 1, None, agent_noise).draws
            for agent_noise in (noise, torch.where(is_ego[:, None], 1 - noise, noise))
        )
    if draws is not None and not _is_ego_alone(draws, ego_draws, is_ego):
        raise ConfigError(
            "the policy draws something at the start of a rollout that the ego shares with other agents: the challenge "
            "wants the ego to be independent of them, because a planner will take its place."
        )


def _is_ego_alone(draws: Tensor, ego_draws: Tensor, is_ego: Tensor) -> bool:
    """True if draws have an agent axis along which only the ego's differ."""
    has_agents = draws.dim() >= 3 and draws.shape[2] == len(is_ego)
    return has_agents and bool((draws[:, :, ~is_ego] == ego_draws[:, :, ~is_ego]).all())
