import math

import numpy as np
import pytest
import torch
from realism_drawing import draw_rollouts, draw_traffic

from rlftsim.errors import ConfigError
from rlftsim.realism import METRIC_2023, METRIC_2024, METRIC_2024_ORIGINAL, METRIC_2025, METRICS, metric_by_name
from rlftsim.realism.config import HISTOGRAM_FEATURES, SUB_SCORES, HistogramConfig
from rlftsim.realism.features import compute_features, scenario_log
from rlftsim.realism.likelihood import (
    LogTarget,
    RolloutCounts,
    compute_bin_edges,
    compute_likelihoods,
    count_bins,
    count_rollouts,
    find_bins,
    histogram_table,
    log_target,
)

CPU = torch.device("cpu")
SPEED, COLLISION_TIME = HISTOGRAM_FEATURES.index("linear_speed"), HISTOGRAM_FEATURES.index("time_to_collision")


def test_an_unknown_metric_lists_the_known_ones():
    with pytest.raises(ConfigError, match=r"'2022'.*2025, 2024, 2024_original_code, 2023"):
        metric_by_name("2022")
    assert all(metric_by_name(name) is METRICS[name] for name in METRICS)


def test_a_histogram_without_a_range_is_refused():
    with pytest.raises(ConfigError, match="low < high"):
        HistogramConfig(1.0, 1.0, 10, 0.1)


@pytest.mark.parametrize(
    ("config", "total"),
    [(METRIC_2025, 1.0), (METRIC_2024, 1.0), (METRIC_2024_ORIGINAL, 1.0), (METRIC_2023, 0.99)],
)
def test_weights_sum_to_one_but_those_of_2023(config, total):
    assert sum(config.weights) == pytest.approx(total)
    assert all(sum(config.sub_score_weights(name)) == pytest.approx(1) for name in SUB_SCORES)


def test_bins_are_closed_on_the_left_and_the_last_one_on_both_sides():
    # Speed bins are 2.5 m/s wide up to 25, the outside is clipped in and NaN lies in the last.
    values = torch.zeros(7, 7)
    values[SPEED] = torch.tensor([-1.0, 0.0, 2.4999, 2.5, 25.0, 99.0, math.nan])
    table = histogram_table(METRIC_2025, CPU)
    assert find_bins(values, table)[SPEED].tolist() == [0, 0, 0, 1, 9, 9, 9]
    values[COLLISION_TIME] = torch.tensor([5.0, 4.9999, 0.5, 0.0, 5.0, 5.0, 5.0])
    assert find_bins(values, table)[COLLISION_TIME].tolist() == [9, 9, 1, 0, 9, 9, 9]


def test_every_edge_opens_its_bin():
    table = histogram_table(METRIC_2025, CPU)
    for row, histogram in enumerate(METRIC_2025.histograms):
        edges = compute_bin_edges(histogram)
        values = torch.zeros(7, histogram.num_bins)
        values[row] = torch.from_numpy(edges[:-1])
        assert find_bins(values, table)[row].tolist() == list(range(histogram.num_bins))
        values[row] = torch.from_numpy(np.nextafter(edges[1:], np.float32(-np.inf)))
        assert find_bins(values, table)[row].tolist() == list(range(histogram.num_bins))


def test_likelihoods_of_two_rollouts_counted_by_hand():
    # One agent, two steps, two rollouts. Speeds: 1 and 3 | 1 and 1, so three of four values in bin 0 and one in bin
    # 1; the log has one scored step in bin 0 and one in bin 1. P(0) = 3.1 / 5, P(1) = 1.1 / 5 with ten bins of
    # pseudocount 0.1. Collisions agree in one of two rollouts: 1.001 / 2.002; the other outcomes in both: 2.001 /
    # 2.002.
    table = histogram_table(METRIC_2025, CPU)
    values = torch.zeros(7, 2, 1, 2)
    values[SPEED] = torch.tensor([[[1.0, 3.0]], [[1.0, 1.0]]])
    bins = count_bins(values, table)
    assert bins.shape == (2, 7, 1, 11)
    steps = torch.zeros(7, 1, 11)
    steps[SPEED, 0, :2] = 1
    target = LogTarget(steps, steps.sum((1, 2)), torch.zeros(3, 1, dtype=torch.bool))
    agreement = torch.tensor([1.0, 2.0, 2.0]).view(1, 3, 1)
    counts = RolloutCounts(bins.sum(0, keepdim=True), agreement, num_steps=2)
    likelihoods = compute_likelihoods(counts, torch.tensor([2.0]), target, table)[0]
    assert likelihoods[SPEED].item() == pytest.approx(math.sqrt(3.1 / 5 * 1.1 / 5), rel=1e-6)
    assert likelihoods[7:].tolist() == pytest.approx([1.001 / 2.002, 2.001 / 2.002, 2.001 / 2.002], rel=1e-6)
    assert likelihoods[SPEED + 1].isnan()  # nothing scored


def test_counts_give_the_mean_over_scored_agent_steps():
    scenario = draw_traffic(3)
    log = scenario_log(scenario)
    features = compute_features(log, draw_rollouts(scenario, 4, seed=0))
    table = histogram_table(METRIC_2025, CPU)
    counts, target = count_rollouts(features, log, METRIC_2025), log_target(log, METRIC_2025)
    total = RolloutCounts(counts.bins.sum(0, keepdim=True), counts.agreement.sum(0, keepdim=True), counts.num_steps)
    likelihoods = compute_likelihoods(total, torch.tensor([4.0]), target, table)[0]
    # The same, step by step, for time to collision: evaluated vehicles at valid steps.
    logged, valid = log.features.time_to_collision[0], log.features.valid[0]
    edges, terms = torch.from_numpy(compute_bin_edges(METRIC_2025.time_to_collision)), []
    for agent in torch.nonzero(log.agents.is_vehicle).flatten().tolist():
        histogram = torch.histogram(features.time_to_collision[:, agent].flatten(), edges)[0]
        for step in torch.nonzero(valid[agent]).flatten().tolist():
            count = histogram[min(9, int(torch.searchsorted(edges, logged[agent, step], right=True)) - 1)]
            terms.append(math.log((count + 0.1) / (4 * 80 + 1)))
    assert likelihoods[COLLISION_TIME].item() == pytest.approx(math.exp(np.mean(terms)), rel=1e-5)


def test_only_the_original_code_of_2024_scores_time_to_collision_of_pedestrians():
    scenario = draw_traffic(3)
    log = scenario_log(scenario)
    assert int((~log.agents.is_vehicle).sum()) == 1
    valid = log.features.valid[0]
    today, original = log_target(log, METRIC_2024), log_target(log, METRIC_2024_ORIGINAL)
    assert today.num_scored_steps[COLLISION_TIME] == valid[log.agents.is_vehicle].sum()
    assert original.num_scored_steps[COLLISION_TIME] == valid.sum()
