"""Hindsight within an update of fine-tuning: rollouts are relabelled with goals that the most realistic one met.

Reaching a goal may be too rare to learn from, but every rollout gets somewhere. So the rollouts of a scenario are used
a second time, as if the goals had been the endpoints of the most realistic rollout. The rollouts were sampled under
other goals, so the reward of an agent's decisions is weighted by the importance ratio, the decisions' probability under
the new goals over the probability under the old goals.

Sources: Rauber et al., "Hindsight policy gradients", 2019; RLFTSim, section 4.2. `training.augment` uses the same idea
before training.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.goals.types import Goals
from rlftsim.realism import RealismResult
from rlftsim.rewards import Term, parse_reward
from rlftsim.rewards.goal import goal_advantage, goal_terms
from rlftsim.rollout.policy import encode_like
from rlftsim.rollout.types import Rollouts
from rlftsim.training.config import FinetuneConfig
from rlftsim.training.experience import Experience, most_realistic_ends
from rlftsim.training.parallel import Fabric, all_reduce_sum
from rlftsim.training.policy_gradient import GradientSums, LossTerms, agent_log_prob, policy_gradient_loss
from rlftsim.training.scored_rollouts import ScoredRollouts

LARGEST_RATIO = 10.0
"""Importance ratios are clipped to it."""


def check_hindsight(config: FinetuneConfig) -> None:
    """Check that hindsight, where it is on, has all rollouts to relabel.

    Raises:
        ConfigError: Only some of the rollouts are scored.
    """
    if config.goals.hindsight and config.num_scored is not None:
        raise ConfigError(
            f"hindsight needs all rollouts, and finetune.num_scored is {config.num_scored}: set finetune.num_scored to "
            "none."
        )


def relabel_with_hindsight(experiences: Sequence[Experience], terms: Sequence[Term]) -> list[ScoredRollouts]:
    """The rollouts as if sampled under goals that the most realistic rollout has met, and the resulting rewards.

    Only the reward's goal terms count: realism does not depend on goals and was rewarded before. Each agent earns a
    separate part, because each agent's decisions have a separate importance ratio.

    Args:
        experiences: Rollouts of this process with rewards, an entry per micro batch.
        terms: Terms of the run's reward, of which only goal terms count.
    """
    relabelled = []
    for experience in experiences:
        batch, rollouts = experience.batch, experience.rollouts
        rollouts = replace(rollouts, goals=met_goals(rollouts, experience.realism))
        earned = rollouts.heading.new_zeros(rollouts.heading.shape[:3])  # [B, N, A]
        for term in goal_terms(terms):
            options: dict[str, Any] = dict(term.options)
            earned = earned + term.weight * goal_advantage(rollouts, batch, **options)
        rollout_ids = experience.rollout_ids or range(rollouts.num_rollouts)
        weight = earned.new_ones(earned.shape[:2])
        relabelled.append(ScoredRollouts(batch, experience.context, rollouts, earned, weight, rollout_ids))
    return relabelled


def met_goals(rollouts: Rollouts, realism: RealismResult) -> Goals:
    """Endpoints of the most realistic rollout of each scenario, for the agents that have goals.

    Args:
        rollouts: Rollouts with goals, N of each scenario.
        realism: Scores of the same rollouts, a row per scenario.
    """
    assert rollouts.goals is not None
    # All rollouts of a scenario have the same goals: the mask of the first one serves.
    goals = Goals.of_scenarios(most_realistic_ends(rollouts, realism), rollouts.goals.goal_mask[:, 0])
    return goals.repeat(rollouts.num_rollouts)


def importance_ratio(new: Float[Tensor, "B N A"], old: Float[Tensor, "B N A"]) -> Float[Tensor, "B N A"]:
    """Probability of each agent's decisions under new goals over the probability under old goals; clipped, no gradient.

    Args:
        new: Log-probability of all of an agent's decisions under the new goals, nats.
        old: Log-probability under the goals at sampling, nats.
    """
    # Clipped from above only: a large ratio raises the variance, a small one merely drops an agent.
    return (new - old).detach().clamp(max=math.log(LARGEST_RATIO)).exp()


def accumulate_hindsight(
    policy: Any, experiences: Sequence[Experience], first_pass: GradientSums, terms: LossTerms, fabric: Fabric
) -> dict[str, float]:
    """Add the gradient of the rewards under hindsight's goals to the policy's parameters.

    Args:
        policy: scores the relabelled rollouts.
        experiences: Rollouts of this process with rewards, an entry per micro batch.
        first_pass: has the log-probabilities under the old goals.
        terms: Settings of the run with the weight of this gradient (0 = no second pass), and counts of the update.
        fabric: Precision of the passes, and processes that sums are added over.

    Returns:
        Metrics: the mean importance ratio. Empty in a run without hindsight.
    """
    config = terms.config
    if not config.goals.hindsight:
        return {}
    # The gradient is divided by the mean ratio of the whole batch, which is known in the end only: so it is gathered
    # apart from the gradient of the first pass, and added to it when it has its scale.
    parameters = [p for p in policy.parameters() if p.requires_grad]
    first_gradients = [p.grad for p in parameters]
    for parameter in parameters:
        parameter.grad = None
    sums = torch.zeros(2, device=fabric.device, dtype=torch.float64)  # ratios, agents
    relabelled = relabel_with_hindsight(experiences, parse_reward(config.reward))
    for entry, old_log_probs in zip(relabelled, first_pass.agent_log_prob):
        for (rows, rollouts), old in zip(entry.slices(config.rollouts_per_pass), old_log_probs):
            mask, decides = rollouts.decision_mask, rollouts.decision_mask.any(-1)  # [B, n, A, L], [B, n, A]
            with fabric.autocast():
                dist = policy.score(encode_like(policy, entry.batch, entry.context), rollouts)
            log_prob = dist.log_prob(rollouts.decision)  # [B, n, A, L]
            ratio = importance_ratio(agent_log_prob(log_prob, mask, "sum"), old)  # [B, n, A]
            by_agent = agent_log_prob(log_prob, mask, config.log_prob_reduction)
            fabric.backward(policy_gradient_loss(entry.reward[:, rows] * ratio, by_agent, terms.num_scenarios))
            # Agents that decide nothing have a ratio of exp(0) = 1, which would pull the mean to 1.
            sums += torch.stack([ratio[decides].sum(), decides.sum()])
    total, count = all_reduce_sum(sums, fabric).tolist()
    mean = total / max(count, 1.0)
    for parameter, gradient in zip(parameters, first_gradients):
        if parameter.grad is not None:
            parameter.grad *= config.goals.hindsight / max(mean, 1e-6)
        if gradient is not None:
            parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)
    return {"hindsight_ratio": mean}
