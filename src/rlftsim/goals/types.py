"""What an agent is asked to do."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Goals:
    """A point for some of the agents of each rollout. Frame: map (centred). `goal_mask` is True where an agent has a goal; elsewhere `position` means nothing."""

    position: Float[Tensor, "B N A 2"]
    goal_mask: Bool[Tensor, "B N A"]

    def rollouts(self, selected: slice) -> "Goals":
        """The goals of some of the rollouts."""
        return Goals(self.position[:, selected], self.goal_mask[:, selected])
