import json
import shutil
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from rlftsim.errors import DataError
from rlftsim.scenario import dataset
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import (
    build_index,
    read_manifest,
    write_dataset,
    write_index_and_manifest,
)
from rlftsim.scenario.inspect import Problem, dataset_stats, find_problems, verify_dataset
from rlftsim.scenario.shards import check_scenario
from rlftsim.scenario.source import CONTRADICTORY
from rlftsim.scenario.types import Scenario
from rlftsim.scenario.womd import scenario_from_bytes
from scenes import without_ego


@pytest.fixture
def make_dataset(tmp_path):
    def make(*messages):
        folder = tmp_path / "data"
        write_dataset(
            [scenario_from_bytes(message.SerializeToString()) for message in messages], folder, split="training"
        )
        return folder

    return make


def found(folder):
    return [(finding.problem, finding.location) for finding in verify_dataset(folder)]


def test_nothing_is_found_in_a_sound_data_set(make_dataset, make_message):
    assert verify_dataset(make_dataset(make_message("a"), make_message("b", num_steps=11))) == []


def test_contradictory_lights_are_found_but_repeated_ones_are_not(make_dataset, make_message):
    contradicting, repeating = make_message("a"), make_message("b")
    contradicting.dynamic_map_states[3].lane_states.add(lane=7, state=4)
    repeating.dynamic_map_states[3].lane_states.add(lane=7, state=6)
    folder = make_dataset(contradicting, repeating)
    assert found(folder) == [(Problem.CONTRADICTORY_LIGHTS, "a")]
    assert "lane 7 has 2 different states at step 3" in verify_dataset(folder)[0].detail


def test_a_jump_between_valid_states_is_a_teleport(make_dataset, make_message):
    jumping, hidden = make_message("a"), make_message("b")
    for state in jumping.tracks[0].states[40:]:
        state.center_x += 6.0  # 6.1 m in 0.1 s
    for state in hidden.tracks[0].states[40:]:
        state.center_x += 6.0
    hidden.tracks[0].states[40].valid = False
    folder = make_dataset(jumping, hidden)
    assert found(folder) == [(Problem.TELEPORT, "a")]
    assert verify_dataset(folder)[0].detail == "track 100 moves 6.1 m from step 39 to 40"


def test_a_state_that_is_no_number_is_found_and_never_written(make_dataset, make_message, tmp_path, monkeypatch):
    scenario = scenario_from_bytes(make_message("a").SerializeToString())
    scenario.tracks.position[0, 30, 1] = float("nan")
    with pytest.raises(DataError, match="scenario a: track 100 has a NaN or infinite position at step 30"):
        write_dataset([scenario], tmp_path / "refused")
    assert not (tmp_path / "refused").exists()
    with monkeypatch.context() as other_writer:
        other_writer.setattr(Scenario, "check_finite_arrays", lambda _: None)
        write_dataset([scenario], tmp_path / "data")
    assert found(tmp_path / "data") == [(Problem.NOT_FINITE, "a")]
    (finding,) = verify_dataset(tmp_path / "data")
    assert str(finding).startswith("not finite: a: track 100 has a NaN or infinite position at step 30, ")
    assert str(finding).endswith("correct the value or mark the state as not valid")


def test_a_scenario_that_breaks_the_contract_is_found(make_message, tmp_path, monkeypatch):
    scenario = scenario_from_bytes(make_message("a").SerializeToString())
    with monkeypatch.context() as other_writer:
        other_writer.setattr(Scenario, "check_consistency", lambda _: None)
        write_dataset(
            [replace(scenario, tracks=replace(scenario.tracks, object_id=np.array([7, 7, 8])))], tmp_path / "data"
        )
    (finding,) = verify_dataset(tmp_path / "data")
    assert str(finding) == "broken scenario: a: object id 7 belongs to 2 tracks: give each its own"


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"timestamps_s": np.arange(91.0)}, "step 1 is 1.000 s after step 0 instead of 0.1 s: steps must be"),
        (
            {"tracks_to_predict": np.array([1, 1], np.int32), "difficulty": np.zeros(2, np.int8)},
            "tracks_to_predict names track index 1 2 times",
        ),
    ],
)
def test_a_time_base_and_ids_that_an_earlier_version_took_are_found(make_message, tmp_path, monkeypatch, change, cause):
    scenario = replace(scenario_from_bytes(make_message("a").SerializeToString()), **change)
    with pytest.raises(DataError, match=cause):
        write_dataset([scenario], tmp_path / "refused")
    with monkeypatch.context() as earlier_version:
        earlier_version.setattr(Scenario, "check_consistency", lambda _: None)
        write_dataset([scenario], tmp_path / "data")
    (finding,) = verify_dataset(tmp_path / "data")
    assert str(finding).startswith(f"broken scenario: a: {cause}")


def test_velocities_across_the_motion_are_counted_by_convert_and_found(make_message, make_tfrecord, tmp_path):
    across = make_message("a")
    for state in (state for track in across.tracks for state in track.states):
        state.velocity_x, state.velocity_y = 0.0, state.velocity_x
    make_tfrecord(tmp_path / "x.tfrecord", across, make_message("b"))
    report = convert(tmp_path / "x.tfrecord", tmp_path / "data", jobs=1, show_progress=False)
    assert report.converted == 2
    assert report.tallies == {CONTRADICTORY: 1}
    (finding,) = verify_dataset(tmp_path / "data")
    assert str(finding).startswith("contradictory motion: a: velocities contradict the change of positions in 2 of 2")


def test_a_map_in_another_frame_and_positions_beyond_float32_are_found(
    make_dataset, make_message, tmp_path, monkeypatch
):
    shifted = make_message("a")
    for state in (state for track in shifted.tracks for state in track.states):
        state.center_y += 5_000.0
    folder = make_dataset(shifted, make_message("b"))
    (finding,) = verify_dataset(folder)
    assert (finding.problem, finding.location) == (Problem.MAP_ELSEWHERE, "a")
    assert " m from the ego: give map and tracks the same origin" in finding.detail
    unknown = scenario_from_bytes(shifted.SerializeToString())  # the ego may be anywhere: nothing is known to be far
    unknown.tracks.valid[unknown.ego_index, 10] = False
    assert Problem.MAP_ELSEWHERE not in [finding.problem for finding in find_problems(unknown)]

    scenario = scenario_from_bytes(make_message("utm").SerializeToString())
    scenario.tracks.position[..., 1] += 4_649_000.0
    scenario.map_features.points[:, 1] += 4_649_000.0
    with monkeypatch.context() as other_writer:
        other_writer.setattr(Scenario, "check_precision", lambda _: None)
        write_dataset([scenario], tmp_path / "older")
    assert (Problem.FAR_FROM_ORIGIN, "utm") in found(tmp_path / "older")


def test_missing_map_and_no_agent_to_evaluate_are_found(make_dataset, make_message):
    no_map, no_edges, alone = make_message("a"), make_message("b"), make_message("c")
    no_map.ClearField("map_features")
    del no_edges.map_features[1]
    alone.tracks[0].states[10].valid = False
    folder = make_dataset(no_map, no_edges, alone)
    assert found(folder) == [
        (Problem.MISSING_MAP, "a"),
        (Problem.MISSING_MAP, "b"),
        (Problem.NO_EVALUATED_AGENTS, "c"),
    ]
    only_ego = "no track to predict is valid at the current step, only the ego is evaluated"
    details = [finding.detail for finding in verify_dataset(folder)]
    assert details == ["no map features", "no road edges", only_ego]
    # other sources may have an ego that is not valid either
    whole = scenario_from_bytes(make_message("d").SerializeToString())
    empty = replace(whole, tracks=replace(whole.tracks, valid=np.zeros_like(whole.tracks.valid)))
    (finding,) = find_problems(empty)
    assert finding.detail == only_ego.replace("only the ego is evaluated", "nor is the ego: nothing is evaluated")
    (finding,) = find_problems(without_ego())
    assert str(finding) == (
        "missing ego: no-ego: the ego (track 100) is not valid at the current step (10): no planner can drive it"
    )


def test_a_scenario_that_is_in_the_index_twice_is_found(make_dataset, make_message, monkeypatch):
    folder = make_dataset(make_message("a"), make_message("b"))
    entry = read_manifest(folder).shards[0]
    shutil.copy(folder / entry.file, folder / "shards" / "copy.arrow")
    with monkeypatch.context() as earlier_version:
        parts = [build_index(folder, [one])[0] for one in (entry, replace(entry, file="shards/copy.arrow"))]
        earlier_version.setattr(dataset, "build_index", lambda *_: (pa.concat_tables(parts), []))
        write_index_and_manifest(folder, [entry, replace(entry, file="shards/copy.arrow")])
    (finding,) = verify_dataset(folder)
    assert finding.problem == Problem.INDEX_MISMATCH
    places = "shards/00000.arrow and shards/copy.arrow"
    assert finding.detail.startswith(f"scenario a is in it from {places} (and 1 more): convert one of the sources ")
    # the same shards with an index of today
    write_index_and_manifest(folder, read_manifest(folder).shards)
    assert verify_dataset(folder) == []
    # another wording of the duplicates is no damage
    manifest = folder / "manifest.json"
    manifest.write_text(manifest.read_text().replace("the first is kept", "left out"))
    assert verify_dataset(folder) == []


def test_a_flipped_byte_and_a_missing_shard_are_found(make_dataset, make_message):
    folder = make_dataset(make_message("a"))
    shard = folder / "shards" / "00000.arrow"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    assert found(folder) == [(Problem.DAMAGED_SHARD, "shards/00000.arrow")]
    shard.unlink()
    assert found(folder) == [(Problem.MISSING_SHARD, "shards/00000.arrow")]


def test_an_index_of_another_data_set_is_found(make_dataset, make_message, tmp_path):
    folder = make_dataset(make_message("a"))
    other = scenario_from_bytes(make_message("b").SerializeToString())
    write_dataset([other], tmp_path / "other")
    (folder / "index.parquet").write_bytes((tmp_path / "other" / "index.parquet").read_bytes())
    assert found(folder) == [(Problem.INDEX_MISMATCH, "index.parquet")]


def test_wrong_counts_in_the_manifest_are_found(make_dataset, make_message):
    folder = make_dataset(make_message("a"))
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**manifest, "num_scenarios": 2}))
    assert found(folder) == [(Problem.INDEX_MISMATCH, "index.parquet")]


def test_an_unfinished_data_set_cannot_be_verified(tmp_path):
    with pytest.raises(DataError, match="is no data set"):
        verify_dataset(tmp_path)


def test_stats_count_scenarios_agents_and_lights(make_dataset, make_message):
    stats = dataset_stats(make_dataset(make_message("a"), make_message("b", lights=False, num_steps=11)))
    assert stats.num_scenarios == 2
    assert stats.by_split == {"training": 2}
    assert stats.by_num_steps == {11: 1, 91: 1}
    assert stats.agents_by_type == {"vehicles": 2, "pedestrians": 2, "cyclists": 2, "others": 0}
    assert (stats.mean_agents, stats.mean_evaluated, stats.percent_with_lights) == (3.0, 2.0, 50.0)


def test_stats_of_an_empty_data_set_are_zeros(tmp_path):
    (tmp_path / "empty").mkdir()
    write_index_and_manifest(tmp_path / "empty", [])  # as a conversion writes it that loses every record
    stats = dataset_stats(tmp_path / "empty")
    assert (stats.num_scenarios, stats.mean_agents) == (0, 0.0)


def test_timestamps_that_are_no_list_are_named(make_message):
    scenario = scenario_from_bytes(make_message("a").SerializeToString())
    object.__setattr__(scenario, "timestamps_s", None)  # as a damaged shard has them
    with pytest.raises(DataError, match="timestamps are None, not one number for each step"):
        scenario.check_consistency()


@pytest.mark.parametrize("name", ["tracks_to_predict", "difficulty", "objects_of_interest"])
@pytest.mark.parametrize("is_scalar", [False, True])
def test_lists_of_the_scenario_itself_are_lists(make_message, name, is_scalar):
    scenario = scenario_from_bytes(make_message("a").SerializeToString())
    value = getattr(scenario, name).sum(dtype=getattr(scenario, name).dtype) if is_scalar else None
    object.__setattr__(scenario, name, value)  # as a damaged shard has them
    with pytest.raises(DataError, match=rf"{name} is \S+, it must be a list of numbers"):
        check_scenario(scenario)
