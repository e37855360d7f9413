import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard import SummaryWriter

import tiny
from rlftsim.errors import CheckpointError, DataError
from rlftsim.rollout.edge_scenes import move_scenario
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.training.config import FinetuneConfig, KlConfig
from rlftsim.training.run_folder import RunFolder, describe_inputs, read_metrics, to_plain
from rlftsim.training.trackers import board_tag, write_film


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


def test_a_run_that_lacks_a_setting_is_another(tmp_path):
    path, config = tmp_path / "config.json", replace(tiny.PRETRAIN, still_weight=0.5)
    RunFolder(tmp_path, config)
    whole = json.loads(path.read_text())
    path.write_text(json.dumps({k: v for k, v in whole.items() if k != "still_weight"}))
    with pytest.raises(CheckpointError, match=r"other settings or inputs \(still_weight\)"):
        RunFolder(tmp_path, config)


def test_other_settings_are_refused_by_name(tmp_path):
    RunFolder(tmp_path, FinetuneConfig())
    with pytest.raises(CheckpointError, match=r"other settings or inputs \(kl.target, seed\): name another --out"):
        RunFolder(tmp_path, FinetuneConfig(kl=KlConfig(target=0.02), seed=1))
    stored = json.loads((tmp_path / "config.json").read_text())
    others = {name: value for name, value in stored.items() if not isinstance(value, str | int | float)}
    with pytest.raises(CheckpointError, match=r"other settings or inputs \((\w+(\.\w+)*, ){7}\S+ and \d+ more\)"):
        RunFolder(tmp_path, others)
    with pytest.raises(CheckpointError, match=r"belongs to a run of another kind: name another --out"):
        RunFolder(tmp_path, tiny.PRETRAIN)


def test_metrics_of_updates_that_are_done_again_are_dropped(tmp_path):
    run = RunFolder(tmp_path, FinetuneConfig())
    run.continue_from(0)
    for update in range(1, 6):
        run.log(update, {"rmm": update / 10})
    run.finish_trackers("finished")
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"update": 6, "rm')  # a kill cut this line short
    again = RunFolder(tmp_path, FinetuneConfig())
    again.continue_from(3)
    again.log(4, {"rmm": 9.0})
    again.finish_trackers("finished")
    assert [(line["update"], line["rmm"]) for line in read_metrics(tmp_path)] == [
        (1, 0.1),
        (2, 0.2),
        (3, 0.3),
        (4, 9.0),
    ]


def test_a_full_disk_is_named_with_the_file_that_does_not_fit(tmp_path):
    run = RunFolder(tmp_path, FinetuneConfig())
    run.continue_from(0)
    (tmp_path / "metrics.jsonl").symlink_to("/dev/full")
    with pytest.raises(DataError, match=r"cannot write .*metrics\.jsonl \(No space left on device\): make room"):
        run.log(1, {"rmm": 0.5})


def test_a_process_that_does_not_write_leaves_nothing(tmp_path):
    run = RunFolder(tmp_path / "run", FinetuneConfig(), writes=False)
    run.continue_from(0)
    run.log(1, {"rmm": 0.5})
    run.finish_trackers("finished")
    assert not (tmp_path / "run").exists()
    assert read_metrics(tmp_path / "run") == []


def test_configurations_become_plain_values():
    plain = to_plain(replace(FinetuneConfig(), betas=(0.8, 0.9)))
    assert plain["betas"] == [0.8, 0.9]
    assert plain["device"]["accelerator"] == "auto"
    assert json.loads(json.dumps(plain)) == plain


def test_another_vocabulary_or_radius_is_another_run(tmp_path, drawn_scenarios):
    vocabulary = tiny.small_vocabulary(drawn_scenarios)
    first = tiny.tiny_policy(vocabulary)
    others = (
        tiny.tiny_policy(replace(vocabulary, corners=vocabulary.corners * 1.01)),
        tiny.tiny_policy(vocabulary, replace(tiny.MODEL, agent_radius_m=20.0)),
    )
    RunFolder(tmp_path, tiny.FINETUNE, describe_inputs(first, drawn_scenarios))
    RunFolder(tmp_path, tiny.FINETUNE, describe_inputs(tiny.tiny_policy(vocabulary), drawn_scenarios))
    for other in others:
        with pytest.raises(CheckpointError, match="initial_policy"):
            RunFolder(tmp_path, tiny.FINETUNE, describe_inputs(other, drawn_scenarios))
    with pytest.raises(CheckpointError, match="scenarios"):
        RunFolder(tmp_path, tiny.FINETUNE, describe_inputs(first, drawn_scenarios[:-1]))


def test_a_data_set_that_was_converted_otherwise_is_another_run(tmp_path, drawn_scenarios):
    """The same ids, other poses. A list of scenarios and a run of before have no files, and are taken to agree."""
    policy = tiny.tiny_policy(tiny.small_vocabulary(drawn_scenarios))
    for name, along_m in {"first": 0.0, "again": 0.0, "otherwise": 0.5}.items():
        write_dataset([move_scenario(one, 0.0, (along_m, 0.0)) for one in drawn_scenarios], tmp_path / name)
    data = {name: ScenarioDataset(tmp_path / name) for name in ("first", "again", "otherwise")}
    run = tmp_path / "run"
    RunFolder(run, tiny.FINETUNE, describe_inputs(policy, data["first"]))
    RunFolder(run, tiny.FINETUNE, describe_inputs(policy, data["again"]))
    with pytest.raises(CheckpointError, match=r"other settings or inputs \(scenario_files\)"):
        RunFolder(run, tiny.FINETUNE, describe_inputs(policy, data["otherwise"]))
    RunFolder(run, tiny.FINETUNE, describe_inputs(policy, list(data["first"])))
    with pytest.raises(CheckpointError, match="scenario_files"):
        RunFolder(run, tiny.FINETUNE, describe_inputs(policy, data["otherwise"]))
    RunFolder(run, tiny.FINETUNE, describe_inputs(policy, data["first"]))


def test_precision_is_part_of_a_run_and_threads_are_not(tmp_path):
    RunFolder(tmp_path, tiny.FINETUNE)
    RunFolder(tmp_path, replace(tiny.FINETUNE, device=replace(tiny.FINETUNE.device, threads=3)))
    with pytest.raises(CheckpointError, match=r"device\.precision"):
        RunFolder(tmp_path, replace(tiny.FINETUNE, device=replace(tiny.FINETUNE.device, precision="bf16-mixed")))


@pytest.mark.parametrize(
    ("name", "tag"),
    [
        ("reward_mloo_std", "reward/reward_mloo_std"),
        ("kl", "kl/kl"),
        ("beta", "kl/beta"),
        ("kinematic", "realism/kinematic"),
        ("alarm_speed", "alarm/alarm_speed"),
        ("seconds_step", "time/seconds_step"),
        ("entropy", "entropy"),
    ],
)
def test_tensorboard_shows_what_belongs_together_under_one_head(name, tag):
    assert board_tag(name) == tag


def test_tensorboard_shows_settings_to_compare_runs_by_and_plays_a_film(tmp_path):
    folder = RunFolder(tmp_path, tiny.FINETUNE)
    folder.continue_from(0, ["tensorboard"])
    folder.log(1, {"loss": 1.0})
    folder.finish_trackers("finished")
    with SummaryWriter(str(tmp_path / "tensorboard")) as board:
        write_film(board, [np.full((10, 20, 3), grey, np.uint8) for grey in (0, 255)], 7, 0.4)
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"images": 0}).Reload()
    (table,) = events.Tensors("settings/text_summary")
    assert "| kl.target | 0.01 |" in table.tensor_proto.string_val[0].decode()
    started = HParamsPluginData.FromString(events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content)
    assert started.session_start_info.hparams["kl.target"].number_value == 0.01
    (film,) = events.Images("film")
    picture = Image.open(io.BytesIO(film.encoded_image_string))
    assert (film.step, picture.size, picture.n_frames, picture.info["duration"]) == (7, (20, 10), 2, 400)
