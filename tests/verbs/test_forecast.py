"""`rlftsim doctor --plan finetune|pretrain`: what a training takes, from its own first updates."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.scenario.open import open_dataset
from rlftsim.verbs import forecast
from rlftsim.verbs.forecast import (
    MeasuredRun,
    TrainingCommand,
    find_fitting_micro_batch,
    forecast_training,
    write_largest,
)
from small_things import write_synthetic

GB = 10**9


@pytest.mark.parametrize(
    ("peaks", "available", "fitting"),
    [
        ({1: 2 * GB, 5: 6 * GB}, 4 * GB, 3),  # 1 GB each beside 1 GB
        ({1: 2 * GB, 5: 6 * GB}, 100 * GB, 8),  # never more than an update has
        ({1: 2 * GB, 5: 6 * GB}, GB, 0),
        ({4: 2 * GB}, 3 * GB, 8),
        ({1: 2 * GB, 5: 2 * GB}, 3 * GB, 8),
    ],
)
def test_the_largest_micro_batch_that_fits_lies_on_the_line_through_two_measurements(peaks, available, fitting):
    assert find_fitting_micro_batch(peaks, available, 8) == fitting


@pytest.fixture
def measured(monkeypatch):
    """Runs that take half a second for an update, and 3 GB a process for each scenario of the micro batch."""
    settings = {"batch_size": 2, "micro_batch_size": 8, "device.processes": 2, "epochs": 3.0, "seed": 0}
    words_of_runs = []

    def measure_run(words, out, num_updates):
        words_of_runs.append(words)
        micro_batch = int(words[-1]) if words[-2].endswith("micro-batch-size") else 8
        return MeasuredRun(0.5, micro_batch * 3 * GB, settings)

    monkeypatch.setattr(forecast, "measure_run", measure_run)
    return words_of_runs


def test_a_run_of_one_update_says_that_its_time_is_not_measured(monkeypatch, capsys):
    settings = {"batch_size": 160, "micro_batch_size": 8, "device.processes": 2, "epochs": 1.0, "seed": 0}
    monkeypatch.setattr(forecast, "measure_run", lambda *_: MeasuredRun(math.nan, GB, settings))
    words = ["doctor", "--plan", "finetune", "--recipe", "smart-demo", "--data", "synthetic", "--method", "rlft"]
    assert main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "not measured: it takes 2 updates, this run has 1" in text
    assert "nan" not in text


def test_updates_time_and_memory_are_those_of_the_command_itself(measured, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.json").write_text('{"finetune": {"epochs": 3.0}}')
    monkeypatch.setattr(forecast, "find_memory", lambda: 100 * GB)
    words = ["doctor", "--plan", "finetune", "--recipe", "smart-demo", "--data", "synthetic", "--measure", "2"]
    assert main([*words, "--model", "runs/base", "--config", "mine.json"]) == 0
    assert measured[0][:6] == ["finetune", "smart-demo", "--data", "synthetic", "--out", measured[0][5]]
    assert measured[0][6:] == ["--model", "runs/base", "--config", "mine.json"]
    # few scenarios alone would be trained on by one process
    assert measured[1][-4:] == ["--processes", "2", "--finetune.micro-batch-size", "2"]
    out = capsys.readouterr().out
    # 160 scenarios by 2, three times; 2 processes of 2 x 3 GB
    for cells in ("240", "0.5 s (mean of 2)", "2 min", "12.0 GB of 100.0 GB", "2 now, up to 2 fit"):
        assert cells in out


def test_a_calibration_has_the_batches_of_its_stages(measured, monkeypatch, capsys):
    monkeypatch.setattr(forecast, "find_memory", lambda: 100 * GB)
    settings = {"batch_size": 4, "micro_batch_size": 2, "device.processes": 1, "lengths": [0.7, 1.4], "held_back": 0.2}
    settings["seed"] = 0
    original = forecast.measure_run
    monkeypatch.setattr(forecast, "measure_run", lambda *arguments: replace(original(*arguments), settings=settings))
    words = ["doctor", "--plan", "finetune", "--method", "calibrate", "--recipe", "smart-demo", "--data", "synthetic"]
    assert main([*words, "--measure", "2"]) == 0
    assert measured[0][-2:] == ["--method", "calibrate"]
    assert measured[1][-2:] == ["--calibrate.micro-batch-size", "2"]
    out = capsys.readouterr().out
    # of 160 scenarios 128 by 4, and three times the 32 that are held back
    for cells in ("56", "28 s", "6.0 GB of 100.0 GB", "2 now, up to 4 fit"):
        assert cells in out


def test_a_training_that_cannot_fit_is_refused(measured, monkeypatch):
    monkeypatch.setattr(forecast, "find_memory", lambda: 5 * GB)
    with pytest.raises(DataError, match=r"cannot fit: at the least micro batch the largest batch needs 12.0 GB of"):
        forecast_training(TrainingCommand("finetune", "smart-demo", "demo-base", "synthetic", method="rlft"), 1)


def test_a_forecast_of_a_training_needs_a_recipe(capsys):
    assert main(["doctor", "--plan", "pretrain", "--data", "synthetic"]) == 2
    assert (
        "--plan pretrain needs the recipe of the training: add --recipe, such as smart-demo" in capsys.readouterr().err
    )


def test_memory_is_measured_on_the_largest_batch_of_the_run(tmp_path):
    dataset = open_dataset("synthetic", "validation")
    least, *_, third, second, most = dataset.num_agents.argsort(kind="stable")
    order = np.array([second, third, least, most])  # beside the most the least is padded to as many
    written = open_dataset(write_largest(dataset, order, 2, 1, tmp_path / "together"), "training")
    assert set(written.scenario_ids) == {dataset.scenario_ids[position] for position in (least, most)}
    # of two processes one has the most alone, which is less than two of another batch
    assert dataset.num_agents[most] < 2 * dataset.num_agents[third]
    order = np.array([most, least, least, least, third, second, third, second])
    written = open_dataset(write_largest(dataset, order, 4, 2, tmp_path / "apart"), "training")
    assert set(written.scenario_ids) == {dataset.scenario_ids[position] for position in (third, second)}


@pytest.mark.slow
def test_a_run_is_stopped_behind_the_updates_that_are_wanted_and_its_mistakes_are_those_of_the_command(tmp_path):
    write_synthetic(tmp_path / "data")
    settings = {"finetune": {"epochs": 50.0, "batch_size": 1, "num_rollouts": 2, "warmup_updates": 0}}
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    command = TrainingCommand(
        "finetune", "smart-demo", "demo-base", str(tmp_path / "data"), config=str(tmp_path / "settings.json")
    )
    made = forecast_training(command, 2)
    assert (made.num_updates, made.num_measured, made.processes) == (100, 2, 1)
    assert 0 < made.seconds < 60
    assert 100_000_000 < made.peak_bytes < made.available_bytes
    # a run that is not stopped takes what was forecast; time on shared cores is held loosely
    words = [*command.write_words(tmp_path / "data", tmp_path / "run"), "--max-updates", "4"]
    whole = forecast.measure_run(words, tmp_path / "run", 4)
    assert made.peak_bytes == pytest.approx(whole.peak_bytes, rel=0.15)
    assert 1 / 3 < made.seconds / whole.seconds < 3
    with pytest.raises(ConfigError, match=r"finetune cannot be forecast: .*nothing.* is neither a model folder"):
        forecast_training(TrainingCommand("finetune", "smart-demo", "nothing", "synthetic"), 1)
