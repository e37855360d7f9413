import math

import numpy as np
import pytest
import torch

import scenes
from rlftsim.goals.attainment import (
    compute_closest_distance,
    compute_tolerance,
    is_passed,
    is_reached,
    is_within,
    measure_outcome,
    rate,
)
from rlftsim.goals.types import Goals, logged_endpoints, logged_goals
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.realism.miss import compute_miss_rates
from rlftsim.scenario.batch import collate


def along_x(*ends_m, steps=80):
    """One scenario, one rollout: agents that start at 0 and drive evenly to x = their end."""
    way = torch.arange(1, steps + 1) / steps
    x = torch.tensor(ends_m)[:, None] * way
    return torch.stack([x, torch.zeros_like(x)], -1)[None, None]


def goals_at(*points):
    position = torch.tensor([points])
    return Goals.of_scenarios(position, torch.ones(position.shape[:2], dtype=torch.bool))


def test_reached_means_near_at_the_end_and_passed_near_at_any_step():
    # ends at 10, 12.1 and 40 m; goals at 10 m: the second ends 2.1 m beyond and was at 10 m before, the third too
    position, goals = along_x(10.0, 12.1, 40.0), goals_at((10.0, 0.0), (10.0, 0.0), (10.0, 2.1))
    assert is_reached(position, goals).tolist() == [[[True, False, False]]]
    assert is_passed(position, goals).tolist() == [[[True, True, False]]]
    assert compute_closest_distance(position, goals)[0, 0, 2] == pytest.approx(2.1)


def test_the_outcome_of_a_goal_is_counted_over_its_rollouts_even_far_from_the_origin():
    # at most 0.5 m apart are numbers of float32 near 8 000 km: x = 10, 40 and 7 m; goal at 10 m, 1 m to the side
    way = torch.stack([along_x(end)[0, 0, 0].double() for end in (10.0, 40.0, 7.0)])
    far = torch.tensor([8.0e6, -8.0e6], dtype=torch.float64)
    outcome = measure_outcome(way + far, (8.0e6 + 10.0, -8.0e6 + 1.0))
    assert (outcome.reached, outcome.passed) == (pytest.approx(1 / 3), pytest.approx(2 / 3))
    assert (outcome.best_m, outcome.median_m) == (pytest.approx(1.0), pytest.approx(1.0))
    few = measure_outcome(way[1:] + far, (8.0e6 + 10.0, -8.0e6 + 1.0))
    assert few.median_m == pytest.approx((1 + math.hypot(3, 1)) / 2)


def test_agents_without_a_goal_meet_none_and_count_nowhere():
    position = along_x(10.0, 10.0)
    goals = goals_at((10.0, 0.0), (10.0, 0.0)).only(torch.tensor([[[True, False]]]))
    assert is_passed(position, goals).tolist() == [[[True, False]]]
    assert rate(is_passed(position, goals), goals.goal_mask).tolist() == [[1.0]]
    none = goals.only(torch.zeros(1, 1, 2, dtype=torch.bool))
    assert not none.any
    assert rate(is_passed(position, none), none.goal_mask).isnan().all()


def test_tolerances_are_those_of_the_challenge():
    # 8 s: 6 m along and 3 m sideways for the fast, half for the slow; 5 s: 3.6 and 1.8; 3 s and less: 2 and 1.
    # Half way between 1.4 and 11 m/s the factor is 0.75.
    speed, horizon = torch.tensor([20.0, 11.0, 1.4, 0.0, 6.2, 20.0]), torch.tensor([8.0, 5.0, 8.0, 3.0, 8.0, 0.5])
    expected = [[6.0, 3.0], [3.6, 1.8], [3.0, 1.5], [1.0, 0.5], [4.5, 2.25], [2.0, 1.0]]
    torch.testing.assert_close(compute_tolerance(speed, horizon), torch.tensor(expected))


@pytest.mark.parametrize(("heading", "inside"), [(0.0, True), (math.pi / 2, False)])
def test_the_box_lies_along_the_heading(heading, inside):
    """5 m short of the goal: inside 6 m along, outside 3 m sideways."""
    offset = torch.tensor([-5.0, 0.0])
    assert bool(is_within(offset, torch.tensor(heading), torch.tensor([6.0, 3.0]))) == inside


def test_passing_misses_are_those_of_the_evaluation():
    """The same rollouts through the evaluator's own path, which knows scenarios and not batches."""
    scenario = scenes.with_gaps()
    batch, states = collate([scenario]), logged_states(scenario, num_rollouts=2)
    pushed = states.x.clone()
    pushed[:, :3] += 30.0
    ends = logged_endpoints(batch)
    goals = logged_goals(batch, batch.evaluated_mask)
    position = torch.stack([pushed, states.y], -1)[None] - batch.origin.float()
    tolerance = compute_tolerance(batch.velocity[:, :, 10].norm(dim=-1), ends.horizon_s)[:, None, :, None]
    offset = position - goals.position[..., None, :]
    missed = goals.goal_mask & ~is_within(offset, ends.heading[:, None, :, None], tolerance).any(-1)
    expected = compute_miss_rates(scenario, type(states)(states.object_id, pushed, states.y, states.z, states.heading))
    assert 0 < expected.passing < 1
    assert float(rate(missed, goals.goal_mask).mean()) == pytest.approx(expected.passing)


def test_the_logged_goal_is_where_an_agent_was_last_seen():
    scenario = scenes.with_gaps()
    batch = collate([scenario])
    ends = logged_endpoints(batch)
    row = scenario.simulated_indices.tolist().index(1)  # not logged at the last three steps, 88 to 90
    expected = scenario.tracks.position[1, 87, :2] - scenario.origin
    np.testing.assert_allclose(ends.position[0, row].numpy(), expected, atol=1e-3)
    assert ends.horizon_s[0, row] == pytest.approx(7.7)
    assert is_passed(batch.position[:, None, :, 11:], logged_goals(batch)).equal(ends.mask[:, None])


def test_without_a_future_no_agent_has_a_goal():
    assert not logged_goals(collate([scenes.without_future()])).any


def test_only_chosen_agents_have_goals():
    batch = collate([scenes.straight_road()])
    chosen = torch.zeros_like(batch.agent_mask)
    chosen[:, 2] = True
    assert logged_goals(batch, chosen).goal_mask.nonzero().tolist() == [[0, 0, 2]]
    assert logged_goals(batch).goal_mask[:, 0].equal(batch.agent_mask)
