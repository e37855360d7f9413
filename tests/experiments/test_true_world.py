"""Statistics of planners in simulated traffic against the truth, on tables made by hand."""

import numpy as np
import pytest
from scipy import stats

from rlftsim.errors import DataError
from rlftsim.experiments.true_world import (
    arrange_episodes,
    choose_sets,
    compute_r_squared,
    compute_tau_b,
    count_failures,
    draw_weights,
    find_interval,
    find_largest_errors,
    measure_agreement,
)

TRUTH = [[1.0, 0.8, 0.6, 0.8], [0.5, 0.5, 0.5, 0.5], [0.0, 0.2, 0.0, 0.2]]
"""Scores of three planners, means 0.8, 0.5 and 0.1, in four windows."""
EQUAL = np.ones((1, 4))
ALL = np.ones((3, 4), bool)


def measure(*traffic, mask=ALL):
    values = np.array([[TRUTH, *traffic]])  # a single rollout
    return {name: table[0] for name, table in measure_agreement(values, mask, EQUAL).items()}


def test_truth_agrees_with_itself():
    numbers = measure()
    assert (numbers["planner_error"], numbers["episode_error"], numbers["changed"]) == (0, 0, 0)
    np.testing.assert_allclose((numbers["tau_b"], numbers["r_squared"]), 1)


def test_an_offset_is_a_bias_and_keeps_the_ranking():
    numbers = measure(np.array(TRUTH) + 0.1)
    for name in ("planner_error", "episode_error", "bias"):
        assert numbers[name][1] == pytest.approx(0.1)
    assert numbers["changed"][1] == 1
    np.testing.assert_allclose((numbers["tau_b"][1], numbers["r_squared"][1]), 1)


def test_errors_of_episodes_may_cancel_in_a_mean_and_those_of_planners_in_a_bias():
    swapped = np.array(TRUTH)[:, [1, 0, 3, 2]]  # the same means from other windows
    shifted = np.array(TRUTH) + np.array([[0.3], [0.0], [-0.3]])
    numbers = measure(swapped, shifted)
    assert numbers["planner_error"][1] == pytest.approx(0)
    assert numbers["episode_error"][1] == pytest.approx((4 * 0.2 + 0 + 4 * 0.2) / 12)
    assert numbers["planner_error"][2] == pytest.approx(0.2)
    assert numbers["bias"][2] == pytest.approx(0)


def test_episodes_that_do_not_count_change_nothing():
    simulated, mask = np.array(TRUTH), ALL.copy()
    simulated[0, 2], mask[0, 2] = np.nan, False
    assert measure(simulated, mask=mask)["planner_error"][1] == 0


def test_a_planner_that_always_fails_leaves_the_statistics_of_the_others():
    simulated, mask = np.array(TRUTH) + 0.1, ALL.copy()
    simulated[2], mask[2] = np.nan, False
    without = measure_agreement(np.array([[TRUTH, simulated]])[:, :, :2], ALL[:2], EQUAL)
    for name, statistic in measure(simulated, mask=mask).items():
        np.testing.assert_array_equal(statistic, without[name][0])
        assert np.isfinite(statistic).all()


@pytest.mark.parametrize("seed", range(5))
def test_rank_correlation_and_r_squared_are_those_of_scipy_with_ties_too(seed):
    x, y = np.random.default_rng(seed).integers(0, 4, (2, 9)).astype(float)
    assert compute_tau_b(x, y) == pytest.approx(stats.kendalltau(x, y).statistic)
    assert compute_r_squared(x, y) == pytest.approx(stats.pearsonr(x, y).statistic ** 2)


def test_a_ranking_of_nothing_has_no_correlation():
    assert np.isnan(compute_tau_b(np.ones(3), np.arange(3.0)))
    assert np.isnan(compute_r_squared(np.ones(3), np.arange(3.0)))


def test_failures_are_found_missed_and_false():
    truth = np.array([[1, 1, 0, 0]], bool)
    simulated = np.array([[1, 0, 1, 0]], bool)
    mask = np.array([[True, True, True, True]])
    assert count_failures(np.array([[truth, simulated]]), mask) == [(2, 0, 0), (1, 1, 1)]
    assert count_failures(np.array([[truth, simulated]]), mask & [True, False, True, True])[1] == (1, 0, 1)
    # of two rollouts the mean: what fails in a single one of them is half a failure
    assert count_failures(np.array([[truth, simulated], [truth, truth]]), mask) == [(2, 0, 0), (1.5, 0.5, 0.5)]


def test_networks_are_drawn_whole():
    clusters = np.array([0, 0, 1, 2, 2, 2])
    weights = draw_weights(clusters, 50)
    assert (weights[0] == 1).all()
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[:, 3] == weights[:, 5]).all()
    assert (weights[1:, [0, 2, 3]].sum(1) == 2).all()


def test_the_interval_of_a_mean_is_that_of_the_networks():
    """Equal values within each network: the spread is that of the 40 networks, not of the 400 windows."""
    of_network = np.random.default_rng(0).normal(size=40)
    values = np.repeat(of_network, 10)[None, None]
    weights = draw_weights(np.repeat(np.arange(40), 10), 4000)
    tables = np.concatenate([np.zeros_like(values), values])[None]
    mean, low, high = find_interval(measure_agreement(tables, np.ones((1, 400), bool), weights)["bias"][:, 1])
    assert mean == pytest.approx(of_network.mean())
    assert (high - low) / 2 == pytest.approx(1.96 * of_network.std(ddof=1) / np.sqrt(40), rel=0.08)


def make_row(window, traffic, planner, score, conflicts="crossing following", is_random=True, rollout=0):
    return {
        "network": window[0], "window": window, "is_random": is_random, "conflicts": conflicts, "planner": planner,
        "traffic": traffic, "rollout": rollout, "nuplan_style": score,
    }  # fmt: skip


def test_rows_are_arranged_and_unfinished_windows_left_out():
    rows = [
        make_row(w, t, p, 10.0 * (t == "truth") + k) for k, w in enumerate(("a1", "b1"))
        for t in ("replay", "truth") for p in ("log", "idm")
    ]  # fmt: skip
    episodes = arrange_episodes([*rows, make_row("c1", "truth", "log", 0.0)], "truth")
    assert episodes.traffic == ("truth", "replay")
    assert (episodes.windows, episodes.networks) == (("a1", "b1"), ("a", "b"))
    assert episodes.conflicts[0] == {"crossing", "following"}
    assert episodes.values["nuplan_style"].tolist() == [[[[10, 11], [10, 11]], [[0, 1], [0, 1]]]]
    chosen = episodes.select(np.array([False, True]))
    assert (chosen.windows, chosen.values["nuplan_style"].shape) == (("b1",), (1, 2, 2, 1))
    with pytest.raises(DataError, match="go on with the run"):
        arrange_episodes(rows[1:4], "truth")


def test_rollouts_cancel_in_the_mean_of_a_planner_and_not_in_the_error_of_an_episode():
    scores = {("truth", 0): 0.5, ("tuned", 0): 0.0, ("tuned", 1): 1.0, ("tuned", 2): 0.5, ("tuned", 3): 0.5}
    rows = [make_row("a1", t, "idm", score, rollout=rollout) for (t, rollout), score in scores.items()]
    episodes = arrange_episodes(rows, "truth")
    np.testing.assert_array_equal(episodes.values["nuplan_style"][:, :, 0, 0].T, [[0.5] * 4, [0.0, 1.0, 0.5, 0.5]])
    numbers = measure_agreement(episodes.values["nuplan_style"], episodes.is_measured, np.ones((1, 1)))
    assert (numbers["planner_error"][0, 1], numbers["episode_error"][0, 1], numbers["changed"][0, 1]) == (0, 0.25, 0.5)
    assert find_largest_errors(episodes, "nuplan_style", "tuned", 1) == [("a1", "idm", 0)]
    with pytest.raises(DataError, match="go on with the run"):  # a window that lacks a rollout
        arrange_episodes([*rows, make_row("b1", "truth", "idm", 0.5), make_row("b1", "tuned", "idm", 0.5)][2:], "truth")


def test_an_episode_in_which_a_rollout_has_failed_does_not_count():
    scores = {("truth", 0): 0.5, ("tuned", 0): 0.5, ("tuned", 1): np.nan}
    rows = [make_row("a1", t, "idm", score, rollout=rollout) for (t, rollout), score in scores.items()]
    rows += [make_row("a1", t, "log", 0.5, rollout=rollout) for t, rollout in scores]
    assert arrange_episodes(rows, "truth").is_measured.tolist() == [[False], [True]]


def test_the_windows_to_film_are_those_that_err_most_each_about_one_planner():
    truth = {"a1": (1.0, 1.0), "b1": (1.0, 0.0), "c1": (0.5, np.nan), "d1": (0.3, 0.3)}
    tuned = {"a1": (0.9, 0.8), "b1": (0.4, 1.0), "c1": (0.4, 1.0), "d1": (0.3, 0.3)}
    rows = [
        make_row(window, t, planner, score) for t, table in (("truth", truth), ("tuned", tuned))
        for window, scores in table.items() for planner, score in zip(("log", "idm"), scores, strict=True)
    ]  # fmt: skip
    rows += [
        {**row, "rollout": 1, "nuplan_style": 0.0} for row in rows if (row["window"], row["traffic"]) == ("a1", "tuned")
    ]
    rows += [{**row, "rollout": 1} for row in rows if row["window"] != "a1" and row["traffic"] == "tuned"]
    episodes = arrange_episodes(rows, "truth")
    chosen = find_largest_errors(episodes, "nuplan_style", "tuned", 9)
    assert chosen == [("a1", "log", 1), ("b1", "idm", 0), ("c1", "log", 0)]
    assert find_largest_errors(episodes, "nuplan_style", "tuned", 1) == chosen[:1]


def test_random_windows_are_apart_from_those_chosen_for_a_conflict():
    rows = [
        make_row(name, t, "idm", 0.0, conflicts, is_random) for t in ("truth", "replay")
        for name, conflicts, is_random in (("a1", "", True), ("b1", "crossing", True), ("c1", "merging", False))
    ]  # fmt: skip
    random, conflict = choose_sets(arrange_episodes(rows, "truth"))
    assert (random.episodes.windows, conflict.episodes.windows) == (("a1", "b1"), ("b1", "c1"))
