"""Rollouts of an update that are scored with gradient, and the rewards of the agents' decisions.

Rewards are clipped, pay the price of constrained means, and choose the rollouts with most reward. A rollout that is
drawn with probability p among M draws counts 1 / (M p), so that no mean depends on M.

B scenarios, N rollouts, M of them scored, A agents, C constraints.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.config import FinetuneConfig
from rlftsim.training.constraints import Prices
from rlftsim.training.experience import Experience, measure_changes
from rlftsim.training.parallel import Fabric, all_reduce_sum, local_rollouts

UNIFORM = 0.5
"""Part of the draws that goes to all rollouts alike, so that none counts more than 2 N / M."""


@dataclass(frozen=True, eq=False)
class ScoredRollouts:
    """Rollouts of some scenarios that are scored with gradient."""

    batch: ScenarioBatch
    context: Any
    """Of the batch, made without gradient by the policy that rolled out; None = nothing to share."""
    rollouts: Rollouts
    reward: Float[Tensor, "B M A"]
    """Of each agent's decisions, before the weight."""
    weight: Float[Tensor, "B M"]
    """Number of rollouts that each stands for; 1 where all are scored."""
    rollout_ids: range
    """Rollouts that this process scores, where several have the same scenarios."""

    def slices(self, size: int) -> Iterator[tuple[slice, Rollouts]]:
        """Yield this process's rollouts of every scenario, with their place among the M.

        Args:
            size: Number of rollouts of a scenario at a time, so that few are in memory with gradients.
        """
        for start in self.rollout_ids[::size]:
            rows = slice(start, min(start + size, self.rollout_ids.stop))
            yield rows, self.rollouts.select(rows)


def choose_scored(
    learner: Any, experiences: Sequence[Experience], config: FinetuneConfig, fabric: Fabric
) -> tuple[list[ScoredRollouts], dict[str, float]]:
    """Rollouts of an update that are scored, with rewards that are clipped and have paid for the constraints.

    Args:
        learner: Policy, reference, prices, which take in the update, and number of the update, for the draw.
        experiences: Rollouts of this process with rewards, an entry per micro batch.
        config: Settings of the run: clipping, constraints, and number of rollouts that are scored.
        fabric: Processes of the run, over which sums are added.

    Returns:
        An entry per micro batch, and metrics of the constraints.
    """
    prices: Prices = learner.prices
    # padding, and whoever decides nothing, earns nothing
    earned = [
        torch.where(experience.rollouts.decision_mask.any(-1), experience.rewards.by_agent, 0.0)
        for experience in experiences
    ]
    rewards = _clip(earned, config.credit_clip, fabric)
    metrics: dict[str, float] = {}
    if prices.names:
        changes = measure_changes(learner, experiences, config, fabric)
        metrics = prices.watch(*_measure(experiences, rewards, fabric), changes)
    values = [metrics[f"price_{name}"] for name in prices.names]
    price = torch.tensor(values, dtype=torch.float64, device=fabric.device)
    scored = []
    for experience, reward in zip(experiences, rewards):
        batch, rollouts, context = experience.batch, experience.rollouts, experience.context
        credits = experience.constraint_credits
        reward = (reward - torch.einsum("c,cbna->bna", price, credits)).float()
        weight = torch.ones(reward.shape[:2], device=reward.device)
        rollout_ids = experience.rollout_ids or range(rollouts.num_rollouts)
        if config.num_scored is not None and config.num_scored < rollouts.num_rollouts:
            index, weight = draw_rollouts(reward, config, learner.update, [s.scenario_id for s in batch.scenarios])
            row = torch.arange(len(index), device=index.device)[:, None]
            rollouts, reward = rollouts.take(index), reward[row, index]
            rollout_ids = local_rollouts(config.batch_size, config.num_scored, fabric)
        scored.append(ScoredRollouts(batch, context, rollouts, reward, weight, rollout_ids))
    return scored, metrics


def draw_rollouts(
    reward: Float[Tensor, "B N A"], config: FinetuneConfig, update: int, scenario_ids: Sequence[str]
) -> tuple[Int64[Tensor, "B M"], Float[Tensor, "B M"]]:
    """Rollouts to score, and the number of rollouts that each stands for.

    Args:
        reward: Rewards of the agents; a rollout with more reward is likelier to be drawn.
        config: Settings of the run: number M of draws, and the seed.
        update: Number of the update.
        scenario_ids: Ids of the scenarios, so that a draw does not depend on the batch.
    """
    num_rollouts, num_scored = reward.shape[1], config.num_scored or reward.shape[1]
    size = reward.double().square().sum(-1).sqrt()  # [B, N]
    uniform = torch.full_like(size, 1 / num_rollouts)
    total = size.sum(1, keepdim=True)
    probability = UNIFORM * uniform + (1 - UNIFORM) * torch.where(total > 0, size / total, uniform)
    # evenly spaced draws: a rollout with p >= 1 / M is drawn in any case
    seeds = [derive_seed(config.seed, "scored", update, scenario_id) % 2**32 for scenario_id in scenario_ids]
    first = torch.tensor(seeds, dtype=torch.float64, device=size.device) / 2**32
    levels = (first[:, None] + torch.arange(num_scored, device=size.device)) / num_scored  # [B, M]
    index = torch.searchsorted(probability.cumsum(1), levels, right=True).clamp(max=num_rollouts - 1)
    return index, (1 / (num_scored * probability.gather(1, index))).float()


def _clip(rewards: list[Tensor], limit: float | None, fabric: Fabric) -> list[Tensor]:
    """Rewards within so many standard deviations of those that are not 0, over all processes."""
    if limit is None:
        return rewards
    sums = torch.zeros(2, device=fabric.device, dtype=torch.float64)
    for values in rewards:
        sums += torch.stack([values.double().square().sum(), (values != 0).sum()])
    square, count = all_reduce_sum(sums, fabric).tolist()
    largest = limit * (square / max(count, 1.0)) ** 0.5
    return [values.clamp(-largest, largest) for values in rewards]


def _measure(
    experiences: Sequence[Experience], rewards: Sequence[Tensor], fabric: Fabric
) -> tuple[float, Float64[np.ndarray, "D C"]]:
    """Standard deviation of a rollout's reward times the number of rollouts, and products of credits, see `Prices`."""
    spread = torch.zeros(2, device=fabric.device, dtype=torch.float64)
    moments: Any = 0.0
    for experience, reward in zip(experiences, rewards):
        total = experience.rewards.total.double()  # [B, N]
        spread += torch.stack([total.std(1).sum() * total.shape[1], torch.tensor(len(total), device=fabric.device)])
        credits = experience.constraint_credits.flatten(1)  # [C, B N A]
        moments = moments + torch.cat([credits, reward.double().flatten()[None]]) @ credits.T
    spread_sum, count = all_reduce_sum(spread, fabric).tolist()
    return spread_sum / max(count, 1.0), all_reduce_sum(moments, fabric).cpu().numpy()
