import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import scenes
from rlftsim.goals.attainment import compute_tolerance
from rlftsim.realism import SimulatedStates
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.realism.miss import compute_miss_rates


def moved(states, shift_xy, steps=slice(None)):
    """The same rollouts, all agents moved at some steps."""
    x, y = states.x.clone(), states.y.clone()
    x[..., steps] += shift_xy[0]
    y[..., steps] += shift_xy[1]
    return SimulatedStates(states.object_id, x, y, states.z, states.heading)


@pytest.fixture
def lone():
    """The ego alone, straight along x: everything about it is known."""
    return scenes.lone_agent()


def speed_of_ego(scenario):
    return np.linalg.norm(scenario.tracks.velocity[scenario.ego_index, 10])


def test_the_log_itself_misses_nothing():
    scenario = scenes.straight_road()
    assert compute_miss_rates(scenario, logged_states(scenario, num_rollouts=3)) == (0.0, 0.0, 0.0)


def test_a_box_not_a_disc(lone):
    states = logged_states(lone, num_rollouts=1)
    along, sideways = compute_tolerance(torch.tensor([speed_of_ego(lone)]), torch.tensor([8.0]))[0].tolist()
    heading = float(lone.tracks.heading[lone.ego_index, 90])
    ahead, left = np.array([math.cos(heading), math.sin(heading)]), np.array([-math.sin(heading), math.cos(heading)])
    shifts = (0.97 * along * ahead, 1.03 * along * ahead, -0.97 * sideways * left, 1.03 * sideways * left)
    for shift, missed in zip(shifts, (0.0, 1.0, 0.0, 1.0)):
        assert compute_miss_rates(lone, moved(states, shift)).at_goal == missed


def test_passing_is_enough_for_the_passing_rate(lone):
    """One that is at the goal one second early and far away in the end."""
    states = logged_states(lone, num_rollouts=1)
    x, y = states.x.clone(), states.y.clone()
    x[..., 69], y[..., 69] = states.x[..., 79], states.y[..., 79]
    x[..., 79] += 500.0
    rates = compute_miss_rates(lone, SimulatedStates(states.object_id, x, y, states.z, states.heading))
    assert rates == (1.0, 0.0, 0.0)


def test_fractions_are_over_rollouts_and_agents(lone):
    """Three of four rollouts meet; in all taken together none misses."""
    once = logged_states(lone, num_rollouts=1)
    off = moved(once, (0.0, 50.0))
    join = [torch.cat([getattr(once, f)] * 3 + [getattr(off, f)]) for f in ("x", "y", "z", "heading")]
    assert compute_miss_rates(lone, SimulatedStates(once.object_id, *join)) == (0.25, 0.25, 0.0)


def test_a_goal_is_where_an_agent_was_last_seen():
    scenario = scenes.straight_road()
    valid = scenario.tracks.valid.copy()
    valid[scenario.ego_index, 41:] = False  # last seen at step 40, 3 s after the current one
    short = replace(scenario, tracks=replace(scenario.tracks, valid=valid))
    states = logged_states(scenario, num_rollouts=1)
    assert compute_miss_rates(short, moved(states, (500.0, 0.0), steps=slice(30, None))).at_goal == pytest.approx(
        1 - 1 / len(scenario.evaluated_indices)
    )


def test_agents_may_come_in_any_order():
    scenario = scenes.straight_road()
    states = moved(logged_states(scenario, num_rollouts=1), (0.0, 0.0))
    x = states.x.clone()
    x[:, list(states.object_id).index(scenario.tracks.object_id[scenario.ego_index])] += 100.0
    order = np.random.default_rng(0).permutation(len(states.object_id))
    fields = (x, states.y, states.z, states.heading)
    shuffled = SimulatedStates(states.object_id[order], *(v[:, order] for v in fields))
    expected = 1 / len(scenario.evaluated_indices)
    assert compute_miss_rates(scenario, shuffled).at_goal == pytest.approx(expected)


def test_without_any_logged_future_the_rates_are_nan(lone):
    valid = lone.tracks.valid.copy()
    valid[:, 11:] = False
    none = replace(lone, tracks=replace(lone.tracks, valid=valid))
    assert all(math.isnan(rate) for rate in compute_miss_rates(none, logged_states(lone, num_rollouts=1)))
