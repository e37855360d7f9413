"""Commands on data that are shaped like Argoverse 2: those of docs/data.md, and training, goals and pages."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import av2_files
import scenes
import tiny
from rlftsim.cli.main import main
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.dataset import ScenarioDataset

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files of four scenarios to train on and of two to evaluate."""
    folder = tmp_path_factory.mktemp("av2")
    for k, scenario in enumerate(tiny.pack_scenarios(6)):
        av2_files.write_av2(folder / "av2" / ("train" if k < 4 else "val"), scenario)
    return folder


def run(capsys, *words):
    status = main([str(word) for word in words])
    captured = capsys.readouterr()
    assert status == 0, captured.err
    return captured.out


@pytest.mark.slow
def test_the_commands_of_the_page_score_scenarios(files, monkeypatch, capsys):
    page = (ROOT / "docs" / "data.md").read_text()
    block = re.search(r"## Convert Argoverse 2.*?```sh\n(rlftsim.*?)```", page, re.DOTALL).group(1).splitlines()
    assert len(block) <= 4
    monkeypatch.chdir(files)
    printed = "".join(run(capsys, *shlex.split(line)[1:]) for line in block if line.startswith("rlftsim "))
    assert "Data of av2 with guessed size, z" in printed
    assert (files / "runs" / "av2" / "oracle.parquet").exists()


@pytest.mark.slow
def test_every_stage_runs_on_the_data(files, tmp_path, capsys):
    data = tmp_path / "data"
    run(capsys, "convert", files / "av2", data, "--jobs", 1)
    shown = run(capsys, "data", "stats", data)
    assert re.search(r"data sources\W+6 av2", shown)
    assert re.search(r"guessed in scenarios\W+6 size, 6 z", shown)
    run(capsys, "data", "verify", data)
    vocabulary = tmp_path / "vocabulary.safetensors"
    tiny.small_vocabulary(ScenarioDataset(data, "training")).save(vocabulary)
    sizes = {"dim": 16, "num-heads": 2, "head-dim": 8, "num-decoder-layers": 1, "num-frequencies": 4}
    small = [word for name, value in sizes.items() for word in (f"--model.{name}", value)]
    base, tuned = tmp_path / "base", tmp_path / "tuned"
    run(capsys, "pretrain", "smart-demo", "--data", data, "--vocabulary", vocabulary, "--out", base, *small,
        "--pretrain.epochs", 5, "--pretrain.batch-size", 1, "--pretrain.device.accelerator", "cpu")  # fmt: skip
    card = (base / "model" / "README.md").read_text()
    assert "CC BY-NC-SA 4.0" in card
    assert "* Data of av2 with guessed size, z" in card
    run(capsys, "finetune", "smart-demo", "--model", base, "--data", data, "--out", tuned, "--finetune.epochs", 1.25,
        "--finetune.batch-size", 1, "--finetune.num-rollouts", 2, "--finetune.device.accelerator", "cpu")  # fmt: skip
    out = tmp_path / "results"
    for model in ("oracle", "constant_velocity", tuned):
        name = Path(model).name
        assert "guessed size, z" in run(capsys, "evaluate", model, "--data", data, "--out", out, "--name", name,
                                        "--device", "cpu", "--num-rollouts", 2)  # fmt: skip
    rollouts = tmp_path / "rollouts"
    run(capsys, "simulate", tuned, "--data", data, "--out", rollouts, "--num-rollouts", 2, "--device", "cpu")
    scores = json.loads(run(capsys, "score", rollouts, "--data", data, "--json", "--explain", tmp_path / "pages"))
    assert (scores["sources"], scores["guessed"]) == (["av2"], ["size", "z"])
    pages = list((tmp_path / "pages").rglob("*.html"))
    assert len(pages) == 2
    assert all("Made from the Argoverse 2 Motion Forecasting Dataset" in page.read_text() for page in pages)
    scenario_id = ScenarioDataset(data, "validation").scenario_ids[0]
    run(capsys, "goals", "propose", data, "--scenario", scenario_id, "--out", tmp_path / "goals.json")
    assert scenario_id in (tmp_path / "goals.json").read_text()


class Parked(ConstantVelocity):
    """Nobody moves."""

    fingerprint_name = "parked"

    def encode(self, scenarios):
        context = super().encode(scenarios)
        return replace(context, velocity=torch.zeros_like(context.velocity))


@pytest.mark.slow
def test_the_log_scores_above_both_baselines(files, tmp_path, capsys):
    run(capsys, "convert", files / "av2", tmp_path / "data", "--jobs", 1)
    data = ScenarioDataset(tmp_path / "data")
    rows = {"log": "oracle", "velocity": ConstantVelocity(), "parked": Parked()}
    config = EvaluateConfig(num_rollouts=8)
    means = {
        name: evaluate(policy, data, config=config, name=name, show_progress=False).mean_and_error("meta_metric").mean
        for name, policy in rows.items()
    }
    # The two baselines are in no fixed order: where most road users stand, "nobody moves" is the better guess.
    assert means["log"] > max(means["velocity"], means["parked"]) + 0.1, means


@pytest.mark.official
@pytest.mark.slow
def test_the_shipped_model_scores_between_constant_velocity_and_the_log_on_the_sample(shared, tmp_path, capsys):
    run(capsys, "convert", shared / "data" / "av2", tmp_path / "data", "--split", "validation", "--jobs", 1)
    data = ScenarioDataset(tmp_path / "data")

    def rmm(policy, name):
        found = evaluate(policy, data, config=EvaluateConfig(), name=name, show_progress=False)
        return found.mean_and_error("meta_metric").mean

    model = rmm(load_policy("demo-base"), "model")
    assert rmm("oracle", "log") == pytest.approx(0.899, abs=0.002)
    # Three evaluated vehicles, one of which stands beside the road: the order of the model and of
    # Parked() is chance here, so only the two ends are asserted.
    assert rmm(ConstantVelocity(), "velocity") + 0.1 < model < 0.85


def test_pictures_of_other_data_carry_no_note():
    from rlftsim.viewer.scene import build_scene

    assert build_scene(scenes.straight_road()).note == ""
    noted = replace(scenes.straight_road(), source="av2", guessed=frozenset({"z", "size"}))
    assert build_scene(noted).note.endswith("CC BY-NC-SA 4.0. Guessed, not logged: size, z.")
