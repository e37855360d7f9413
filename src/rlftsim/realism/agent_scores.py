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
    """Shares of A agents in the scores of N distinct rollouts of B scenarios; the shares sum to the rollout's score."""

    features: tuple[ScenarioFeatures, ...]
    config: MetricConfig
    num_agents: int
    """A, padding included."""

    @cached_property
    def leave_one_out(self) -> Float64[Tensor, "B N A"]:
        """Shares of mean_j RMM(-j) - RMM(-i), the reward `mloo`; see `Credit.mloo`. The sum over rollouts is zero."""
        return self._scatter(lambda scene: compute_credit(scene.log, scene.features, self.config).mloo.sum(-1))

    @cached_property
    def sub_scores(self) -> dict[str, Float64[Tensor, "B N A"]]:
        """`leave_one_out` in its parts of each sub-score, by name."""
        credits = {id(scene): compute_credit(scene.log, scene.features, self.config).mloo for scene in self.features}
        columns = {name: [FEATURE_NAMES.index(feature) for feature in names] for name, names in SUB_SCORES.items()}
        return {
            name: self._scatter(lambda scene, index=index: credits[id(scene)][..., index].nan_to_num().sum(-1))
            for name, index in columns.items()
        }

    @cached_property
    def single(self) -> Float64[Tensor, "B N A"]:
        """Shares of RMM_i - mean_{j != i} RMM_j, the reward `rloo`; see `compute_single_credit`."""
        return self._scatter(lambda scene: compute_single_credit(scene.log, scene.features, self.config).sum(-1))

    @cached_property
    def displacement_error(self) -> Float[Tensor, "B N A"]:
        """Shares of `RealismResult.rollout_displacement_error`, m: an agent's error over the number of agents E."""
        return self._scatter_mean(lambda scene: scene.features.displacement_error)

    @cached_property
    def collision(self) -> Float[Tensor, "B N A"]:
        """Shares of `RealismResult.rollout_collision_rate`: 1 / E for each evaluated agent that collides."""
        return self._scatter_mean(lambda scene: compute_outcomes(scene.features, scene.log)[:, 0].float())

    @cached_property
    def offroad(self) -> Float[Tensor, "B N A"]:
        """Shares of `RealismResult.rollout_offroad_rate`: 1 / E for each evaluated agent that leaves the road."""
        return self._scatter_mean(lambda scene: compute_outcomes(scene.features, scene.log)[:, 1].float())

    def _scatter_mean(self, compute: Callable[[ScenarioFeatures], Tensor]) -> Tensor:
        """Values [N, E] over the number of evaluated agents in each scenario, scattered as by `_scatter`."""

        def divide(scene: ScenarioFeatures) -> Tensor:
            values, layout = compute(scene), scene.log.agents.layout
            return values / to_agents(sum_over_agents(torch.ones_like(values[0]), layout), layout)

        return self._scatter(divide)

    def _scatter(self, compute: Callable[[ScenarioFeatures], Tensor]) -> Tensor:
        """Values [N, E] of each scenario's evaluated agents, scattered to the agent axis of the batch: [B, N, A]."""
        rows = []
        for scene in self.features:
            values, layout, index = compute(scene), scene.log.agents.layout, scene.log.agents.evaluated
            if layout is not None:
                # From the index among the agents of all scenarios to that in the padded batch.
                index = index - layout.first_agent[layout.scenario] + layout.scenario * self.num_agents
            row = values.new_zeros(len(values), len(scene.log.scenario_ids) * self.num_agents)
            rows.append(row.index_copy(1, index, values).view(len(values), -1, self.num_agents))
        return torch.cat(rows, 1).transpose(0, 1)
