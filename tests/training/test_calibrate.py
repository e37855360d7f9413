"""Calibration: gradients without a backward pass, a step that leaves means as they are, and runs that resume."""

import copy
import dataclasses
import itertools
import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import scenes
import tiny
from rlftsim.errors import ConfigError
from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.rewards import leave_one_out
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import ObjectType
from rlftsim.training.calibrate import (
    CalibrationLearner,
    best_length,
    natural_direction,
    split_scenarios,
    t_value,
)
from rlftsim.training.config import FEATURES, CalibrateConfig
from rlftsim.training.constraints import CONSTRAINTS, Constraint, constraint_by_name, register_constraint
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

CONFIG = CalibrateConfig(
    num_rollouts=3, batch_size=2, micro_batch_size=1, checkpoint_every=1, lengths=(1.0,), max_kl=1.0, device=tiny.CPU
)


@pytest.fixture
def policy(vocabulary):
    base = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
    return CalibratedTokenPolicy(base, CONFIG.features).eval()


# ---- gradients -----------------------------------------------------------------------------------------------------

VALUES = torch.tensor([[0.3, -0.7, 1.1], [0.9, 0.2, -0.4]], dtype=torch.float64)  # [agent, token]
FEATURE = torch.tensor([[1.0, 0.0, -1.0], [0.5, -0.5, 0.2]], dtype=torch.float64)
LOGITS = torch.tensor([[0.1, 0.4, -0.2], [0.0, 0.3, 0.6]], dtype=torch.float64)


def expected_value_and_gradient(constraint, eta, num_agents, num_rollouts=3):
    """Over all outcomes of agents that choose one of three tokens: the value, and the estimate of its gradient."""
    p = (LOGITS + eta * FEATURE).softmax(-1)[:num_agents]
    score = FEATURE[:num_agents] - (p * FEATURE[:num_agents]).sum(-1, keepdim=True)
    value = gradient = 0.0
    outcomes = list(itertools.product(range(3), repeat=num_agents))
    for rollouts in itertools.product(outcomes, repeat=num_rollouts):
        token = torch.tensor(rollouts)  # [N, A]
        agent = torch.arange(num_agents)
        parts = VALUES[agent, token][None]  # [1, N, A]
        probability = p[agent, token].prod()
        value += float(probability * constraint.value(parts))
        gradient += float(probability * (constraint.credit(parts) * score[agent, token]).sum())
    return value, gradient


@pytest.mark.parametrize(("name", "num_agents"), [("speed", 2), ("min_ade", 1)], ids=["mean", "minimum"])
def test_credit_times_score_function_is_the_gradient_of_the_expected_value(name, num_agents):
    constraint = constraint_by_name(name)
    (high, _), (low, _) = (expected_value_and_gradient(constraint, eta, num_agents) for eta in (0.2 + 1e-4, 0.2 - 1e-4))
    _, gradient = expected_value_and_gradient(constraint, 0.2, num_agents)
    assert gradient == pytest.approx((high - low) / 2e-4, rel=1e-5)


def test_the_credit_of_mloo_against_the_others_estimates_the_gain_of_the_whole_group():
    # the RMM of a group stands for a function of its rollouts; here the mean of what they reached
    def expected(eta):
        return float(((LOGITS[0] + eta * FEATURE[0]).softmax(-1) * VALUES[0]).sum())

    p, gradient = LOGITS[0].softmax(-1), 0.0
    score = FEATURE[0] - (p * FEATURE[0]).sum()
    for outcome in itertools.product(range(3), repeat=3):
        group = list(outcome)
        values = VALUES[0, group]
        without = (values.sum() - values) / 2
        mloo = (without.mean() - without)[None, :, None]  # as compute_mloo
        gradient += float(p[group].prod() * (leave_one_out(mloo)[0, :, 0] * score[group]).sum())
    # without one of N the mean moves by 1 / (N - 1) in place of 1 / N
    assert gradient == pytest.approx(3 / 2 * (expected(1e-4) - expected(-1e-4)) / 2e-4, rel=1e-5)


# ---- the step ------------------------------------------------------------------------------------------------------


def test_the_step_follows_the_gradient_in_the_metric_of_the_kl_and_has_that_kl():
    gradient, fisher = np.array([1.0, 1.0]), np.diag([1.0, 4.0])
    step = natural_direction(gradient, fisher, np.zeros((0, 2)), 0.01)
    assert step[0] / step[1] == pytest.approx(4.0)
    assert 0.5 * step @ fisher @ step == pytest.approx(0.01, rel=2e-3)  # up to the ridge


def test_projection_makes_the_predicted_change_of_fixed_means_zero():
    random = np.random.default_rng(0)
    root, gradient, fixed = random.normal(size=(6, 9)), random.normal(size=6), random.normal(size=(2, 6))
    free = natural_direction(gradient, root @ root.T, np.zeros((0, 6)), 0.01)
    step = natural_direction(gradient, root @ root.T, fixed, 0.01)
    assert np.abs(fixed @ free).min() > 0.01
    np.testing.assert_allclose(fixed @ step, 0.0, atol=1e-12)
    assert 0 < gradient @ step < gradient @ free


def test_two_constraints_that_say_the_same_count_once():
    fixed = np.array([[1.0, 0.0], [1.0, 0.0]])
    step = natural_direction(np.array([1.0, 1.0]), np.eye(2), fixed, 0.02)
    np.testing.assert_allclose(step, [0.0, 0.2], atol=1e-3)


def test_a_gradient_that_constraints_forbid_leaves_no_step():
    assert not natural_direction(np.array([1.0, 0.0]), np.eye(2), np.array([[2.0, 0.0]]), 0.01).any()


def test_a_feature_that_never_differs_gets_no_weight():
    step = natural_direction(np.array([1.0, 0.0]), np.diag([1.0, 0.0]), np.zeros((1, 2)), 0.01)
    assert step[0] > 0
    assert step[1] == 0


@pytest.mark.parametrize(
    ("slope", "bend", "best"),
    [(1.0, -0.5, 1.0), (1.0, -0.1, 1.5), (1.0, 0.2, 1.5), (-1.0, -0.5, 0.0), (-1.0, 0.1, 0.0)],
)
def test_the_length_is_the_top_of_the_parabola_and_none_that_was_not_tried(slope, bend, best):
    lengths = (0.5, 1.0, 1.5)
    gains = np.array([[slope * x + bend * x**2 for x in lengths]] * 4) + np.array([[-1e-3], [1e-3], [0.0], [0.0]])
    assert best_length(lengths, gains) == pytest.approx(best)


def test_a_t_value_is_the_mean_over_its_standard_error():
    assert t_value(np.array([1.0, 2.0, 3.0])) == pytest.approx(2 / (1 / np.sqrt(3)))
    assert t_value(np.array([1.0, 1.0])) == 0.0
    assert t_value(np.array([1.0])) is None


# ---- runs ----------------------------------------------------------------------------------------------------------


def test_a_calibration_says_what_each_feature_weighs_and_earns(policy, drawn_scenarios, tmp_path):
    model = train_policy(policy, drawn_scenarios, tmp_path, CONFIG, card="made by a test")
    stored = json.loads((model / "calibration.json").read_text())
    assert [row["feature"] for row in stored["features"]] == list(FEATURES)
    assert [row["eta"] for row in stored["features"]] == pytest.approx(policy.eta.tolist())
    for row in stored["features"]:  # the parts are those of the whole, but for clipped credits
        assert row["rmm"] == pytest.approx(row["kinematic"] + row["interactive"] + row["map_based"], abs=0.02)
    assert stored["num_scenarios"] == [3, 1]
    card = (model / "README.md").read_text()
    assert card.startswith("made by a test")
    assert "| speed_gap_under_2s |" in card
    assert "Measured on 1 scenario that was held back, too few for a t." in card
    assert "(+0.0)" not in card


@pytest.mark.filterwarnings("error")
def test_a_measure_that_no_scenario_has_is_left_out_of_the_table(policy, tmp_path):
    def walking(scenario):
        types = np.full_like(scenario.tracks.object_type, ObjectType.PEDESTRIAN)
        return dataclasses.replace(scenario, tracks=dataclasses.replace(scenario.tracks, object_type=types))

    walkers = [walking(scenes.straight_road(name)) for name in ("a", "b", "c")]
    model = train_policy(policy, walkers, tmp_path, CONFIG)
    assert load_policy(model).calibration["held_back"][0]["rmm"]["change"] is None
    assert "| – |" in (model / "README.md").read_text()


def test_a_constraint_with_a_score_is_measured_by_it(policy, drawn_scenarios, tmp_path):
    @register_constraint("ade", tolerance=0.1, score="average_displacement_error")
    def ade(batch, rollouts, agents):
        return -agents.displacement_error

    try:
        model = train_policy(policy, drawn_scenarios, tmp_path, tiny.replace(CONFIG, constraints=("ade",)))
    finally:
        CONSTRAINTS.remove("ade")
    base = json.loads((model / "calibration.json").read_text())["base"]
    assert base["ade"] > 0


def test_weights_of_the_network_stay_as_they_are(policy, drawn_scenarios, tmp_path):
    before = fingerprint_policy(policy.base)
    train_policy(policy, drawn_scenarios, tmp_path, CONFIG)
    assert fingerprint_policy(policy.base) == before


def test_a_run_that_was_stopped_ends_with_the_same_weights(policy, vocabulary, drawn_scenarios, tmp_path, monkeypatch):
    train_policy(policy, drawn_scenarios, tmp_path / "whole", CONFIG)
    original, calls = CalibrationLearner.measure, []

    def interrupted(learner, fabric):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(learner, fabric)

    def fresh():
        return CalibratedTokenPolicy(tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE), CONFIG.features).eval()

    monkeypatch.setattr(CalibrationLearner, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt, match="behind update 2"):
        train_policy(fresh(), drawn_scenarios, tmp_path / "stopped", CONFIG)
    train_policy(fresh(), drawn_scenarios, tmp_path / "stopped", CONFIG)
    whole, stopped = (measured_in(tmp_path / name) for name in ("whole", "stopped"))
    assert all(torch.equal(whole[name], stopped[name]) for name in whole)
    assert whole["gradients"].any()
    folders = (tmp_path / name / "model" / "calibration.json" for name in ("whole", "stopped"))
    assert len({folder.read_text() for folder in folders}) == 1


def measured_in(run):
    return load_file(max((run / "checkpoints").iterdir()) / "statistics.safetensors")


def test_processes_change_no_gradient(vocabulary, drawn_scenarios, tmp_path):
    measured = []
    for processes in (1, 2):
        learner = CalibratedTokenPolicy(tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE), CONFIG.features).eval()
        device = tiny.replace(tiny.CPU, processes=processes)
        out = tmp_path / str(processes)
        train_policy(learner, drawn_scenarios, out, tiny.replace(CONFIG, device=device))
        measured.append(measured_in(out))
    assert torch.equal(*(one["gradients"] for one in measured))
    torch.testing.assert_close(*(one["fisher"] for one in measured), rtol=1e-12, atol=0)


def test_max_kl_bounds_the_distance_of_a_further_calibration_to_the_model_that_it_started_from(
    policy, drawn_scenarios, tmp_path
):
    with torch.no_grad():
        policy.eta.copy_(torch.linspace(-1.0, 1.0, len(policy.eta)))
    start, batch = copy.deepcopy(policy), collate(drawn_scenarios)
    train_policy(policy, drawn_scenarios, tmp_path, tiny.replace(CONFIG, max_kl=0.001))
    rollouts = simulate(policy, batch, num_rollouts=8, seed=3)
    result, reference = (model.score(model.encode(batch), rollouts) for model in (policy, start))
    kl = result.kl(reference).detach().sum() / rollouts.decision_mask.sum()
    assert 0.0003 < kl < 0.0015  # on other rollouts than those of the run
    assert [line["kl"] for line in read_metrics(tmp_path) if line.get("length") == 0.0] == [0.0]


def test_the_policy_must_have_the_features_of_the_settings(policy, drawn_scenarios, tmp_path):
    with pytest.raises(ConfigError, match="make it with add_features"):
        train_policy(policy, drawn_scenarios, tmp_path, tiny.replace(CONFIG, features=("speed_slow",)))


def test_an_unknown_constraint_is_refused_before_the_first_rollout(policy, drawn_scenarios, tmp_path):
    with pytest.raises(ConfigError, match="unknown constraint 'sped': did you mean 'speed'"):
        train_policy(policy, drawn_scenarios, tmp_path, tiny.replace(CONFIG, constraints=("sped",)))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"num_rollouts": 1}, "at least 2 rollouts"),
        ({"held_back": 1.0}, "a fraction between 0 and 1"),
        ({"lengths": ()}, "at least one"),
        ({"reward": "mlo"}, "did you mean 'mloo'"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, reason):
    with pytest.raises(ConfigError, match=reason):
        tiny.replace(CONFIG, **changes)


def test_the_direction_and_its_length_come_from_different_scenarios():
    fitted, held = split_scenarios(CONFIG, list("abcdefghij"))
    assert sorted(fitted + held) == list(range(10))
    assert len(held) == 2
    with pytest.raises(ConfigError, match="at least 2 scenarios"):
        split_scenarios(CONFIG, ["a"])


def test_a_least_value_stays_without_any_rollout_but_the_least():
    parts = torch.tensor([[[1.0, 2.0], [4.0, 0.0], [5.0, 5.0]]])  # sums 3, 4, 10
    credit = Constraint("least", lambda *_: parts, 0.1, is_minimum=True).credit(parts)
    assert credit[0].tolist() == [[1.0 - 4.0, 2.0 - 0.0], [0.0, 0.0], [0.0, 0.0]]
