"""What all training methods share: their arguments, their guards, and the end of a run that makes no sense any more."""

import math
from dataclasses import replace

import pytest
import torch

import tiny
from rlftsim.errors import CheckpointError, ConfigError, NotYetError
from rlftsim.jobs.folder import Lease
from rlftsim.jobs.runner import Inline
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.training import imitation
from rlftsim.training.config import GcslConfig
from rlftsim.training.method import check_trainable
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

GCSL = GcslConfig(epochs=1.0, batch_size=1, num_rollouts=2, device=tiny.CPU)


def goal_conditioned(vocabulary):
    torch.manual_seed(1)
    return tiny.tiny_policy(vocabulary).with_goal_conditioning("concat")


@pytest.mark.parametrize("stage", ["pretrain", "catk", "finetune", "gcsl"])
def test_one_scenario_and_a_path_as_text_are_enough(stage, vocabulary, drawn_scenarios, tmp_path):
    scenario, out = drawn_scenarios[0], str(tmp_path / "run")
    if stage == "gcsl":
        model = train_policy(goal_conditioned(vocabulary), scenario, out, GCSL)
    else:
        model = tiny.train(stage, tiny.tiny_policy(vocabulary), scenario, out, epochs=1.0)
    assert model == tmp_path / "run" / "model"
    assert len(read_metrics(tmp_path / "run")) == 1


@pytest.mark.parametrize(
    ("stage", "processes"),
    [*((stage, 1) for stage in ("pretrain", "catk", "road", "finetune", "gcsl")), ("pretrain", 2), ("finetune", 2)],
)
def test_a_second_run_in_a_folder_is_refused_until_the_first_has_ended(
    stage, processes, vocabulary, drawn_scenarios, tmp_path
):
    def train():
        device = replace(tiny.CPU, processes=processes)
        if stage == "gcsl":
            return train_policy(goal_conditioned(vocabulary), drawn_scenarios[:2], tmp_path, GCSL)
        policy, changes = tiny.tiny_policy(vocabulary), {"epochs": 1.0, "batch_size": 2, "device": device}
        return tiny.train(stage, policy, drawn_scenarios[:2], tmp_path, **changes)

    with Lease(tmp_path / ".lock", Inline(), "works in"):
        with pytest.raises(NotYetError, match=rf"another process works in {tmp_path} \(.*, for 0:00:"):
            train()
        assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    assert train() == tmp_path / "model"
    assert not (tmp_path / ".lock").exists()


def test_a_run_that_ends_with_an_error_lets_its_folder_go(vocabulary, drawn_scenarios, tmp_path):
    for _ in range(2):  # a notebook keeps the first error and all that it holds
        with pytest.raises(CheckpointError, match="not finite"):
            tiny.train("pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, learning_rate=1e30)
    assert not (tmp_path / ".lock").exists()


@pytest.mark.parametrize("stage", ["pretrain", "catk", "finetune"])
def test_a_policy_without_weights_and_an_empty_data_set_are_refused(stage, vocabulary, drawn_scenarios, tmp_path):
    if stage != "pretrain":  # whose argument is a model that ConstantVelocity is not
        with pytest.raises(ConfigError, match="ConstantVelocity has no weights: there is nothing for"):
            tiny.train(stage, ConstantVelocity(), drawn_scenarios, tmp_path)
    with pytest.raises(ConfigError, match="no scenario to train on"):
        tiny.train(stage, tiny.tiny_policy(vocabulary), [], tmp_path)
    assert not any(tmp_path.iterdir())


def test_all_attributes_that_a_policy_lacks_are_named():
    with pytest.raises(
        ConfigError, match="Linear cannot be trained with CAT-K: it has no vocabulary and no save_pretr"
    ):
        check_trainable(torch.nn.Linear(1, 1), [None], "CAT-K", needs=("vocabulary",))


def test_a_model_without_tokens_is_trained_by_rlft():
    with pytest.raises(ConfigError, match="it has no vocabulary; fine-tune it by rlft, which needs no tokens"):
        check_trainable(load_policy("trafficbots-base"), [None], "CAT-K", needs=("vocabulary",))


def test_a_run_of_imitation_whose_gradients_are_lost_stops(vocabulary, drawn_scenarios, tmp_path, monkeypatch, capsys):
    original, calls = imitation.summed_loss, []

    def poisoned(*args):
        calls.append(1)
        summed = original(*args)
        return replace(summed, loss=summed.loss * (math.nan if len(calls) > 3 else 1.0))

    monkeypatch.setattr(imitation, "summed_loss", poisoned)
    changes = {"epochs": 3.0, "max_skipped_in_a_row": 2}
    expected = r"2 updates in a row were skipped, their gradients are not finite.*update-00000002: lower learning_rate"
    with pytest.raises(CheckpointError, match=expected):
        tiny.train("pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, **changes)
    warnings = [line for line in capsys.readouterr().err.splitlines() if "skipped" in line]
    assert warnings[0] == "update 4 skipped: its gradient is not finite (1 in a row, the run stops at 2)"
    # a skipped update leaves no checkpoint, though the fourth would have been due
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["update-00000002"]
    monkeypatch.undo()
    model = tiny.train("pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, **changes)
    assert (model / "model.safetensors").exists()


def test_a_run_whose_weights_are_lost_writes_no_checkpoint_of_them(vocabulary, drawn_scenarios, tmp_path):
    with pytest.raises(CheckpointError, match=r"not finite.*checkpoint is none: lower learning_rate"):
        tiny.train("pretrain", tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, learning_rate=1e30, epochs=3.0)
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize(("warmup_updates", "is_warned"), [(100, True), (1, False)])
def test_a_run_that_ends_within_its_warmup_says_so(
    warmup_updates, is_warned, vocabulary, drawn_scenarios, tmp_path, capsys
):
    policy = tiny.tiny_policy(vocabulary)
    tiny.train("finetune", policy, drawn_scenarios[0], tmp_path, epochs=1.0, warmup_updates=warmup_updates)
    error = capsys.readouterr().err
    assert (f"the run ends after 1 of {warmup_updates} warm-up updates" in error) == is_warned
    assert ("raise epochs or max_updates, or lower warmup_updates where that can be set" in error) == is_warned
