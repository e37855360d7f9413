"""Each reason for which entries were refused: a good archive is damaged in that way, and exactly that is found."""

import gzip
import json
import re
import time

import entries
import pytest

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.submission_pb2 import SimAgentsChallengeSubmission
from rlftsim.submission import check
from rlftsim.submission.check import CHECKS, check_archive
from rlftsim.submission.messages import decode_rollouts
from rlftsim.submission.report import SERVER_ERRORS, write_findings

FIRST, SECOND = "submission.binproto-00000-of-00003", "submission.binproto-00001-of-00003"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return entries.write_data(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def good(data):
    return entries.draw_shards(data)


@pytest.fixture
def shards(good):
    copies = {name: SimAgentsChallengeSubmission.FromString(m.SerializeToString()) for name, m in good.items()}
    return copies


def scenes_of(shards, shard=FIRST, scenario=0):
    return shards[shard].scenario_rollouts[scenario].joint_scenes


def agent(shards, scene=7, index=2):
    return scenes_of(shards)[scene].simulated_trajectories[index]


def all_agents(shards):
    return [
        trajectory
        for message in shards.values()
        for rollouts in message.scenario_rollouts
        for scene in rollouts.joint_scenes
        for trajectory in scene.simulated_trajectories
    ]


def leave_out_an_agent(shards):
    del scenes_of(shards)[7].simulated_trajectories[2]


def invent_an_agent(shards):
    for scene in scenes_of(shards):
        scene.simulated_trajectories[2].object_id = 4711


def lose_a_scenario(shards):
    del shards[FIRST].scenario_rollouts[1]


def invent_a_scenario(shards):
    copy = shards[FIRST].scenario_rollouts.add()
    copy.CopyFrom(shards[FIRST].scenario_rollouts[0])
    copy.scenario_id = "feed"


def leave_three_scenes(shards):
    del scenes_of(shards)[3:]


def add_steps(shards):
    agent(shards).center_y.extend([0.0] * 11)


def forget_a_field(shards):
    shards[SECOND].ClearField("uses_lidar_data")


def change_the_method(shards):
    shards[SECOND].unique_method_name = "Another method"


def write_parameters_as_a_fraction(shards):
    for message in shards.values():
        message.num_model_parameters = "0.64M"


def call_a_shard_otherwise(shards):
    shards["submission_1.pb"] = shards.pop(SECOND)


def count_from_one(shards):
    shards["submission.binproto-00003-of-00003"] = shards.pop(FIRST)


def repeat_a_scenario(shards):
    shards[SECOND].scenario_rollouts.add().CopyFrom(shards[FIRST].scenario_rollouts[0])


def list_an_agent_twice(shards):
    trajectories = scenes_of(shards)[7].simulated_trajectories
    trajectories[2].object_id = trajectories[1].object_id


def take_a_scenario_of_another_split(shards):
    copy = shards[FIRST].scenario_rollouts.add()
    copy.CopyFrom(shards[FIRST].scenario_rollouts[0])
    copy.scenario_id = "another"


def write_a_nan(shards):
    agent(shards).center_x[40] = float("nan")


def jump_far(shards):
    agent(shards).center_x[40] += 400


def write_degrees(shards):
    one = agent(shards)
    one.heading[:] = [170.0 + h for h in one.heading]


def add_a_turn_midway(shards):
    one = agent(shards)
    one.heading[40:] = [6.2831853 + h for h in one.heading[40:]]


def forget_heights(shards):
    for scene in scenes_of(shards):
        for trajectory in scene.simulated_trajectories:
            trajectory.center_z[:] = [0.0] * 80


def raise_an_agent(shards):
    one = agent(shards)
    one.center_z[:] = [z + 21 for z in one.center_z]


def shift_the_frame(shards):
    for trajectory in all_agents(shards):
        trajectory.center_x[:] = [x + 6 for x in trajectory.center_x]


def repeat_a_scene(shards):
    for scene in scenes_of(shards):
        scene.CopyFrom(scenes_of(shards)[0])


def take_ids_of_another_version(shards):
    for trajectory in all_agents(shards):
        trajectory.object_id += 1000


DAMAGES = [
    (1, leave_out_an_agent, "error", r"missing: 102$", FIRST, "a0", 102),
    (1, invent_an_agent, "error", r"missing: 102; not simulated in this scenario: 4711$", FIRST, "a0", 102),
    (2, lose_a_scenario, "error", r"1 of 12 scenarios of split testing missing: a3$", "a.tar.gz", None, None),
    (2, invent_a_scenario, "error", r"unknown to .*, split testing$", FIRST, "feed", None),
    (3, leave_three_scenes, "error", r"3 scenes instead of 32$", FIRST, "a0", None),
    (4, add_steps, "error", r"\[80, 91, 80, 80\] steps in scene 7$", FIRST, "a0", 102),
    (5, forget_a_field, "error", r"uses_lidar_data is missing$", SECOND, None, None),
    (5, change_the_method, "error", r"unique_method_name differ from those of .*00000-of-00003$", SECOND, None, None),
    (5, write_parameters_as_a_fraction, "error", r'"0\.64M", not a whole number', FIRST, None, None),
    (6, call_a_shard_otherwise, "error", r"no shard's name; wanted are flat names", "submission_1.pb", None, None),
    (6, count_from_one, "error", r"do not count from 0 to 2 of 3$", "a.tar.gz", None, None),
    (8, repeat_a_scenario, "error", r"in the archive twice$", SECOND, "a0", None),
    (8, list_an_agent_twice, "error", r"listed twice in scene 7$", FIRST, "a0", 101),
    (9, take_a_scenario_of_another_split, "error", r"of split training, not testing$", FIRST, "another", None),
    (10, write_a_nan, "error", r"x is nan at step 40 in scene 7$", FIRST, "a0", 102),
    (10, jump_far, "error", r"a step of \d+\.\d m in 0\.1 s in scene 7$", FIRST, "a0", 102),
    (11, write_degrees, "warning", r"heading of 1\d\d rad \(degrees\?\) in scene 7$", FIRST, "a0", 102),
    (11, add_a_turn_midway, "warning", r"heading changes by 6\.28 rad", FIRST, "a0", 102),
    (12, forget_heights, "warning", r"z is 0 everywhere, in the log it is not", FIRST, "a0", None),
    (12, raise_an_agent, "warning", r"z is 21 m from that of the current step in scene 7$", FIRST, "a0", 102),
    (13, shift_the_frame, "warning", r"100 % of agents jump away from the log", "a.tar.gz", None, None),
    (14, repeat_a_scene, "warning", r"all 32 rollouts are equal", FIRST, "a0", None),
    (15, take_ids_of_another_version, "error", r"12 of 12 scenarios have other agents than", "a.tar.gz", None, None),
]


def test_a_good_archive_has_no_finding(good, data, tmp_path):
    found = check_archive(entries.pack(tmp_path / "a.tar.gz", good), data, show_progress=False)
    assert found.findings.lines() == []
    assert (found.num_scenarios, found.num_checked, len(found.shards)) == (12, 12, 3)
    assert found.num_trajectories == 32 * sum(len(s.simulated_indices) for s in data)


@pytest.mark.parametrize("case", DAMAGES, ids=[case[1].__name__ for case in DAMAGES])
def test_a_damage_is_found_as_what_it_is(case, shards, data, tmp_path):
    number, damage, severity, text, file, scenario, object_id = case
    damage(shards)
    found = check_archive(entries.pack(tmp_path / "a.tar.gz", shards), data, show_progress=False).findings
    assert set(found.counts) == {number}
    first = found.stored[0]
    assert (first.severity, first.file, first.scenario_id, first.object_id) == (severity, file, scenario, object_id)
    assert re.search(text, first.text)
    assert found.has_errors == (severity == "error")


def members_apart(path, shards):
    """Each shard in a gzip member of its own, as joined .tar.gz files have them."""
    entries.pack(path, shards, "w:")
    tar = path.read_bytes()
    path.write_bytes(gzip.compress(tar[:5120]) + gzip.compress(tar[5120:]))


@pytest.mark.parametrize(
    ("write", "text"),
    [
        (lambda path, shards: entries.pack(path, shards, "w:"), "not compressed with gzip"),
        (lambda path, shards: path.write_bytes(entries.pack(path, shards).read_bytes()[:-100]), "cut off"),
        (lambda path, shards: path.write_bytes(entries.pack(path, shards).read_bytes()[:-8] + bytes(8)), "damaged"),
        (members_apart, "cut off|another gzip member|unexpected end"),
        (lambda path, shards: entries.pack(path, {**shards, FIRST: b"\xff" * 99}), "not a protobuf message"),
    ],
    ids=["tar", "cut", "checksum", "members", "contents"],
)
def test_a_file_that_python_cannot_read_to_its_end_is_check_7(write, text, good, data, tmp_path):
    write(tmp_path / "a.tar.gz", good)
    found = check_archive(tmp_path / "a.tar.gz", data, show_progress=False).findings
    assert set(found.counts) == {7}
    assert re.search(text, found.stored[0].text)


def test_sizes_are_check_16(good, data, tmp_path, monkeypatch):
    archive = entries.pack(tmp_path / "a.tar.gz", good)
    monkeypatch.setattr(check, "MAX_SHARD_BYTES", good[SECOND].ByteSize())
    monkeypatch.setattr(check, "DOUBTFUL_ARCHIVE_BYTES", archive.stat().st_size)
    found = check_archive(archive, data, show_progress=False).findings
    assert set(found.counts) == {16}
    assert {finding.severity for finding in found.stored} == {"error", "warning"}


def test_another_file_than_the_reported_one_is_check_17(good, data, tmp_path):
    archive = entries.pack(tmp_path / "a.tar.gz", good)
    sha256 = check_archive(archive, data, show_progress=False).sha256
    whole = archive.read_bytes()
    archive.write_bytes(whole[:4] + b"\x01" + whole[5:])  # the time in gzip's header, which no checksum covers
    found = check_archive(archive, data, expected_sha256=sha256, show_progress=False).findings
    assert set(found.counts) == {17}
    part = tmp_path / "a.tar.gz.000"
    part.write_bytes(whole)
    (finding,) = check_archive(part, data, show_progress=False).findings.stored
    assert finding.check == 17
    assert "cat a.tar.gz.??? > a.tar.gz" in finding.text


def test_every_check_has_a_damage():
    damaged = {damage[0] for damage in DAMAGES} | {7, 16, 17} | {19, 20}  # the last two in test_generated_scenes
    assert damaged == set(CHECKS)
    # the eighteenth reason leaves no trace in the file: the report says what to do
    assert "submission key" in SERVER_ERRORS


def test_a_sample_looks_at_few_trajectories_and_all_sets(shards, data, tmp_path):
    write_a_nan(shards)
    archive = entries.pack(tmp_path / "a.tar.gz", shards)
    found = check_archive(archive, data, sample=0.1, show_progress=False)
    assert found.num_checked < found.num_scenarios == 12
    lose_a_scenario(shards)
    found = check_archive(entries.pack(archive, shards), data, sample=0.1, show_progress=False)
    assert 2 in found.findings.counts
    with pytest.raises(ConfigError, match="sample=0 must be above 0"):
        check_archive(archive, data, sample=0.0)


def test_findings_are_counted_and_not_all_kept(shards, data, tmp_path):
    for trajectory in all_agents({FIRST: shards[FIRST], SECOND: shards[SECOND]}):
        trajectory.center_z[0] = 1000.0
    shards[SECOND].scenario_rollouts.add().CopyFrom(shards[FIRST].scenario_rollouts[0])
    found = check_archive(entries.pack(tmp_path / "a.tar.gz", shards), data, show_progress=False).findings
    assert found.counts == {12: 8, 8: 1}
    assert [line.split(":")[0] for line in found.lines()][:2] == ["error, check 8", "warning, check 12"]


def test_without_data_names_and_fields_are_checked(shards, tmp_path):
    forget_a_field(shards)
    found = check_archive(entries.pack(tmp_path / "a.tar.gz", shards), None, show_progress=False)
    assert set(found.findings.counts) == {5}
    assert (found.num_scenarios, found.metadata.unique_method_name) == (12, entries.ENTRY.method)
    with pytest.raises(DataError, match=r"nothing\.tar\.gz: there is no such archive"):
        check_archive(tmp_path / "nothing.tar.gz", None)


def test_texts_that_are_none_are_named(data, tmp_path):
    account = entries.METADATA.replace(b"jane.doe@university", b"jane.doe university")
    account = account.replace(b"jane", b"j\xff\xfee")
    scenario = b"\x0a\x04\x0a\x02\xff\xfe"
    archive = entries.pack(tmp_path / "a.tar.gz", {"submission.binproto\x1b[2J\n\udcff": account + scenario})
    found = check_archive(archive, data, show_progress=False)
    lines = found.findings.lines()
    assert all(line.isprintable() for line in lines)
    assert any("account_name is no e-mail address" in line for line in lines)
    assert any(r"submission.binproto\x1b[2J\n\udcff: no shard's name" in line for line in lines)
    write_findings(found, tmp_path / "found.json")
    assert "\ufffd\ufffd" in {
        finding["scenario_id"] for finding in json.loads((tmp_path / "found.json").read_text())["findings"]
    }


def test_a_number_without_an_end_takes_no_time():
    start = time.process_time()
    with pytest.raises(DataError, match="not a ScenarioRollouts message"):
        decode_rollouts(b"\x0a" + b"\xff" * 400_000)
    assert time.process_time() - start < 1


def test_damage_of_the_data_set_is_no_finding_about_the_archive(good, tmp_path):
    data = entries.write_data(tmp_path / "set")
    archive = entries.pack(tmp_path / "a.tar.gz", good)
    for shard in (tmp_path / "set" / "shards").iterdir():
        shard.unlink()
    with pytest.raises(DataError, match=r"shard .*\.arrow is missing"):
        check_archive(archive, data, show_progress=False)
