"""Means that calibration keeps unchanged, by name: the value in a scenario, and the credit of each agent for the value.

B scenarios, N rollouts, A agents.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import AgentScores
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.experience import simulated_speeds


@dataclass(frozen=True)
class Constraint:
    """A sum over agents, of which the mean over rollouts is held, or the least."""

    shares: Callable[[ScenarioBatch, Rollouts, AgentScores], Float[Tensor, "B N A"]]
    """Part of each agent in each rollout; they are summed over agents."""
    is_minimum: bool = False
    """True = the value is that of the rollout with the least sum."""

    def value(self, shares: Float[Tensor, "B N A"]) -> Float[Tensor, "B"]:
        """Value in each scenario."""
        total = shares.sum(-1)
        return total.amin(1) if self.is_minimum else total.mean(1)

    def credit(self, shares: Float[Tensor, "B N A"]) -> Float[Tensor, "B N A"]:
        """Contribution of an agent's decisions in a rollout to the value.

        Summed with score functions over rollouts and agents, credits are an estimate of the value's gradient, without
        bias where no agent's part depends on other agents.
        """
        if not self.is_minimum:
            return subtract_baseline(shares / shares.shape[1])
        # Without the rollout of the least sum the value is the second one, without any other it is what it was.
        first, second = shares.sum(-1).topk(2, dim=1, largest=False).indices.unbind(1)  # [B]
        row, added = torch.arange(len(shares), device=shares.device), torch.zeros_like(shares)
        added[row, first] = shares[row, first] - shares[row, second]
        return added


def subtract_baseline(added: Float[Tensor, "B N A"]) -> Float[Tensor, "B N A"]:
    """Contributions of rollouts minus the mean of the other rollouts' contributions.

    Where that mean depends on the rollout at hand, as in `mloo`, the score function of the rollout times the result is
    the gradient to first order.
    """
    num_rollouts = added.shape[1]
    return (added - added.mean(1, keepdim=True)) * (num_rollouts / (num_rollouts - 1))


def mean_speed(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """Parts of the agents in the mean speed, m/s, over the steps that the log has."""
    speed, logged_valid = simulated_speeds(batch, rollouts)
    by_agent = (speed * logged_valid[:, None]).sum(-1) / logged_valid.sum(-1).clamp(min=1)[:, None]  # [B, N, A]
    return _share(by_agent, logged_valid.any(-1))


def mean_evaluated_speed(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """The same of the evaluated agents alone."""
    speed, logged_valid = simulated_speeds(batch, rollouts)
    by_agent = (speed * logged_valid[:, None]).sum(-1) / logged_valid.sum(-1).clamp(min=1)[:, None]
    return _share(by_agent, logged_valid.any(-1) & batch.evaluated_mask)


def displacement(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """Parts of the evaluated agents in the displacement error, m."""
    return agents.displacement_error.double()


def _share(values: Float[Tensor, "B N A"], counts: Tensor) -> Float[Tensor, "B N A"]:
    """Values of the agents that count over the number of these agents; 0 for all other agents."""
    number = counts.sum(-1).clamp(min=1)[:, None, None]
    return torch.where(counts[:, None], values, 0.0) / number


CONSTRAINTS = {
    "speed": Constraint(mean_speed),
    "evaluated_speed": Constraint(mean_evaluated_speed),
    "min_ade": Constraint(displacement, is_minimum=True),
}
"""Constrained means by name: m/s of all agents and of the evaluated ones, and minADE in m."""
