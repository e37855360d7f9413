"""What an agent is asked to do."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Goals:
    """A point for some of the agents. Frame: map (centred). `goal_mask` is True where an agent has a goal; elsewhere `position` means nothing."""

    position: Float[Tensor, "*batch A 2"]
    goal_mask: Bool[Tensor, "*batch A"]
