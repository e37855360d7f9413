"""Fixtures around the model of `tiny`, for the tests of training and of rewards."""

from dataclasses import replace

import pytest

import scenes
import tiny
from rlftsim.goals.types import Goals
from rlftsim.realism import METRIC_2025, compute_batch_features
from rlftsim.realism.credit import AgentScores
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.realism.meta_metric import score_batch_features
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate


@pytest.fixture(scope="session")
def drawn_scenarios():
    """Four scenarios drawn by hand."""
    return [scenes.straight_road(), scenes.junction_with_light(), scenes.with_gaps(), scenes.straight_road("again")]


@pytest.fixture(scope="session")
def vocabulary(drawn_scenarios):
    return tiny.small_vocabulary([*drawn_scenarios, scenes.crowd(num_agents=40)])


@pytest.fixture(scope="session")
def measured(vocabulary):
    """Four rollouts of two scenarios with their realism: (realism, rollouts, batch, scores by agent)."""
    other = scenes.junction_with_light()
    mirrored = replace(
        other.tracks, object_id=other.tracks.object_id[::-1].copy()
    )  # tracks are not in the order of ids
    batch = collate([scenes.straight_road(), replace(other, tracks=mirrored)])
    rollouts = simulate(tiny.tiny_policy(vocabulary), batch, num_rollouts=4, seed=1)
    # as if all agents had the endpoints of the first rollout as their goals
    goals = Goals.of_scenarios(rollouts.position[:, 0, :, -1], batch.agent_mask).repeat(4)
    rollouts = replace(rollouts, goals=goals)
    features = compute_batch_features(batch.scenarios, states_of_rollouts(batch, rollouts))
    agents = AgentScores(features, METRIC_2025, batch.agent_mask.shape[1])
    return score_batch_features(features, METRIC_2025), rollouts, batch, agents


@pytest.fixture(scope="session")
def simulated(measured):
    """Arguments of a reward: (realism, rollouts, batch)."""
    return measured[:3]
