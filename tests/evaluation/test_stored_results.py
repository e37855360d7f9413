"""Results that release 0.1 stored: found again, resumed and compared."""

import json
import math
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rlftsim.evaluation import evaluate as evaluating
from rlftsim.evaluation import score_files
from rlftsim.evaluation.compare import compare
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.evaluation.goal_attainment import attain_goals
from rlftsim.evaluation.results import ADDED_COLUMNS, SCORE_COLUMNS, Evaluation
from rlftsim.evaluation.resumable import JsonParts
from rlftsim.evaluation.score_files import ScoreConfig, score_rollouts, to_json
from rlftsim.goals.goals_file import read_goals
from rlftsim.policies.registry import load_policy, with_guidance
from rlftsim.rollout.baselines import ConstantVelocity

STORED = Path(__file__).parents[1] / "data" / "stored_0_1"
EXPECTED = json.loads((STORED / "expected.json").read_text())
SAME_BITS = torch.backends.cpu.get_cpu_capability() == EXPECTED["made_with"]["cpu_capability"]
"""Other code paths of torch and MKL round otherwise."""
QUICK = EvaluateConfig(num_rollouts=4, limit=4)
LOGGED = replace(QUICK, goals="logged")
ADDED_SCORES = [column for column in SCORE_COLUMNS if column in ADDED_COLUMNS]


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    with tarfile.open(STORED / "stored.tar.xz") as archive:
        archive.extractall(folder)
    return folder


@pytest.fixture(autouse=True)
def inside(unpacked, monkeypatch):
    """Stored paths are relative to the folder."""
    monkeypatch.chdir(unpacked)


def must_not_be_called(*arguments):
    pytest.fail("a stored result was computed again")


def assert_rows(found, expected, tolerance=0.0):
    assert len(found) == len(expected)
    for row, own in zip(found, expected):
        assert row.keys() - set(ADDED_COLUMNS) == own.keys()
        for name, value in own.items():
            if isinstance(value, float):
                assert row[name] == pytest.approx(value, rel=0, abs=tolerance, nan_ok=True), name
            else:
                assert row[name] == value, name


EVALUATED = {
    "base": (lambda: load_policy("models/base"), QUICK),
    "tuned": (lambda: load_policy("models/tuned"), QUICK),
    "goals": (lambda: load_policy("models/goals"), LOGGED),
    "guided": (lambda: with_guidance(load_policy("models/goals"), 2.0), LOGGED),
    "synthetic": (ConstantVelocity, QUICK),
}


@pytest.mark.parametrize("name", EVALUATED)
def test_a_finished_evaluation_is_found_and_left_as_it_is(name, monkeypatch):
    monkeypatch.setattr(evaluating, "_evaluate_scenario", must_not_be_called)
    path = Path(f"evaluations/{name}.parquet")
    before = path.stat().st_mtime_ns, path.read_bytes()
    policy, config = EVALUATED[name]
    data = "synthetic" if name == "synthetic" else "data"
    result = evaluate(policy(), data, "evaluations", config, name=name, show_progress=False)
    assert_rows(result.table.to_pylist(), EXPECTED["evaluations"][name])
    assert (path.stat().st_mtime_ns, path.read_bytes()) == before


def test_a_stopped_evaluation_goes_on_with_the_one_scenario_that_is_missing(monkeypatch):
    original, computed = evaluating._evaluate_scenario, []
    monkeypatch.setattr(evaluating, "_evaluate_scenario", lambda job, p: computed.append(p) or original(job, p))
    config, policy = replace(LOGGED, limit=None), load_policy("models/goals")
    result = evaluate(policy, "data", "evaluations", config, name="stopped", show_progress=False)
    rows, expected = result.table.to_pylist(), EXPECTED["evaluations"]["stopped"]
    assert computed == [4]
    assert_rows(rows[:4], expected[:4])
    assert_rows(rows[4:], expected[4:], 0.0 if SAME_BITS else 1e-5)
    # rows of 0.1 lack later columns, the new row has them (or no agent that could leave the road)
    assert all(math.isnan(row[name]) for row in rows[:4] for name in ADDED_SCORES)
    assert not Path("evaluations/stopped.parts").exists()


def test_stored_evaluations_compare_as_before():
    base, tuned = (Evaluation.read(f"evaluations/{name}.parquet") for name in ("base", "tuned"))
    assert base.provenance.package_version == "0.1.0"
    comparison = compare(base, tuned)
    for column in ADDED_SCORES:  # nothing was stored to compare
        assert comparison[column].count == 0
        assert "nothing to compare" in comparison[column].verdict
    for column in set(SCORE_COLUMNS) - set(ADDED_COLUMNS):
        found = comparison[column]
        numbers = (found.mean_a, found.mean_b, found.difference, found.p_value)
        for number, expected in zip(numbers, EXPECTED["comparison"][column]):
            assert number == expected or (math.isnan(number) and math.isnan(expected)), column


def test_stored_scores_of_rollouts_are_found(monkeypatch):
    monkeypatch.setattr(score_files, "_score_entry", must_not_be_called)
    path = Path("scores/rollouts.parquet")
    before = path.stat().st_mtime_ns
    result = score_rollouts("rollouts", "data", "scores", ScoreConfig(jobs=1), show_progress=False)
    # earlier versions did not store where data come from
    assert to_json(result) == {**EXPECTED["score"], "sources": [], "guessed": []}
    assert path.stat().st_mtime_ns == before


@pytest.mark.parametrize("name", EXPECTED["goals_files"])
def test_stored_goals_files_say_the_same(name):
    file = read_goals(Path(f"goals/{name}.json"))
    found = {
        section: [[e.scenario_id, e.agent_id, e.x, e.y, e.label] for e in entries]
        for section, entries in (("goals", file.goals), ("alternatives", file.alternatives))
    }
    assert found == EXPECTED["goals_files"][name]


def test_stored_attainment_is_found():
    out = Path("experiments/attainment/maneuver-controllability/base")
    before = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    file = read_goals(Path("experiments/maneuver-controllability.goals.json"))
    goals = [*file.goals, *file.alternatives]
    attained = attain_goals(load_policy("models/base"), "data", out, QUICK, goals, show_progress=False)
    assert [[one.reached, one.passed] for one in attained] == EXPECTED["experiments"]["attained"]["base"]
    assert [one.entry for one in attained] == goals
    assert {path: path.stat().st_mtime_ns for path in out.iterdir()} == before


def test_stored_variances_are_found_whatever_identifies_them_today():
    ids = [row["scenario_id"] for row in EXPECTED["experiments"]["evaluations"]["base"]]
    identity = {i: {"sizes": [2, 3, 4], "policy": "unknown to 0.1"} for i in ids}
    files = JsonParts(Path("experiments/variances"), ids, identity, {}, lambda i, values: values["variances"])
    found = [files.read(range(k, k + 1)) for k in range(len(ids))]
    expected = EXPECTED["experiments"]["variances"]
    assert found == [[expected["mloo"][k], expected["rloo"][k]] for k in range(len(ids))]
    other = JsonParts(files.folder, ids, {i: {"sizes": [2, 3]} for i in ids}, {}, files.parse)
    assert other.read(range(1)) is None
