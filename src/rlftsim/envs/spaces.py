"""Spaces of Gymnasium for actions and observations."""

import math

import numpy as np
from gymnasium import spaces

from rlftsim.envs.actions import Controls
from rlftsim.envs.config import ObservationFormat
from rlftsim.envs.observations import BOUND, SHAPES, Observation


def action_space(controls: Controls) -> spaces.Space:
    """Space of an agent's actions."""
    if controls.num_choices:
        return spaces.Discrete(controls.num_choices)
    limits = controls.limits.astype(np.float32)
    return spaces.Box(-limits, limits, dtype=np.float32)


def observation_space(form: ObservationFormat) -> spaces.Space:
    """Space of an agent's observations; "arrays" has the space of "dict"."""
    if form == "flat":
        return spaces.Box(-BOUND, BOUND, (sum(math.prod(shape) for shape in SHAPES.values()),), np.float32)
    return spaces.Dict({
        name: spaces.Box(0, 1, shape, np.int8)
        if name.endswith("_mask")
        else spaces.Box(-BOUND, BOUND, shape, np.float32)
        for name, shape in SHAPES.items()
    })  # fmt: skip


def format_observation(observation: Observation, form: ObservationFormat, row: int | None = None):
    """An observation in the form of the space.

    Args:
        observation: Observation of M agents.
        form: Form of the observation, as the setting `observation` has it.
        row: Row of a single agent; None = all agents, with a leading axis M.
    """
    if form == "arrays":
        return observation
    if form == "flat":
        return observation.flat() if row is None else observation.flat()[row]
    return observation.by_name() if row is None else observation.of_agent(row)
