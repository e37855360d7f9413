"""The goal reward, and the paper's mixture of goal reward and realism (RLFTSim, equation 4)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.goals.attainment import NEAR_M, compute_closest_distance, compute_final_distance
from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import check_num_rollouts, register_agent_rewards, register_reward, register_sum
from rlftsim.rewards.expression import Term
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP

GOAL_DISTANCES = {"soft": compute_closest_distance, "hard": compute_final_distance}
"""Distance to the goal that must be at most 2 m. soft: the smallest distance over all steps; hard: the final one."""


@register_reward("goal")
def goal(
    realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch, *, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N"]:
    """Fraction of the evaluated agents with a goal that meet the goal, minus the mean in the other rollouts.

    The other rollouts are measured with the goals of the rollout at hand. 0 in scenarios without a goal.

    Args:
        realism: Scores of the same rollouts; not read here.
        rollouts: N rollouts of each scenario with goals; without goals the reward is 0.
        batch: Scenarios of the rollouts, with positions at the current step.
        kind: "soft" counts the smallest distance to the goal over all steps, "hard" the final distance.
        partial: True = agents that miss the goal count by the fraction of the distance covered, so that a goal that no
            rollout meets is learned from, too.
    """
    return goal_advantage(rollouts, batch, kind, partial).sum(-1)


@register_agent_rewards("goal")
def goal_by_agent(
    agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch, *, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N A"]:
    """Share of each agent in the reward `goal`.

    Args:
        agents: Scores of the same rollouts by agent; not read here.
        rollouts: N rollouts of each scenario with goals; without goals all shares are 0.
        batch: Scenarios of the rollouts, with positions at the current step.
        kind: "soft" or "hard", the same as in the reward itself.
        partial: Fractions for agents that miss the goal, the same as in the reward itself.
    """
    return goal_advantage(rollouts, batch, kind, partial)


def goal_terms(terms: Sequence[Term]) -> list[Term]:
    """The terms of a reward that depend on goals."""
    return [term for term in terms if term.name == "goal"]


def goal_advantage(
    rollouts: Rollouts, batch: ScenarioBatch, kind: str = "soft", partial: bool = False
) -> Float[Tensor, "B N A"]:
    """Share of each agent in the fraction of agents that meet the goal, minus the mean share in the other rollouts.

    Args:
        rollouts: N rollouts of each scenario; goals may differ between rollouts.
        batch: Scenarios of the rollouts, with positions at the current step.
        kind: "soft" counts the smallest distance to the goal over all steps, "hard" the final distance.
        partial: True = agents that miss the goal count by the fraction of the distance covered.

    Raises:
        ConfigError: Neither "soft" nor "hard".
    """
    if kind not in GOAL_DISTANCES:
        raise ConfigError(f"reward goal(kind={kind!r}): known kinds are {', '.join(GOAL_DISTANCES)}.")
    if rollouts.goals is None:
        return rollouts.heading.new_zeros(rollouts.heading.shape[:3])
    goals, position, count = rollouts.goals, rollouts.position, rollouts.num_rollouts
    is_counted = goals.goal_mask & batch.evaluated_mask[:, None]  # [B, N, A]
    # 1. Distances from the goals of rollout i to the agents of rollout j, [B, i, j, A]. Where all rollouts have the
    # same goals, one row serves for all i.
    num_goal_sets = 1 if (goals.position == goals.position[:, :1]).all() else count
    rows = [GOAL_DISTANCES[kind](position, goals.rollouts(slice(i, i + 1)).repeat(count)) for i in range(num_goal_sets)]
    excess = torch.stack(rows, 1).expand(-1, count, -1, -1) - NEAR_M
    # 2. Met = 1, missed = 0, or the fraction of the way covered.
    attainment = (excess <= 0).float()
    if partial:
        start = batch.position[:, None, :, CURRENT_STEP]
        start_excess = (goals.position - start).norm(dim=-1) - NEAR_M  # [B, N, A]
        progress = 1 - (excess / start_excess.clamp(min=NEAR_M)[:, :, None]).clamp(0, 1)
        attainment = torch.maximum(attainment, progress)
    # 3. Leave-one-out over j: each rollout's own value against the mean of the others under the same goals.
    own_attainment = attainment.diagonal(dim1=1, dim2=2).movedim(-1, 1)  # [B, N, A]
    check_num_rollouts(own_attainment)
    advantage = (own_attainment - attainment.mean(2)) * (count / (count - 1))
    return torch.where(is_counted, advantage, 0.0) / is_counted.sum(-1, keepdim=True).clamp(min=1)


@register_sum("gcft")
def gcft(*, goal_weight: float = 0.1, kind: str = "soft", partial: bool = False) -> str:
    """Sum of rewards of the paper's goal-conditioned fine-tuning (RLFTSim, equation 4).

    Args:
        goal_weight: The paper's lambda in [0, 1]; realism has the weight 1 - `goal_weight`.
        kind: "soft" or "hard", the same as in the reward `goal`.
        partial: Fractions for agents that miss the goal, which the paper does not have.
    """
    if not 0 <= goal_weight <= 1:
        raise ConfigError(f"reward gcft(goal_weight={goal_weight}): a weight in [0, 1] is expected.")
    # Rounded, so that 1 - 0.1 is written 0.9 in the run's settings.
    return f"{round(1 - goal_weight, 12)}*mloo + {goal_weight}*goal(kind={kind!r}, partial={partial})"
