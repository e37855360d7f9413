"""Planners that act for the agents of several scenes at once."""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, TypeGuard

import numpy as np

Observe = Callable[[], Mapping[str, np.ndarray]]
"""Makes the observations of M agents: arrays by name, agents first."""


class BatchPlanner:
    """Drives M agents in step. A subclass that defines `act` and not `act_batch` drives one agent at a time."""

    memory: ClassVar[tuple[str, ...]] = ()
    """Attributes that an action may change: arrays, agents first."""

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


def act_together(planners: Sequence[BatchPlanner], observe: Observe) -> np.ndarray:
    """Actions of planners that drive an agent each, with their memories put together and taken apart again.

    Args:
        planners: Copies of one planner, whose episodes began together.
        observe: Maker of the observations, in the order of the planners.
    """
    joined = copy.copy(planners[0])
    for name in joined.memory:
        setattr(joined, name, np.concatenate([getattr(planner, name) for planner in planners]))
    action = joined.act_batch(observe)
    for name in joined.memory:
        for planner, row in zip(planners, np.split(getattr(joined, name), len(planners))):
            setattr(planner, name, row)
    return action


def acts_together(planner: object) -> TypeGuard[BatchPlanner]:
    """True for a planner that acts in batches and has no attribute but its declared memory."""
    return acts_in_batches(planner) and vars(planner).keys() <= {*planner.memory}
