"""Scenes that hurt: alone, crowded, hardly seen, on a huge map, with impossible rollouts."""

import dataclasses
import resource

import numpy as np
import pytest
import torch
from realism_drawing import draw_map, draw_red_light, draw_rollouts, draw_traffic, select_rollouts

import scenes
from rlftsim.errors import DataError
from rlftsim.realism import SimulatedStates, compute_credit, compute_features, scenario_log, score
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.scenario.types import HISTORY_STEPS


def peak_mib():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def draw_large_map(num_points):
    """A grid of wavy road edges and lanes, a point every 0.5 m."""
    lines, length = [], 500
    for row in range(num_points // length):
        x = np.arange(length) * 0.5 - 125
        y = row * 3.0 - 1.5 * (num_points // length) + np.sin(x / 7)
        lines.append(((15, 2)[row % 2], np.stack([x, y, 0 * x], -1)))
    return draw_map(lines)


def test_a_map_of_50_000_points_is_searched_in_bounded_memory():
    scenario = draw_traffic(1, map_features=draw_large_map(50_000), lights=draw_red_light(lane_id=101))
    states = draw_rollouts(scenario, 8, seed=1)
    score(scenario, select_rollouts(states, [0]))
    before = peak_mib()
    result = score(scenario, states)
    assert result.likelihoods.isfinite().all()
    assert peak_mib() - before < 300


@pytest.mark.parametrize("num_rollouts", [1, 2])
def test_128_agents(num_rollouts):
    scenario = scenes.crowd()
    states = logged_states(scenario, num_rollouts=1)
    noisy = select_rollouts(states, [0] * num_rollouts)
    noisy.x.add_(torch.linspace(0, 3, 80))
    result = score(scenario, noisy)
    assert len(states.object_id) == 128
    assert result.likelihoods.isfinite().all()
    assert result.meta_metric.isfinite()


def test_one_agent_alone_collides_with_nothing():
    scenario = scenes.lone_agent()
    result = score(scenario, logged_states(scenario, num_rollouts=32))
    assert result.collision_rate == 0
    assert result.meta_metric.isfinite()


def test_an_obstacle_seen_at_the_current_step_only_is_an_obstacle_of_the_rollouts_only():
    scenario = draw_traffic(2, num_agents=4, num_evaluated=2)
    scenario.tracks.valid[2, :] = False
    scenario.tracks.valid[2, 10] = True
    log = scenario_log(scenario)
    states = draw_rollouts(scenario, 3, seed=2)
    assert score(scenario, states).likelihoods.isfinite().all()
    assert (log.features.distance_to_nearest_object > 1e9).any() or len(scenario.simulated_indices) > 2


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
def test_rollouts_that_are_no_numbers_or_far_too_large_do_not_crash(value):
    scenario = draw_traffic(1, lights=draw_red_light())
    states = draw_rollouts(scenario, 3, seed=1)
    states.x[1, 0, 40:] = value
    result = score(scenario, states)
    assert result.likelihoods.isfinite().all()
    assert (
        compute_credit(scenario_log(scenario), compute_features(scenario_log(scenario), states)).added.isfinite().all()
    )


def test_the_order_of_ids_is_free_and_their_type_may_be_any_whole_number():
    scenario = draw_traffic(1)
    states = draw_rollouts(scenario, 2, seed=1)
    other = SimulatedStates(states.object_id.astype(np.int32), states.x, states.y, states.z, states.heading)
    assert score(scenario, other).meta_metric == score(scenario, states).meta_metric


def test_a_scene_of_one_step_of_history_scores():
    scenario = draw_traffic(4)
    scenario.tracks.valid[:, :10] = False
    states = draw_rollouts(scenario, 2, seed=1)
    assert score(scenario, states).likelihoods.isfinite().all()


def test_a_future_of_padding_is_refused_and_has_no_score_in_training():
    padded = scenes.without_agents(slice(HISTORY_STEPS, None))
    states = logged_states(scenes.straight_road(), num_rollouts=2)
    with pytest.raises(DataError, match="Scenario padded has no valid logged state of an evaluated agent"):
        score(padded, states)
    assert score(padded, states, missing_map="neutral").meta_metric.isnan()


def test_agents_without_extent_score():
    scenario = draw_traffic(4)
    flat = dataclasses.replace(scenario.tracks, size=np.zeros_like(scenario.tracks.size))
    scenario = dataclasses.replace(scenario, tracks=flat)
    assert score(scenario, draw_rollouts(scenario, 2, seed=1)).likelihoods.isfinite().all()
