"""The realism metric on the pack: the log scores finite and above constant velocity."""

import numpy as np
import pytest
import torch

from rlftsim.realism.agents import SimulatedStates
from rlftsim.realism.meta_metric import score
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S, Scenario


def filled_log(scenario: Scenario) -> SimulatedStates:
    """The logged future as a rollout; a step at which an agent is hidden repeats the last one seen."""
    agents = scenario.simulated_indices
    valid = scenario.tracks.valid[agents, CURRENT_STEP:]
    latest = np.maximum.accumulate(np.where(valid, np.arange(valid.shape[1]), 0), axis=1)[:, 1:] + CURRENT_STEP
    position = np.take_along_axis(scenario.tracks.position[agents], latest[..., None], axis=1)
    heading = np.take_along_axis(scenario.tracks.heading[agents], latest, axis=1)
    return as_rollout(scenario, position, heading)


def constant_velocity(scenario: Scenario) -> SimulatedStates:
    agents, tracks = scenario.simulated_indices, scenario.tracks
    time_s = (np.arange(FUTURE_STEPS) + 1) * STEP_S
    position = np.repeat(tracks.position[agents, CURRENT_STEP, None], FUTURE_STEPS, axis=1)
    position[..., :2] += tracks.velocity[agents, CURRENT_STEP, None] * time_s[:, None]
    return as_rollout(scenario, position, np.repeat(tracks.heading[agents, CURRENT_STEP, None], FUTURE_STEPS, axis=1))


def as_rollout(scenario: Scenario, position: np.ndarray, heading: np.ndarray) -> SimulatedStates:
    x, y, z = (torch.tensor(position[None, ..., k], dtype=torch.float32) for k in range(3))
    object_id = scenario.tracks.object_id[scenario.simulated_indices]
    return SimulatedStates(object_id, x, y, z, torch.tensor(heading[None], dtype=torch.float32), repeat=32)


@pytest.mark.parametrize("position", [0, 60, 120])
def test_log_scores_finite_and_above_constant_velocity(position):
    scenario = ScenarioDataset(pack_path())[position]
    log = score(scenario, filled_log(scenario))
    straight = score(scenario, constant_velocity(scenario))
    assert torch.isfinite(log.likelihoods).all()
    assert float(log.meta_metric) > float(straight.meta_metric)
