"""Rewards: from rollouts and realism scores to a number per rollout.

`expression` reads sums of rewards as text, `composition` adds rewards up and assigns the credit.
"""

# Importing a module registers its rewards.
from rlftsim.rewards import realism as _realism
from rlftsim.rewards.base import (
    REWARDS,
    AgentRewards,
    Reward,
    leave_one_out,
    masked_mean,
    register_agent_rewards,
    register_reward,
    register_sum,
    reward_by_name,
)
from rlftsim.rewards.expression import Rewards, Term, compute_rewards, parse_reward, write_reward
from rlftsim.rewards.goal import goal_terms

__all__ = [
    "REWARDS", "AgentRewards", "Reward", "Rewards", "Term", "compute_rewards", "goal_terms", "leave_one_out",
    "masked_mean", "parse_reward", "register_agent_rewards", "register_reward", "register_sum", "reward_by_name",
    "write_reward",
]  # fmt: skip

del _realism
