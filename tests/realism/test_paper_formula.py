import dataclasses

import pytest
import torch
from realism_drawing import draw_rollouts, draw_traffic

from rlftsim.realism import METRIC_2025, build_scenario_log, compute_features
from rlftsim.realism.config import FEATURE_NAMES
from rlftsim.realism.paper_formula import PAPER_BINS, score_by_paper_formula


def features_of(scenario, **values):
    """Features of two rollouts, constant over agents and steps but for those given."""
    log = build_scenario_log(scenario)
    features = compute_features(log, draw_rollouts(scenario, 2, seed=0, spread=0.0))
    return log, dataclasses.replace(features, **values)


@pytest.fixture(scope="module")
def scenario():
    scenario = draw_traffic(0, num_evaluated=2)
    scenario.tracks.valid[scenario.simulated_indices] = True
    return scenario


def test_a_bin_that_no_rollout_visits_makes_the_score_zero(scenario):
    log, features = features_of(scenario)
    far = dataclasses.replace(features, linear_speed=torch.full_like(features.linear_speed, 24.0))
    scores = score_by_paper_formula(log, far).scores
    assert scores[FEATURE_NAMES.index("linear_speed")] == 0
    assert (scores[FEATURE_NAMES.index("distance_to_nearest_object") :] > 0).all()


def test_frequencies_are_counted_without_smoothing_over_rollouts_and_steps(scenario):
    # Off-road in a quarter of all steps of both agents, the log nowhere: the mean of ln 3/4.
    log, features = features_of(scenario)
    distance = torch.full_like(features.distance_to_road_edge, -1.0)
    distance[0, :, :40] = 1.0
    index = FEATURE_NAMES.index("offroad_indication")
    scores = score_by_paper_formula(log, dataclasses.replace(features, distance_to_road_edge=distance)).scores
    assert scores[index].item() == pytest.approx(0.75)


def test_steps_without_a_value_count_nowhere(scenario):
    log, features = features_of(scenario)
    logged = log.features.linear_speed.expand_as(features.linear_speed).clone()
    scores = score_by_paper_formula(log, dataclasses.replace(features, linear_speed=logged)).scores
    # 79 steps have a speed; a histogram of themselves, at worst spread evenly over the bins
    assert 1 / PAPER_BINS < scores[0] <= 1


def test_the_meta_metric_is_the_weighted_sum(scenario):
    log, features = features_of(scenario)
    result = score_by_paper_formula(log, features)
    expected = (result.scores * torch.tensor(METRIC_2025.weights)).sum()
    assert result.meta_metric.item() == pytest.approx(expected.item())
