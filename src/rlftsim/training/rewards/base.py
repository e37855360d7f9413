"""What a reward is, and the table of known ones.

A reward maps the rollouts of a batch to one number each, shape [B, N]; its leave-one-out baseline is already inside. A new one, here
or in anybody's own package:

    @register_reward("quiet")
    def quiet(scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
        return leave_one_out(-scores.rollout_collision_rate)
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.realism import RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch

Reward = Callable[[RealismResult, Rollouts, ScenarioBatch], Float[Tensor, "B N"]]

_REWARDS: dict[str, Reward] = {}


def register_reward(name: str) -> Callable[[Reward], Reward]:
    """Make a reward known under a name.

    Raises:
        ConfigError: the name is taken.
    """

    def register(reward: Reward) -> Reward:
        if name in _REWARDS:
            raise ConfigError(f"reward {name!r} is registered already: choose another name.")
        _REWARDS[name] = reward
        return reward

    return register


def reward_by_name(name: str) -> Reward:
    """The reward of a name.

    Raises:
        ConfigError: unknown; lists the known ones.
    """
    if name not in _REWARDS:
        raise ConfigError(f"unknown reward {name!r}: known are {', '.join(sorted(_REWARDS))}.")
    return _REWARDS[name]


def leave_one_out(values: Float[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Each rollout's value minus the mean of the others. Sums to zero over the rollouts of a scenario.

    Raises:
        ConfigError: fewer than two rollouts, so there are no others.
    """
    num_rollouts = require_two(values)
    return (values - values.mean(-1, keepdim=True)) * (num_rollouts / (num_rollouts - 1))


def require_two(values: Float[Tensor, "B N"]) -> int:
    """N, if it is at least 2."""
    if values.shape[-1] < 2:
        raise ConfigError(
            f"a leave-one-out reward needs at least 2 rollouts per scenario, got {values.shape[-1]}: "
            "set finetune.num_rollouts >= 2."
        )
    return values.shape[-1]


def finite_or_zero(values: Float[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Rewards with the scenarios that have none (nothing valid to compare with) at zero."""
    return torch.where(values.isfinite().all(-1, keepdim=True), values, 0.0)
