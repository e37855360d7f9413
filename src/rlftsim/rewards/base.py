"""Rewards and the table of registered rewards.

A reward maps the rollouts of a batch to a number for each rollout, shape [B, N]; the leave-one-out baseline is already
inside. A new reward, in a notebook or in a separate package:

    @register_reward("quiet")
    def quiet(realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
        return leave_one_out(-realism.rollout_collision_rate)

Keyword-only parameters with defaults become options: "quiet(scale=2)". A second function may split the reward
over agents, shape [B, N, A], for credit assignment by agent (`rewards.expression`); the sum over agents has to
equal the reward:

    @register_agent_rewards("quiet")
    def quiet_by_agent(agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
        return leave_one_out(-agents.collision)
"""

import inspect
import keyword
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar
from weakref import WeakSet

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint, is_ours

Reward = Callable[..., Float[Tensor, "B N"]]
"""Called with `RealismResult`, `Rollouts`, `ScenarioBatch` and the reward's options."""
AgentRewards = Callable[..., Float[Tensor, "B N A"]]
"""Called with `AgentScores`, `Rollouts`, `ScenarioBatch` and the reward's options."""
Sum = Callable[..., str]
"""Called with options; returns the sum of rewards that a name stands for."""

REWARDS: ExtensionPoint[Callable[..., Any]] = ExtensionPoint(
    "reward", "rlftsim.rewards", use=lambda name: sum_by_name(name) or validate_reward(name)
)
"""Rewards and named sums of rewards, by name."""
_SUMS: "WeakSet[Sum]" = WeakSet()
"""The entries of `REWARDS` that are sums."""
_SPLITS: dict[str, tuple[Reward, AgentRewards]] = {}
"""Name -> reward and its split over agents; a reward that is registered again does not inherit the split."""

Function = TypeVar("Function", bound=Callable[..., Any])


def register_reward(name: str) -> Callable[[Function], Function]:
    """Decorator that registers a reward under a name; an earlier reward of yours is replaced with a warning.

    Raises:
        ConfigError: The name is that of a shipped reward, or does not fit into a sum of rewards; or the function does
            not take the arguments that a reward is called with.
    """
    return _register(name, partial(check_signature, name))


def register_sum(name: str) -> Callable[[Function], Function]:
    """Decorator that registers a sum of rewards under a name: a function of options that returns the sum as text.

    Raises:
        ConfigError: The name is that of a shipped reward, or does not fit into a sum of rewards.
    """
    return _register(name, _SUMS.add)


def _register(name: str, prepare: Callable[[Function], object]) -> Callable[[Function], Function]:
    """Decorator that adds a function to `REWARDS` once it is prepared."""
    _check_name(name)

    def register(function: Function) -> Function:
        prepare(function)
        REWARDS.add(name, function, stacklevel=3)
        return function

    return register


def register_agent_rewards(name: str) -> Callable[[Function], Function]:
    """Decorator that registers the split of a registered reward over agents. Reward and split take the same options.

    Raises:
        ConfigError: No reward of this name is registered yet, or the reward ships with rlftsim; or the function does
            not take the arguments that a split is called with.
    """
    reward = reward_by_name(name)

    def register(function: Function) -> Function:
        if is_ours(reward) and not is_ours(function):
            raise ConfigError(f"reward {name!r} ships with rlftsim: choose another name.")
        check_signature(name, function)
        # None for a reward that was registered again: its split is missing, not replaced.
        earlier_split = agent_rewards_by_name(name)
        if earlier_split not in (None, function) and not is_ours(reward):
            warnings.warn(f"split of reward {name!r} is registered again and replaces the earlier one.", stacklevel=2)
        _SPLITS[name] = reward, function
        return function

    return register


def _check_name(name: object) -> None:
    if not isinstance(name, str):
        raise ConfigError('a reward needs a name: write @register_reward("name") above the function.')
    if not name.isidentifier() or keyword.iskeyword(name):
        raise ConfigError(f"reward {name!r}: a name is letters, digits and underscores, such as on_the_road.")


def check_signature(name: str, function: Callable[..., Any]) -> None:
    """Check that a reward or a split can be called with exactly three arguments by position.

    Args:
        name: Name of the reward in the message.
        function: Reward or split, of this or any other package.

    Raises:
        ConfigError: The function takes fewer arguments, or needs more.
    """
    try:
        inspect.signature(function).bind(None, None, None)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"reward {name}: {getattr(function, '__name__', function)} cannot be called with realism, rollouts and "
            f"batch ({error}): take these three by position, and options by keyword only with defaults, such as "
            "*, scale=1.0."
        ) from None


def reward_by_name(name: str) -> Reward:
    """The reward of a name, installed packages included.

    Raises:
        ConfigError: Unknown, with the nearest registered name; or a sum; or a package's rewards cannot be imported.
    """
    reward = REWARDS.get(name)
    if reward in _SUMS:
        raise ConfigError(f"reward {name!r} stands for a sum of rewards: it has no number of its own.")
    return reward


def validate_reward(name: str) -> Reward:
    """The reward of a name, checked for use in a sum: rewards of entry points are registered without a check.

    Raises:
        ConfigError: The causes in `reward_by_name`; or a name that does not fit into a sum of rewards, or a function
            that cannot be called like a reward.
    """
    _check_name(name)
    reward = reward_by_name(name)
    check_signature(name, reward)
    return reward


def sum_by_name(name: str) -> Sum | None:
    """The sum of rewards that a name stands for; None if there is no such sum."""
    function = REWARDS.find(name)
    return function if function is not None and function in _SUMS else None


def agent_rewards_by_name(name: str) -> AgentRewards | None:
    """The split of a reward over agents; None for a reward without a split."""
    reward, split = _SPLITS.get(name, (None, None))
    return split if reward is reward_by_name(name) else None


def leave_one_out(values: Float[Tensor, "B N *A"]) -> Float[Tensor, "B N *A"]:
    """Each rollout's value minus the mean of the other rollouts. Sums to zero over the rollouts of a scenario.

    Raises:
        ConfigError: Fewer than two rollouts, so that a baseline is missing.
    """
    check_num_rollouts(values)
    num_rollouts = values.shape[1]
    # v_i - sum_{j != i} v_j / (N - 1) = (v_i - mean) N / (N - 1)
    return (values - values.mean(1, keepdim=True)) * (num_rollouts / (num_rollouts - 1))


def masked_mean(values: Float[Tensor, "B N A"], mask: Bool[Tensor, "B A"]) -> Float[Tensor, "B N"]:
    """Mean over some agents of each scenario, 0 where there are none. Padding does not count, whatever its values.

    Args:
        values: Value of each agent in each rollout, such as a distance in meters.
        mask: Agents that count, such as `batch.agent_mask`, all but padding, or `batch.evaluated_mask`.
    """
    mask = mask[:, None]
    return torch.where(mask, values, 0.0).sum(-1) / mask.sum(-1).clamp(min=1)


def check_num_rollouts(values: Float[Tensor, "B N *A"]) -> None:
    """Check that values of at least two rollouts are present, as every leave-one-out reward needs.

    Raises:
        ConfigError: Fewer than two rollouts.
    """
    if values.shape[1] < 2:
        raise ConfigError(
            f"a leave-one-out reward needs at least 2 rollouts per scenario, got {values.shape[1]}: "
            "set finetune.num_rollouts >= 2."
        )
