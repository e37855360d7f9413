"""Getting where one was asked to go, and the paper's mixture of that with realism (RLFTSim, equation 4)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.goals.attainment import NEAR_M, closest_m, final_m
from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.training.rewards.base import register_reward, register_shares, register_sum, require_two

KINDS = {"soft": closest_m, "hard": final_m}
"""What must be at most 2 m. soft: the least distance to the goal over all steps; hard: the one in the end."""


@register_reward("goal")
def goal(
    scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch, *, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N"]:
    """Share of the evaluated agents with a goal that meet it, minus the mean share of them in the other rollouts that meet the same goals. 0 where
    nobody has one.

    With `partial` those that miss it count by the share of the way that they have covered: a goal that nobody meets teaches, too.
    """
    return goal_advantage(rollouts, batch, kind, partial).sum(-1)


@register_shares("goal")
def goal_shares(
    scores: AgentScores, rollouts: Rollouts, batch: ScenarioBatch, *, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N A"]:
    """Each agent's own."""
    return goal_advantage(rollouts, batch, kind, partial)


def goal_advantage(
    rollouts: Rollouts, batch: ScenarioBatch, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N A"]:
    """What each agent adds to the share of those that meet their goals, minus what it would add on average in the other rollouts.

    Raises:
        ConfigError: no such kind.
    """
    if kind not in KINDS:
        raise ConfigError(f"reward goal(kind={kind!r}): known kinds are {', '.join(KINDS)}.")
    if rollouts.goals is None:
        return rollouts.heading.new_zeros(rollouts.heading.shape[:3])
    counted = counted_agents(rollouts, batch)
    beyond = _distances(rollouts, kind) - NEAR_M  # [B, N, N, A]
    met = (beyond <= 0).float()
    if partial:
        start = batch.position[:, None, :, CURRENT_STEP]
        ahead = (rollouts.goals.position - start).norm(dim=-1) - NEAR_M  # [B, N, A]
        met = torch.maximum(met, 1 - (beyond / ahead.clamp(min=NEAR_M)[:, :, None]).clamp(0, 1))
    own = met.diagonal(dim1=1, dim2=2).movedim(-1, 1)
    advantage = (own - met.mean(2)) * (require_two(own) / (own.shape[1] - 1))
    return torch.where(counted, advantage, 0.0) / counted.sum(-1, keepdim=True).clamp(min=1)


def _distances(rollouts: Rollouts, kind: str) -> Float[Tensor, "B N N A"]:
    """From the goals of rollout i to the agents of rollout j, m. All the same goals give N equal rows."""
    goals, position = rollouts.goals, rollouts.position
    assert goals is not None
    count = rollouts.num_rollouts
    num_different = 1 if (goals.position == goals.position[:, :1]).all() else count
    rows = [KINDS[kind](position, goals.rollouts(slice(i, i + 1)).repeat(count)) for i in range(num_different)]
    return torch.stack(rows, 1).expand(-1, count, -1, -1)


def counted_agents(rollouts: Rollouts, batch: ScenarioBatch) -> Bool[Tensor, "B N A"]:
    """The evaluated agents that have a goal."""
    assert rollouts.goals is not None
    return rollouts.goals.goal_mask & batch.evaluated_mask[:, None]


@register_sum("gcft")
def gcft(*, goal_weight: float = 0.1, kind: str = "soft", partial: bool = False) -> str:
    """The paper's reward of goal-conditioned fine-tuning; its lambda is `goal_weight`. `partial` is ours, see `goal`."""
    if not 0 <= goal_weight <= 1:
        raise ConfigError(f"reward gcft(goal_weight={goal_weight}): a share in [0, 1] is expected.")
    return f"{round(1 - goal_weight, 12)}*mloo + {goal_weight}*goal(kind={kind!r}, partial={partial})"
