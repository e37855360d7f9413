"""Rollouts and logged futures in the metric's form: world frame, float32, z of the current step."""

import numpy as np
import torch

from rlftsim.errors import DataError
from rlftsim.realism.agents import SimulatedStates
from rlftsim.realism.config import SIM_AGENTS, Challenge, metric_by_name
from rlftsim.realism.credit import AgentScores
from rlftsim.realism.meta_metric import RealismResult, compute_batch_features, score_batch_features
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, TOTAL_STEPS, Scenario


def states_of_rollouts(batch: ScenarioBatch, rollouts: Rollouts) -> tuple[SimulatedStates, ...]:
    """Each scenario's rollouts without padding, in the world frame. Agents keep the height of the current step.

    Args:
        batch: Scenarios that were simulated, padded to the same number of agents.
        rollouts: N rollouts of each scenario, in the frame of the batch.
    """
    world = batch.to_world(rollouts.position)  # [B, N, A, T, 2]
    states = []
    for b, scenario in enumerate(batch.scenarios):
        count = len(scenario.simulated_indices)
        position, heading = world[b, :, :count], rollouts.heading[b, :, :count]
        z = batch.z[b, :count, CURRENT_STEP, None].expand_as(heading)  # [N, A, T]
        ids = scenario.tracks.object_id[scenario.simulated_indices]
        valid = None if rollouts.valid is None else rollouts.valid[b, :, :count]
        states.append(SimulatedStates(ids, position[..., 0], position[..., 1], z, heading, valid=valid))
    return tuple(states)


def score_rollouts(batch: ScenarioBatch, rollouts: Rollouts, metric: str) -> tuple[RealismResult, AgentScores]:
    """Realism of rollouts, and its split over agents; a scenario without a map counts as on the road.

    The features behind both are measured once; shares of agents are computed on first use.

    Args:
        batch: Scenarios with futures.
        rollouts: N rollouts of each scenario, in the frame of the batch.
        metric: Name of the meta-metric's configuration.
    """
    config = metric_by_name(metric)
    features = compute_batch_features(batch.scenarios, states_of_rollouts(batch, rollouts), missing_map="neutral")
    return score_batch_features(features, config), AgentScores(features, config, batch.agent_mask.shape[1])


def prepend_history(scenario: Scenario, states: SimulatedStates) -> SimulatedStates:
    """A generated scene: the history that rollouts began with, then the rollouts; sizes are those of the history.

    Args:
        scenario: Scenario with the generated history of the simulated agents, all valid.
        states: N rollouts from there on, agents in track order.
    """
    tracks, simulated, num_rollouts = scenario.tracks, scenario.simulated_indices, len(states.x)
    history = np.concatenate([tracks.position, tracks.heading[..., None]], -1)[simulated, :HISTORY_STEPS]  # [A, 11, 4]
    columns = torch.from_numpy(history).to(states.device).expand(num_rollouts, -1, -1, -1).unbind(-1)
    future = (states.x, states.y, states.z, states.heading)
    size = torch.from_numpy(tracks.size[simulated, CURRENT_STEP, None]).to(states.device)  # [A, 1, 3]
    size = size.expand(num_rollouts, -1, TOTAL_STEPS, -1)
    x, y, z, heading = (torch.cat(pair, -1) for pair in zip(columns, future))
    return SimulatedStates(states.object_id, x, y, z, heading, size=size)


def logged_states(
    scenario: Scenario, *, num_rollouts: int, device: torch.device | str = "cpu", challenge: Challenge = SIM_AGENTS
) -> SimulatedStates:
    """The logged future as N equal rollouts, the oracle. Invalid steps keep what the file stores, as officially.

    Args:
        scenario: Scenario with its logged future, 91 steps.
        num_rollouts: Number of rollouts N; equal rollouts are stored once.
        device: Device of the tensors; the metric is computed there.
        challenge: Rules that say which steps a rollout has, and whether sizes.

    Raises:
        DataError: The scenario has no logged future.
    """
    if not scenario.has_future:
        raise DataError(
            f"scenario {scenario.scenario_id} has no logged future: the oracle needs training or validation data."
        )
    tracks, simulated, steps = scenario.tracks, scenario.simulated_indices, slice(challenge.first_step, TOTAL_STEPS)
    position, heading, size = (
        torch.from_numpy(values[simulated, steps]).to(device)[None]
        for values in (tracks.position, tracks.heading, tracks.size)
    )  # [1, A, T, ...]
    x, y, z = position.unbind(-1)
    size = size if challenge.makes_scenes else None
    return SimulatedStates(tracks.object_id[simulated], x, y, z, heading, repeat=num_rollouts, size=size)
