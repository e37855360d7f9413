"""What an agent is asked to do."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.scenario.batch import ScenarioBatch, origin_of

Points = tuple[Int64[np.ndarray, "n"], Float[np.ndarray, "n 2"]]
"""Object ids, each once, and a point of each. Frame: world, metres, float64."""


@dataclass(frozen=True, eq=False)
class Goals:
    """A point for some of the agents of each rollout. Frame: map (centred). `goal_mask` is True where an agent has a goal; elsewhere `position` means nothing."""

    position: Float[Tensor, "B N A 2"]
    goal_mask: Bool[Tensor, "B N A"]

    @classmethod
    def of_scenarios(cls, position: Float[Tensor, "B A 2"], goal_mask: Bool[Tensor, "B A"]) -> "Goals":
        """The goals of a single rollout; `repeat` makes them those of N."""
        return cls(position[:, None], goal_mask[:, None])

    @property
    def num_rollouts(self) -> int:
        """N."""
        return self.goal_mask.shape[1]

    @property
    def any(self) -> bool:
        """Whether anybody has a goal."""
        return bool(self.goal_mask.any())

    def rollouts(self, selected: slice) -> "Goals":
        """The goals of some of the rollouts."""
        return Goals(self.position[:, selected], self.goal_mask[:, selected])

    def repeat(self, num_rollouts: int) -> "Goals":
        """The goals of a single rollout, asked in N of them, without copies; goals of N rollouts as they are.

        Raises:
            ConfigError: they are of another number of rollouts.
        """
        if self.num_rollouts not in (1, num_rollouts):
            raise ConfigError(
                f"goals of {self.num_rollouts} rollouts cannot be those of {num_rollouts}: give as many, or those of one."
            )
        return Goals(self.position.expand(-1, num_rollouts, -1, -1), self.goal_mask.expand(-1, num_rollouts, -1))

    def only(self, chosen: Bool[Tensor, "B #N A"]) -> "Goals":
        """The same, without the goals of agents that are not chosen."""
        return replace(self, goal_mask=self.goal_mask & chosen)

    def where(self, condition: Bool[Tensor, "B N A"], other: "Goals") -> "Goals":
        """These goals where a condition is True, other ones elsewhere."""
        return Goals(
            torch.where(condition[..., None], self.position, other.position),
            torch.where(condition, self.goal_mask, other.goal_mask),
        )

    def to(self, device: torch.device | str) -> "Goals":
        """The same goals on another device."""
        return Goals(self.position.to(device), self.goal_mask.to(device))


def goals_at(points: Mapping[str, Points], batch: ScenarioBatch) -> Goals:
    """Points of the world as goals of a batch, for a single rollout, in its frame.

    Args:
        points: by scenario id; those of agents that nobody simulates are left out.
        batch: scenarios and agents that have no point have no goal.
    """
    mask = np.zeros(batch.agent_mask.shape, bool)
    position = np.zeros((*mask.shape, 2), np.float32)
    for row, scenario in enumerate(batch.scenarios):
        if scenario.scenario_id in points:
            ids, places = points[scenario.scenario_id]
            simulated = scenario.tracks.object_id[scenario.simulated_indices]
            _, agents, asked = np.intersect1d(simulated, ids, return_indices=True)
            mask[row, agents] = True
            position[row, agents] = places[asked] - origin_of(scenario, batch.frame)
    return Goals.of_scenarios(torch.from_numpy(position), torch.from_numpy(mask)).to(batch.device)
