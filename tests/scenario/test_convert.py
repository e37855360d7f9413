import errno
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.runner import Inline, Share, Unfinished
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.inspect import verify_dataset
from rlftsim.scenario.source import infer_split
from rlftsim.scenario.womd import read_scenarios


@pytest.fixture
def source(tmp_path, make_message, make_tfrecord):
    """Two shards of training, one of validation, two scenarios each."""
    for split, number in (("training", 0), ("training", 1), ("validation", 0)):
        messages = [make_message(f"{split}{number}{k}") for k in range(2)]
        make_tfrecord(tmp_path / "womd" / split / f"{split}.tfrecord-{number:05d}-of-00002", *messages)
    return tmp_path / "womd"


def run(source, destination, **settings):
    return convert(source, destination, **{"jobs": 1, "show_progress": False, **settings})


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_every_scenario_arrives_with_its_split(source, tmp_path, differences):
    report = run(source, tmp_path / "data")
    assert (report.converted, report.skipped, report.duplicates) == (6, (), ())
    assert (report.shards_written, report.shards_reused) == (3, 0)
    assert report.counts == {"training": 4, "validation": 2}
    originals = list(read_scenarios(source))
    stored = list(ScenarioDataset(tmp_path / "data"))
    assert [difference for a, b in zip(originals, stored, strict=True) for difference in differences(a, b)] == []
    assert ScenarioDataset(tmp_path / "data", "validation").scenario_ids == ["validation00", "validation01"]
    assert verify_dataset(tmp_path / "data") == []


def test_the_source_is_not_needed_afterwards(source, tmp_path):
    run(source, tmp_path / "data")
    source.rename(tmp_path / "gone")
    assert len(list(ScenarioDataset(tmp_path / "data"))) == 6


def test_any_number_of_jobs_gives_the_same_bytes(source, tmp_path):
    run(source, tmp_path / "one", jobs=1)
    run(source, tmp_path / "two", jobs=2)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


@pytest.mark.parametrize(
    ("setting", "cause"),
    [({"jobs": 0}, "jobs must be at least 1, got 0"), ({"split": " "}, "a split's name becomes")],
)
def test_impossible_settings_are_refused(source, tmp_path, setting, cause):
    with pytest.raises(ConfigError, match=cause):
        run(source, tmp_path / "data", **setting)


def test_a_second_run_does_nothing_again(source, tmp_path):
    run(source, tmp_path / "data")
    before = contents(tmp_path / "data")
    report = run(source, tmp_path / "data")
    assert (report.converted, report.shards_written, report.shards_reused) == (6, 0, 3)
    assert contents(tmp_path / "data") == before


def test_a_changed_source_and_a_damaged_shard_are_converted_again(source, tmp_path, make_message, make_tfrecord):
    run(source, tmp_path / "data")
    make_tfrecord(source / "training" / "training.tfrecord-00001-of-00002", make_message("new"))
    damaged = tmp_path / "data" / "shards" / "validation" / "validation.tfrecord-00000-of-00002.arrow"
    damaged.write_bytes(damaged.read_bytes()[:-5])
    report = run(source, tmp_path / "data")
    assert (report.shards_written, report.shards_reused) == (2, 1)
    assert ScenarioDataset(tmp_path / "data").scenario_ids == [
        "training00",
        "training01",
        "new",
        "validation00",
        "validation01",
    ]
    assert verify_dataset(tmp_path / "data") == []


def test_other_files_are_added_to_a_data_set(source, tmp_path):
    run(source / "training", tmp_path / "data")
    report = run(source / "validation", tmp_path / "data")
    assert report.converted == 2
    assert report.counts == {"training": 4, "validation": 2}


def test_bad_records_are_skipped_and_reported(source, tmp_path, make_message, make_tfrecord, capsys):
    path = source / "training" / "training.tfrecord-00001-of-00002"
    bad = make_message("bad")
    bad.tracks[0].states[20].center_x = float("nan")
    make_tfrecord(path, make_message("good"), bad, make_message("cut"))
    path.write_bytes(path.read_bytes()[:-30])
    (source / "training" / "empty.tfrecord").touch()
    report = run(source, tmp_path / "data")
    assert report.converted == 5
    assert [(s.file, s.record, s.cause.removeprefix("scenario bad: ").split(":")[0]) for s in report.skipped] == [
        ("training/empty.tfrecord", 0, "the file is empty"),
        (
            "training/training.tfrecord-00001-of-00002",
            1,
            "track 100 has a NaN or infinite position at step 20, where it is marked valid",
        ),
        ("training/training.tfrecord-00001-of-00002", 2, "truncated"),
    ]
    assert run(source, tmp_path / "data").skipped == report.skipped  # the second run knows it from the first
    assert main(["convert", str(source), str(tmp_path / "data"), "--jobs", "1"]) == 0
    printed = capsys.readouterr().out
    assert "5 scenarios converted, at least 3 lost" in printed
    assert "bytes, the file has" in printed
    assert printed.count("the rest of the file is lost") == 1


@pytest.mark.parametrize("jobs", [1, 2])
def test_stop_raises_at_a_bad_record_and_skip_goes_on_later(source, tmp_path, make_tfrecord, jobs):
    make_tfrecord(source / "training" / "x.tfrecord", b"nonsense")
    with pytest.raises(DataError, match=r"x\.tfrecord: record 0: not a WOMD Scenario message"):
        run(source, tmp_path / "data", on_error="stop", jobs=jobs)
    with pytest.raises(DataError, match="was not finished"):
        ScenarioDataset(tmp_path / "data")
    assert run(source, tmp_path / "data").converted == 6
    with pytest.raises(DataError, match=r"x\.tfrecord: record 0"):
        run(source, tmp_path / "data", on_error="stop")


@pytest.mark.parametrize("number", range(8))
def test_a_full_disk_is_named_in_one_line_and_the_same_command_goes_on(source, tmp_path, monkeypatch, number):
    """Three shards and a receipt each, an index, a manifest: every one of them is synced to disk once."""
    synced, sync = [], os.fsync

    def full_at(descriptor):
        synced.append(descriptor)
        if len(synced) == number + 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(descriptor)

    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full_at)
        with pytest.raises(DataError) as caught:
            run(source, tmp_path / "data")
    assert "\n" not in str(caught.value)
    kinds = (r"shards/.*\.arrow", r"shards/.*\.arrow\.json")
    path = kinds[number % 2] if number < 6 else ("index.parquet", "manifest.json")[number - 6]
    way_out = "make room or choose another place, then run the same command again"
    assert re.fullmatch(rf"cannot write .*/data/{path} \(No space left on device\): {way_out}\.", str(caught.value))
    assert not list((tmp_path / "data").rglob("*.tmp"))
    report = run(source, tmp_path / "data")
    assert report.shards_reused == min((number) // 2, 3)
    run(source, tmp_path / "uninterrupted")
    assert contents(tmp_path / "data") == contents(tmp_path / "uninterrupted")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_destination_that_may_not_be_written_to_is_named(source, tmp_path):
    (tmp_path / "closed").mkdir(mode=0o500)
    with pytest.raises(DataError, match=r"cannot write .*/closed/data/INCOMPLETE \(Permission denied\)"):
        run(source, tmp_path / "closed" / "data")


def test_of_duplicates_the_first_is_kept_and_the_others_are_reported(source, tmp_path, make_message, make_tfrecord):
    make_tfrecord(source / "training" / "z.tfrecord", make_message("training01", num_tracks=1), make_message("new"))
    report = run(source, tmp_path / "data")
    assert report.converted == 7
    assert [(d.file, d.record) for d in report.duplicates] == [("training/z.tfrecord", 0)]
    assert "already in training/training.tfrecord-00000-of-00002 record 1" in report.duplicates[0].cause
    assert len(ScenarioDataset(tmp_path / "data").by_id("training01").tracks.object_id) == 3
    assert verify_dataset(tmp_path / "data") == []


def test_a_scenario_is_in_one_split_only(source, tmp_path):
    training, data = source / "training", tmp_path / "data"
    assert run(training, data, split="training").converted == 4
    report = run(training, data, split="validation")
    assert (report.converted, report.counts) == (0, {"training": 4})
    assert len(report.duplicates) == 4
    assert report.duplicates[0].cause == (
        "scenario training00 is already in shards/training/training.tfrecord-00000-of-00002.arrow record 0; the first "
        "is kept, in split training: to have it in split validation, convert to another folder"
    )
    assert ScenarioDataset(data).scenario_ids == ["training00", "training01", "training10", "training11"]
    assert verify_dataset(data) == []
    # whichever was first: the same data set, and scenarios that leave their split are reported
    run(training, tmp_path / "other", split="validation")
    report = run(training, tmp_path / "other", split="training")
    assert (report.converted, len(report.duplicates)) == (4, 4)
    assert contents(tmp_path / "other") == contents(data)


def test_a_foreign_destination_is_refused_and_left_alone(source, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "diary.txt").write_text("mine")
    with pytest.raises(DataError, match="not empty and not a data set"):
        run(source, tmp_path / "home")
    assert contents(tmp_path / "home") == {"diary.txt": b"mine"}


def test_nothing_readable_leaves_nothing(tmp_path, make_tfrecord):
    make_tfrecord(tmp_path / "x.tfrecord", b"nonsense")
    with pytest.raises(
        DataError, match=r"not one scenario could be converted; first of 1 causes: x\.tfrecord: record 0"
    ):
        run(tmp_path / "x.tfrecord", tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_two_conversions_to_one_folder_do_not_mix(source, tmp_path):
    fcntl = pytest.importorskip("fcntl")
    (tmp_path / "data").mkdir()
    with open(tmp_path / "data" / "INCOMPLETE", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DataError, match="another process is converting"):
            run(source, tmp_path / "data")


@pytest.mark.parametrize(
    ("path", "split"),
    [
        ("/data/x/training.tfrecord-00000-of-01000", "training"),
        ("/data/x/uncompressed_scenario_validation_interactive_validation_interactive.tfrecord-0-of-9", "validation"),
        ("/data/testing/a.tfrecord", "testing"),
        ("/testing/x/a.tfrecord", "unknown"),
    ],
)
def test_the_split_follows_from_the_name_of_file_or_folder(path, split):
    assert infer_split(Path(path)) == split


def test_a_given_split_wins(source, tmp_path):
    assert run(source, tmp_path / "data", split="mine").counts == {"mine": 6}


CONVERT = """
import sys
from rlftsim.scenario.convert import convert
if __name__ == "__main__":
    report = convert(sys.argv[1], sys.argv[2], jobs=int(sys.argv[3]), show_progress=False)
    print(report.converted, report.shards_written, report.shards_reused)
"""


@pytest.fixture
def many(tmp_path, make_message, make_tfrecord):
    """Twelve shards of eight scenarios: long enough to be interrupted in the middle."""
    for number in range(12):
        messages = [make_message(f"{number}-{k}", num_tracks=40) for k in range(8)]
        make_tfrecord(tmp_path / "many" / f"training.tfrecord-{number:05d}-of-00012", *messages)
    return tmp_path / "many"


def start(script, source, destination, jobs):
    return subprocess.Popen(
        [sys.executable, str(script), str(source), str(destination), str(jobs)],
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background job ignores Ctrl-C, and so would everything it starts
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )


def wait_for_shards(process, destination, count):
    deadline = time.monotonic() + 240
    while len(list(destination.rglob("*.arrow.json"))) < count:
        assert process.poll() is None, "ended before it could be interrupted"
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.parametrize(("jobs", "kind"), [(1, signal.SIGKILL), (2, signal.SIGKILL), (2, signal.SIGINT)])
def test_an_interrupted_conversion_goes_on_and_gives_the_same_bytes(many, tmp_path, jobs, kind):
    script = tmp_path / "convert_script.py"
    script.write_text(CONVERT)
    destination = tmp_path / "data"
    process = start(script, many, destination, jobs)
    wait_for_shards(process, destination, 3)
    if kind == signal.SIGINT:
        os.killpg(process.pid, kind)  # as a terminal does
    else:
        process.kill()
    process.communicate(timeout=240)
    assert process.returncode != 0
    with pytest.raises(DataError, match="was not finished"):
        ScenarioDataset(destination)
    wait_for_orphans(process)

    report = run(many, destination)
    assert report.converted == 96
    assert report.shards_reused >= 3
    assert report.shards_written + report.shards_reused == 12
    run(many, tmp_path / "uninterrupted")
    assert contents(destination) == contents(tmp_path / "uninterrupted")
    assert not any(finding.problem.is_damage for finding in verify_dataset(destination))


def wait_for_orphans(process):
    """Workers of a killed process end by themselves, at the latest after the shard that they write."""
    deadline = time.monotonic() + 240
    while any(process.pid == group and state != "Z" for state, group in list_processes()):
        assert time.monotonic() < deadline, "workers outlive their parent"
        time.sleep(0.1)


def list_processes():
    """State and process group of each process."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has just ended
            state, _, group, *_ = path.read_text().rpartition(")")[2].split()
            yield state, int(group)


@pytest.mark.official
def test_no_official_scenario_is_lost(shared, tmp_path):
    report = run(shared / "data" / "womd", tmp_path / "data")
    assert (report.converted, report.skipped, report.duplicates) == (7, (), ())
    damage = [finding for finding in verify_dataset(tmp_path / "data") if finding.problem.is_damage]
    assert damage == []


def test_an_empty_file_is_named(tmp_path, capsys):
    (tmp_path / "empty.tfrecord").touch()
    with pytest.raises(DataError, match=r"not one scenario could be converted; .*empty\.tfrecord.*the file is empty"):
        run(tmp_path / "empty.tfrecord", tmp_path / "data", show_progress=True)
    assert "convert: 100%" in capsys.readouterr().err


def test_only_temporaries_of_killed_conversions_are_removed(source, tmp_path):
    run(source, tmp_path / "data")
    expected = contents(tmp_path / "data")
    [shard, *_] = (tmp_path / "data" / "shards" / "training").iterdir()
    for name in ("notes.tmp", "shards/.mine.tmp", "mine/.draft.2.txt.tmp", "shards/.x.123.tmp"):
        (tmp_path / "data" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "data" / name).write_text("of the user")
        expected[name] = b"of the user"
    (tmp_path / "data" / "shards" / "training" / f".{shard.name}.machine.12.tmp").write_text("cut short")
    run(source, tmp_path / "data")
    assert contents(tmp_path / "data") == expected


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"schema_version": 1', "\0"])
def test_a_damaged_receipt_costs_its_shard_alone(source, tmp_path, text):
    with pytest.raises(Unfinished):
        run(source, tmp_path / "data", runner=Share(1, 2, Inline()))
    (receipt, *_) = sorted((tmp_path / "data").rglob("*.arrow.json"))
    receipt.write_text(text)
    run(source, tmp_path / "data")
    run(source, tmp_path / "whole")
    assert contents(tmp_path / "data") == contents(tmp_path / "whole")
