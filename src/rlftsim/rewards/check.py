"""A test of any reward against the contract of `rewards.base`, on rollouts of two or more scenarios.

Scenarios of a batch are padded to the largest number of agents. Positions of padded agents are 0, so a plain mean over
agents depends on the other scenarios of the batch, which training changes from update to update.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from rlftsim.realism import AgentScores, RealismResult, score_rollouts
from rlftsim.rewards.base import AgentRewards, Reward
from rlftsim.rollout.contract import CheckReport, RuleBroken, RuleNotApplicable, check_limit, check_rules, compute_gap
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch, collate

TOLERANCE = 1e-4
"""Largest difference by rounding, as a fraction of the largest reward."""


def check_reward(
    name: str,
    rewards: Mapping[str, Reward],
    splits: Mapping[str, AgentRewards],
    batch: ScenarioBatch,
    rollouts: Rollouts,
) -> CheckReport:
    """Try every rule of the reward contract that applies.

    Args:
        name: Name of the reward, or sum of rewards, for the report.
        rewards: Functions of the terms by name, options filled in.
        splits: Splits over agents, for the terms that have some.
        batch: Scenarios with futures, best with different numbers of agents.
        rollouts: Two or more different rollouts of each scenario.
    """
    return check_rules(RewardRules(rewards, splits, batch, rollouts), name)


@dataclass(frozen=True, eq=False)
class RewardRules:
    """The contract: a public method for each rule, see `rollout.contract`."""

    _rewards: Mapping[str, Reward]
    _splits: Mapping[str, AgentRewards]
    _batch: ScenarioBatch
    _rollouts: Rollouts

    def each_rollout_gets_a_number(self) -> str:
        """Values are a tensor [B, N]."""
        return f"[B, N] = {list(self._values[0].shape)}"

    def numbers_are_finite(self) -> str:
        """No value is infinite or NaN."""
        if not all(values.isfinite().all() for values in self._computed):
            raise RuleBroken("a number is infinite or NaN, so that the scenario would earn 0")
        return f"largest {self._largest:.3g}"

    def the_same_rollouts_get_the_same_numbers(self) -> str:
        """A second call gives the same values."""
        expected = self._computed
        repeated = self._compute(self._rewards, self._batch, self._rollouts)
        return self._check_gap(max(map(compute_gap, repeated, expected)))

    def nothing_is_changed(self) -> str:
        """Rollouts and scenarios, which further terms read, are the same after a call."""
        tensors = (self._rollouts.position, self._rollouts.heading, self._batch.position, self._batch.heading)
        copies = [tensor.clone() for tensor in tensors]
        if self._computed:
            self._compute(self._rewards, self._batch, self._rollouts)
        if not all(map(torch.equal, tensors, copies)):
            raise RuleBroken("positions or headings are changed in place: clone() before")
        return "positions and headings stay"

    def padding_changes_no_number(self) -> str:
        """A scenario earns the same alone and in a batch with a larger scenario."""
        batch, expected, gaps = self._batch, self._computed, []
        if len(set(batch.agent_mask.sum(-1).tolist())) < 2:
            raise RuleNotApplicable("no scenario is padded: hand over scenarios with different numbers of agents")
        for row, scenario in enumerate(batch.scenarios):
            alone = collate([scenario]).to(batch.device)
            rollouts = self._rollouts.select_scenario(row, alone.agent_mask.shape[1])
            values = self._compute(self._rewards, alone, rollouts)
            gaps += [compute_gap(value[0], computed[row]) for value, computed in zip(values, expected)]
        try:
            return self._check_gap(max(gaps))
        except RuleBroken as error:
            raise RuleBroken(f"{error}: padded agents count; take rlftsim.rewards.masked_mean") from None

    def shares_of_agents_add_up(self) -> str:
        """Shares [B, N, A] of the agents add up to the reward, and padding has none."""
        if not self._splits:
            raise RuleNotApplicable("no split over agents is registered")
        shares = self._compute(self._splits, self._batch, self._rollouts)
        rewards = [values for name, values in zip(self._rewards, self._computed) if name in self._splits]
        padding = ~self._batch.agent_mask[:, None].expand_as(shares[0])
        self._check_gap(max(float(share[padding].abs().sum()) for share in shares), "shares of padded agents")
        return self._check_gap(max(compute_gap(share.sum(-1), reward) for share, reward in zip(shares, rewards)))

    # ---- what the rules share ---------------------------------------------------------------------------------------

    @cached_property
    def _scores(self) -> tuple[RealismResult, AgentScores]:
        return score_rollouts(self._batch, self._rollouts, "2025")

    @cached_property
    def _values(self) -> list[Tensor]:
        return self._compute(self._rewards, self._batch, self._rollouts)

    @property
    def _computed(self) -> list[Tensor]:
        """Values of each term, [B, N]."""
        try:
            return self._values
        except Exception:
            raise RuleNotApplicable("there are no numbers, see above") from None

    @property
    def _largest(self) -> float:
        return max(float(values.abs().max()) for values in self._computed)

    def _check_gap(self, gap: float, title: str = "largest gap") -> str:
        return check_limit(gap, TOLERANCE * max(self._largest, 1e-3), title)

    def _compute(
        self, functions: Mapping[str, Callable[..., Any]], batch: ScenarioBatch, rollouts: Rollouts
    ) -> list[Tensor]:
        """Values of functions of the same kind: rewards [B, N], or splits [B, N, A]."""
        realism, agents = self._scores if batch is self._batch else score_rollouts(batch, rollouts, "2025")
        is_split = functions is self._splits
        shape = rollouts.heading.shape[: 3 if is_split else 2]
        computed = []
        for name, function in functions.items():
            values = function(agents if is_split else realism, rollouts, batch)
            if not isinstance(values, Tensor) or values.shape != shape:
                result = f"shape {list(values.shape)}" if isinstance(values, Tensor) else f"a {type(values).__name__}"
                raise RuleBroken(f"{name} gives {result}, expected {list(shape)}, a number per rollout [B, N]")
            computed.append(values.detach().float().clone())
        return computed
