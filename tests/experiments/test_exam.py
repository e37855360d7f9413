"""The exam: one look at scenarios that chose nothing, margins, and a ledger of looks."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import scenes
from made_up import evaluation
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.experiments import exam
from rlftsim.experiments.exam import ExamConfig, Examinee, ExamRow, Ledger, find_seed, find_temperature
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.synthetic import sumo
from rlftsim.statistics import mean_interval
from rlftsim.verbs.exam import parse_rows

NETWORKS = [f"network{k // 4}" for k in range(80)]
"""Eighty scenarios of twenty street networks."""
NOISE = np.random.default_rng(0).normal(0.0, 1.0, (3, 80))


def row(*runs, **changed):
    """A candidate whose columns differ from the base's by given numbers and a little noise."""
    flat = {"min_average_displacement_error": np.full(80, 2.0), "speed_gap": np.full(80, -0.3)}
    base = evaluation("base", np.full(80, 0.7), columns=flat, clusters=NETWORKS)
    by_run = []
    for gain, noise in zip(runs, NOISE):
        columns = {name: values + changed.get(name, 0.0) + 1e-4 * noise for name, values in flat.items()}
        by_run.append(evaluation("run", 0.7 + gain + 0.01 * noise, columns=columns, clusters=NETWORKS))
    models = [Examinee("constant_velocity", ConstantVelocity())] * len(runs)
    return ExamRow("mloo", models, by_run, [base] * len(runs))


def test_who_gains_realism_within_all_margins_passes():
    assert row(0.02).verdict.startswith("mloo passes: RMM difference, for the better: +0.0")
    assert row(0.02).verdict.endswith("Margins: all hold.")
    assert set(row(0.02).margins.values()) == {"holds"}
    assert row(0.0).verdict.startswith("mloo undecided: RMM no difference")
    assert row(-0.02).verdict.startswith("mloo fails: RMM difference, for the worse")


@pytest.mark.parametrize(
    ("column", "change", "word"),
    [
        ("min_average_displacement_error", 0.05, "holds"),  # 2.5 % of 2 m
        ("min_average_displacement_error", 0.07, "missed"),
        ("min_average_displacement_error", -0.5, "holds"),
        ("min_average_displacement_error", 0.06, "undecided"),  # the margin itself
        ("speed_gap", -0.2, "missed"),  # slower by 0.2 m/s
        ("speed_gap", 0.2, "missed"),
        ("speed_gap", 0.08, "holds"),
    ],
)
def test_a_margin_holds_is_missed_or_is_undecided(column, change, word):
    judged = row(0.02, **{column: change})
    assert judged.margins[column] == word
    assert judged.verdict.startswith(
        f"mloo {'passes' if word == 'holds' else 'fails' if word == 'missed' else 'undec'}"
    )


def test_intervals_are_over_networks_and_runs_and_the_next_run_has_one_of_its_own():
    # without seeds the spread of the scenarios is all there is; runs that differ widen the interval
    alike, apart = row(0.02, 0.02, 0.02).changes["meta_metric"], row(0.0, 0.02, 0.04).changes["meta_metric"]
    assert apart.standard_error > 3 * alike.standard_error
    assert (apart.num_clusters, apart.count) == (20, 80)
    gains = row(0.0, 0.02, 0.04).gains
    assert gains == pytest.approx([0.0, 0.02, 0.04], abs=0.005)
    # Student's interval of the mean, wider by the root of n + 1
    low, high = mean_interval(gains).interval
    assert np.diff(row(0.0, 0.02, 0.04).next_run.interval)[0] == pytest.approx(2 * (high - low))


def test_the_seed_of_an_exam_follows_from_the_commit(monkeypatch, tmp_path):
    monkeypatch.setattr(exam, "CHECKOUT", tmp_path)
    with pytest.raises(ConfigError, match="give one by --seed"):
        find_seed()
    git = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "first"], check=True)
    commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout
    assert f"{find_seed():08x}" == commit[:8]
    assert ExamConfig({"a": ["b"]}).exam_name == f"synthetic-200-{int(commit[:8], 16)}"


def test_rows_of_models_are_named_and_of_equal_parts():
    assert parse_rows(["demo-tuned", "runs/a/model", "mloo=runs/x,runs/y"]) == {
        "demo-tuned": ["demo-tuned"], "a": ["runs/a/model"], "mloo": ["runs/x", "runs/y"]
    }  # fmt: skip
    with pytest.raises(ConfigError, match="two rows are called a"):
        parse_rows(["runs/a", "other/a"])
    with pytest.raises(ConfigError, match="mloo has 3 models for 2 base models"):
        ExamConfig({"mloo": ["x", "y", "z"]}, bases=["a", "b"])


def test_the_temperature_of_the_base_is_chosen_on_the_split_tune(tmp_path):
    seen = []

    class Cooler(Examinee):
        def evaluate(self, scenarios, out, config):
            seen.append(scenarios.split)
            return evaluation("base", [{0.8: 0.7, 0.9: 0.75, 1.0: 0.72}[config.temperature]] * 3)

    config = ExamConfig({"a": ["b"]}, temperatures=(0.8, 0.9, 1.0), evaluation=EvaluateConfig())
    assert find_temperature([Cooler("base", ConstantVelocity())], config, tmp_path) == 0.9
    assert seen == ["tune"] * 3


@pytest.fixture
def logs(tmp_path):
    """Logs with a training and a validation split."""
    scene = scenes.straight_road()
    named = [replace(scene, scenario_id=f"log{k}", source="womd") for k in range(12)]
    write_dataset(named, tmp_path / "logs", split=lambda s: "training" if s.scenario_id == "log0" else "validation")
    return tmp_path / "logs"


def test_a_second_look_needs_to_be_asked_for_and_is_counted(logs, tmp_path, capsys):
    words = ["experiment", "exam", "--models", "straight=constant_velocity", "--base-model", "constant_velocity"]
    words += [
        "--data",
        str(logs),
        "--num-rollouts",
        "2",
        "--jobs",
        "1",
        "--device",
        "cpu",
        "--out",
        str(tmp_path / "out"),
    ]
    words += ["--ledger", str(tmp_path / "ledgers" / "exam.jsonl")]
    assert main(words) == 0
    assert "straight undecided: RMM no difference: equal in all" in capsys.readouterr().out
    sat = ScenarioDataset(logs, "exam")
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "straight sat the exam logs-" in error
    assert "--again" in error
    # nor under another name
    renamed = ["turned=constant_velocity" if word.startswith("straight") else word for word in words]
    assert main(renamed) == 2
    assert main([*words, "--again"]) == 0
    first, second = map(json.loads, (tmp_path / "ledgers" / "exam.jsonl").read_text().splitlines())
    assert (first["looks"], second["looks"]) == (1, 2)
    assert first["num_scenarios"] == len(sat) < 11
    assert first["columns"]["meta_metric"]["difference"] == 0.0
    assert first["seeds"] == [None]
    (report,) = (tmp_path / "out").glob("logs-*/exam.md")
    assert "| minADE ≤ +3.00 % | holds" in report.read_text()
    assert json.loads(report.with_suffix(".json").read_text())["rows"][0]["recipe"] == "straight"


def test_a_line_that_is_none_of_a_ledger_is_named(tmp_path):
    (tmp_path / "exam.jsonl").write_text(
        '{"exam": "a", "looks": 1, "recipe": "r", "date": "d", "fingerprints": []}\n[]\n'
    )
    with pytest.raises(DataError, match="line 2 is none of a ledger"):
        Ledger(tmp_path / "exam.jsonl").count_looks("a", "r", [], is_repeat=True)


def test_the_ledger_of_this_repository_takes_further_looks():
    ledger = Ledger(Path(__file__).parents[2] / "benchmarks" / "exam.jsonl")
    assert ledger.count_looks("synthetic-200-2415932249", "demo-fast", [], is_repeat=True) == 1


@pytest.mark.slow
@pytest.mark.skipif(not sumo.is_available(), reason="the extra `synthetic` is not installed")
def test_an_exam_is_generated_of_networks_that_no_other_data_set_has(tmp_path, capsys):
    words = ["experiment", "exam", "--models", "cv=constant_velocity", "--base-model", "constant_velocity"]
    words += ["--seed", "7", "--num-scenarios", "12", "--num-rollouts", "2", "--jobs", "1", "--out", str(tmp_path)]
    assert main([*words, "--ledger", str(tmp_path / "exam.jsonl")]) == 0
    assert "bootstrap over 2 street networks" in capsys.readouterr().out
    scenarios = ScenarioDataset(tmp_path / "synthetic-12-7" / "scenarios", "exam")
    assert (len(scenarios), len(set(scenarios.clusters))) == (12, 2)
    assert not {*scenarios.clusters} & {f"7/{split}/{k}" for split in range(3) for k in range(3)}
