"""Files of GPUDrive, PufferDrive and Nocturne: ten real ones, and files written by their programs' rules."""

import gzip
import json
from dataclasses import replace

import numpy as np
import pytest

import rlftsim as rs
from gpudrive_files import FORMS, to_json, write_file
from rlftsim.cli.main import main
from rlftsim.errors import DataError
from rlftsim.scenario import womd_pb2
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.gpudrive import GpudriveSource, read_scenario
from rlftsim.scenario.tfrecord import read_records
from rlftsim.scenario.types import CURRENT_STEP, MEDIAN_SIZE_M, MapFeatureType, ObjectType
from rlftsim.scenario.womd import scenario_from_bytes

GUESSED = {
    "present": {"size"},
    "early": {"size", "ego", "predict"},
    "Nocturne": {"size", "ego", "predict", "z", "subtype"},
}


def write(folder, scene):
    path = folder / "scene.json"
    path.write_text(json.dumps(scene))
    return path


# --- ten real files -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(shared):
    return sorted((shared / "data" / "womd_json").glob("*.json.gz"))


@pytest.mark.official
def test_ten_of_ten_real_files_convert_and_their_forms_and_guesses_are_printed(real, tmp_path, capsys):
    assert main(["convert", str(real[0].parent), str(tmp_path / "d"), "--split", "validation", "--jobs", "1"]) == 0
    printed = capsys.readouterr().out
    assert "10 scenarios converted, 0 lost; in all 10 validation" in printed
    assert "7 of the present form, with guessed size\n" in printed
    assert "2 of the early form, with guessed ego, predict, size\n" in printed
    assert "1 of the Nocturne form, with guessed ego, predict, size, subtype, z\n" in printed
    data = ScenarioDataset(tmp_path / "d")
    assert main(["data", "verify", str(tmp_path / "d")]) == 0
    assert "0 doubtful contents" in capsys.readouterr().out
    lanes = [len(np.unique(data.by_id(name).lights.lane_id)) for name in ("2a173b334be3d32c", "2af8a17d6cee3f8")]
    assert lanes == [12, 14]


@pytest.mark.official
def test_headings_agree_with_the_velocity_of_moving_vehicles(real):
    for file in real:
        tracks = read_scenario(file)[0].tracks
        speed = np.linalg.norm(tracks.velocity, axis=-1)
        moving = tracks.valid & (speed > 1.0) & (tracks.object_type == ObjectType.VEHICLE)[:, None]
        direction = np.arctan2(tracks.velocity[..., 1], tracks.velocity[..., 0])
        off = np.abs(np.angle(np.exp(1j * (tracks.heading - direction))))[moving]
        assert np.median(off) <= 0.02, file.name


@pytest.mark.official
def test_states_equal_those_of_another_reader_of_the_same_files(real, shared):
    for file in real:
        scenario = read_scenario(file)[0]
        tracks, lights = scenario.tracks, scenario.lights
        with np.load(shared / "data" / "womd_npz" / "scenarios" / file.name.replace(".json.gz", ".npz")) as other:
            np.testing.assert_array_equal(tracks.valid, other["agent_valid"])
            expected = (other["agent_pos"] + other["origin"])[tracks.valid][:, :2]
            np.testing.assert_allclose(tracks.position[tracks.valid][:, :2], expected, atol=2e-3)
            turn = np.exp(1j * tracks.heading[tracks.valid]) - np.exp(1j * other["agent_heading"][tracks.valid])
            assert np.abs(turn).max() < 1e-4
            np.testing.assert_array_equal(scenario.map_features.offsets, other["map_ptr"])
            assert len(lights.step) == other["tl_valid"].sum()
            assert scenario.ego_index == other["sdc_index"] or "ego" in scenario.guessed


@pytest.mark.official
def test_a_record_that_goes_through_such_a_file_scores_the_same_but_for_sizes_and_turns(shared, tmp_path):
    """Files have one size of each object and no whole turns in headings; records have both."""
    records = sorted((shared / "data" / "womd").rglob("*tfrecord*"))
    off = {}
    for _, record in (entry for path in records for entry in read_records(path)):
        original, message = scenario_from_bytes(record), womd_pb2.Scenario.FromString(record)
        stored, form, num_off = read_scenario(write_file(tmp_path, message))
        assert (form, num_off) == ("present", 0)
        rollouts = rs.simulate(rs.ConstantVelocity(), original, num_rollouts=2)
        tracks = replace(original.tracks, size=stored.tracks.size, heading=stored.tracks.heading)
        alike = replace(original, tracks=tracks)
        scores = [rs.score(one, rollouts).to_official_fields()[0] for one in (original, alike, stored)]
        numbers = [[value for value in score.values() if isinstance(value, float)] for score in scores]
        np.testing.assert_allclose(numbers[2], numbers[1], atol=1e-6)
        off[original.scenario_id] = abs(scores[0]["metametric"] - scores[2]["metametric"])
    assert len(off) == 7
    assert sum(value <= 1e-6 for value in off.values()) == 4  # sizes of all steps were equal before
    assert max(off.values()) < 0.01


# --- files by their rules -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_every_form_becomes_the_scenario_that_it_was_written_from(form, make_message, tmp_path, differences):
    message = make_message(num_tracks=8)
    message.tracks[1].states[40].valid = False
    for state in message.tracks[2].states:
        state.heading = 2.5 * np.pi  # 450 degrees
    expected = scenario_from_bytes(message.SerializeToString())
    scenario, name, num_off = read_scenario(write_file(tmp_path, message, form))
    assert (name, scenario.guessed, num_off) == (form, GUESSED[form], 0)
    assert scenario.num_steps == 91
    tracks, logged = scenario.tracks, expected.tracks
    np.testing.assert_array_equal(tracks.valid, logged.valid)
    np.testing.assert_array_equal(tracks.position[..., :2], logged.position[..., :2] * logged.valid[..., None])
    np.testing.assert_array_equal(tracks.velocity, logged.velocity * logged.valid[..., None])
    np.testing.assert_array_equal(tracks.object_type, logged.object_type)
    np.testing.assert_allclose(tracks.heading[2], np.pi / 2, atol=1e-6)
    assert not tracks.position[1, 40].any()
    assert not tracks.size[1, 40].any()
    np.testing.assert_array_equal(scenario.map_features.points[:, :2], expected.map_features.points[:, :2])
    assert scenario.ego_index == expected.ego_index
    if form == "Nocturne":
        assert scenario.scenario_id == "tfrecord-00000-of-00001_0a1b"
        np.testing.assert_allclose(tracks.size[0, 0], [4.5, 2.0, MEDIAN_SIZE_M[ObjectType.VEHICLE][2]])
        np.testing.assert_allclose(tracks.position[0, 0, 2], MEDIAN_SIZE_M[ObjectType.VEHICLE][2] / 2)
        assert scenario.map_features.feature_type.tolist() == [2, 15]  # surface street, boundary
        return
    assert scenario.scenario_id == "0a1b"
    assert not differences(scenario.lights, expected.lights)
    assert not differences(scenario.map_features.feature_type, expected.map_features.feature_type)
    assert not differences(scenario.map_features.feature_id, expected.map_features.feature_id)
    np.testing.assert_array_equal(tracks.position[..., 2], logged.position[..., 2] * logged.valid)
    if form == "present":
        for field in ("tracks_to_predict", "difficulty", "objects_of_interest"):
            assert not differences(getattr(scenario, field), getattr(expected, field)), field
        assert not differences(tracks.object_id, logged.object_id)
    else:
        assert tracks.object_id.tolist() == list(range(8))
        assert scenario.tracks_to_predict.tolist() == [0, 2, 3, 4, 5, 6]  # of these that are always valid and move


def test_lights_come_at_the_steps_that_their_lists_name(make_message, tmp_path):
    scene = to_json(make_message())
    lane = scene["tl_states"]["7"]
    scene["tl_states"]["7"] = {name: values[12:20] for name, values in lane.items()}
    scene["tl_states"]["9"] = {name: values[15:16] for name, values in lane.items()}
    lights = read_scenario(write(tmp_path, scene))[0].lights
    assert lights.step.tolist() == [12, 13, 14, 15, 15, 16, 17, 18, 19]
    assert lights.lane_id.tolist() == [7, 7, 7, 7, 9, 7, 7, 7, 7]


def test_polygons_keep_their_precision_and_driveways_of_the_first_writers_are_driveways(make_message, tmp_path):
    scene = to_json(make_message())
    corner = {"x": 1000.123456789, "y": -200.5, "z": 3.0}
    polygon = [corner, {**corner, "x": 1010.0}, {**corner, "y": -190.0}]
    scene["roads"].append({"geometry": polygon, "type": "driveway", "map_element_id": -1, "id": 9})
    features = read_scenario(write(tmp_path, scene))[0].map_features
    assert features.feature_type[-1] == MapFeatureType.DRIVEWAY
    assert features.polygon(len(features) - 1)[0, 0] == pytest.approx(1000.123456789, abs=1e-8)


def test_files_are_recognized_by_what_is_in_them_and_a_tfrecord_becomes_a_shard(make_message, tmp_path, capsys):
    for number in range(3):
        folder = tmp_path / "in" / ("validation" if number < 2 else "training")
        path = write_file(folder, make_message(f"{number}"))
        if number:
            path.with_suffix(".json.gz").write_bytes(gzip.compress(path.read_bytes()))
            path.unlink()
    (tmp_path / "in" / "other.json").write_text("{}")
    assert GpudriveSource().detects(tmp_path / "in")
    assert not GpudriveSource().detects(tmp_path / "in" / "other.json")
    report = convert(tmp_path / "in", tmp_path / "out", jobs=1)
    assert report.counts == {"training": 1, "validation": 2}
    assert report.shards_written == 2 + 1  # one without a scenario
    assert [record.cause for record in report.skipped] == ["the file: no objects, not as GPUDrive writes files"]
    text = (tmp_path / "out" / "manifest.json").read_text()
    assert "Waymo" in text
    assert "speed limits" in text


def test_a_goal_that_is_not_the_last_position_is_counted(make_message, tmp_path):
    scene = to_json(make_message())
    scene["objects"][1]["goalPosition"]["x"] += 5.0
    write(tmp_path, scene)
    report = convert(tmp_path, tmp_path / "out", reader="gpudrive", jobs=1)
    assert sum(count for event, count in report.tallies.items() if "goalPosition" in event) == 1


@pytest.mark.parametrize(
    ("path", "value", "cause"),
    [
        (("objects",), [], "no objects"),
        (("objects", 0, "type"), "tank", "object 0: type is 'tank', none of unset, vehicle"),
        (("objects", 0, "id"), -1, "object 0: id is -1, no whole number"),
        (("objects", 0, "valid", 3), 1, "object 0: not 91 positions"),
        (("objects", 0, "heading"), [0.0], "object 0: not 91 positions"),
        (("objects", 0, "position", 5, "y"), "4", "object 0: position: not all are numbers"),
        (("objects", 0, "position", 5), {"x": 0.0}, "object 0: position: a point without x, y, z"),
        (("objects", 0, "width"), None, "object 0: length, width, height: not all are numbers"),
        (("objects", 2, "valid", 10), False, r"the ego \(track 102\) is not valid at the current step"),
        (("roads", 0, "type"), "moat", "road 0: type is 'moat', none of lane"),
        (("roads", 0, "map_element_id"), 15, "road 0: map_element_id is 15, which is no lane"),
        (("tl_states", "x"), {}, "light of lane 'x': the lane is no number"),
        (("tl_states", "7", "state", 0), "pink", "light of lane '7': state is 'pink'"),
        (("tl_states", "7", "time_index", 0), 91, "light of lane '7': time_index is 91"),
        (("tl_states", "7", "z"), [], "light of lane '7': its lists differ in length"),
        (("metadata", "sdc_track_index"), 3, "sdc_track_index is 3, no whole number below 3"),
        (("metadata",), [], r"the file: metadata is \[\]"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(make_message, tmp_path, path, value, cause):
    scene = to_json(make_message())
    inner = scene
    for step in path[:-1]:
        inner = inner[step]
    inner[path[-1]] = value
    with pytest.raises(DataError, match=cause) as info:
        read_scenario(write(tmp_path, scene))
    assert "\n" not in str(info.value)


def test_rollouts_go_back_into_files_that_hold_their_poses(make_message, make_tfrecord, tmp_path, capsys):
    message = make_message(num_tracks=4)
    for state in message.tracks[1].states[:11]:
        state.valid = False  # appears later: is not simulated
    make_tfrecord(tmp_path / "w.tfrecord", message)
    convert(tmp_path / "w.tfrecord", tmp_path / "data", split="validation", jobs=1)
    words = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "r"), "--num-rollouts", "2", "--device", "cpu"]
    assert main(["simulate", "constant_velocity", *words]) == 0
    out = tmp_path / "json"
    assert main(["export", "gpudrive", str(tmp_path / "r"), str(out), "--data", str(tmp_path / "data")]) == 0
    assert str(out / "tfrecord-0a1b_*.json") in capsys.readouterr().out
    files = sorted(out.iterdir())
    assert [file.name for file in files] == ["tfrecord-0a1b_0.json", "tfrecord-0a1b_1.json"]
    original = ScenarioDataset(tmp_path / "data")[0]
    with np.load(tmp_path / "r" / "0a1b.npz") as rollouts:
        for number, file in enumerate(files):
            stored, form, num_off = read_scenario(file)
            assert (form, num_off) == ("present", 0)
            assert stored.tracks.object_id.tolist() == rollouts["object_ids"].tolist() == [100, 102, 103]
            assert stored.tracks.object_id[stored.ego_index] == 103
            future = stored.tracks.position[:, CURRENT_STEP + 1 :]
            np.testing.assert_array_equal(future[..., 0], rollouts["x"][number])
            np.testing.assert_array_equal(future[..., 2], rollouts["z"][number])
            np.testing.assert_array_equal(stored.tracks.heading[:, CURRENT_STEP + 1 :], rollouts["heading"][number])
            np.testing.assert_allclose(stored.tracks.velocity[0, CURRENT_STEP + 1 :, 0], 1.0, atol=1e-3)
            for field in ("points", "feature_type", "feature_id"):
                np.testing.assert_array_equal(
                    getattr(stored.map_features, field), getattr(original.map_features, field)
                )
            np.testing.assert_array_equal(stored.lights.state, original.lights.state)
