"""Miss rates by the definition of the Waymo motion prediction challenge. Reported beside the meta-metric.

The goal of an agent is the last logged position. A goal is missed if the simulated position is off, sideways or along
the logged heading, by more than a tolerance that grows with the horizon and shrinks for slow agents
(`goals.attainment`).
"""

from typing import NamedTuple

import numpy as np
import torch

from rlftsim.goals.attainment import compute_tolerance, is_within
from rlftsim.realism.agents import SimulatedStates
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S, TOTAL_STEPS, Scenario


class MissRates(NamedTuple):
    """Fractions of misses; NaN if no evaluated agent has a logged future."""

    at_goal: float
    """Missed at the step at which the goal was logged: fraction of (rollout, evaluated agent) pairs."""
    passing: float
    """Missed at every simulated step: fraction of the same pairs."""
    passing_in_every_rollout: float
    """Missed at every step of every rollout: fraction of evaluated agents, the challenge's way to count predictions."""


def compute_miss_rates(scenario: Scenario, states: SimulatedStates) -> MissRates:
    """Miss rates of a scenario's rollouts.

    Args:
        scenario: Scenario with its logged future, 91 steps.
        states: Rollouts of the scenario; repeated rollouts count once, which changes no fraction.
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
    index = torch.from_numpy(states.find_rows(tracks.object_id[evaluated])).to(states.device)
    position = torch.stack([states.x, states.y], -1).index_select(1, index)  # [N, E, T, 2]
    # 3. True where a simulated position is inside the box of the goal.
    goal = torch.from_numpy(tracks.position[evaluated, goal_step, :2]).to(position)
    heading = torch.from_numpy(tracks.heading[evaluated, goal_step]).to(position)
    tolerance = compute_tolerance(torch.from_numpy(speed), torch.from_numpy((last + 1) * STEP_S)).to(position)
    is_met = is_within(position - goal[:, None], heading[:, None], tolerance[:, None])  # [N, E, T]
    at_goal = is_met.gather(2, torch.from_numpy(last).to(index).expand(len(is_met), -1)[..., None])
    is_passed = is_met.any(-1)
    return MissRates(*(1.0 - float(mask.double().mean()) for mask in (at_goal, is_passed, is_passed.any(0))))
