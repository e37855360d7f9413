from dataclasses import replace

import pytest
import tiny
import torch

import scenes
from rlftsim.goals.types import Goals
from rlftsim.realism import METRIC_2025, measure_batch
from rlftsim.realism.agent_scores import AgentScores
from rlftsim.realism.batch import score_measured
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate


@pytest.fixture(autouse=True)
def _one_thread_as_before():
    """Runs set the number of threads; the next test file shall not notice."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def drawn_scenarios():
    """Four scenarios drawn by hand."""
    return [scenes.straight_road(), scenes.junction_with_light(), scenes.with_gaps(), scenes.straight_road("again")]


@pytest.fixture(scope="session")
def vocabulary(drawn_scenarios):
    return tiny.small_vocabulary([*drawn_scenarios, scenes.crowd(num_agents=40)])


@pytest.fixture(scope="session")
def measured(vocabulary):
    """Four rollouts of two scenarios with their scores: (scores, rollouts, batch, scores by agent)."""
    other = scenes.junction_with_light()
    mirrored = replace(
        other.tracks, object_id=other.tracks.object_id[::-1].copy()
    )  # tracks are not in the order of ids
    batch = collate([scenes.straight_road(), replace(other, tracks=mirrored)])
    rollouts = simulate(tiny.tiny_policy(vocabulary), batch, num_rollouts=4, seed=1)
    # as if everybody had been asked to go where the first rollout ends
    goals = Goals.of_scenarios(rollouts.position[:, 0, :, -1], batch.agent_mask).repeat(4)
    rollouts = replace(rollouts, goals=goals)
    features = measure_batch(batch.scenarios, states_of_rollouts(batch, rollouts))
    agents = AgentScores(features, METRIC_2025, batch.agent_mask.shape[1])
    return score_measured(features, METRIC_2025), rollouts, batch, agents


@pytest.fixture(scope="session")
def simulated(measured):
    """What a reward is called with: (scores, rollouts, batch)."""
    return measured[:3]
