"""Rewards, a file for each: from rollouts and realism scores to a number per rollout.

`expression` reads sums of rewards as text, `composition` adds rewards up and assigns the credit.
"""

# Importing a module registers its rewards.
from rlftsim.rewards import collision_offroad as _collision_offroad
from rlftsim.rewards import displacement as _displacement
from rlftsim.rewards import goal as _goal
from rlftsim.rewards import mloo as _mloo
from rlftsim.rewards import rloo as _rloo
from rlftsim.rewards.base import (
    REWARDS,
    AgentRewards,
    Reward,
    leave_one_out,
    register_agent_rewards,
    register_reward,
    register_sum,
    reward_by_name,
)
from rlftsim.rewards.composition import CreditTo, Rewards, compute_rewards
from rlftsim.rewards.expression import Term, parse_reward, write_reward

__all__ = [
    "REWARDS",
    "AgentRewards",
    "CreditTo",
    "Reward",
    "Rewards",
    "Term",
    "compute_rewards",
    "leave_one_out",
    "parse_reward",
    "register_agent_rewards",
    "register_reward",
    "register_sum",
    "reward_by_name",
    "write_reward",
]

del _collision_offroad, _displacement, _goal, _mloo, _rloo
