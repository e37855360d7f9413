"""Miss rates by the definition of the Waymo motion prediction challenge. Reported beside the meta-metric.

An agent's goal is its last logged position. It is missed if the simulated position is off, sideways or along the logged
heading, by more than a tolerance that grows with the horizon and shrinks for slow agents (`goals.attainment`).
"""

from typing import NamedTuple

import numpy as np
import torch

from rlftsim.goals.attainment import is_within, tolerance_m
from rlftsim.realism.agents import SimulatedStates
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S, TOTAL_STEPS, Scenario


class MissRates(NamedTuple):
    """Fractions of misses; NaN if no evaluated agent has a logged future."""

    at_goal: float
    """Missed at the step at which the goal was logged: fraction of (rollout, evaluated agent) pairs."""
    passing: float
    """Missed at every simulated step: fraction of the same pairs."""
    passing_in_all: float
    """Missed at every step of every rollout: fraction of evaluated agents, the challenge's way to count predictions."""


def compute_miss_rates(scenario: Scenario, states: SimulatedStates) -> MissRates:
    """Miss rates of one scenario's rollouts.

    Args:
        scenario: with its future.
        states: its rollouts; repeated ones count once, which changes no fraction.
    """
    # 1. Last logged state of each evaluated agent that has a logged future.
    tracks, evaluated = scenario.tracks, scenario.evaluated_indices
    future_valid = tracks.valid[evaluated, CURRENT_STEP + 1 : TOTAL_STEPS]
    evaluated, future_valid = evaluated[future_valid.any(1)], future_valid[future_valid.any(1)]
    if not len(evaluated):
        return MissRates(*[float("nan")] * 3)
    last = FUTURE_STEPS - 1 - future_valid[:, ::-1].argmax(1)  # [E], future step of the goal
    goal_step = last + CURRENT_STEP + 1
    speed = np.linalg.norm(tracks.velocity[evaluated, CURRENT_STEP], axis=-1)
    # 2. The same agents in the rollouts, which may list agents in any order.
    order = np.argsort(states.object_id)
    rows = order[np.searchsorted(states.object_id[order], tracks.object_id[evaluated])]
    index = torch.from_numpy(rows).to(states.device)
    position = torch.stack([states.x, states.y], -1).index_select(1, index)  # [N, E, T, 2]
    # 3. True where a simulated position is inside the box of the goal.
    goal = torch.from_numpy(tracks.position[evaluated, goal_step, :2]).to(position)
    heading = torch.from_numpy(tracks.heading[evaluated, goal_step]).to(position)
    tolerance = tolerance_m(torch.from_numpy(speed), torch.from_numpy((last + 1) * STEP_S)).to(position)
    met = is_within(position - goal[:, None], heading[:, None], tolerance[:, None])  # [N, E, T]
    at_goal = met.gather(2, torch.from_numpy(last).to(index).expand(len(met), -1)[..., None])
    passes = met.any(-1)
    return MissRates(*(1.0 - float(hits.double().mean()) for hits in (at_goal, passes, passes.any(0))))
