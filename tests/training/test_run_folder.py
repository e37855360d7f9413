import json
from dataclasses import replace

import pytest
import tiny

from rlftsim.errors import CheckpointError
from rlftsim.training.finetune import FinetuneConfig
from rlftsim.training.reference import KlConfig
from rlftsim.training.run_folder import RunFolder, read_metrics, to_plain


def test_the_folder_holds_the_resolved_configuration_and_the_environment(tmp_path):
    RunFolder(tmp_path, FinetuneConfig(kl=KlConfig(target=0.02)))
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["kl"]["target"] == 0.02
    assert config["learning_rate"] == 3e-6  # defaults are filled in
    environment = json.loads((tmp_path / "environment.json").read_text())
    assert {"command", "python", "machine", "packages", "commit"} <= environment.keys()


def test_the_same_settings_may_come_back(tmp_path):
    RunFolder(tmp_path, FinetuneConfig())
    RunFolder(tmp_path, FinetuneConfig())


def test_other_settings_are_refused_by_name(tmp_path):
    RunFolder(tmp_path, FinetuneConfig())
    with pytest.raises(CheckpointError, match=r"other settings \(kl, seed\): name another --out"):
        RunFolder(tmp_path, FinetuneConfig(kl=KlConfig(target=0.02), seed=1))
    with pytest.raises(CheckpointError, match="other settings"):
        RunFolder(tmp_path, tiny.PRETRAIN)


def test_metrics_of_updates_that_are_done_again_are_dropped(tmp_path):
    run = RunFolder(tmp_path, FinetuneConfig())
    run.continue_from(0)
    for update in range(1, 6):
        run.log(update, {"rmm": update / 10})
    run.close()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"update": 6, "rm')  # a kill cut this line short
    again = RunFolder(tmp_path, FinetuneConfig())
    again.continue_from(3)
    again.log(4, {"rmm": 9.0})
    again.close()
    assert [(line["update"], line["rmm"]) for line in read_metrics(tmp_path)] == [
        (1, 0.1),
        (2, 0.2),
        (3, 0.3),
        (4, 9.0),
    ]


def test_a_process_that_does_not_write_leaves_nothing(tmp_path):
    run = RunFolder(tmp_path / "run", FinetuneConfig(), writes=False)
    run.continue_from(0)
    run.log(1, {"rmm": 0.5})
    run.close()
    assert not (tmp_path / "run").exists()
    assert read_metrics(tmp_path / "run") == []


def test_configurations_become_plain_values():
    plain = to_plain(replace(FinetuneConfig(), betas=(0.8, 0.9)))
    assert plain["betas"] == [0.8, 0.9]
    assert plain["device"]["accelerator"] == "auto"
    assert json.loads(json.dumps(plain)) == plain
