"""Goals addressed by the agents' object ids."""

import numpy as np
import pytest
import torch

import scenes
from rlftsim.errors import ConfigError, DataError
from rlftsim.goals.types import Goals, simulated_track
from rlftsim.scenario.batch import collate

TWO = {"straight": {100: (1040.0, -200.0)}, "other": {101: (1017.0, -190.0), 103: [1010, -195]}}


def test_agents_get_goals_by_object_id_in_the_frame_of_the_batch():
    batch = collate([scenes.straight_road(), scenes.straight_road("other")])
    goals = Goals.from_points(batch, TWO)
    assert goals.num_rollouts == 1
    assert goals.goal_mask.nonzero().tolist() == [[0, 0, 0], [1, 0, 1], [1, 0, 3]]
    # the map frame is centered on the ego, at (1000, -200)
    torch.testing.assert_close(goals.position[goals.goal_mask], torch.tensor([[40.0, 0.0], [17.0, 10.0], [10.0, 5.0]]))


def test_one_scenario_needs_no_scenario_id():
    batch = collate([scenes.straight_road()])
    short = Goals.from_points(batch, {np.int64(100): np.array([1040.0, -200.0])})
    long = Goals.from_points(batch, {"straight": {100: (1040.0, -200.0)}})
    assert short.goal_mask.equal(long.goal_mask)
    assert short.position.equal(long.position)
    assert not Goals.from_points(batch, {}).any


@pytest.mark.parametrize(
    ("points", "error", "message"),
    [
        ({7: (0.0, 0.0)}, DataError, r"^goals: scenario gaps has no agent 7: it simulates \d agents: 100, 101"),
        ({105: (0.0, 0.0)}, DataError, "^goals: agent 105 is not there at the current step of scenario gaps"),
        ({100: (np.nan, 0.0)}, DataError, r"^goal of agent 100 in scenario gaps: \(nan, 0.0\) is not a point"),
        ({100: (1.0, 2.0, 3.0)}, DataError, "is not a point"),
        ({"straight": {100: (0.0, 0.0)}}, ConfigError, "scenario 'straight', which is not in the batch: it has gaps"),
    ],
)  # fmt: skip
def test_agents_without_a_track_and_points_that_are_none_are_refused_in_one_line(points, error, message):
    with pytest.raises(error, match=message) as caught:
        Goals.from_points(collate([scenes.with_gaps()]), points)
    assert "\n" not in str(caught.value)


def test_object_ids_alone_are_ambiguous_for_several_scenarios():
    batch = collate([scenes.straight_road(), scenes.straight_road("other")])
    with pytest.raises(ConfigError, match=r"need a batch of one scenario, this one has 2: write \{scenario_id: "):
        Goals.from_points(batch, {100: (0.0, 0.0)})


def test_an_id_that_is_text_is_shown_as_text():
    with pytest.raises(DataError, match=r"has no agent '100' \(ids are whole numbers\): it simulates \d agents: 100"):
        simulated_track(scenes.with_gaps(), "100", "goals")
