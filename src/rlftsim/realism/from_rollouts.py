"""Rollouts and recorded futures as the metric wants them: world frame, float32, z of the current step."""

import torch

from rlftsim.errors import DataError
from rlftsim.realism.agents import SimulatedStates
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, TOTAL_STEPS, Scenario


def states_of_rollouts(batch: ScenarioBatch, rollouts: Rollouts) -> tuple[SimulatedStates, ...]:
    """Each scenario's rollouts without padding, in the world frame. Everybody keeps the height of the current step."""
    world = batch.to_world(rollouts.position)
    states = []
    for b, scenario in enumerate(batch.scenarios):
        count = len(scenario.simulated_indices)
        position, heading = world[b, :, :count], rollouts.heading[b, :, :count]
        z = batch.z[b, :count, CURRENT_STEP, None].expand_as(heading)
        ids = scenario.tracks.object_id[scenario.simulated_indices]
        states.append(SimulatedStates(ids, position[..., 0], position[..., 1], z, heading))
    return tuple(states)


def logged_states(scenario: Scenario, *, num_rollouts: int, device: torch.device | str = "cpu") -> SimulatedStates:
    """What was recorded, N times: the oracle. Invalid steps keep what the record stores, as in the official converter.

    Raises:
        DataError: the scenario has no recorded future.
    """
    if not scenario.has_future:
        raise DataError(
            f"scenario {scenario.scenario_id} has no recorded future: the oracle needs training or validation data."
        )
    chosen, future = scenario.simulated_indices, slice(TOTAL_STEPS - FUTURE_STEPS, TOTAL_STEPS)
    position = torch.from_numpy(scenario.tracks.position[chosen, future]).to(device)[None]
    heading = torch.from_numpy(scenario.tracks.heading[chosen, future]).to(device)[None]
    ids = scenario.tracks.object_id[chosen]
    x, y, z = position.unbind(-1)
    return SimulatedStates(ids, x, y, z, heading, repeat=num_rollouts)
