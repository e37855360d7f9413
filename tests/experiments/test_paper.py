"""Summaries of experiments from made-up evaluations, so that every number is known."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import scenes
from made_up import TINY, row
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation import reward_variance
from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.experiments.model_specs import CATK, FineTuned, finetune_config, over_seeds
from rlftsim.experiments.paper import (
    benchmark,
    finetune_curve,
    kl_frontier,
    model_agnosticism,
    oracle,
    paired_ttest,
    qualitative,
    reward_ablation,
    variance_scaling,
)
from rlftsim.experiments.registry import EXPERIMENTS, PAPER
from rlftsim.experiments.results import ExperimentResult, run_experiment, to_finite
from rlftsim.experiments.suite import ExperimentSuite, Stage, run_stages
from rlftsim.experiments.tables import mean_of_seeds
from rlftsim.recipes.base import Recipe
from rlftsim.rewards.base import leave_one_out
from rlftsim.rewards.realism import compute_mloo
from rlftsim.scenario.dataset import write_dataset

RNG = np.random.default_rng(5)
EASE = RNG.normal(0.6, 0.1, 30)
"""Difficulty of each scenario, which pairing removes."""


def around(gain, seed=0, spread=0.01):
    """Meta-metrics of 30 scenarios that lie this far from their ease, give or take."""
    return (EASE + gain + np.random.default_rng(seed).normal(0, spread, 30)).tolist()


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    """Four scenarios to train on and one to measure on; nothing is trained here."""
    folder = tmp_path_factory.mktemp("paper")
    kinds = [scenes.straight_road(), scenes.junction_with_light(), scenes.with_gaps(), scenes.straight_road("again")]
    held_out = scenes.straight_road("held out")
    write_dataset([*kinds, held_out], folder / "data", split=lambda s: "validation" if s is held_out else "training")
    return ExperimentSuite(TINY, folder / "data", folder / "out", EvaluateConfig(), num_seeds=2)


def cell(result: ExperimentResult, name, heading, table=0):
    """A cell of a table, by its row's name and the start of its heading."""
    found = result.tables[table]
    column = next(i for i, h in enumerate(found.headings) if h.startswith(heading))
    return next(r for r in found.rows if r[0] == name)[column]


# ---- benchmark -------------------------------------------------------------------------------------------------------


def test_the_benchmark_says_how_much_of_the_gap_is_closed(suite):
    measured = {
        "base": row("base", [0.50, 0.60]),
        "CAT-K": row("CAT-K", [0.52, 0.62], [0.52, 0.62]),
        "RLFTSim (MLOO)": row("RLFTSim (MLOO)", [0.58, 0.70], [0.62, 0.70]),
        "oracle": row("oracle", [0.80, 0.90]),
        "constant velocity": row("constant velocity", [0.40, 0.40]),
    }
    found = benchmark.summarize(measured, suite)
    # seeds averaged: 0.60 and 0.70; mean 0.65, standard deviation 0.0707, over the root of 2: 0.05
    assert cell(found, "RLFTSim (MLOO)", "RMM") == "0.6500 ± 0.0500"
    # gains 0.10 and 0.10 of gaps 0.30 and 0.30: one third; all resamples give the same
    assert found.numbers["gap_closed"]["RLFTSim (MLOO)"]["fraction"] == pytest.approx(1 / 3)
    assert found.numbers["gap_closed"]["RLFTSim (MLOO)"]["interval"] == pytest.approx((1 / 3, 1 / 3))
    assert "RLFTSim (MLOO): 33.3% of the gap from base to oracle closed" in " ".join(found.verdicts)
    # seed means 0.64 and 0.66 against 0.55: gains 0.09 and 0.11, mean 0.10, error 0.01, t(0.975, 1) = 12.706
    assert found.numbers["gain_by_seed"]["RLFTSim (MLOO)"] == pytest.approx([0.09, 0.11])
    low, high = 0.10 - 0.12706, 0.10 + 0.12706
    assert f"mean +0.1000, 95% interval over seeds [{low:+.4f}, {high:+.4f}]" in " ".join(found.verdicts)
    assert found.tables[1].title.startswith("The paper")
    assert "not comparable" in found.tables[1].note


def test_two_architectures_are_in_one_table_with_a_gain_each(suite):
    measured = {
        "constant velocity": row("constant velocity", around(-0.3, 7)),
        "SMART, base": row("SMART, base", around(0.0)),
        "SMART, RLFTSim (MLOO)": row("SMART, RLFTSim (MLOO)", around(0.03, 1), around(0.05, 2)),
        "TrafficBots V1.5, base": row("TrafficBots V1.5, base", around(-0.1, 3)),
        "TrafficBots V1.5, RLFTSim (MLOO)": row("TrafficBots V1.5, RLFTSim (MLOO)", around(-0.06, 4)),
        "TrafficBots V1.5, base, mean actions": row("TrafficBots V1.5, base, mean actions", around(-0.1, 5)),
        "TrafficBots V1.5, RLFTSim (MLOO), mean actions": row(
            "TrafficBots V1.5, RLFTSim (MLOO), mean actions", around(-0.05, 6)
        ),
    }
    found = model_agnosticism.summarize(measured, suite)
    assert len(found.tables[0].rows) == 7
    assert found.numbers["gain_by_seed"]["SMART, RLFTSim (MLOO)"] == pytest.approx([0.03, 0.05], abs=0.01)
    assert set(found.numbers["gain_by_seed"]) == {name for name in measured if "RLFTSim" in name}
    gains = [v for v in found.verdicts if "RLFTSim" in v.partition(" against ")[0] and "for the better: +0.0" in v]
    assert len(gains) == 3
    assert "0.7231" in found.tables[1].markdown()
    assert sum("updates of" in note for note in found.notes) == 2


def test_each_architecture_has_the_base_model_that_was_named_for_it(suite, tmp_path):
    named = replace(suite, base_model="demo-base", counterpart_model="trafficbots-base", out=tmp_path)
    own, counterpart = model_agnosticism.suites(named)
    assert (own.base(), counterpart.base()) == ("demo-base", "trafficbots-base")
    # Rows are named after the recipes, so a model of the other architecture would stand under a wrong name.
    with pytest.raises(ConfigError, match="makes SMART policies, none like a TrafficBotsPolicy"):
        model_agnosticism.run(replace(named, base_model="trafficbots-base", out=tmp_path / "swapped"))
    assert not (tmp_path / "swapped").exists()


@pytest.mark.parametrize("name", ["goal-conditioning", "kinematic-controllability", "maneuver-controllability"])
def test_a_model_that_cannot_be_given_goals_is_refused_before_it_is_trained(suite, tmp_path, name):
    named = replace(suite, base_model="trafficbots-base", out=tmp_path)
    with pytest.raises(ConfigError, match="trafficbots-base cannot be given any"):
        run_experiment(name, EXPERIMENTS.get(name), named)
    assert not list(tmp_path.iterdir())  # free for a model that can


def test_a_recipe_without_a_counterpart_is_refused(suite):
    with pytest.raises(ConfigError, match="names no recipe of another architecture"):
        model_agnosticism.suites(replace(suite, recipe=Recipe(), out=suite.out.parent / "plain"))


def test_no_gap_gives_no_fraction():
    same = row("x", [0.5, 0.6]).mean
    closed = benchmark.compute_gap_closed(same, row("y", [0.6, 0.7]).mean, same)
    assert not math.isfinite(closed.fraction)


def test_a_single_seed_says_so():
    assert "a single seed says nothing" in row("tuned", [0.6]).seeds_against(row("base", [0.5]))


# ---- rewards ---------------------------------------------------------------------------------------------------------


def test_the_ablation_compares_each_reward_with_the_base_and_with_mloo(suite):
    names = ["base", *reward_ablation.REWARDS]
    gains = dict(zip(names, (0.0, 0.05, 0.05, 0.04, 0.0, 0.0, -0.03)))
    measured = {name: row(name, around(gain, seed)) for seed, (name, gain) in enumerate(gains.items())}
    found = reward_ablation.summarize(measured, suite)
    verdicts = {line.split(" in both")[0] for line in found.verdicts}
    assert len(verdicts) == 6 + 5
    assert "difference, for the better" in next(v for v in found.verdicts if v.startswith("MLOO against base"))
    assert "difference, for the worse" in next(
        v for v in found.verdicts if v.startswith("collision + off-road against")
    )
    assert "no difference at the 5% level" in next(
        v for v in found.verdicts if v.startswith("MLOO against MLOO, credit")
    )
    headings = found.tables[0].headings
    for heading in ("RMM", "kinematic", "interactive", "map-based", "minADE", "collision", "off-road", "ADE", "miss"):
        assert any(h.startswith(heading) for h in headings)
    assert cell(found, "MLOO", "miss") == "50.00 ± 0.00"


def test_the_ablation_says_how_far_each_reward_went(suite):
    run = suite.model_folder(FineTuned("rloo"))
    run.mkdir(parents=True)
    others = {"entropy": 2.0, "diversity_m": 5.0, "speed_gap_mps": -1.0, "reward_std": 0.1}
    lines = [{"update": n, "kl": n / 100, **others} for n in range(10)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    measured = {name: row(name, [0.5, 0.6]) for name in ("base", *reward_ablation.REWARDS)}
    found = reward_ablation.summarize(measured, suite).tables[1]
    assert found.rows == (("RLOO", "0.085", "2", "5", "-1", "0.1"),)  # the last two of ten updates; others have no run


def test_columns_in_percent_and_metres_are_the_evaluations_own(suite):
    columns = {"collision_rate": [0.1, 0.3], "average_displacement_error": [2.0, 3.0]}
    measured = {name: row(name, [0.5, 0.6], **columns) for name in ("base", *reward_ablation.REWARDS)}
    found = reward_ablation.summarize(measured, suite)
    assert cell(found, "base", "collision") == "20.00 ± 10.00"
    assert cell(found, "base", "ADE") == "2.50 ± 0.50"


def test_every_reward_has_the_recipes_budget():
    for one in reward_ablation.REWARDS.values():
        if one.credit == "rollout" and one.method in ("mloo", "rloo"):
            config = finetune_config(one, TINY.finetune)
            assert (config.reward, config.epochs, config.batch_size, config.num_rollouts) == (one.method, 0.5, 1, 2)


# ---- rewards at equal KL ---------------------------------------------------------------------------------------------


def frontier(suite, gain_per_nat):
    """Made-up runs that end at a KL of 0.045, but for minADE's, which ends at 0.03, and their evaluations."""
    rows, specs = {"base": row("base", EASE.tolist())}, kl_frontier.specs(suite.num_seeds)
    for number, name in enumerate(kl_frontier.REWARDS):
        for part in kl_frontier.FRACTIONS:
            reached = min(0.045 * part, 0.03 if name.startswith("minADE") else 0.045)
            for one in specs[kl_frontier.point(name, part)]:
                run = suite.model_folder(one)
                run.mkdir(parents=True, exist_ok=True)
                line = {"kl": reached, "entropy": 2.0, "diversity_m": 5.0, "speed_gap_mps": -1.0, "reward_std": 0.1}
                (run / "metrics.jsonl").write_text(json.dumps({"update": 0, **line}) + "\n")
            gain, noise = gain_per_nat[name] * reached, (number, number + 10)
            rows[kl_frontier.point(name, part)] = row(name, *(around(gain, seed) for seed in noise))
    return rows


def test_rewards_are_compared_at_the_largest_kl_that_all_reach(suite):
    slopes = dict(zip(kl_frontier.REWARDS, (5.0, 4.0, 2.0, 1.0, -1.0)))
    found = kl_frontier.summarize(frontier(suite, slopes), suite)
    assert found.numbers["kl"] == pytest.approx(0.03)
    for name, slope in slopes.items():  # between 0.0225 and 0.045
        gain = found.numbers["at_equal_kl"][name]["meta_metric"]["mean"] - EASE.mean()
        assert gain == pytest.approx(0.03 * slope, abs=0.005)
    assert found.verdicts[0].endswith("at a KL of 0.0300 nats and the 5% level: confirmed.")
    assert "RLOO, KL 0.0450" in {cells[0] for cells in found.tables[2].rows}


@pytest.mark.parametrize(
    ("slopes", "verdict"),
    [
        ((4.0, 5.0, 2.0, 1.0, 0.0), "refuted: RLOO above MLOO by 0.0"),
        ((5.0, 2.0, 2.0, 1.0, 0.0), "not decided: no difference between RLOO and minADE, RLOO"),
    ],
)
def test_the_order_of_the_paper_may_be_refuted_or_open(suite, slopes, verdict):
    found = kl_frontier.summarize(frontier(suite, dict(zip(kl_frontier.REWARDS, slopes))), suite)
    assert verdict in found.verdicts[0]


def test_the_points_of_a_reward_are_those_of_one_run():
    *_, whole = kl_frontier.specs(2)[kl_frontier.point("RLOO", 1.0)]
    assert whole == replace(reward_ablation.REWARDS["RLOO"], seed=1)  # the run of the ablation itself
    halves = kl_frontier.specs(2)[kl_frontier.point("RLOO", 0.5)]
    assert [one.epochs_fraction for one in halves] == [0.5, 0.5]


# ---- paired t-test ---------------------------------------------------------------------------------------------------


def test_the_matrix_has_a_verdict_for_every_pair(suite):
    measured = {
        "good": row("good", around(0.05, 1)),
        "twin": row("twin", around(0.05, 2)),
        "bad": row("bad", around(-0.05, 3)),
    }
    found = paired_ttest.summarize(measured, suite)
    names = found.numbers["names"]
    verdicts = np.array(found.numbers["verdicts"])
    good, twin, bad = (names.index(n) for n in ("good", "twin", "bad"))
    assert names[-1] == "bad"  # the best first
    assert verdicts[good, bad] == verdicts[twin, bad] == 1
    assert verdicts[good, twin] == 0
    assert (verdicts == -verdicts.T).all()
    p = np.array(found.numbers["p_values"])
    assert (p[~np.eye(3, dtype=bool)] == p.T[~np.eye(3, dtype=bool)]).all()
    assert cell(found, "bad", "good") == "−"
    assert cell(found, "good", "twin") == "~"
    assert "no difference at the 0.1% level" in next(v for v in found.verdicts if "twin" in v and "good" in v)


def test_a_difference_at_five_percent_is_none_at_a_thousandth(suite):
    # differences 1, 2, 3, 4 (x 0.01): mean 2.5, error 0.645, t = 3.87 with 3 degrees of freedom, p = 0.03
    measured = {"a": row("a", [0.5, 0.5, 0.5, 0.5]), "b": row("b", [0.51, 0.52, 0.53, 0.54])}
    found = paired_ttest.summarize(measured, suite)
    assert np.array(found.numbers["p_values"])[0, 1] == pytest.approx(0.0305, abs=5e-4)
    assert not np.array(found.numbers["verdicts"]).any()


# ---- variance --------------------------------------------------------------------------------------------------------


def additive(values):
    """Rewards of a metric that is the mean of a number of each rollout."""

    def rewards_of(chosen):
        x = torch.from_numpy(values[chosen])[None]
        others = (x.sum() - x) / (x.shape[1] - 1)
        return compute_mloo(others)[0], leave_one_out(x)[0]

    return rewards_of


def test_variance_of_an_additive_metric_is_known():
    """s² is the variance of a rollout's number: s² / (N (N - 1)) for MLOO and s² N / (N - 1) for RLOO."""
    sizes, rng = (2, 4, 8, 16, 32), np.random.default_rng(0)
    found = np.mean(
        [
            reward_variance.variance_by_size(additive(rng.normal(0, 3.0, 32)), 32, sizes, rng)
            for _ in range(120)
        ],
        axis=0,
    )  # fmt: skip
    n = np.array(sizes)
    np.testing.assert_allclose(found[0], 9.0 / (n * (n - 1)), rtol=0.12)
    np.testing.assert_allclose(found[1], 9.0 * n / (n - 1), rtol=0.12)


def test_slope_of_a_power_law_is_its_power():
    sizes = (2, 4, 8, 16, 32)
    n = np.array(sizes, float)
    assert variance_scaling.fit_slope(5.0 / n**2, sizes) == pytest.approx(-2.0)
    assert math.isnan(variance_scaling.fit_slope(0.0 * n, sizes))
    # for large N an additive metric's MLOO falls with the square
    large = (128, 256, 512)
    assert variance_scaling.fit_slope(variance_scaling.law(large)["mloo"], large) == pytest.approx(-2.0, abs=0.01)


def made_up_variances(sizes, scenarios=50):
    rng = np.random.default_rng(1)
    strength = np.exp(rng.normal(0, 1, (scenarios, 1)))
    curves = {
        name: strength * curve * np.exp(rng.normal(0, 0.02, (scenarios, len(sizes))))
        for name, curve in variance_scaling.law(sizes).items()
    }
    curves["mloo"][0] = 0.0  # a scenario in which nothing moves
    return reward_variance.Variances(tuple(map(str, range(scenarios))), sizes, curves)


def test_scaling_is_fitted_with_an_interval_and_a_verdict(suite):
    sizes = reward_variance.SIZES
    measured = made_up_variances(sizes)
    found = variance_scaling.EXPERIMENT.summarize(measured, suite)
    for slope, first in zip(found.numbers["rewards"]["mloo"]["slopes"], (2, 8)):
        expected = variance_scaling.fit_slope(variance_scaling.law(sizes)["mloo"], sizes, first)
        assert (slope["from_size"], slope["scenarios"]) == (first, 49)
        assert slope["of_law"] == pytest.approx(expected)
        assert slope["slope"] == pytest.approx(expected, abs=0.01)
        low, high = slope["interval"]
        assert low < slope["slope"] < high
    assert found.verdicts[0].startswith("MLOO, N ≥ 2: no difference from the slope")
    # a pure alpha / N² comes back
    exact = variance_scaling.fit_scaling(np.array([[7.0 / n**2 for n in sizes]] * 3), sizes)
    assert exact.alpha == pytest.approx(7.0)
    assert [slope.mean for slope in exact.slopes.values()] == pytest.approx([-2.0, -2.0])


def test_a_slope_can_be_fitted_to_large_numbers_alone():
    # flat up to 8, then with the square
    curve = np.array([1.0, 1.0, 1.0, 0.25, 0.0625])
    assert variance_scaling.fit_slope(curve, (2, 4, 8, 16, 32), 8) == pytest.approx(-2.0)
    assert variance_scaling.fit_slope(curve, (2, 4, 8, 16, 32)) > -1.5


def test_a_reward_that_falls_otherwise_is_a_difference(suite):
    sizes = (2, 4, 8, 16)
    n = np.array(sizes, float)
    noise = np.exp(np.random.default_rng(0).normal(0, 0.01, (20, 4)))
    other = reward_variance.Variances(tuple("abcdefghijklmnopqrst"), sizes, {"mloo": noise / n, "rloo": noise / n})
    found = variance_scaling.EXPERIMENT.summarize(other, suite)
    assert len(found.verdicts) == 2  # two sizes from 8 on are too few for a slope of their own
    assert all("difference from the slope" in v and "no difference" not in v for v in found.verdicts)


# ---- the others ------------------------------------------------------------------------------------------------------


def test_the_curve_compares_at_equal_length(suite):
    epochs = suite.recipe.finetune.epochs
    rows = finetune_curve.specs(1, epochs)
    gains = dict.fromkeys(rows, 0.0)
    for fraction, gain in zip(finetune_curve.EPOCHS_FRACTIONS, (0.02, 0.05, 0.04, 0.03)):
        gains[finetune_curve.point("RLFTSim", fraction * epochs)] = gain
    measured = {name: row(name, around(gain, seed)) for seed, (name, gain) in enumerate(gains.items())}
    found = finetune_curve.summarize(measured, suite)
    assert len(found.tables[0].rows) == 2 + 4 * 4
    assert found.verdicts[0].startswith("best of its curve: RLFTSim, 0.25 epochs against base")
    equal = next(v for v in found.verdicts if v.startswith("RLFTSim, 0.125 epochs against CAT-K, 0.125 epochs"))
    assert "difference, for the better" in equal
    assert {c.method for specs in rows.values() for c in specs if isinstance(c, FineTuned)} == {"mloo", CATK}


def test_the_benchmark_and_the_curve_do_without_catk(suite):
    measured = {name: row(name, [0.5, 0.6]) for name in ("base", "RLFTSim (MLOO)", "oracle", "constant velocity")}
    found = benchmark.summarize(measured, suite)
    assert not any("CAT-K" in verdict for verdict in found.verdicts)
    names = [name for name in finetune_curve.specs(1, suite.recipe.finetune.epochs) if not name.startswith("CAT-K")]
    found = finetune_curve.summarize({name: row(name, [0.5, 0.6]) for name in names}, suite)
    assert len(found.verdicts) == 2


def test_the_oracle_says_what_each_feature_costs(suite):
    features = {"linear_speed_likelihood": [0.6, 0.8], "time_to_collision_likelihood": [math.nan] * 2}
    measured = {"oracle": row("oracle", [0.8, 0.9], **features)}
    found = oracle.summarize(measured, suite)
    # weight 0.05, mean 0.7: 0.05 x 0.3
    assert cell(found, "linear speed", "missing") == "0.0150"
    assert cell(found, "linear speed", "likelihood") == "0.7000 ± 0.1000"
    assert cell(found, "time to collision", "likelihood") == "–"
    assert "0.8500" in found.verdicts[0]


def test_scenarios_are_shown_by_rule_the_one_that_became_worst_included():
    ids, before, after = ["a", "b", "c", "d", "e", "f"], np.array([0.5] * 6), np.array([0.4, 0.0, 0.5, 0.9, 0.1, 0.5])
    chosen = qualitative.choose_scenarios(ids, before, after)
    assert chosen == {"1. of 6": "b", "2. of 6": "e", "3. of 6": "a", "in the middle": "c", "last of 6": "d"}
    assert qualitative.choose_scenarios(["a", "b"], before[:2], after[:2]) == {"1. of 2": "b", "2. of 2": "a"}


def test_seeds_are_averaged_scenario_by_scenario():
    both = row("x", [0.5, 0.7], [0.7, 0.7])
    np.testing.assert_allclose(both.mean.values("meta_metric"), [0.6, 0.7])
    other = row("y", [0.5, 0.6, 0.7]).by_seed
    with pytest.raises(DataError, match="different scenarios"):
        mean_of_seeds("x", (*both.by_seed, *other))


def test_seeds_change_nothing_else():
    assert [c.name for c in over_seeds(FineTuned("rloo", credit="agent"), 2)] == [
        "rloo-agent-seed0",
        "rloo-agent-seed1",
    ]


@pytest.mark.parametrize("name", PAPER)
def test_every_experiment_has_a_question(name):
    experiment = EXPERIMENTS.get(name)
    assert experiment.question.endswith("?")
    assert experiment.default_seeds >= 1


def test_an_unknown_experiment_is_refused_with_the_known_ones():
    with pytest.raises(
        ConfigError, match=r"unknown experiment 'benchmrk': did you mean 'benchmark'\? known are benchmark, "
    ):
        EXPERIMENTS.get("benchmrk")


def test_numbers_for_machines_are_never_nan():
    values = {"a": [1.0, math.nan, (math.inf, 2)], "b": "nan"}
    assert json.dumps(to_finite(values)) == '{"a": [1.0, null, [null, 2]], "b": "nan"}'


def test_progress_counts_stages_and_estimates_the_rest(capsys):
    stages = [Stage(f"fine-tune {name}", False, lambda: None) for name in ("a", "b", "b")]  # b: needed twice
    run_stages([*stages, Stage("evaluate a", True, lambda: None)])
    err = capsys.readouterr().err
    assert "1/3  fine-tune a\n" in err
    assert "2/3  fine-tune b  (less than a minute to go)" in err
    assert err.count("fine-tune b") == 1
    assert "3/3  evaluate a  (finished before)" in err
