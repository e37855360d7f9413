"""Rollouts and logged futures as the metric reads them: world frame, float32, z of the current step."""

import torch

from rlftsim.errors import DataError
from rlftsim.realism.agents import SimulatedStates
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, TOTAL_STEPS, Scenario


def states_of_rollouts(batch: ScenarioBatch, rollouts: Rollouts) -> tuple[SimulatedStates, ...]:
    """Each scenario's rollouts without padding, in the world frame. Agents keep the height of the current step.

    Args:
        batch: the scenarios that were simulated.
        rollouts: N rollouts of each, in the frame of the batch.
    """
    world = batch.to_world(rollouts.position)  # [B, N, A, T, 2]
    states = []
    for b, scenario in enumerate(batch.scenarios):
        count = len(scenario.simulated_indices)
        position, heading = world[b, :, :count], rollouts.heading[b, :, :count]
        z = batch.z[b, :count, CURRENT_STEP, None].expand_as(heading)  # [N, A, T]
        ids = scenario.tracks.object_id[scenario.simulated_indices]
        states.append(SimulatedStates(ids, position[..., 0], position[..., 1], z, heading))
    return tuple(states)


def logged_states(scenario: Scenario, *, num_rollouts: int, device: torch.device | str = "cpu") -> SimulatedStates:
    """The logged future as N equal rollouts, the oracle. Invalid steps keep what the file stores, as officially.

    Args:
        scenario: with its future.
        num_rollouts: N; stored once.
        device: where the tensors go.

    Raises:
        DataError: the scenario has no logged future.
    """
    if not scenario.has_future:
        raise DataError(
            f"scenario {scenario.scenario_id} has no logged future: the oracle needs training or validation data."
        )
    chosen, future = scenario.simulated_indices, slice(TOTAL_STEPS - FUTURE_STEPS, TOTAL_STEPS)
    position = torch.from_numpy(scenario.tracks.position[chosen, future]).to(device)[None]  # [1, A, T, 3]
    heading = torch.from_numpy(scenario.tracks.heading[chosen, future]).to(device)[None]
    ids = scenario.tracks.object_id[chosen]
    x, y, z = position.unbind(-1)
    return SimulatedStates(ids, x, y, z, heading, repeat=num_rollouts)
