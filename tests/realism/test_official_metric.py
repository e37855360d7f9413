"""Agreement with the official evaluator on real scenarios: fields, features, small sets, leave-one-out, alone."""

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from rlftsim.realism import (
    METRICS,
    SimulatedStates,
    compute_features,
    scenario_log,
    score,
    score_batch,
    score_features,
)
from rlftsim.realism.config import HISTOGRAM_FEATURES
from rlftsim.realism.likelihood import (
    compute_log_probabilities,
    count_rollouts,
    find_bins,
    histogram_table,
    stack_histogram_features,
)
from rlftsim.scenario.womd import read_scenarios

pytestmark = pytest.mark.official

SCORE_TOLERANCE = 1e-6
DISPLACEMENT_TOLERANCE = {"atol": 1e-5, "rtol": 1e-6}
"""Metres; rollouts of the hardest recipe end up to 60 m away."""
FEATURE_TOLERANCE = {"atol": 1e-5, "rtol": 1e-6}
"""Logged speeds next to invalid states reach 1e4 m/s and more: there float32 itself allows no better than relative."""
DISTANCE_TOLERANCE = {"atol": 2e-3, "rtol": 0}
OFFICIAL_FLAGS = {
    "collision": "collision_per_step",
    "offroad": "offroad_per_step",
    "traffic_light_violation": "traffic_light_violation_per_step",
}
CASES = [
    f"{scenario}_{recipe}"
    for scenario in ("637f", "68d5", "bada", "db4e", "eb4b", "ee51", "ef3a")
    for recipe in ("oracle_raw", "oracle_filled", "constant_velocity", "log_noise", "messy")
] + ["637f_test_submission"]
SMALL_SETS = ["637f_log_noise", "637f_messy", "eb4b_log_noise", "ee51_log_noise"]


@lru_cache
def read_all_scenarios(shared: Path):
    return {scenario.scenario_id[:4]: scenario for scenario in read_scenarios(shared / "data" / "womd")}


@lru_cache
def build_log(shared: Path, prefix: str):
    return scenario_log(read_all_scenarios(shared)[prefix])


@lru_cache(maxsize=2)
def compute_case(shared: Path, case: str):
    """Scenario part, rollouts and features of a case; 32 identical rollouts are measured once."""
    expected = json.loads((shared / "golden" / "rmm" / "cases" / f"{case}.json").read_text())
    archive = np.load(shared / "golden" / "rmm" / "rollouts" / f"{case}.npz")
    distinct = expected["distinct_rollouts"]
    states = SimulatedStates(
        archive["object_ids"],
        *(torch.from_numpy(archive[name][:distinct].copy()) for name in ("x", "y", "z", "heading")),
        repeat=32 // distinct,
    )
    log = build_log(shared, case[:4])
    return expected, log, states, compute_features(log, states)


def take(states, rollouts):
    return SimulatedStates(states.object_id, *(v[rollouts] for v in (states.x, states.y, states.z, states.heading)))


def assert_fields_agree(actual, expected):
    assert set(actual) - {"scenario_id", "buckets"} == set(expected["metrics"])
    assert set(actual["buckets"]) == set(expected["buckets"])
    pairs = [(name, actual[name], value) for name, value in expected["metrics"].items()]
    pairs += [(name, actual["buckets"][name], value) for name, value in expected["buckets"].items()]
    for name, ours, official in pairs:
        is_metres = "displacement" in name or "ade" in name
        limit = 1e-5 + 1e-6 * abs(official) if is_metres else SCORE_TOLERANCE
        assert abs(ours - official) <= limit, f"{name}: ours {ours}, official {official}"


@pytest.mark.parametrize("case", CASES)
def test_every_official_field_agrees(shared, case):
    expected, log, _, features = compute_case(shared, case)
    for name, fields in expected["configs"].items():
        assert_fields_agree(score_features(log, features, METRICS[name]).to_official_fields()[0], fields)


@pytest.mark.parametrize("case", CASES)
def test_every_feature_of_every_step_agrees(shared, case):
    _, log, _, features = compute_case(shared, case)
    archive = np.load(shared / "golden" / "rmm" / "features" / f"{case}.npz")
    assert log.agents.evaluated_object_id.tolist() == archive["object_id"].tolist()
    assert log.agents.evaluated_object_type.tolist() == archive["object_type"].tolist()
    for side, ours in (("log", log.features), ("sim", features)):
        for name in HISTOGRAM_FEATURES:
            official = torch.from_numpy(archive[f"{side}_{name}"])
            official = official[: len(ours.valid)] if side == "sim" else official[None]
            tolerance = DISTANCE_TOLERANCE if name.startswith("distance") else FEATURE_TOLERANCE
            torch.testing.assert_close(getattr(ours, name), official, equal_nan=True, **tolerance)
        for name, official_name in OFFICIAL_FLAGS.items():
            official = archive[f"{side}_{official_name}"]
            assert (getattr(ours, name).numpy() == official).all(), f"{side} {name} flipped"
        assert (ours.valid.numpy() == archive[f"{side}_valid"]).all()
        displacement = torch.from_numpy(archive[f"{side}_average_displacement_error"])
        displacement = displacement[: len(ours.valid)] if side == "sim" else displacement[None]
        torch.testing.assert_close(ours.displacement_error, displacement, **DISPLACEMENT_TOLERANCE)


@pytest.mark.parametrize("case", CASES)
def test_the_log_likelihood_of_every_step_agrees(shared, case):
    _, log, states, features = compute_case(shared, case)
    config = METRICS["2025"]
    table = histogram_table(config, torch.device("cpu"))
    bins = count_rollouts(features, log, config).bins.sum(0, keepdim=True) * states.repeat
    log_probability = compute_log_probabilities(bins, torch.tensor([32.0 * 80]), table)[0]  # [H, E, K]
    values = stack_histogram_features(log.features)[:, 0]
    steps = log_probability.gather(-1, find_bins(values.flatten(1), table).view(values.shape))
    archive = np.load(shared / "golden" / "rmm" / "features" / f"{case}.npz")
    for row, name in enumerate(HISTOGRAM_FEATURES):
        official = torch.from_numpy(archive[f"loglik_{name}"])
        torch.testing.assert_close(steps[row], official, atol=2e-6, rtol=0)


@pytest.mark.parametrize("case", SMALL_SETS)
def test_small_sets_each_left_out_and_each_alone_agree(shared, case):
    expected, log, states, _ = compute_case(shared, case)
    for small in expected["small_sets"].values():
        features = compute_features(log, take(states, small["rollouts"]))
        for name, fields in small["all"].items():
            assert_fields_agree(score_features(log, features, METRICS[name]).to_official_fields()[0], fields)
        for name in ("2025", "2024"):
            result, summary = score_features(log, features, METRICS[name]), small[f"summary_{name}"]
            without_each, alone = result.leave_one_out_meta_metric, result.single_meta_metric
            assert without_each.tolist() == pytest.approx(summary["rmm_minus_i"], abs=SCORE_TOLERANCE)
            assert alone.tolist() == pytest.approx(summary["rmm_single_i"], abs=SCORE_TOLERANCE)
            mloo = without_each.mean() - without_each
            assert mloo.tolist() == pytest.approx(summary["mloo_i"], abs=SCORE_TOLERANCE)


@pytest.mark.parametrize("case", SMALL_SETS[:1])
def test_every_field_of_the_sets_left_out_and_alone_agrees(shared, case):
    expected, log, states, _ = compute_case(shared, case)
    small = expected["small_sets"]["4"]
    for rollout in small["rollouts"]:
        others = [other for other in small["rollouts"] if other != rollout]
        for chosen, official in ((others, small["leave_one_out"][rollout]), ([rollout], small["single"][rollout])):
            features = compute_features(log, take(states, chosen))
            for name, fields in official.items():
                assert_fields_agree(score_features(log, features, METRICS[name]).to_official_fields()[0], fields)


def test_a_batch_of_real_scenarios_scores_as_one_by_one(shared):
    scenarios, states = [], []
    for case in ("637f_log_noise", "bada_log_noise", "ee51_log_noise"):
        scenarios.append(read_all_scenarios(shared)[case[:4]])
        states.append(take(compute_case(shared, case)[2], [0, 1, 2, 3]))
    batch = score_batch(scenarios, states)
    for row, (scenario, item) in enumerate(zip(scenarios, states)):
        assert torch.equal(batch.leave_one_out_meta_metric[row], score(scenario, item).leave_one_out_meta_metric)


def test_32_identical_rollouts_score_as_one_that_is_repeated(shared):
    expected, log, states, _ = compute_case(shared, "bada_constant_velocity")
    assert states.repeat == 32
    copies = take(states, [0] * 32)
    fields = score_features(log, compute_features(log, copies), METRICS["2025"]).to_official_fields()[0]
    assert_fields_agree(fields, expected["configs"]["2025"])
