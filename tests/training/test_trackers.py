"""Trackers receive what metrics.jsonl holds, and never end a run."""

import json
import os
import sqlite3
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

import tiny
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError
from rlftsim.training import trackers
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import RunFolder, read_metrics
from rlftsim.training.trackers import TRACKERS, find_tracker

SCRIPT = Path(__file__).parent / "tracked_run.py"


class Recorder:
    """Keeps its calls."""

    calls: list[tuple] = []  # noqa: RUF012

    def start(self, run, config, resume):
        self.calls.append(("start", run, config, resume))
        return resume or "abc"

    def log(self, values, step):
        self.calls.append(("log", dict(values), step))

    def artifact(self, path, kind):
        self.calls.append(("artifact", path, kind, (Path(path) / "config.json").exists()))

    def finish(self, status):
        self.calls.append(("finish", status))


@pytest.fixture
def recorder():
    Recorder.calls = []
    TRACKERS.add("recorder", Recorder)
    yield Recorder.calls
    TRACKERS.remove("recorder")


@pytest.fixture
def train(vocabulary, drawn_scenarios, tmp_path):
    def run(*names, epochs=1.25):
        policy = tiny.tiny_policy(vocabulary)
        settings = replace(tiny.PRETRAIN, epochs=epochs)
        return train_policy(policy, drawn_scenarios, tmp_path / "run", settings, trackers=names)

    return run


def logged(calls):
    return [(step, values) for name, values, step in (call for call in calls if call[0] == "log")]


def metrics(folder):
    return [
        (line["update"], {k: v for k, v in line.items() if k not in ("update", "time")})
        for line in read_metrics(folder)
    ]


def test_a_tracker_gets_the_settings_the_metrics_and_the_model(train, recorder, tmp_path):
    model = train("recorder")
    _, run, config, resume = recorder[0]
    assert (run, resume) == (str(tmp_path / "run"), None)
    assert config["device.accelerator"] == "cpu"
    assert config["scenarios"] == json.loads((tmp_path / "run" / "config.json").read_text())["scenarios"]
    assert logged(recorder) == metrics(tmp_path / "run")
    assert [step for step, _ in logged(recorder)] == [1, 2, 3, 4, 5]
    assert recorder[-2:] == [("artifact", str(model), "model", True), ("finish", "finished")]
    assert not (tmp_path / "run" / "tensorboard").exists()
    train("recorder")  # nothing is left to do, so nothing is told
    assert len(recorder) == 8


def test_a_stopped_run_goes_on_in_its_trackers(train, recorder, tmp_path, monkeypatch):
    log = RunFolder.log

    def press(self, update, values):
        log(self, update, values)
        if update == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(RunFolder, "log", press)
        with pytest.raises(KeyboardInterrupt):
            train("recorder")
    assert recorder[-1] == ("finish", "stopped")
    del recorder[:]
    train("recorder")
    assert recorder[0][3] == "abc"
    assert [step for step, _ in logged(recorder)] == [3, 4, 5]  # the checkpoint was behind update 2
    assert recorder[-1] == ("finish", "finished")
    assert json.loads((tmp_path / "run" / "trackers.json").read_text()) == {"recorder": "abc"}


@pytest.mark.parametrize("method", ["__init__", "start", "log", "artifact", "finish"])
@pytest.mark.parametrize("fault", ["raises", "exits", "hangs"])
def test_a_tracker_that_fails_or_hangs_never_ends_a_run(method, fault, train, recorder, tmp_path, monkeypatch, caplog):
    def fail(*arguments):
        if fault == "hangs":
            time.sleep(60.0)
        raise (SystemExit if fault == "exits" else RuntimeError)("no such server")

    monkeypatch.setattr(trackers, "START_S", 1.0)
    monkeypatch.setattr(trackers, "CALL_S", 1.0)
    TRACKERS.add("faulty", type("Faulty", (Recorder,), {method: fail}))
    begin = time.monotonic()
    try:
        assert (train("faulty", "recorder", epochs=0.25) / "config.json").exists()
    finally:
        TRACKERS.remove("faulty")
    assert time.monotonic() - begin < 50.0
    warnings = [record.message for record in caplog.records if "tracker faulty" in record.message]
    assert len(warnings) == 1
    assert "the run goes on" in warnings[0]
    assert ("takes more than 1 s" if fault == "hangs" else "no such server") in warnings[0]
    assert recorder[-1] == ("finish", "finished")  # of the other one
    assert len(read_metrics(tmp_path / "run")) == 1


def test_a_library_that_is_not_installed_is_named_with_its_extra(train, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "wandb", None)
    train("wandb", epochs=0.25)
    assert "the run goes on" in caplog.text
    assert "pip install rlftsim[wandb]" in caplog.text


def test_a_damaged_file_of_ids_begins_anew(train, recorder, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "trackers.json").write_text('{"recorder"')
    train("recorder", epochs=0.25)
    assert recorder[0][3] is None


def test_a_mistyped_tracker_is_refused_before_any_work(tmp_path, capsys, monkeypatch):
    words = ["smart-demo", "--model", "demo-base", "--data", "synthetic", "--out", str(tmp_path / "run")]
    assert main(["finetune", *words, "--tracker", "wanbd"]) == 2
    assert "unknown tracker 'wanbd': did you mean 'wandb'?" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match=r"tracker 'no_such:Thing' cannot be imported .*name package.module:Class"):
        find_tracker("no_such:Thing")
    (tmp_path / "trackers_of_mine.py").write_text("class Mine:\n    start = log = artifact = finish = print\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert find_tracker("trackers_of_mine:Mine").__name__ == "Mine"


# --- the libraries themselves: a run that is killed and resumed, in processes of its own ---------------------------


@pytest.fixture
def killed_and_resumed(tmp_path):
    """Folder of a run that was killed behind its third update, and then resumed from the second."""

    def run(tracker, **environment):
        pytest.importorskip(tracker, reason=f"{tracker} is not installed")
        folder = tmp_path / "run"
        call = [sys.executable, str(SCRIPT), tracker, str(folder)]
        settings = {"cwd": tmp_path, "env": {**os.environ, **environment}, "capture_output": True, "text": True}
        killed = subprocess.run([*call, "3"], timeout=240, **settings)
        assert killed.returncode == -9, killed.stderr
        resumed = subprocess.run(call, timeout=240, **settings)
        assert resumed.returncode == 0, resumed.stderr
        assert "is left out" not in killed.stderr + resumed.stderr
        return folder

    return run


def assert_complete(history, folder, first=1):
    """Assert that the last value of each step, from the first on, is that of metrics.jsonl."""
    for step, values in metrics(folder)[first - 1 :]:
        assert {name: history[step][name] for name in values} == pytest.approx(values, rel=1e-12), step


def read_wandb(path):
    """Rows of a file of Weights & Biases: a header of 7 bytes, then log records of LevelDB."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, position, message = path.read_bytes(), 7, b""
    while position + 7 <= len(data):
        left = 32768 - position % 32768
        if left < 7:
            position += left
            continue
        size, kind = struct.unpack("<HB", data[position + 4 : position + 7])
        message += data[position + 7 : position + 7 + size]
        position += 7 + size
        if kind in (1, 4):  # whole, or the last part
            record = Record.FromString(message)
            message = b""
            if record.HasField("history"):
                row = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
                yield row["_step"], row


def test_weights_and_biases_has_the_metrics_of_a_killed_run(killed_and_resumed):
    folder = killed_and_resumed("wandb", WANDB_MODE="offline")
    files = sorted(folder.rglob("run-*.wandb"))
    assert len({file.name for file in files}) == 1  # one id
    history = {}
    for file in files:
        for step, row in read_wandb(file):
            history.setdefault(step, {}).update(row)
    assert len(files) == 2
    assert_complete(history, folder, first=3)  # it writes in blocks: the killed process has lost its own


def test_mlflow_has_the_metrics_of_a_killed_run(killed_and_resumed, tmp_path):
    uri = (tmp_path / "mlruns").as_uri()
    folder = killed_and_resumed("mlflow", MLFLOW_TRACKING_URI=uri, MLFLOW_ALLOW_FILE_STORE="true")
    os.environ["MLFLOW_ALLOW_FILE_STORE"] = "true"
    from mlflow import MlflowClient

    client = MlflowClient(uri)
    (experiment,) = [one for one in client.search_experiments() if one.name == "rlftsim"]
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "FINISHED"
    assert run.data.params["batch_size"] == "1"
    history = {}
    for name in run.data.metrics:
        for value in client.get_metric_history(run.info.run_id, name):
            history.setdefault(value.step, {})[name] = value.value
    assert_complete(history, folder)
    assert "model.safetensors" in str([one.path for one in client.list_artifacts(run.info.run_id, "model")])


def test_trackio_has_the_metrics_of_a_killed_run(killed_and_resumed, tmp_path):
    folder = killed_and_resumed("trackio", TRACKIO_DIR=str(tmp_path / "trackio"))
    (file,) = [path for path in (tmp_path / "trackio").rglob("*.db")]
    with sqlite3.connect(file) as database:
        rows = database.execute("SELECT run_name, step, metrics FROM metrics ORDER BY id").fetchall()
    assert len({name for name, _, _ in rows}) == 1
    history = {}
    for _, step, text in rows:
        history.setdefault(step, {}).update(json.loads(text))
    assert_complete(history, folder)


def test_no_tracker_is_imported_unless_it_is_named():
    code = "import sys, rlftsim.verbs.finetune; print({'wandb', 'mlflow', 'trackio'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
