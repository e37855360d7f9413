"""Who misses where the record ended: the miss rate of the Waymo motion prediction challenge. Reported beside the meta-metric.

An agent's goal is its last recorded position. It is missed when the simulated position lies further from it, sideways or along the
recorded heading, than a tolerance that grows with the horizon and shrinks for slow agents.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.realism.agents import SimulatedStates
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S, TOTAL_STEPS, Scenario

HORIZON_S = (3.0, 5.0, 8.0)
SIDEWAYS_M = (1.0, 1.8, 3.0)
ALONG_M = (2.0, 3.6, 6.0)
"""Tolerances at these horizons; linear between, constant before."""
SLOW_MPS, FAST_MPS = 1.4, 11.0
SLOW_FACTOR = 0.5
"""Of agents at most that slow at the current step; 1 from the fast speed on, linear between."""


class MissRates(NamedTuple):
    """Shares of (rollout, evaluated agent) pairs; NaN where nobody has a recorded future."""

    at_goal: float
    """Missed at the step at which the goal was recorded."""
    passing: float
    """Missed at every simulated step."""


def compute_miss_rates(scenario: Scenario, states: SimulatedStates) -> MissRates:
    """Miss rates of one scenario's rollouts.

    Args:
        scenario: with its future.
        states: its rollouts; rollouts that stand for several count once, which changes no share.
    """
    tracks, evaluated = scenario.tracks, scenario.evaluated_indices
    future_valid = tracks.valid[evaluated, CURRENT_STEP + 1 : TOTAL_STEPS]
    evaluated, future_valid = evaluated[future_valid.any(1)], future_valid[future_valid.any(1)]
    if not len(evaluated):
        return MissRates(float("nan"), float("nan"))
    last = FUTURE_STEPS - 1 - future_valid[:, ::-1].argmax(1)  # future step of the goal [E]
    goal_step = last + CURRENT_STEP + 1
    speed = np.linalg.norm(tracks.velocity[evaluated, CURRENT_STEP], axis=-1)
    tolerance = tolerance_m(speed, (last + 1) * STEP_S)
    order = np.argsort(states.object_id)
    rows = order[np.searchsorted(states.object_id[order], tracks.object_id[evaluated])]
    index = torch.from_numpy(rows).to(states.device)
    position = torch.stack([states.x, states.y], -1).index_select(1, index)  # [N, E, T, 2]
    goal = torch.from_numpy(tracks.position[evaluated, goal_step, :2]).to(position)
    heading = torch.from_numpy(tracks.heading[evaluated, goal_step]).to(position)
    met = is_within(position - goal[:, None], heading, torch.from_numpy(tolerance).to(position))  # [N, E, T]
    at_goal = met.gather(2, torch.from_numpy(last).to(index).expand(len(met), -1)[..., None])
    return MissRates(1.0 - float(at_goal.double().mean()), 1.0 - float(met.any(-1).double().mean()))


def tolerance_m(speed: Float[np.ndarray, "E"], horizon_s: Float[np.ndarray, "E"]) -> Float[np.ndarray, "E 2"]:
    """How far along the recorded heading and sideways an agent may be from its goal, m.

    Args:
        speed: at the current step, m/s.
        horizon_s: time from the current step to the goal.
    """
    factor = np.interp(speed, (SLOW_MPS, FAST_MPS), (SLOW_FACTOR, 1.0))
    widths = [np.interp(horizon_s, HORIZON_S, sizes) for sizes in (ALONG_M, SIDEWAYS_M)]
    return factor[:, None] * np.stack(widths, -1)


def is_within(
    offset: Float[Tensor, "N E T 2"], heading: Float[Tensor, "E"], tolerance: Float[Tensor, "E 2"]
) -> Bool[Tensor, "N E T"]:
    """Whether offsets from the goal lie inside its box.

    Args:
        offset: position minus goal, m.
        heading: of the box, rad.
        tolerance: half its length and half its width.
    """
    cos, sin = heading.cos()[:, None], heading.sin()[:, None]
    along = offset[..., 0] * cos + offset[..., 1] * sin
    sideways = offset[..., 1] * cos - offset[..., 0] * sin
    return (along.abs() <= tolerance[:, None, 0]) & (sideways.abs() <= tolerance[:, None, 1])
