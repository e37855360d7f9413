"""What a reward is, and the table of known ones.

A reward maps the rollouts of a batch to one number each, shape [B, N]; its leave-one-out baseline is already inside. A new one, here
or in anybody's own package:

    @register_reward("quiet")
    def quiet(scores: RealismResult, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N"]:
        return leave_one_out(-scores.rollout_collision_rate)

Keyword-only parameters with defaults become options: "quiet(scale=2)". A second function may say whose doing the reward is: shares of
the agents, shape [B, N, A], that add up to it. It is asked where credit goes by agent (`rewards.composition`):

    @register_shares("quiet")
    def quiet_shares(scores: AgentScores, rollouts: Rollouts, batch: ScenarioBatch) -> Float[Tensor, "B N A"]:
        return leave_one_out(-scores.collision)
"""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError

Reward = Callable[..., Float[Tensor, "B N"]]
"""Called with `RealismResult`, `Rollouts`, `ScenarioBatch` and its options."""
Shares = Callable[..., Float[Tensor, "B N A"]]
"""Called with `AgentScores`, `Rollouts`, `ScenarioBatch` and the reward's options."""
Sum = Callable[..., str]
"""Called with options; gives the sum of rewards that a name stands for."""

_REWARDS: dict[str, Reward] = {}
_SHARES: dict[str, Shares] = {}
_SUMS: dict[str, Sum] = {}

Function = TypeVar("Function", bound=Callable[..., Tensor | str])


def register_reward(name: str) -> Callable[[Function], Function]:
    """Make a reward known under a name.

    Raises:
        ConfigError: the name is taken, or is none that a sum of rewards can be written with.
    """
    return _register(_REWARDS, name, "reward")


def register_shares(name: str) -> Callable[[Function], Function]:
    """Make known how a reward is split over agents. It takes the same options.

    Raises:
        ConfigError: as `register_reward`.
    """
    return _register(_SHARES, name, "split of reward")


def register_sum(name: str) -> Callable[[Function], Function]:
    """Make a sum of rewards known under a name: a function of options that gives its text.

    Raises:
        ConfigError: as `register_reward`.
    """
    return _register(_SUMS, name, "sum of rewards")


def _register(table: dict[str, Callable[..., Any]], name: str, what: str) -> Callable[[Function], Function]:
    if not name.isidentifier():
        raise ConfigError(f"{what} {name!r}: a name is letters, digits and underscores, such as on_the_road.")

    def register(function: Function) -> Function:
        if name in table or (table is not _SHARES and name in (_REWARDS | _SUMS)):
            raise ConfigError(f"{what} {name!r} is registered already: choose another name.")
        table[name] = function
        return function

    return register


ENTRY_POINTS = "rlftsim.rewards"
"""Entry points of installed packages: modules that register rewards when they are imported."""


def reward_by_name(name: str) -> Reward:
    """The reward of a name; looked for in installed packages, too (`ENTRY_POINTS`).

    Raises:
        ConfigError: unknown; lists the known ones. Or a package's rewards cannot be imported.
    """
    if name not in _REWARDS:
        _import_rewards_of_packages()
    if name not in _REWARDS:
        raise ConfigError(f"unknown reward {name!r}: known are {', '.join(sorted(_REWARDS | _SUMS))}.")
    return _REWARDS[name]


def sum_by_name(name: str) -> Sum | None:
    """The sum of rewards that a name stands for; None = it is no such name."""
    return _SUMS.get(name)


def _import_rewards_of_packages() -> None:
    for entry in entry_points(group=ENTRY_POINTS):
        try:
            entry.load()
        except Exception as error:
            raise ConfigError(
                f"rewards of {entry.value} cannot be imported ({error}): mend or uninstall its package."
            ) from error


def shares_by_name(name: str) -> Shares | None:
    """How the reward of a name is split over agents; None = nobody has said."""
    return _SHARES.get(name)


def leave_one_out(values: Float[Tensor, "B N *A"]) -> Float[Tensor, "B N *A"]:
    """Each rollout's value minus the mean of the others. Sums to zero over the rollouts of a scenario.

    Raises:
        ConfigError: fewer than two rollouts, so there are no others.
    """
    num_rollouts = require_two(values)
    return (values - values.mean(1, keepdim=True)) * (num_rollouts / (num_rollouts - 1))


def require_two(values: Float[Tensor, "B N *A"]) -> int:
    """N, if it is at least 2."""
    if values.shape[1] < 2:
        raise ConfigError(
            f"a leave-one-out reward needs at least 2 rollouts per scenario, got {values.shape[1]}: "
            "set finetune.num_rollouts >= 2."
        )
    return values.shape[1]


def finite_or_zero(values: Float[Tensor, "B N *A"]) -> Float[Tensor, "B N *A"]:
    """Rewards with the scenarios that have none (nothing valid to compare with) at zero."""
    is_finite = values.isfinite().flatten(1).all(1)
    return torch.where(is_finite.view(-1, *[1] * (values.dim() - 1)), values, 0.0)
