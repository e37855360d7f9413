"""Validation during training: the numbers of an evaluation, and not a trace in the weights."""

import json
import math
import shutil
from dataclasses import astuple, replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import tiny
from rlftsim.errors import CheckpointError, ConfigError, DataError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.training.config import AlarmConfig, FinetuneConfig, ValidationConfig
from rlftsim.training.monitoring import describe_map_use, measure_map_use
from rlftsim.training.run import TrainingRun
from rlftsim.training.run_folder import read_metrics

OFTEN = ValidationConfig(every=2, num_scenarios=3, num_rollouts=2, scenarios_per_pass=2)


@pytest.fixture(scope="module")
def held_out():
    """Scenarios that ship, those with the fewest agents."""
    data = ScenarioDataset(pack_path(), "validation")
    return [data[int(i)] for i in data.num_agents.argsort(kind="stable")[:7]]


@pytest.mark.parametrize("stage", ["pretrain", "catk", "finetune"])
def test_validation_changes_nothing_of_the_training(stage, vocabulary, drawn_scenarios, held_out, tmp_path):
    for name, settings in (("without", ValidationConfig()), ("with", OFTEN)):
        policy = tiny.tiny_policy(vocabulary)
        options = {"validation": settings, "epochs": 1.0}  # four updates of one scenario
        tiny.train(stage, policy, drawn_scenarios, tmp_path / name, held_out=held_out, **options)
    without, with_it = (load_file(tmp_path / n / "model" / "model.safetensors") for n in ("without", "with"))
    assert all(torch.equal(value, with_it[name]) for name, value in without.items())
    lines = read_metrics(tmp_path / "with")
    assert ["validation_rmm" in line for line in lines] == [False, True, False, True]
    objective = "kl" if stage == "finetune" else "loss"
    for line, other in zip(lines, read_metrics(tmp_path / "without")):
        assert line[objective] == other[objective]
        assert "validation_rmm" not in other


def test_a_fine_tuned_model_is_that_of_the_best_validation_also_where_the_run_was_stopped(
    vocabulary, drawn_scenarios, held_out, tmp_path, monkeypatch
):
    with monkeypatch.context() as patch:
        patch.setattr(TrainingRun, "keep_best", scripted())
        whole = train_keeping_best(vocabulary, drawn_scenarios, held_out, tmp_path / "whole")
        assert read_metrics(tmp_path / "whole")[-1]["update"] == 4
        # superseded weights are gone
        assert [path.name for path in (tmp_path / "whole" / "best").iterdir()] == ["update-00000002.safetensors"]
        kept = load_file(tmp_path / "whole" / "best" / "update-00000002.safetensors")
        assert all(torch.equal(value, kept[f"network.{name}"]) for name, value in whole.items())
    # the same model where the run stops behind its best validation, or a later one, and goes on
    for update in (2, 3):
        with monkeypatch.context() as patch:
            patch.setattr(TrainingRun, "keep_best", scripted(stop=update))
            with pytest.raises(KeyboardInterrupt):
                train_keeping_best(vocabulary, drawn_scenarios, held_out, tmp_path / "stopped")
            patch.setattr(TrainingRun, "keep_best", scripted())
            resumed = train_keeping_best(vocabulary, drawn_scenarios, held_out, tmp_path / "stopped")
        assert all(torch.equal(value, resumed[name]) for name, value in whole.items())
        shutil.rmtree(tmp_path / "stopped")


KEEP_BEST = TrainingRun.keep_best
BOUNDS = {1: 0.0, 2: 0.3, 3: -0.1, 4: 0.2}


def scripted(stop=0):
    """A `keep_best` of validations with the gains `BOUNDS`, behind which the process ends at an update."""

    def keep(run, values):
        values["validation_gain_low"] = BOUNDS[run.learner.update]
        KEEP_BEST(run, values)
        if run.learner.update == stop:
            raise KeyboardInterrupt

    return keep


def train_keeping_best(vocabulary, scenarios, held_out, out, **changes):
    """Weights of the model of a run of four updates, each with a validation and a checkpoint."""
    validation = ValidationConfig(every=1, num_scenarios=3, num_rollouts=2, keep_best=True)
    options = {"held_out": held_out, "epochs": 1.0, "validation": validation, "checkpoint_every": 1} | changes
    tiny.train("finetune", tiny.tiny_policy(vocabulary), scenarios, out, **options)
    return load_file(out / "model" / "model.safetensors")


def test_what_the_best_model_depends_on_cannot_change_when_a_run_goes_on(
    vocabulary, drawn_scenarios, held_out, tmp_path, monkeypatch
):
    monkeypatch.setattr(TrainingRun, "keep_best", scripted(stop=3))
    arguments = (vocabulary, drawn_scenarios)
    with pytest.raises(KeyboardInterrupt):
        train_keeping_best(*arguments, held_out, tmp_path)
    same = ValidationConfig(every=1, num_scenarios=3, num_rollouts=2, keep_best=True)
    for changed, data, name in (
        (replace(same, num_scenarios=2), held_out, r"validation\.num_scenarios"),
        (replace(same, keep_best=False), held_out, r"validation\.keep_best"),
        (same, [held_out[i] for i in range(3, 7)], "held_out"),
    ):
        with pytest.raises(CheckpointError, match=rf"other settings or inputs \({name}\)"):
            train_keeping_best(*arguments, data, tmp_path, validation=changed)
    # what changes no number may change; but weights that are lost cannot be the model
    monkeypatch.setattr(TrainingRun, "keep_best", scripted())
    (tmp_path / "best" / "update-00000002.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"update-00000002\.safetensors is missing, the weights of the best"):
        train_keeping_best(*arguments, held_out, tmp_path, validation=replace(same, scenarios_per_pass=1))


def test_by_default_rewards_are_validated_for_a_twentieth_of_the_run():
    auto = FinetuneConfig().validation
    assert auto.every == "auto"
    # the demo's 40 updates of 32 rollouts, 8 rollouts of training for each of a validation
    assert astuple(auto.fit(40, 32))[:3] == (20, 13, 4)
    assert 3 * 13 * 4 * 8 <= 40 * 32
    # too few to choose a model by; the gain is logged all the same
    assert (auto.fit(40, 32).keep_best, auto.fit(60_900, 32).keep_best, auto.fit(40, 32).paired) == (False, True, True)
    # of a long run 64 scenarios at most, 21 times: many more would find the luckiest
    assert astuple(auto.fit(60_900, 32))[:3] == (3045, 64, 4)
    # 8 scenarios, three times, are the least
    assert [auto.fit(24, 32).every, auto.fit(23, 32).every, auto.fit(0, 32).every] == [12, 0, 0]
    assert OFTEN.fit(1, 1) == OFTEN


def test_a_run_keeps_the_numbers_of_its_validations_where_it_goes_on(vocabulary, drawn_scenarios, held_out, tmp_path):
    auto = ValidationConfig(every="auto", num_scenarios=2, num_rollouts=1, keep_best=True)
    options = {"validation": auto, "batch_size": 2, "num_rollouts": 6, "held_out": held_out}
    for epochs, out in ((2.0, "grown"), (4.0, "grown"), (2.0, "blind")):
        options |= {"held_out": None} if out == "blind" else {}
        tiny.train("finetune", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path / out, epochs=epochs, **options)
    stored = [json.loads((tmp_path / out / "config.json").read_text())["validation"] for out in ("grown", "blind")]
    # 4 updates of 12 rollouts pay 2 scenarios three times
    assert [(values["every"], values["num_scenarios"]) for values in stored] == [(2, 2), (0, 2)]
    lines = read_metrics(tmp_path / "grown")
    assert [line["update"] for line in lines if "validation_gain" in line] == [2, 4, 6, 8]


def test_a_gain_may_be_logged_and_the_last_model_taken(vocabulary, drawn_scenarios, held_out, tmp_path, caplog):
    validation = ValidationConfig(every=1, num_scenarios=3, num_rollouts=2, paired=True)
    train_keeping_best(vocabulary, drawn_scenarios, held_out, tmp_path, validation=validation)
    assert all("validation_gain_low" in line for line in read_metrics(tmp_path))
    assert not (tmp_path / "best").exists()
    assert "is the model of update" not in caplog.text


def test_a_single_scenario_is_warned_of(vocabulary, drawn_scenarios, held_out, tmp_path, caplog):
    train_keeping_best(vocabulary, drawn_scenarios, [held_out[0]], tmp_path)
    assert "a single scenario does not tell the best model" in caplog.text


def test_a_run_says_where_no_validation_is_better_than_the_start(
    vocabulary, drawn_scenarios, held_out, tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(TrainingRun, "keep_best", scripted())
    monkeypatch.setitem(BOUNDS, 2, -0.2)
    monkeypatch.setitem(BOUNDS, 4, -0.3)
    train_keeping_best(vocabulary, drawn_scenarios, held_out, tmp_path)
    assert "no validation is clearly better than the start" in caplog.text
    assert "of update 1: the lower bound of its gain in RMM over the start, +0.0000" in caplog.text


def test_the_gain_is_over_the_start_scenario_by_scenario(vocabulary, drawn_scenarios, held_out, tmp_path):
    # nothing is learned, so each scenario scores as at the start
    validation = ValidationConfig(every=2, num_scenarios=3, num_rollouts=2, keep_best=True)
    options = {"held_out": held_out, "learning_rate": 1e-30, "epochs": 0.5, "validation": validation}
    tiny.train("finetune", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, **options)
    *_, line = read_metrics(tmp_path)
    assert (line["validation_gain"], line["validation_gain_low"]) == (0.0, 0.0)


def test_a_run_ends_where_an_alarm_is_raised_and_stays_ended(vocabulary, drawn_scenarios, tmp_path, caplog):
    alarms = AlarmConfig(first_updates=1, window=1, speed_drift_mps=1e-9, stop=True)
    options = {"alarms": alarms, "learning_rate": 0.3, "epochs": 2.0, "max_kl": 1e3, "warmup_updates": 0}
    tiny.train("finetune", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, **options)
    updates = read_metrics(tmp_path)[-1]["update"]
    assert updates < 8
    assert f"the run ends at update {updates} of 8: alarm_speed: mean speed differs" in caplog.text
    assert (tmp_path / "model" / "model.safetensors").exists()
    tiny.train("finetune", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, **options)
    assert read_metrics(tmp_path)[-1]["update"] == updates


def test_the_last_validation_is_what_an_evaluation_of_the_model_finds(vocabulary, drawn_scenarios, held_out, tmp_path):
    write_dataset(held_out[:5], tmp_path / "data", split="validation", license_note="CC0-1.0")
    held_out = ScenarioDataset(tmp_path / "data", "validation")
    policy = tiny.tiny_policy(vocabulary)
    everything = replace(OFTEN, every=100, num_scenarios=4, top_k=3)
    tiny.train("pretrain", policy, drawn_scenarios, tmp_path, held_out=held_out, validation=everything, epochs=0.5)
    line = read_metrics(tmp_path)[-1]
    model = SmartPolicy.from_pretrained(tmp_path / "model")
    found = evaluate(
        model,
        tmp_path / "data",
        tmp_path,
        EvaluateConfig(num_rollouts=2, seed=0, top_k=3),
        name="e",
        show_progress=False,
    )
    rows = [found.scenario_ids.index(held_out.scenario_ids[i]) for i in everything.choose(len(held_out))]
    assert len(set(rows)) == 4
    rmm = np.array(found.values("meta_metric"))[rows]
    error = 3.182446 * rmm.std(ddof=1) / math.sqrt(4)  # 97.5 % quantile of t with 3 degrees of freedom
    assert line["validation_rmm"] == pytest.approx(rmm.mean(), abs=1e-5)
    assert line["validation_rmm_low"] == pytest.approx(rmm.mean() - error, abs=1e-5)
    assert line["validation_rmm_high"] == pytest.approx(rmm.mean() + error, abs=1e-5)
    ade = np.array(found.values("min_average_displacement_error"))[rows]
    assert line["validation_min_ade_m"] == pytest.approx(ade.mean(), rel=1e-4)
    leaves = np.nanmean(np.array(found.values("unlogged_offroad_rate"))[rows])
    assert line["validation_unlogged_offroad_rate"] == pytest.approx(leaves, abs=1e-6)
    batch = collate([held_out[i] for i in everything.choose(len(held_out))])
    map_use = describe_map_use(measure_map_use(model.eval(), batch), "validation_")
    assert {name: line[name] for name in map_use} == pytest.approx(map_use, abs=1e-4, nan_ok=True)


def test_a_run_may_go_on_with_another_validation(vocabulary, drawn_scenarios, held_out, tmp_path):
    options = {"epochs": 0.5, "held_out": held_out}
    tiny.train("pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, validation=OFTEN, **options)
    other = replace(OFTEN, every=1, num_rollouts=3)
    tiny.train("pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, validation=other, **options)


class Mute(torch.nn.Module):
    """Can be trained, cannot simulate."""

    def teacher_forced(self, scenarios, trained):
        raise AssertionError

    def save_pretrained(self, folder, *, card=""):
        raise AssertionError


def test_what_cannot_be_validated_is_refused_before_the_run(vocabulary, drawn_scenarios, tmp_path):
    options = {"validation": OFTEN}
    with pytest.raises(ConfigError, match="Mute cannot simulate"):
        tiny.train("pretrain", Mute(), drawn_scenarios, tmp_path, held_out=drawn_scenarios, **options)
    with pytest.raises(ConfigError, match="no scenario to validate on"):
        tiny.train("pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, held_out=[], **options)
    with pytest.raises(ConfigError, match=r"validation\.every must be 0"):
        ValidationConfig(every=-1)
    with pytest.raises(ConfigError, match="num_rollouts must be positive"):
        ValidationConfig(num_rollouts=0)
    assert not (tmp_path / "config.json").exists()


def test_scenarios_without_a_future_cannot_be_validated_on(vocabulary, drawn_scenarios, tmp_path):
    scenario = drawn_scenarios[0]
    arrays = {name: value[:, :11] if value.ndim > 1 else value for name, value in vars(scenario.tracks).items()}
    short = replace(scenario, tracks=replace(scenario.tracks, **arrays), timestamps_s=scenario.timestamps_s[:11])
    with pytest.raises(DataError, match="its future is withheld"):
        tiny.train(
            "pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, held_out=[short], validation=OFTEN,
            epochs=0.5
        )  # fmt: skip
