"""One file a reward: rollouts and their scores in, one number per rollout out. `expression` reads sums of them, `composition` adds."""

from rlftsim.training.rewards import collision_offroad as _collision_offroad
from rlftsim.training.rewards import displacement as _displacement
from rlftsim.training.rewards import goal as _goal
from rlftsim.training.rewards import mloo as _mloo
from rlftsim.training.rewards import rloo as _rloo
from rlftsim.training.rewards.base import (
    Reward,
    Shares,
    leave_one_out,
    register_reward,
    register_shares,
    register_sum,
    reward_by_name,
)
from rlftsim.training.rewards.composition import CreditTo, Rewards, compute_rewards
from rlftsim.training.rewards.expression import Term, parse_reward, write_reward

__all__ = [
    "CreditTo",
    "Reward",
    "Rewards",
    "Shares",
    "Term",
    "compute_rewards",
    "leave_one_out",
    "parse_reward",
    "register_reward",
    "register_shares",
    "register_sum",
    "reward_by_name",
    "write_reward",
]

del _collision_offroad, _displacement, _goal, _mloo, _rloo
