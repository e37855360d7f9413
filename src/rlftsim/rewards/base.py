"""Rewards and the table of known ones.

A reward maps the rollouts of a batch to one number each, shape [B, N]; its leave-one-out baseline is already
inside. A new one, in a notebook or in a package of its own:

    @register_reward("quiet")
    def quiet(realism: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
        return leave_one_out(-realism.rollout_collision_rate)

Keyword-only parameters with defaults become options: "quiet(scale=2)". A second function may split the reward
over agents, shape [B, N, A], for credit assignment by agent (`rewards.composition`); summed over agents it has to
give the reward:

    @register_agent_rewards("quiet")
    def quiet_by_agent(agents: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
        return leave_one_out(-agents.collision)
"""

import inspect
import keyword
import warnings
from collections.abc import Callable
from typing import Any, TypeVar
from weakref import WeakSet

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint, is_ours

Reward = Callable[..., Float[Tensor, "B N"]]
"""Called with `RealismResult`, `Rollouts`, `ScenarioBatch` and its options."""
AgentRewards = Callable[..., Float[Tensor, "B N A"]]
"""Called with `AgentScores`, `Rollouts`, `ScenarioBatch` and the reward's options."""
Sum = Callable[..., str]
"""Called with options; returns the sum of rewards that a name stands for."""

REWARDS: ExtensionPoint[Callable[..., Any]] = ExtensionPoint(
    "reward", "rlftsim.rewards", use=lambda name: sum_by_name(name) or checked_reward(name)
)
"""Rewards and named sums of them, by name."""
_SUMS: "WeakSet[Sum]" = WeakSet()
"""Those of them that are sums."""
_SPLITS: dict[str, tuple[Reward, AgentRewards]] = {}
"""Name -> reward and its split over agents; a reward that replaces it does not inherit the split."""

Function = TypeVar("Function", bound=Callable[..., Any])


def register_reward(name: str) -> Callable[[Function], Function]:
    """Decorator that registers a reward under a name; an earlier one of your own is replaced with a warning.

    Raises:
        ConfigError: the name is that of a shipped reward, or none that a sum of rewards can be written with; or the
            function does not take what a reward is called with.
    """
    _require_name(name)

    def register(function: Function) -> Function:
        require_signature(name, function)
        REWARDS.add(name, function, stacklevel=3)
        return function

    return register


def register_sum(name: str) -> Callable[[Function], Function]:
    """Decorator that registers a sum of rewards under a name: a function of options that returns its text.

    Raises:
        ConfigError: the name is that of a shipped reward, or none that a sum of rewards can be written with.
    """
    _require_name(name)

    def register(function: Function) -> Function:
        _SUMS.add(function)
        REWARDS.add(name, function, stacklevel=3)
        return function

    return register


def register_agent_rewards(name: str) -> Callable[[Function], Function]:
    """Decorator that registers the split of a known reward over agents. It takes the same options.

    Raises:
        ConfigError: there is no reward of this name yet, or it ships with rlftsim; or the function does not take what
            a split is called with.
    """
    reward = reward_by_name(name)

    def register(function: Function) -> Function:
        if is_ours(reward) and not is_ours(function):
            raise ConfigError(f"reward {name!r} ships with rlftsim: choose another name.")
        require_signature(name, function)
        # None for a reward that was registered again: its split is missing, not replaced.
        known = agent_rewards_by_name(name)
        if known not in (None, function) and not is_ours(reward):
            warnings.warn(f"split of reward {name!r} is registered again and replaces the earlier one.", stacklevel=2)
        _SPLITS[name] = reward, function
        return function

    return register


def _require_name(name: object) -> None:
    if not isinstance(name, str):
        raise ConfigError('a reward needs a name: write @register_reward("name") above the function.')
    if not name.isidentifier() or keyword.iskeyword(name):
        raise ConfigError(f"reward {name!r}: a name is letters, digits and underscores, such as on_the_road.")


def require_signature(name: str, function: Callable[..., Any]) -> None:
    """Require that a reward or its split can be called with three arguments by position and nothing else.

    Args:
        name: of the reward, for the message.
        function: of any package.

    Raises:
        ConfigError: it takes fewer, or needs more.
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
    """The reward of a name; those of installed packages are found, too.

    Raises:
        ConfigError: unknown, with the nearest known name; or it is a sum; or a package's rewards cannot be imported.
    """
    reward = REWARDS.get(name)
    if reward in _SUMS:
        raise ConfigError(f"reward {name!r} stands for a sum of rewards: it has no number of its own.")
    return reward


def checked_reward(name: str) -> Reward:
    """As `reward_by_name`, for a sum of rewards that is to be computed: those of entry points are registered without a
    look at them.

    Raises:
        ConfigError: as `reward_by_name`; or a sum cannot be written with the name, or the reward is not to be called as
            rewards are.
    """
    _require_name(name)
    reward = reward_by_name(name)
    require_signature(name, reward)
    return reward


def sum_by_name(name: str) -> Sum | None:
    """The sum of rewards that a name stands for; None if there is no such sum."""
    found = REWARDS.find(name)
    return found if found is not None and found in _SUMS else None


def agent_rewards_by_name(name: str) -> AgentRewards | None:
    """The split of a reward over agents; None if it has none."""
    reward, split = _SPLITS.get(name, (None, None))
    return split if reward is reward_by_name(name) else None


def leave_one_out(values: Float[Tensor, "B N *A"]) -> Float[Tensor, "B N *A"]:
    """Each rollout's value minus the mean of the others. Sums to zero over the rollouts of a scenario.

    Raises:
        ConfigError: fewer than two rollouts, so there are no others.
    """
    num_rollouts = require_two(values)
    # v_i - sum_{j != i} v_j / (N - 1) = (v_i - mean) N / (N - 1)
    return (values - values.mean(1, keepdim=True)) * (num_rollouts / (num_rollouts - 1))


def require_two(values: Float[Tensor, "B N *A"]) -> int:
    """N, if it is at least 2.

    Raises:
        ConfigError: it is less.
    """
    if values.shape[1] < 2:
        raise ConfigError(
            f"a leave-one-out reward needs at least 2 rollouts per scenario, got {values.shape[1]}: "
            "set finetune.num_rollouts >= 2."
        )
    return values.shape[1]


def finite_or_zero(values: Float[Tensor, "B N *A"]) -> tuple[Float[Tensor, "B N *A"], Bool[Tensor, "B"]]:
    """Rewards with the scenarios that have none (nothing valid to compare with) at zero, and True for those."""
    # A whole scenario at once: a leave-one-out reward of which one number is missing has no baseline.
    is_finite = values.isfinite().flatten(1).all(1)
    return torch.where(is_finite.view(-1, *[1] * (values.dim() - 1)), values, 0.0), ~is_finite
