"""A run that was stopped, politely or not, ends with the weights of one that never was."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import rlftsim
import tiny
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.jobs.interruption import Interruption, signals_like_ctrl_c
from rlftsim.training import imitation as imitation_module
from rlftsim.training import reward as finetune_module
from rlftsim.training.config import CalibrateConfig
from rlftsim.training.parallel import scenario_costs
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

MODULES = {
    **dict.fromkeys(("pretrain", "catk", "road"), imitation_module),
    **dict.fromkeys(("finetune", "everything"), finetune_module),
}
WORK = {imitation_module: "update_imitator", finetune_module: "update_policy"}
STAGES = ["pretrain", "catk", "finetune"]


def weights(out: Path) -> dict[str, torch.Tensor]:
    return load_file(out / "model" / "model.safetensors")


def assert_same_weights(first: Path, second: Path):
    a, b = weights(first), weights(second)
    assert a.keys() == b.keys()
    differing = [name for name in a if not torch.equal(a[name], b[name])]
    assert differing == []


def train(stage, vocabulary, scenarios, out, **changes):
    return tiny.train(stage, tiny.tiny_policy(vocabulary), scenarios, out, **changes)


@pytest.fixture(scope="module")
def whole(vocabulary, drawn_scenarios, tmp_path_factory):
    """Folder of a run that nothing stops, made once for the same settings."""

    @cache
    def make(stage, **changes):
        out = tmp_path_factory.mktemp("whole")
        train(stage, vocabulary, drawn_scenarios, out, **changes)
        return out

    return make


def stop_at(monkeypatch, stage, update, *, presses=None, number=signal.SIGINT):
    """Let a run be interrupted in the middle of its n-th update: by an exception, or by Ctrl-C so many times."""
    module = MODULES[stage]
    name = WORK[module]
    original, calls = getattr(module, name), []

    def interrupted(*args, **options):
        calls.append(1)
        result = original(*args, **options)  # the weights have moved, nothing is written yet
        if len(calls) == update and presses is None:
            raise KeyboardInterrupt
        for _ in range((presses or 0) if len(calls) == update else 0):
            signal.raise_signal(number)
        return result

    monkeypatch.setattr(module, name, interrupted)


@pytest.mark.parametrize(
    ("stage", "update"),
    # In its second epoch RoaD's rollouts are of a policy between the first one and the present one.
    [("pretrain", 1), ("pretrain", 4), ("catk", 1), ("catk", 4), ("road", 7), ("finetune", 1), ("everything", 4)],
)
def test_a_run_interrupted_inside_an_update_ends_as_if_it_never_was(
    stage, update, whole, vocabulary, drawn_scenarios, tmp_path, monkeypatch
):
    # Five or seven updates, checkpoints after every second and in the end.
    changes = {"epochs": 1.75 if stage == "road" else 1.25, "batch_size": 1}
    with monkeypatch.context() as patch:
        stop_at(patch, stage, update)
        with pytest.raises(KeyboardInterrupt):
            train(stage, vocabulary, drawn_scenarios, tmp_path / "stopped", **changes)
    assert not (tmp_path / "stopped" / "model").exists()
    train(stage, vocabulary, drawn_scenarios, tmp_path / "stopped", **changes)
    assert_same_weights(whole(stage, **changes), tmp_path / "stopped")
    lines = read_metrics(tmp_path / "stopped")
    assert [line["update"] for line in lines] == list(range(1, len(lines) + 1))
    timeless = {k for k in lines[0] if k != "time" and not k.startswith("seconds")}
    for mine, other in zip(lines, read_metrics(whole(stage, **changes))):
        assert {k: mine[k] for k in timeless} == {k: other[k] for k in timeless}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1])
def test_a_signal_of_slurm_or_of_a_closed_terminal_keeps_the_update_that_has_begun(
    number, vocabulary, drawn_scenarios, tmp_path, monkeypatch
):
    stop_at(monkeypatch, "pretrain", 1, presses=1, number=number)
    with signals_like_ctrl_c(), pytest.raises(Interruption, match="continues behind update 1"):
        train("pretrain", vocabulary, drawn_scenarios, tmp_path, epochs=1.25, batch_size=1)
    assert len(read_metrics(tmp_path)) == 1


@pytest.mark.parametrize(
    ("stage", "update", "processes"),
    # Checkpoints are due after every second update. In its second epoch RoaD's rollouts are of an earlier policy.
    [("pretrain", 1, 1), ("pretrain", 3, 2), ("road", 5, 1), ("everything", 3, 1)],
)
def test_ctrl_c_keeps_the_update_that_has_begun(
    stage, update, processes, whole, vocabulary, drawn_scenarios, tmp_path, monkeypatch, capsys
):
    changes = {"epochs": (1.75 if stage == "road" else 1.25) * processes, "batch_size": processes}
    changes |= {"device": replace(tiny.CPU, processes=processes)} if processes > 1 else {}
    with monkeypatch.context() as patch:
        stop_at(patch, stage, update, presses=1)
        with pytest.raises(KeyboardInterrupt, match=f"continues behind update {update}"):
            train(stage, vocabulary, drawn_scenarios, tmp_path / "stopped", **changes)
    assert "stopping at the end of this update; Ctrl-C once more stops at once" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert len(read_metrics(tmp_path / "stopped")) == update
    train(stage, vocabulary, drawn_scenarios, tmp_path / "stopped", **changes)
    assert f"goes on behind update {update}:" in capsys.readouterr().err
    assert_same_weights(whole(stage, **changes), tmp_path / "stopped")
    assert len(read_metrics(tmp_path / "stopped")) == len(read_metrics(whole(stage, **changes)))


@pytest.mark.parametrize(
    ("update", "what_next"), [(1, "starts anew"), (3, "continues behind update 2"), (5, "continues behind update 4")]
)
def test_a_second_ctrl_c_stops_at_once_and_says_what_is_kept(
    update, what_next, vocabulary, drawn_scenarios, tmp_path, monkeypatch
):
    stop_at(monkeypatch, "pretrain", update, presses=2)
    with pytest.raises(KeyboardInterrupt, match=what_next):
        train("pretrain", vocabulary, drawn_scenarios, tmp_path, epochs=1.25, batch_size=1)
    assert len(read_metrics(tmp_path)) == update - 1


def test_ctrl_c_in_the_last_update_leaves_the_model_to_the_next_call(
    vocabulary, drawn_scenarios, tmp_path, monkeypatch
):
    with monkeypatch.context() as patch:
        stop_at(patch, "pretrain", 2, presses=1)
        with pytest.raises(KeyboardInterrupt, match="continues behind update 2"):
            train("pretrain", vocabulary, drawn_scenarios, tmp_path, epochs=0.5, batch_size=1)
    assert not (tmp_path / "model").exists()
    train("pretrain", vocabulary, drawn_scenarios, tmp_path, epochs=0.5, batch_size=1)
    assert len(read_metrics(tmp_path)) == 2
    assert (tmp_path / "model").exists()


@pytest.mark.parametrize("stage", STAGES)
def test_a_finished_run_does_nothing_more(stage, vocabulary, drawn_scenarios, tmp_path, monkeypatch):
    changes = {"epochs": 0.5, "batch_size": 1}
    train(stage, vocabulary, drawn_scenarios, tmp_path, **changes)
    before = weights(tmp_path)

    def no_more(*_, **__):
        raise AssertionError("an update too many")

    monkeypatch.setattr(MODULES[stage], WORK[MODULES[stage]], no_more)
    train(stage, vocabulary, drawn_scenarios, tmp_path, **changes)
    assert all(torch.equal(before[name], value) for name, value in weights(tmp_path).items())


def start(stage, out) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(rlftsim.__file__).parents[1]), *sys.path])}
    command = [sys.executable, tiny.__file__, stage, str(out)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def lines_logged(out: Path) -> int:
    """Whole lines of metrics: a kill may cut the last one short."""
    path = out / "metrics.jsonl"
    return path.read_text().count("\n") if path.exists() else 0


def kill_at_random(stage, out) -> str:
    """SIGKILL a run at a random moment between its first and its last update; says when that was."""
    seed = random.SystemRandom().randrange(2**32)
    chance = random.Random(seed)
    after, pause = chance.randint(1, 6), chance.uniform(0, 0.5)
    process = start(stage, out)
    deadline = time.monotonic() + 120
    while lines_logged(out) < after and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(pause)
    process.send_signal(signal.SIGKILL)
    errors = process.communicate()[1]
    return f"killed {pause:.3f} s after update {after} with status {process.returncode}: {errors[-500:]}"


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["pretrain", "finetune"])
def test_a_run_killed_at_a_random_moment_ends_as_if_it_never_was(stage, tmp_path):
    tiny.run(stage, tmp_path / "whole")
    what = kill_at_random(stage, tmp_path / "killed")
    print(what)
    assert lines_logged(tmp_path / "killed"), what
    tiny.run(stage, tmp_path / "killed")
    assert_same_weights(tmp_path / "whole", tmp_path / "killed")
    assert [line["update"] for line in read_metrics(tmp_path / "killed")] == list(range(1, 9))


def train_by_torchrun(stage, out, *options):
    """An update with four scenarios, in two processes."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", tiny.__file__]
    command += [stage, str(out), "--updates", "1", "--batch-size", "4", *options]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr[-2000:]


def assert_same_gradients(first: Path, second: Path):
    stored = [json.loads((folder / "config.json").read_text()) for folder in (first, second)]
    assert [config["device"]["processes"] for config in stored] == [1, 2]
    one, two = (load_file(folder / "gradients.safetensors") for folder in (first, second))
    assert one.keys() == two.keys()
    assert max(float(g.abs().max()) for g in one.values()) > 1e-3
    for name, gradient in one.items():
        torch.testing.assert_close(two[name], gradient, atol=1e-6, rtol=1e-5, msg=name)
    a, b = (read_metrics(folder)[0] for folder in (first, second))
    assert a.keys() == b.keys()
    own = {"time", "score_gap"}  # of a process
    for name in (name for name in a if name not in own and not name.startswith("seconds")):
        assert b[name] == pytest.approx(a[name], rel=1e-5, abs=1e-6), name


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["pretrain", "catk"])
def test_torchrun_finds_the_gradient_of_one_process(stage, tmp_path):
    costs = scenario_costs(tiny.pack_scenarios())
    budget = float(2.1 * costs.min())  # some pieces hold two scenarios, some one
    assert costs.max() > 1.05 * costs.min()
    tiny.run(stage, tmp_path / "1", updates=1, batch_size=4, micro_batch_cost=budget)
    train_by_torchrun(stage, tmp_path / "2", "--micro-batch-cost", str(budget))
    assert_same_gradients(tmp_path / "1", tmp_path / "2")
    assert (tmp_path / "2" / "model" / "model.safetensors").exists()


@pytest.mark.parametrize("stage", ["pretrain", "road", "finetune"])
def test_a_run_cut_short_has_a_model_and_goes_on_to_the_weights_of_a_whole_run(
    stage, vocabulary, drawn_scenarios, tmp_path, capsys
):
    def train(out, **options):
        policy, settings = tiny.tiny_policy(vocabulary), replace(tiny.SETTINGS[stage], epochs=1.75)
        return train_policy(policy, drawn_scenarios, tmp_path / out, settings, **options)

    train("whole")
    for cut, largest in ((3, 3), (6, 6), (20, 7)):  # 7 updates in all; RoaD's second epoch begins behind the fourth
        model = train("cut", max_updates=cut)
        assert len(read_metrics(tmp_path / "cut")) == largest
        assert (model / "model.safetensors").exists()
        if largest < 7:
            with pytest.raises(AssertionError):
                assert_same_weights(tmp_path / "whole", tmp_path / "cut")
    assert f"{model} stays the model of the shorter run" in " ".join(capsys.readouterr().err.split())
    assert_same_weights(tmp_path / "whole", tmp_path / "cut")
    with pytest.raises(CheckpointError, match="behind update 7, this one has 2 updates: raise epochs or max_updates"):
        train("cut", max_updates=2)


def test_a_number_of_updates_that_makes_no_model_is_refused(vocabulary, drawn_scenarios, tmp_path):
    policy = tiny.tiny_policy(vocabulary)
    with pytest.raises(ConfigError, match="max_updates must be a whole number of at least 1, got 0"):
        train_policy(policy, drawn_scenarios, tmp_path, tiny.PRETRAIN, max_updates=0)
    with pytest.raises(ConfigError, match="max_updates=2 would leave no model: calibrate has one after all updates"):
        train_policy(policy, drawn_scenarios, tmp_path, CalibrateConfig(), max_updates=2)
    assert not list(tmp_path.iterdir())
