"""The scenario generation metric: numbers of the official evaluator of 2025 for scenes drawn by hand, and its rules."""

import dataclasses

import numpy as np
import pytest
import torch
from realism_drawing import draw_red_light, draw_rollouts, draw_scenes, draw_traffic

from rlftsim.errors import ConfigError, DataError
from rlftsim.realism import METRIC_2025, METRIC_2025_SCENARIO_GEN, SCENARIO_GEN, score, score_batch
from rlftsim.realism.from_rollouts import logged_states

OFFICIAL = {
    "log": {
        "metametric": 0.6996303796768188,
        "average_displacement_error": 0.0,
        "linear_speed_likelihood": 0.25742480158805847,
        "linear_acceleration_likelihood": 0.9539574980735779,
        "angular_speed_likelihood": 0.9758824110031128,
        "angular_acceleration_likelihood": 0.9539574980735779,
        "distance_to_nearest_object_likelihood": 0.1866423636674881,
        "collision_indication_likelihood": 0.6062865853309631,
        "time_to_collision_likelihood": 0.3727515637874603,
        "distance_to_road_edge_likelihood": 0.7031616568565369,
        "offroad_indication_likelihood": 0.9998001456260681,
        "min_average_displacement_error": 0.0,
        "simulated_collision_rate": 0.800000011920929,
        "simulated_offroad_rate": 0.0,
        "traffic_light_violation_likelihood": 0.9990020394325256,
        "simulated_traffic_light_violation_rate": 0.6000000238418579,
    },
    "scenes": {
        "metametric": 0.6885557770729065,
        "average_displacement_error": 0.0,
        "linear_speed_likelihood": 0.2576749920845032,
        "linear_acceleration_likelihood": 0.9555214643478394,
        "angular_speed_likelihood": 0.977486252784729,
        "angular_acceleration_likelihood": 0.9555214643478394,
        "distance_to_nearest_object_likelihood": 0.1733560562133789,
        "collision_indication_likelihood": 0.6020521521568298,
        "time_to_collision_likelihood": 0.3561152517795563,
        "distance_to_road_edge_likelihood": 0.6855811476707458,
        "offroad_indication_likelihood": 0.9999500513076782,
        "min_average_displacement_error": 0.0,
        "simulated_collision_rate": 0.75,
        "simulated_offroad_rate": 0.0,
        "traffic_light_violation_likelihood": 0.8703765273094177,
        "simulated_traffic_light_violation_rate": 0.4000000059604645,
    },
}
"""Results of the official evaluator, wheel 1.6.7: the log against itself, and four scenes with sizes of their own."""


def draw_scenario():
    """Traffic with a red light, and an agent that is absent over the first steps."""
    scenario = draw_traffic(3, lights=draw_red_light())
    scenario.tracks.valid[2, :6] = False
    return scenario


@pytest.mark.parametrize("case", OFFICIAL)
def test_scores_are_those_of_the_official_evaluator(case):
    scenario = draw_scenario()
    log = logged_states(scenario, num_rollouts=1, challenge=SCENARIO_GEN)
    states = draw_scenes(scenario, 4, seed=5) if case == "scenes" else log
    fields = score(scenario, states, METRIC_2025_SCENARIO_GEN).to_official_fields()[0]
    assert {name: fields[name] for name in OFFICIAL[case]} == pytest.approx(OFFICIAL[case], abs=1e-6)


def test_agents_in_another_order_and_equal_scenes_score_alike():
    scenario = draw_scenario()
    states = draw_scenes(scenario, 3, seed=1)
    order = torch.tensor([3, 0, 4, 2, 1])
    columns = {name: getattr(states, name)[:, order] for name in ("x", "y", "z", "heading", "size")}
    shuffled = dataclasses.replace(states, object_id=states.object_id[order.numpy()], **columns)
    first, second = (score(scenario, s, METRIC_2025_SCENARIO_GEN) for s in (states, shuffled))
    torch.testing.assert_close(first.likelihoods, second.likelihoods)
    log = logged_states(scenario, num_rollouts=32, challenge=SCENARIO_GEN)
    written_out = dataclasses.replace(
        log, repeat=1, **{name: getattr(log, name).repeat_interleave(32, 0) for name in columns}
    )
    first, second = (score(scenario, s, METRIC_2025_SCENARIO_GEN) for s in (log, written_out))
    torch.testing.assert_close(first.likelihoods, second.likelihoods)


def test_the_sizes_of_every_step_count():
    scenario = draw_scenario()
    states = draw_scenes(scenario, 3, seed=1)
    grown = dataclasses.replace(states, size=states.size.clone())
    grown.size[:, :, 80:, :2] = 200.0
    rates = [float(score(scenario, s, METRIC_2025_SCENARIO_GEN).collision_rate) for s in (states, grown)]
    assert rates[0] < rates[1] == 1.0


def test_rollouts_of_the_other_challenge_are_refused():
    scenario = draw_scenario()
    rollouts, scenes = draw_rollouts(scenario, 2, seed=0), draw_scenes(scenario, 2, seed=0)
    with pytest.raises(
        DataError, match="Scenario Generation scores 91 steps of an agent, and these rollouts have the 80"
    ):
        score(scenario, rollouts, METRIC_2025_SCENARIO_GEN)
    with pytest.raises(DataError, match="Sim Agents scores 80 steps"):
        score(scenario, scenes, METRIC_2025)
    with pytest.raises(ConfigError, match="metric 2025-scenario-gen scores Scenario Generation"):
        score_batch([scenario], [rollouts], METRIC_2025_SCENARIO_GEN)
    assert np.isfinite(score(scenario, scenes, METRIC_2025_SCENARIO_GEN).likelihoods.numpy()).all()


def test_wrong_shapes_are_refused():
    scenario = draw_scenario()
    scenes = draw_scenes(scenario, 2, seed=0)
    names = ("x", "y", "z", "heading")
    short = {name: getattr(scenes, name)[..., :80] for name in names}
    with pytest.raises(DataError, match=r"Sizes of generated agents must be \[2, 5, 91, 3\]"):
        dataclasses.replace(scenes, **short, size=scenes.size[:, :, :80])
    with pytest.raises(DataError, match="compares 80 steps, these rollouts have 91"):
        score(scenario, dataclasses.replace(scenes, size=None), METRIC_2025)
