import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from realism_drawing import draw_red_light, draw_rollouts, draw_traffic, select_rollouts

from rlftsim.errors import DataError
from rlftsim.realism import (
    METRIC_2023,
    METRIC_2024,
    METRIC_2025,
    compute_credit,
    compute_features,
    scenario_log,
    score_features,
)
from rlftsim.realism.credit import compute_logarithmic_mean

SLOW = settings(deadline=None, max_examples=15)


def draw(seed, num_rollouts=4):
    scenario = draw_traffic(seed, lights=draw_red_light())
    log = scenario_log(scenario)
    return log, draw_rollouts(scenario, num_rollouts, seed=seed, spread=4.0)


@SLOW
@given(st.integers(0, 10_000), st.sampled_from([METRIC_2025, METRIC_2024, METRIC_2023]))
def test_parts_add_up_to_the_contribution_of_the_rollout(seed, config):
    log, states = draw(seed)
    features = compute_features(log, states)
    result, credit = score_features(log, features, config), compute_credit(log, features, config)
    expected = result.meta_metric - result.leave_one_out_meta_metric
    torch.testing.assert_close(credit.added.sum((1, 2)).float(), expected, atol=1e-6, rtol=0)


@SLOW
@given(st.integers(0, 10_000))
def test_parts_of_features_are_weight_times_change_of_likelihood(seed):
    log, states = draw(seed)
    weights = torch.tensor(METRIC_2025.weights)
    credit = compute_credit(log, compute_features(log, states))
    whole = score_features(log, compute_features(log, states)).likelihoods
    for rollout in range(4):
        others = [other for other in range(4) if other != rollout]
        left = score_features(log, compute_features(log, select_rollouts(states, others))).likelihoods
        torch.testing.assert_close(credit.added.sum(1)[rollout].float(), weights * (whole - left), atol=1e-6, rtol=0)


@SLOW
@given(st.integers(0, 10_000))
def test_rewards_split_over_agents_and_features_sum_to_zero_and_to_the_reward(seed):
    log, states = draw(seed)
    features = compute_features(log, states)
    credit = compute_credit(log, features)
    without = score_features(log, features).leave_one_out_meta_metric
    torch.testing.assert_close(credit.mloo.sum(0), torch.zeros_like(credit.mloo[0]), atol=1e-12, rtol=0)
    torch.testing.assert_close(credit.mloo.sum((1, 2)).float(), without.mean() - without, atol=1e-6, rtol=0)


def test_an_agent_that_moves_like_the_log_in_all_rollouts_but_one_loses_there():
    log, states = draw(3)
    shared = select_rollouts(states, [0, 0, 0, 0])
    agent = int(log.agents.evaluated[1])
    shared.x[2, agent] += 30.0  # off the street's traffic: other distances, a jump in speed
    credit = compute_credit(log, compute_features(log, shared))
    assert credit.mloo.sum(-1)[2].argmin() == 1
    assert credit.mloo.sum(-1)[2, 1] < 0


def test_repeated_rollouts_get_the_credit_of_their_copies():
    log, states = draw(1, num_rollouts=2)
    repeated = compute_credit(log, compute_features(log, dataclasses.replace(states, repeat=3)))
    copied = compute_credit(log, compute_features(log, select_rollouts(states, [0, 0, 0, 1, 1, 1])))
    torch.testing.assert_close(repeated.added.repeat_interleave(3, 0), copied.added)


def test_a_single_rollout_has_no_credit():
    log, states = draw(1, num_rollouts=1)
    with pytest.raises(DataError, match="at least 2 rollouts"):
        compute_credit(log, compute_features(log, states))


def test_the_logarithmic_mean_lies_between_and_is_smooth_where_both_are_equal():
    logs = torch.tensor([-3.0, -3.0 + 1e-9, -1.0], dtype=torch.float64)
    means = compute_logarithmic_mean(logs, torch.full_like(logs, -3.0))
    # (e^-1 - e^-3) / 2 by hand
    assert means.tolist() == pytest.approx([0.049787068, 0.049787068, 0.159046186], rel=1e-8)
