"""The command line of submissions, and the report."""

import errno
import itertools
import json
import os
import tarfile

import entries
import pytest

import made_up
import scenes
from rlftsim.cli.main import main
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.policies.checkpoint import save_model
from rlftsim.scenario.dataset import write_dataset
from rlftsim.submission.report import estimate_realism, model_card


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    entries.write_data(tmp_path / "set", num_scenarios=4)
    (tmp_path / "submission.toml").write_text(entries.TOML)
    return tmp_path


BUILD = (
    "submit", "build", "constant_velocity", "--data", "set", "--config", "submission.toml", "--out", "out",
    "--num-shards", "2", "--device", "cpu",
)  # fmt: skip
CHECK = ("submit", "check", "out/submission.tar.gz", "--data", "set")


def test_a_build_is_declared_checked_and_reported(place, capsys):
    # 1. without the declaration nothing is simulated
    assert main(BUILD) == 2
    printed = capsys.readouterr()
    assert "decides every 0.1 s, 80 times in 8 s" in printed.out
    assert "add --i-comply" in printed.err
    assert not (place / "out").exists()
    # 2. with it there is an archive, a report, and no parts
    assert main([*BUILD, "--i-comply"]) == 0
    printed = capsys.readouterr().out
    assert "all 32 rollouts are equal" in printed
    assert printed.splitlines()[-1] == "out/submission.report.md"  # the report itself is long
    assert {path.name for path in (place / "out").iterdir()} == {
        "plan.json", "submission.report.json", "submission.report.md", "submission.tar.gz"
    }  # fmt: skip
    report = json.loads((place / "out" / "submission.report.json").read_text())
    assert report["bytes"] == (place / "out" / "submission.tar.gz").stat().st_size
    assert report["counts"] == {"14": 4}
    assert (report["scenarios"], report["shards"], report["num_parameters"]) == (4, 2, "0")
    text = (place / "out" / "submission.report.md").read_text()
    assert report["sha256"] in text
    assert "submission key" in text  # what to write about a server error without a reason
    assert "constant_velocity is no model folder" in text
    assert "Not known: runs/evaluations/constant_velocity.parquet" in text
    assert all("jane.doe" not in (place / "out" / name).read_text() for name in
               ("plan.json", "submission.report.json", "submission.report.md"))  # fmt: skip
    # 3. the same again changes nothing
    assert main([*BUILD, "--i-comply"]) == 0
    assert json.loads((place / "out" / "submission.report.json").read_text())["sha256"] == report["sha256"]


def test_an_archive_is_checked_described_cut_and_joined(place, capsys, monkeypatch):
    main([*BUILD, "--i-comply"])
    archive = place / "out" / "submission.tar.gz"
    assert main([*CHECK, "--json", "found.json", "--sample", "0.5"]) == 0
    assert json.loads((place / "found.json").read_text())["scenarios"] == 4
    for size in ("nan", "inf", "0", "-1"):
        assert main(["submit", "info", str(archive), f"--split-gb={size}"]) == 2
        assert "choose 1 to 1000 parts" in capsys.readouterr().err
    main(["submit", "info", str(archive), "--split-gb", "0.000002"])  # finer, whose last parts must not be left
    assert main(["submit", "info", str(archive), "--split-gb", "0.00001"]) == 0
    assert "unique_method_name: A method" in capsys.readouterr().out
    parts = sorted((place / "out").glob("*.tar.gz.0*"))
    assert b"".join(part.read_bytes() for part in parts) == archive.read_bytes()
    assert max(part.stat().st_size for part in parts) == 10_000
    before = {part: part.read_bytes() for part in (place / "out").iterdir()}
    sync, count = os.fsync, itertools.count()

    def full_at_the_third(descriptor):
        if next(count) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(descriptor)

    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full_at_the_third)
        assert main(["submit", "info", str(archive), "--split-gb", "0.000005"]) == 2
    assert "submission.tar.gz.002 (No space left on device): make room" in capsys.readouterr().err
    assert {part: part.read_bytes() for part in (place / "out").iterdir()} == before
    archive.write_bytes(archive.read_bytes()[:-50])  # copied in part
    assert main(CHECK) == 1
    printed = capsys.readouterr().out
    assert "error, check 7: submission.tar.gz: cut off" in printed
    assert "error, check 17: submission.tar.gz: not the file that its report describes" in printed
    assert main([*BUILD, "--i-comply"]) == 1
    assert "cannot be uploaded: remove it and repeat the command" in capsys.readouterr().out
    archive.unlink()
    assert main([*BUILD, "--i-comply"]) == 0


def test_an_archive_without_a_shard_is_found_and_a_folder_named(tmp_path, capsys):
    with tarfile.open(tmp_path / "empty.tar.gz", "w:gz"):
        pass
    assert main(["submit", "info", str(tmp_path / "empty.tar.gz")]) == 1
    printed = capsys.readouterr().out
    assert "error, check 6: empty.tar.gz: there is no shard in it" in printed
    assert "1 findings" in printed
    assert main(["submit", "info", str(tmp_path)]) == 2
    assert f"{tmp_path} is a folder: name the .tar.gz in it." in capsys.readouterr().err


def test_the_rollouts_of_an_archive_score_as_its_unpacked_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data = entries.write_data(tmp_path / "set", num_scenarios=5)
    shards = entries.draw_shards(data)
    entries.pack(tmp_path / "a.tar.gz", shards)
    (tmp_path / "unpacked").mkdir()
    for name, message in shards.items():
        (tmp_path / "unpacked" / name).write_bytes(message.SerializeToString())
    assert main(["submit", "check", "a.tar.gz", "--data", "set", "--score"]) == 0
    lines = capsys.readouterr().out.splitlines()
    skip = ("--missing-map", "skip", "--jobs", "1")
    assert main(["score", "unpacked", "--data", "set", "--name", "a", *skip]) == 0
    expected = capsys.readouterr().out.splitlines()
    of_tables = [[line.split() for line in some if "0." in line and "likelihood" in line] for some in (lines, expected)]
    assert len(of_tables[0]) > 8
    assert of_tables[0] == of_tables[1]


def test_scores_of_an_archive_need_logged_futures(place, capsys):
    write_dataset([scenes.without_future("one"), scenes.without_future("two")], place / "held", split="testing")
    # before the archive is read, which is not even there
    assert main([*CHECK[:3], "--data", "held", "--score"]) == 2
    printed = capsys.readouterr()
    assert "--score is for the validation split: " in printed.err
    assert "held (split testing): 2 of 2 scenarios withhold their future" in printed.err
    assert not printed.out


def test_scores_of_an_archive_need_a_scenario_without_an_error(place, capsys):
    assert main([*BUILD, "--i-comply"]) == 0
    write_dataset([scenes.straight_road()], place / "other", split="testing")
    assert main([*CHECK[:3], "--data", "other", "--score"]) == 2
    assert "none of 1 scenarios of split testing of other could be scored" in capsys.readouterr().err


def test_the_card_of_a_model_is_part_of_the_report(tmp_path):
    save_model(tmp_path / "m", entries.Wanderer(), {}, card="# A model\n\ntrained on nothing\n")
    assert model_card(str(tmp_path / "m")) == "### A model\n\ntrained on nothing"
    assert "RMM" in model_card("demo-tuned")
    assert model_card("oracle") == "oracle is no model folder, so it has no card."


def test_an_estimate_is_of_the_same_model_and_settings(tmp_path):
    path = tmp_path / "a.parquet"
    made_up.evaluation("a", [0.78, 0.79, 0.77], columns={"meta_metric_light_one": [0.79, 0.8, 0.78]}).write(path)
    estimate = estimate_realism(path, "f" * 32, EvaluateConfig(split="testing"))
    assert (estimate.scenarios, estimate.rmm) == (3, pytest.approx(0.78))
    assert estimate.rmm_light_one == pytest.approx(0.79)
    low, high = estimate.interval
    assert low < 0.77 < 0.79 < high
    assert "of another model" in estimate_realism(path, "e" * 32, EvaluateConfig())
    assert "another seed, temperature." in estimate_realism(path, "f" * 32, EvaluateConfig(seed=1, temperature=0.5))
    assert "no such evaluation" in estimate_realism(tmp_path / "b.parquet", "f" * 32, EvaluateConfig())
