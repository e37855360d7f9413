"""What each agent has to do with the scores of its rollouts, in a batch's order of agents: for rewards that are owed by agent.

Everybody who is not evaluated, and padding, has 0. Each property is computed when it is first asked for, from features that are there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from rlftsim.realism.batch import Measured
from rlftsim.realism.config import MetricConfig
from rlftsim.realism.credit import compute_credit, compute_single_credit
from rlftsim.realism.likelihood import compute_outcomes


@dataclass(frozen=True, eq=False)
class AgentScores:
    """Shares of A agents in scores of N distinct rollouts of B scenarios. Summed over agents they are the rollout's score."""

    measured: tuple[Measured, ...]
    config: MetricConfig
    num_agents: int
    """A, padding included."""

    @cached_property
    def leave_one_out(self) -> Float64[Tensor, "B N A"]:
        """Of mean_j RMM(-j) - RMM(-i), the reward `mloo`, see `Credit.mloo`. Sums to zero over rollouts, too."""
        return self._place(lambda item: compute_credit(item.log, item.features, self.config).mloo.sum(-1))

    @cached_property
    def single(self) -> Float64[Tensor, "B N A"]:
        """Of RMM_i - mean_{j != i} RMM_j, the reward `rloo`, see `compute_single_credit`."""
        return self._place(lambda item: compute_single_credit(item.log, item.features, self.config).sum(-1))

    @cached_property
    def displacement_error(self) -> Float[Tensor, "B N A"]:
        """Of `RealismResult.rollout_displacement_error`, m: the agent's own error over the number of evaluated agents."""
        return self._place(lambda item: item.features.displacement_error / item.features.displacement_error.shape[-1])

    @cached_property
    def collision(self) -> Float[Tensor, "B N A"]:
        """Of `RealismResult.rollout_collision_rate`: one over the number of evaluated agents for whoever collides."""
        return self._place(lambda item: _share_of_outcome(item, 0))

    @cached_property
    def offroad(self) -> Float[Tensor, "B N A"]:
        """Of `RealismResult.rollout_offroad_rate`."""
        return self._place(lambda item: _share_of_outcome(item, 1))

    def _place(self, compute: Callable[[Measured], Tensor]) -> Tensor:
        """Values [N, E] of each scenario's evaluated agents at these agents' places [B, N, A]."""
        rows = []
        for item in self.measured:
            values = compute(item)
            row = values.new_zeros(len(values), self.num_agents)
            rows.append(row.index_copy(1, item.log.agents.evaluated, values))
        return torch.stack(rows)


def _share_of_outcome(item: Measured, outcome: int) -> Float[Tensor, "N E"]:
    """What each evaluated agent adds to the rate of an outcome, in the order of `BERNOULLI_FEATURES`."""
    happened = compute_outcomes(item.features, item.log)[:, outcome]
    return happened.float() / happened.shape[-1]
