"""Hindsight within an update of fine-tuning with goals.

Reaching a goal may be too rare to learn from. But every rollout gets somewhere: the rollouts of a scenario are looked at again as if the
goals had been where the most realistic of them ended. They were sampled under other goals, so what each agent's decisions earn is
weighted by how much likelier they are under the new ones (hindsight policy gradient, Rauber et al., 2019; RLFTSim, section 4.2).
`training.augment` uses the same idea before training.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from lightning_fabric import Fabric
from torch import Tensor

from rlftsim.goals.types import Goals
from rlftsim.realism import RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.augment import ends_of, most_realistic
from rlftsim.training.experience import Experience
from rlftsim.training.parallel import add_up
from rlftsim.training.rewards import Rewards

LARGEST_RATIO = 10.0
"""Ratios of probabilities are clipped to it."""
Measure = Callable[[ScenarioBatch, Rollouts], tuple[RealismResult, Rewards]]
"""Scores of rollouts, and what they earn."""


def look_back(
    policy: Any, experiences: Sequence[Experience], measure: Measure, *, weight: float, at_once: int, fabric: Fabric
) -> tuple[list[Experience], float]:
    """The rollouts under goals that one of each scenario's has met, rewarded for these and weighted.

    Args:
        policy: that sampled the rollouts.
        experiences: of this process.
        measure: scores and rewards of rollouts.
        weight: of hindsight, against what is earned under the goals that were asked.
        at_once: rollouts that are scored in one pass.
        fabric: the processes.

    Returns:
        The experiences, and the mean ratio of probabilities, over the agents of the whole batch, that weights are normalised by.
    """
    met = [met_goals(e.rollouts, e.scores) for e in experiences]
    with fabric.autocast():
        ratios = [
            log_ratio(policy, e.batch, e.rollouts, goals, at_once=at_once).clamp(max=math.log(LARGEST_RATIO)).exp()
            for e, goals in zip(experiences, met)
        ]
    deciding = [e.rollouts.decision_mask.any(-1) for e in experiences]
    sums = [torch.stack([r[who].sum(), who.sum().to(r)]) for r, who in zip(ratios, deciding)]
    total, count = add_up(torch.stack(sums).double().sum(0), fabric).tolist()
    mean = total / max(count, 1.0)
    relabelled = []
    for e, goals, ratio in zip(experiences, met, ratios):
        new = replace(e.rollouts, goals=goals)
        scores, rewards = measure(e.batch, new)
        relabelled.append(Experience(e.batch, new, scores, rewards.weighted(ratio * (weight / max(mean, 1e-6)))))
    return relabelled, mean


def met_goals(rollouts: Rollouts, scores: RealismResult) -> Goals:
    """For the agents that have goals: where the most realistic rollout of their scenario took them."""
    assert rollouts.goals is not None
    ends = Goals.of_scenarios(ends_of(rollouts, most_realistic(scores)), rollouts.goals.goal_mask[:, 0])
    return ends.repeat(rollouts.num_rollouts)


@torch.no_grad()
def log_ratio(
    policy: Any, batch: ScenarioBatch, rollouts: Rollouts, goals: Goals, *, at_once: int
) -> Float[Tensor, "B N A"]:
    """How much likelier each agent's decisions are under other goals: the log of the ratio of their probabilities.

    Args:
        policy: that sampled the rollouts.
        batch: their scenarios.
        rollouts: with the goals they were sampled under.
        goals: the others.
        at_once: rollouts that are scored in one pass.
    """
    context = policy.encode(batch)
    asked = replace(rollouts, goals=goals)
    parts = []
    for start in range(0, rollouts.num_rollouts, at_once):
        part = slice(start, start + at_once)
        old, new = (_log_prob(policy, context, r.select(part)) for r in (rollouts, asked))
        parts.append((new - old).sum(-1))
    return torch.cat(parts, 1)


def _log_prob(policy: Any, context: Any, rollouts: Rollouts) -> Float[Tensor, "B N A L"]:
    return torch.where(rollouts.decision_mask, policy.score(context, rollouts).log_prob(rollouts.decision), 0.0)
