"""`rs.check_reward`: every rule of the reward contract, tried on a reward."""

from functools import partial
from typing import Any

from rlftsim.errors import ConfigError, in_short
from rlftsim.goals.types import logged_goals
from rlftsim.policies.registry import load_policy
from rlftsim.rewards import Reward, parse_reward, reward_by_name
from rlftsim.rewards.base import agent_rewards_by_name
from rlftsim.rewards.check import check_reward as check_contract
from rlftsim.rollout.contract import CheckReport
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.open import open_dataset
from rlftsim.verbs.arguments import Data
from rlftsim.verbs.inputs import to_batch, with_checked_arguments

NUM_ROLLOUTS = 3


@with_checked_arguments
def check_reward(reward: "Reward | str", scenarios: Data | None = None) -> CheckReport:
    """Try every rule of the reward contract that applies: shape, finite numbers, equal numbers for equal rollouts, no
    change of rollouts, no influence of padding, shares of agents that add up. Takes seconds.

    Args:
        reward: Function, or a registered name or a sum, such as "mloo + 0.1*on_the_road".
        scenarios: Scenarios with logged futures and different numbers of agents; left out, two that ship with the
            package.

    Returns:
        A result per rule. An error in the check of a rule counts as failed.

    Raises:
        ConfigError: Neither a function nor a sum of registered rewards.
    """
    rewards: dict[str, Any] = {}
    splits: dict[str, Any] = {}
    if isinstance(reward, str):
        for term in parse_reward(reward):
            rewards[term.name] = partial(reward_by_name(term.name), **dict(term.options))
            split = agent_rewards_by_name(term.name)
            if split is not None:
                splits[term.name] = partial(split, **dict(term.options))
    elif callable(reward):
        rewards[getattr(reward, "__name__", "reward")] = reward
    else:
        raise ConfigError(f"{in_short(reward)} is no reward: hand over a function, or the name of a registered one.")
    batch = to_batch(find_small_scenarios() if scenarios is None else scenarios)
    goals = logged_goals(batch)
    rollouts = simulate(load_policy("demo-base", "cpu"), batch, num_rollouts=NUM_ROLLOUTS, seed=0, goals=goals)
    name = reward if isinstance(reward, str) else next(iter(rewards))
    return check_contract(name, rewards, splits, batch, rollouts)


def find_small_scenarios() -> list[Any]:
    """The scenario with the smallest map that ships, and the next one with a different number of agents."""
    data = open_dataset("synthetic", "validation")
    order = data.index["num_map_points"].to_numpy().argsort(kind="stable").tolist()
    second = next(position for position in order if data.num_agents[position] != data.num_agents[order[0]])
    return [data[order[0]], data[second]]
