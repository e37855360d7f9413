"""Scores of rollouts split over agents, in a batch's order of agents: for rewards with credit per agent.

Agents that are not evaluated, and padding, have 0. Each property is computed on first use, from features that exist.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from rlftsim.realism.agents import sum_over_agents, to_agents
from rlftsim.realism.batch import ScenarioFeatures
from rlftsim.realism.config import FEATURE_NAMES, SUB_SCORES, MetricConfig
from rlftsim.realism.credit import compute_credit, compute_single_credit
from rlftsim.realism.likelihood import compute_outcomes


@dataclass(frozen=True, eq=False)
class AgentScores:
    """Parts of A agents in the scores of N distinct rollouts of B scenarios; their sum is the rollout's score."""

    measured: tuple[ScenarioFeatures, ...]
    config: MetricConfig
    num_agents: int
    """A, padding included."""

    @cached_property
    def leave_one_out(self) -> Float64[Tensor, "B N A"]:
        """Parts of mean_j RMM(-j) - RMM(-i), the reward `mloo`; see `Credit.mloo`. Their sum over rollouts is zero."""
        return self._place(lambda item: compute_credit(item.log, item.features, self.config).mloo.sum(-1))

    @cached_property
    def sub_scores(self) -> dict[str, Float64[Tensor, "B N A"]]:
        """`leave_one_out` in its parts of each sub-score, by name."""
        credits = {id(item): compute_credit(item.log, item.features, self.config).mloo for item in self.measured}
        columns = {name: [FEATURE_NAMES.index(one) for one in members] for name, members in SUB_SCORES.items()}
        return {
            name: self._place(lambda item, chosen=chosen: credits[id(item)][..., chosen].nan_to_num().sum(-1))
            for name, chosen in columns.items()
        }

    @cached_property
    def single(self) -> Float64[Tensor, "B N A"]:
        """Parts of RMM_i - mean_{j != i} RMM_j, the reward `rloo`; see `compute_single_credit`."""
        return self._place(lambda item: compute_single_credit(item.log, item.features, self.config).sum(-1))

    @cached_property
    def displacement_error(self) -> Float[Tensor, "B N A"]:
        """Parts of `RealismResult.rollout_displacement_error`, m: an agent's own error over the number of agents E."""
        return self._place(lambda item: item.features.displacement_error / _num_evaluated(item))

    @cached_property
    def collision(self) -> Float[Tensor, "B N A"]:
        """Parts of `RealismResult.rollout_collision_rate`: 1 / E for each evaluated agent that collides."""
        return self._place(lambda item: _part_of_rate(item, 0))

    @cached_property
    def offroad(self) -> Float[Tensor, "B N A"]:
        """Parts of `RealismResult.rollout_offroad_rate`: 1 / E for each evaluated agent that leaves the road."""
        return self._place(lambda item: _part_of_rate(item, 1))

    def _place(self, compute: Callable[[ScenarioFeatures], Tensor]) -> Tensor:
        """Values [N, E] of each scenario's evaluated agents, scattered to their places in the batch: [B, N, A]."""
        rows = []
        for item in self.measured:
            values, agents, place = compute(item), item.log.agents, item.log.agents.evaluated
            if agents.layout is not None:
                # From places among the agents of all scenarios to those in the padded batch.
                scenario = agents.layout.scenario
                place = place - agents.layout.first_agent[scenario] + scenario * self.num_agents
            row = values.new_zeros(len(values), len(item.log.scenario_ids) * self.num_agents)
            rows.append(row.index_copy(1, place, values).view(len(values), -1, self.num_agents))
        return torch.cat(rows, 1).transpose(0, 1)


def _part_of_rate(item: ScenarioFeatures, outcome: int) -> Float[Tensor, "N E"]:
    """Part of each evaluated agent in the rate of an outcome (index into `BERNOULLI_FEATURES`)."""
    return compute_outcomes(item.features, item.log)[:, outcome].float() / _num_evaluated(item)


def _num_evaluated(item: ScenarioFeatures) -> Float[Tensor, "E_or_1"]:
    """Number of evaluated agents of each agent's scenario."""
    layout, ones = item.log.agents.layout, torch.ones_like(item.features.displacement_error[0])
    return to_agents(sum_over_agents(ones, layout), layout)
