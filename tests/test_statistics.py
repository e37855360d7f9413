"""Means and intervals against numbers worked out by hand."""

import math

import numpy as np
import pytest

from rlftsim.statistics import cluster_bootstrap, interval_around, mean_interval


def test_student_s_interval_of_four_values_is_as_in_the_tables():
    # 1, 2, 3, 4: variance 5/3, divided by 4; the 97.5 % quantile of t with 3 degrees of freedom is 3.18245
    found = mean_interval(np.array([1.0, 2.0, math.nan, 3.0, 4.0]))
    assert found.count == 4
    assert found.mean == 2.5
    assert found.standard_error == pytest.approx(math.sqrt(5 / 3 / 4))
    assert found.interval == pytest.approx((2.5 - 3.18245 * 0.645497, 2.5 + 3.18245 * 0.645497), abs=1e-4)
    assert found == interval_around(found.mean, found.standard_error, 4)


def test_fewer_than_two_values_have_no_interval_and_equal_ones_a_point():
    assert math.isnan(mean_interval(np.array([])).mean)
    single = mean_interval(np.array([3.0]))
    assert (single.mean, single.count) == (3.0, 1)
    assert all(map(math.isnan, (single.standard_error, *single.interval, single.p_value)))
    assert mean_interval(np.full(5, 0.5)).interval == (0.5, 0.5)


def test_clusters_of_a_single_value_give_the_ordinary_interval():
    values = np.append(np.random.default_rng(0).normal(0.3, 1.0, 40), np.nan)
    ordinary = mean_interval(values)
    clustered = cluster_bootstrap(values, np.arange(41), num_draws=40_000)
    assert (clustered.mean, clustered.count) == (pytest.approx(ordinary.mean), 40)
    assert clustered.interval == pytest.approx(ordinary.interval, abs=0.02 * ordinary.standard_error)
    assert clustered.p_value == pytest.approx(ordinary.p_value, rel=0.05)


def test_equal_values_within_clusters_count_once():
    # clusters of 10 with the means 1, 2, 3, 4: the interval is that of these four values, not of forty
    clustered = cluster_bootstrap(np.repeat([1.0, 2.0, 3.0, 4.0], 10), np.repeat(list("abcd"), 10), num_draws=40_000)
    four = mean_interval(np.array([1.0, 2.0, 3.0, 4.0]))
    assert clustered.interval == pytest.approx(four.interval, abs=0.05)
    assert clustered.count == 40
    low, high = cluster_bootstrap(np.repeat([1.0, 2.0, 3.0, 4.0], 10), np.repeat(list("abcd"), 10), level=0.9).interval
    assert four.interval[0] < low < high < four.interval[1]


def test_the_interval_of_a_nested_model_holds_the_truth_as_often_as_it_says():
    # value = 0 + cluster (sd 1) + value (sd 1), 12 clusters of 1 to 15 values
    rng, holds, ignoring = np.random.default_rng(0), [], []
    for draw in range(1000):
        clusters = np.repeat(np.arange(12), rng.integers(1, 16, 12))
        values = rng.normal(size=12)[clusters] + rng.normal(size=len(clusters))
        low, high = cluster_bootstrap(values, clusters, num_draws=400, seed=draw).interval
        holds.append(low <= 0 <= high)
        low, high = mean_interval(values).interval
        ignoring.append(low <= 0 <= high)
    assert 0.92 < np.mean(holds) < 0.97
    assert np.mean(ignoring) < 0.7  # what the ordinary interval does there


def test_the_interval_of_several_runs_holds_the_mean_of_all_runs():
    # a third of the variance of the mean comes from which runs were made
    rng, holds, errors, means = np.random.default_rng(0), [], [], []
    for draw in range(1000):
        clusters = np.repeat(np.arange(20), 5)
        shared = rng.normal(size=20)[clusters] + rng.normal(size=100)
        values = shared + 0.35 * rng.normal(size=(5, 1)) + rng.normal(size=(5, 100))
        interval = cluster_bootstrap(values, clusters, num_draws=400, seed=draw)
        holds.append(interval.interval[0] <= 0 <= interval.interval[1])
        errors.append(interval.standard_error)
        means.append(interval.mean)
    assert 0.92 < np.mean(holds) < 0.98
    assert np.mean(errors) == pytest.approx(np.std(means), rel=0.1)


def test_a_single_cluster_has_a_mean_and_no_interval():
    single = cluster_bootstrap(np.array([1.0, 3.0]), np.array(["a", "a"]))
    assert (single.mean, single.count) == (2.0, 2)
    assert all(map(math.isnan, (single.standard_error, *single.interval, single.p_value)))
    assert math.isnan(cluster_bootstrap(np.array([np.nan]), np.array(["a"])).mean)
