"""The goal reward, and the paper's mixture of it with realism (RLFTSim, equation 4)."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.goals.attainment import NEAR_M, closest_m, final_m
from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import register_agent_rewards, register_reward, register_sum, require_two
from rlftsim.rewards.expression import Term
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP

KINDS = {"soft": closest_m, "hard": final_m}
"""Distance that must be at most 2 m. soft: the least one to the goal over all steps; hard: the final one."""


@register_reward("goal")
def goal(
    realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch, *, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N"]:
    """Fraction of the evaluated agents with a goal that meet it, minus the mean of that in the other rollouts.

    The other rollouts are measured with this one's goals. 0 in scenarios without a goal.

    Args:
        realism: not used.
        rollouts: with their goals; without any the reward is 0.
        batch: the scenarios.
        kind: "soft" or "hard", see `KINDS`.
        partial: agents that miss their goal count by the fraction of the way that they have covered, so a goal that no
            rollout meets is learned from, too.
    """
    return goal_advantage(rollouts, batch, kind, partial).sum(-1)


@register_agent_rewards("goal")
def goal_by_agent(
    agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch, *, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N A"]:
    """Each agent's own part of `goal`.

    Args:
        agents: not used.
        rollouts: with their goals.
        batch: the scenarios.
        kind: as in `goal`.
        partial: as in `goal`.
    """
    return goal_advantage(rollouts, batch, kind, partial)


def goal_terms(terms: Sequence[Term]) -> list[Term]:
    """The terms of a reward that depend on goals."""
    return [term for term in terms if term.name == "goal"]


def goal_advantage(
    rollouts: Rollouts, batch: ScenarioBatch, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N A"]:
    """Each agent's part of the fraction of agents that meet their goals, minus its mean in the other rollouts.

    Args:
        rollouts: N of each scenario; their goals may differ between rollouts.
        batch: the scenarios.
        kind: "soft" or "hard", see `KINDS`.
        partial: see `goal`.

    Raises:
        ConfigError: no such kind.
    """
    if kind not in KINDS:
        raise ConfigError(f"reward goal(kind={kind!r}): known kinds are {', '.join(KINDS)}.")
    if rollouts.goals is None:
        return rollouts.heading.new_zeros(rollouts.heading.shape[:3])
    goals, position, count = rollouts.goals, rollouts.position, rollouts.num_rollouts
    counted = counted_agents(rollouts, batch)  # [B, N, A]
    # 1. Distances from the goals of rollout i to the agents of rollout j, [B, i, j, A]. Where all rollouts have the
    # same goals, one row serves for all i.
    num_different = 1 if (goals.position == goals.position[:, :1]).all() else count
    rows = [KINDS[kind](position, goals.rollouts(slice(i, i + 1)).repeat(count)) for i in range(num_different)]
    beyond = torch.stack(rows, 1).expand(-1, count, -1, -1) - NEAR_M
    # 2. Met = 1, missed = 0, or the fraction of the way covered.
    met = (beyond <= 0).float()
    if partial:
        start = batch.position[:, None, :, CURRENT_STEP]
        ahead = (goals.position - start).norm(dim=-1) - NEAR_M  # [B, N, A]
        met = torch.maximum(met, 1 - (beyond / ahead.clamp(min=NEAR_M)[:, :, None]).clamp(0, 1))
    # 3. Leave-one-out over j: each rollout's own value against the mean of the others under the same goals.
    own = met.diagonal(dim1=1, dim2=2).movedim(-1, 1)  # [B, N, A]
    advantage = (own - met.mean(2)) * (require_two(own) / (own.shape[1] - 1))
    return torch.where(counted, advantage, 0.0) / counted.sum(-1, keepdim=True).clamp(min=1)


def counted_agents(rollouts: Rollouts, batch: ScenarioBatch) -> Bool[Tensor, "B N A"]:
    """True for the evaluated agents that have a goal.

    Args:
        rollouts: with goals.
        batch: the scenarios.
    """
    assert rollouts.goals is not None
    return rollouts.goals.goal_mask & batch.evaluated_mask[:, None]


@register_sum("gcft")
def gcft(*, goal_weight: float = 0.1, kind: str = "soft", partial: bool = False) -> str:
    """Sum of rewards of the paper's goal-conditioned fine-tuning (RLFTSim, equation 4).

    Args:
        goal_weight: the paper's lambda, in [0, 1].
        kind: as in `goal`.
        partial: as in `goal`; not in the paper.
    """
    if not 0 <= goal_weight <= 1:
        raise ConfigError(f"reward gcft(goal_weight={goal_weight}): a weight in [0, 1] is expected.")
    # Rounded, so that 1 - 0.1 is written 0.9 in the run's settings.
    return f"{round(1 - goal_weight, 12)}*mloo + {goal_weight}*goal(kind={kind!r}, partial={partial})"
