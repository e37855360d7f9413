"""Planners that act for the agents of several scenes at once."""

from collections.abc import Callable, Mapping
from typing import Any, TypeGuard

import numpy as np

Observe = Callable[[], Mapping[str, np.ndarray]]
"""Makes the observations of M agents: arrays by name, agents first."""


class BatchPlanner:
    """Drives M agents in step. A subclass that defines `act` and not `act_batch` drives one agent at a time."""

    def reset(self, info: dict[str, Any]) -> None:
        """Do nothing: no memory. Called for each agent in turn before the first action."""

    def act_batch(self, observe: Observe) -> np.ndarray:
        """Actions of M agents whose episodes began together.

        Args:
            observe: Maker of the observations; takes time, so a planner that follows a plan does not call it.
        """
        raise NotImplementedError

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        """Action of a single agent."""
        return self.act_batch(lambda: {name: array[None] for name, array in observation.items()})[0]


def acts_in_batches(planner: object) -> TypeGuard[BatchPlanner]:
    """True for a `BatchPlanner` that has no `act` of its own."""
    return getattr(type(planner), "act", None) is BatchPlanner.act
