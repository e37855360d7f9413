"""Builds: the same bytes however they were interrupted, and nothing simulated that the server would refuse."""

import fcntl
import json
import multiprocessing
import os
import random
import resource
import signal
import tarfile
import time
from dataclasses import replace
from pathlib import Path

import entries
import numpy as np
import pytest

import scenes
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.rollout_files import find_rollouts, read_states
from rlftsim.evaluation.rollout_states import simulate_states
from rlftsim.jobs.runner import Inline, Share, Unfinished
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.check import check_policy
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.submission.build import build_archive, delete_shards, forecast_size
from rlftsim.submission.check import check_archive
from rlftsim.submission.entry import check_closed_loop, statement
from rlftsim.submission.messages import round_states
from rlftsim.submission.plan import check_complete, check_sources

NUM_SHARDS = 6


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return entries.write_data(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """An uninterrupted archive: its bytes."""
    return build(data, tmp_path_factory.mktemp("whole")).read_bytes()


def build(data, folder, **settings):
    more = {name: settings.pop(name) for name in ("is_deleting", "runner") if name in settings}
    job = entries.make_job(data, folder, **{"num_shards": NUM_SHARDS, **settings})
    return build_archive(job, show_progress=False, **more)


def test_the_archive_has_every_scenario_and_no_finding(data, whole, tmp_path):
    (tmp_path / "a.tar.gz").write_bytes(whole)
    found = check_archive(tmp_path / "a.tar.gz", data, show_progress=False)
    assert found.findings.lines() == []
    assert found.num_checked == len(data) == 12  # one has no map, one 11 steps
    assert len(found.shards) == NUM_SHARDS
    assert found.metadata.unique_method_name == entries.ENTRY.method


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [2])
def test_any_number_of_processes_gives_the_same_bytes(jobs, data, whole, tmp_path):
    assert build(data, tmp_path, jobs=jobs).read_bytes() == whole


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 1, 2)])
def test_shares_give_the_same_bytes(order, data, whole, tmp_path):
    for number in order[:-1]:
        with pytest.raises(Unfinished, match=f"submit: share {number}/3 is done"):
            build(data, tmp_path, runner=Share(number, 3, Inline()))
    assert build(data, tmp_path, runner=Share(order[-1], 3, Inline())).read_bytes() == whole
    assert not [path for path in tmp_path.rglob(".*") if path.is_file()]


@pytest.mark.slow
def test_a_killed_build_with_two_processes_goes_on_to_the_same_bytes(data, whole, tmp_path):
    process = multiprocessing.get_context("fork").Process(target=build, args=(data, tmp_path), kwargs={"jobs": 2})
    process.start()
    while process.is_alive() and len(list(tmp_path.rglob("*.part"))) < 2:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == -signal.SIGKILL
    time.sleep(1.0)  # its workers end by themselves
    assert build(data, tmp_path, jobs=2).read_bytes() == whole
    assert not [path for path in tmp_path.rglob(".*") if path.is_file()]


def test_a_killed_build_goes_on_to_the_same_bytes(data, whole, tmp_path):
    start = time.monotonic()
    build(data, tmp_path / "timed")
    seconds = time.monotonic() - start
    moments = random.Random(0)
    num_killed = 0
    for number in range(5):
        folder = tmp_path / f"killed-{number}"
        process = multiprocessing.get_context("fork").Process(
            target=build, args=(data, folder), kwargs={"is_deleting": number % 2 == 1}
        )
        process.start()
        time.sleep(moments.uniform(0.05, seconds))
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        num_killed += process.exitcode == -signal.SIGKILL
        assert build(data, folder).read_bytes() == whole
        strays = {path.name for path in folder.rglob("*") if path.name.startswith(".")} - {".lock"}
        assert strays == set()
    assert num_killed > 0


def test_finished_shards_are_not_simulated_again(data, whole, tmp_path, monkeypatch):
    archive = build(data, tmp_path)
    archive.unlink()
    shards = tmp_path / "shards"
    (shards / "00003.json").unlink()  # killed before the receipt
    (shards / "00004.part").unlink()
    seen = []
    real = entries.Wanderer.encode

    def encode(self, batch):
        seen.extend(batch.scenarios)
        return real(self, batch)

    monkeypatch.setattr(entries.Wanderer, "encode", encode)
    assert build(data, tmp_path).read_bytes() == whole
    plan = json.loads((tmp_path / "plan.json").read_text())
    wanted = [data.scenario_ids[n] for shard in (3, 4) for n in range(*plan["shards"][shard])]
    assert [scenario.scenario_id for scenario in seen] == wanted


def test_a_full_disk_leaves_one_line_and_what_is_finished(data, whole, tmp_path):
    process = multiprocessing.get_context("fork").Process(target=fill_the_disk, args=(data, tmp_path))
    process.start()
    process.join()
    message = (tmp_path / "message").read_text()
    assert message.startswith("cannot write ")
    assert "make room" in message
    assert "\n" not in message
    assert not list((tmp_path / "out" / "shards").glob(".*"))  # what was half written gives its room back
    assert build(data, tmp_path / "out").read_bytes() == whole


def fill_the_disk(data, tmp_path):
    # a limit on the size of files stands in for the disk: plan and receipts fit, a shard does not
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
    try:
        build(data, tmp_path / "out")
    except DataError as error:
        (tmp_path / "message").write_text(str(error))


def test_ctrl_c_leaves_a_folder_that_goes_on(data, whole, tmp_path, monkeypatch):
    real = entries.Wanderer.encode

    def interrupted(self, batch):
        if batch.scenarios[0].scenario_id == data.scenario_ids[7]:
            raise KeyboardInterrupt
        return real(self, batch)

    monkeypatch.setattr(entries.Wanderer, "encode", interrupted)
    with pytest.raises(KeyboardInterrupt):
        build(data, tmp_path)
    assert list((tmp_path / "shards").glob("*.part"))
    monkeypatch.setattr(entries.Wanderer, "encode", real)
    assert build(data, tmp_path).read_bytes() == whole


def test_parts_go_as_they_are_joined(data, whole, tmp_path):
    assert build(data, tmp_path, is_deleting=True).read_bytes() == whole
    assert not list((tmp_path / "shards").glob("*.part"))


def test_only_the_files_of_the_build_are_removed(data, tmp_path):
    (tmp_path / "shards").mkdir()
    mine = [tmp_path / "shards" / name for name in ("validation.arrow", ".hidden")]
    for path in mine:
        path.write_text("of a user")
    build(data, tmp_path, is_deleting=True)
    delete_shards(entries.make_job(data, tmp_path, num_shards=NUM_SHARDS))
    assert sorted((tmp_path / "shards").iterdir()) == sorted(mine)


def test_a_receipt_of_another_file_counts_for_nothing(data, tmp_path):
    (tmp_path / "shards").mkdir()
    (tmp_path / "mine.txt").write_text("of a user")
    receipt = {"file": "../mine.txt", "size": 9, "piece_crc": 0, "raw_size": 9, "raw_crc": 0}
    (tmp_path / "shards" / "00000.json").write_text(json.dumps(receipt))
    build(data, tmp_path, is_deleting=True)
    assert (tmp_path / "mine.txt").read_text() == "of a user"


@pytest.mark.parametrize(
    "damage", [{"raw_size": -(2**70)}, {"raw_size": 2**70}, {"raw_crc": -1}, {"raw_crc": 2**40}, {"size": -5}]
)
def test_a_receipt_with_impossible_numbers_counts_for_nothing(damage, data, whole, tmp_path):
    job = entries.make_job(data, tmp_path, num_shards=NUM_SHARDS)
    with pytest.raises(Unfinished):
        build_archive(job, runner=Share(1, 2, Inline()), show_progress=False)
    receipt = job.receipt_path(0)
    receipt.write_text(json.dumps(json.loads(receipt.read_text()) | damage))
    assert build(data, tmp_path).read_bytes() == whole


def test_another_plan_is_refused_with_its_difference(data, tmp_path):
    build(data, tmp_path)
    with pytest.raises(ConfigError, match=r"holds a submission of another seed \(0, not 1\): name another --out"):
        build(data, tmp_path, seed=1)
    with pytest.raises(ConfigError, match="another shards"):
        build(data, tmp_path, num_shards=3)


def test_two_builds_do_not_share_a_folder(data, tmp_path):
    (tmp_path / "out").mkdir()
    with (tmp_path / "out" / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(DataError, match=r"another process builds in .*: wait for it or choose another destination"):
            build(data, tmp_path / "out")
    build(data, tmp_path / "out")


def test_poses_that_are_not_finite_stop_the_build(data, tmp_path):
    class Lost(entries.Wanderer):
        def advance(self, context, state, decision, forced=None):
            return super().advance(context, state, decision * float("nan"), forced)

    with pytest.raises(DataError, match=r"Lost moves agent 100 of scenario a0 in rollout 0 at step 0 to x nan m"):
        build(data, tmp_path, policy=Lost())
    assert not list((tmp_path / "shards").glob("*"))


def test_files_of_the_archive_are_read_by_score_bit_for_bit(data, whole, tmp_path):
    (tmp_path / "a.tar.gz").write_bytes(whole)
    with tarfile.open(tmp_path / "a.tar.gz") as tar:
        tar.extractall(tmp_path / "out")
    job = entries.make_job(data, tmp_path, num_shards=NUM_SHARDS)
    for entry in find_rollouts(tmp_path / "out"):
        states = read_states(entry)
        expected = simulate_states(job.policy, collate([data.by_id(entry.scenario_id)]), job.config)
        for axis in ("x", "y", "z", "heading"):
            np.testing.assert_array_equal(getattr(states, axis).numpy(), getattr(expected, axis).numpy())


def test_the_first_shard_foretells_the_size(data, whole, tmp_path):
    archive = build(data, tmp_path)
    job = entries.make_job(data, tmp_path, num_shards=NUM_SHARDS)
    size = forecast_size(job.plan, 0, job.receipt(0))
    assert size == pytest.approx(archive.stat().st_size, rel=0.1)
    assert job.plan.message_bytes == pytest.approx(sum(job.receipt(n).raw_size for n in range(NUM_SHARDS)), rel=0.02)


def test_shards_hold_equal_numbers_of_agents(data):
    for num_shards in (1, 4, 6, 12, 150):
        plan = entries.make_job(data, Path(), num_shards=num_shards).plan
        assert [n for shard in plan.shards for n in shard] == list(range(12))
        assert len(plan.shards) == min(num_shards, 12)
        assert all(len(shard) for shard in plan.shards)
        assert max(plan.num_agents) <= sum(plan.num_agents) / len(plan.shards) + 6  # the largest scenario


def test_rounding_moves_nothing_by_more_than_half_a_step():
    states = entries.draw_states(scenes.straight_road())
    rounded = round_states(states, 0.001)
    for axis, step in (("x", 2**-10), ("y", 2**-10), ("heading", 2**-13)):
        before, after = getattr(states, axis).double(), getattr(rounded, axis).double()
        assert float((after - before).abs().max()) <= step / 2
        assert float((after / step).frac().abs().max()) == 0
    assert round_states(states, None) is states


@pytest.mark.parametrize("round_m", [0.0, -1.0, 1.0, float("nan")])
def test_a_step_that_is_none_is_refused_before_a_folder_is_claimed(data, tmp_path, round_m):
    with pytest.raises(ConfigError, match=r"round=.* must be above 0 and below 1 m"):
        entries.make_job(data, tmp_path / "out", round_m=round_m)


def test_a_split_with_a_missing_file_is_refused(tmp_path):
    data = entries.write_data(tmp_path / "set")
    check_complete(data)
    (shard,) = data.folder.glob("shards/*.arrow")
    shard.rename(tmp_path / "gone")
    with pytest.raises(DataError, match=r"00000\.arrow is missing, and 0 more: convert again"):
        check_complete(data)
    (tmp_path / "gone").rename(shard)
    # as `rlftsim convert` writes the manifest of the files 0 and 2 of 3
    entry = replace(data.manifest.shards[0], split="testing")
    names = [f"testing.tfrecord-{number:05d}-of-00003" for number in (0, 2)]
    data.manifest = replace(data.manifest, shards=tuple(replace(entry, source=name) for name in names))
    with pytest.raises(DataError, match=r"from 2 of 3 files, testing\.tfrecord-00001-of-00003 is missing"):
        check_complete(data)


def test_recordings_of_others_are_refused(tmp_path):
    check_sources(entries.write_data(tmp_path / "set"))
    write_dataset(replace(scenes.straight_road(), source="av2"), tmp_path / "foreign")
    with pytest.raises(DataError, match="scenarios of the source av2: the Sim Agents server scores WOMD alone"):
        check_sources(ScenarioDataset(tmp_path / "foreign"))


class Slow(ConstantVelocity):
    steps_per_decision = 16


class Drawing(ConstantVelocity):
    """Draws something at the start of a rollout: of each agent, or of the ego for all."""

    initial_noise_size = 1

    def __init__(self, shared):
        self.shared = shared

    def begin(self, context, num_rollouts, goals, noise):
        draws = noise[:, :, :1].expand_as(noise) if self.shared else noise
        return replace(super().begin(context, num_rollouts, goals, noise), draws=draws)


class Foreseeing(ConstantVelocity):
    """Drives at the mean velocity of the logged future."""

    def encode(self, scenarios):
        if scenarios.valid.shape[-1] <= CURRENT_STEP + 1:
            return super().encode(scenarios)
        velocity = scenarios.velocity.clone()
        velocity[:, :, CURRENT_STEP] = (
            scenarios.position[:, :, -1] - scenarios.position[:, :, CURRENT_STEP]
        ) / 8.0 + 1.0
        return super().encode(replace(scenarios, velocity=velocity))


def test_policies_that_are_no_closed_loop_are_refused():
    drawn = scenes.straight_road()
    with pytest.raises(ConfigError, match="change where the logged future is taken away"):
        check_closed_loop(Foreseeing(), drawn)
    check_closed_loop(Foreseeing(), scenes.without_future())  # there is nothing to foresee
    (found,) = check_policy(Foreseeing(), [drawn]).failures
    assert found.rule == "rollouts do not depend on the logged future"
    with pytest.raises(ConfigError, match=r"decides every 1\.6 s: the challenge wants an inference call at least once"):
        check_closed_loop(Slow(), drawn)
    with pytest.raises(ConfigError, match="the ego shares with other agents"):
        check_closed_loop(Drawing(shared=True), drawn)
    check_closed_loop(Drawing(shared=False), drawn)
    check_closed_loop(ConstantVelocity(), drawn)
    config = entries.make_job(ScenarioDataset("synthetic", "validation"), Path()).config
    assert "decides every 0.1 s, 80 times in 8 s" in statement(ConstantVelocity(), config.sampling)


def test_a_test_split_alone_builds(tmp_path):
    write_dataset([scenes.without_future("a"), scenes.without_future("b")], tmp_path / "set", split="testing")
    data = ScenarioDataset(tmp_path / "set", "testing")
    found = check_archive(build(data, tmp_path / "out"), data, show_progress=False)
    assert found.findings.lines() == []
    assert found.num_checked == 2


def test_locks_of_a_process_killed_after_the_archive_was_whole_go_with_the_next_call(data, whole, tmp_path):
    archive = build(data, tmp_path)
    left = [tmp_path / name for name in (".lock", ".lock.1-of-2", ".lock.2-of-2")]
    for lock in left:
        lock.write_text("host process 1 since 2026-01-01T00:00:00+00:00")
    assert build(data, tmp_path) == archive
    assert archive.read_bytes() == whole
    assert not any(lock.exists() for lock in left)


def test_an_archive_of_unknown_origin_is_not_taken_for_the_build(data, whole, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "submission.tar.gz").write_bytes(whole)
    with pytest.raises(DataError, match=r"submission\.tar\.gz is there without its plan\.json: name another --out"):
        build(data, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["submission.tar.gz"]
