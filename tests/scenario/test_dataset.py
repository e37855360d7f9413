import errno
import gc
import json
import pickle
import weakref
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import scenes
from rlftsim.errors import DataError
from rlftsim.rollout.edge_scenes import move_scenario
from rlftsim.scenario.dataset import ScenarioDataset, read_manifest, write_dataset
from rlftsim.scenario.types import LaneTopology, cached_on_scenario
from rlftsim.scenario.womd import read_scenarios, scenario_from_bytes


@pytest.fixture
def scenarios(make_message):
    return [scenario_from_bytes(make_message(f"id{k}", num_tracks=1 + k).SerializeToString()) for k in range(5)]


@pytest.fixture
def folder(tmp_path, scenarios):
    split = {"id4": "validation"}
    write_dataset(scenarios, tmp_path / "data", split=lambda s: split.get(s.scenario_id, "training"))
    return tmp_path / "data"


def test_scenarios_come_back_bit_by_bit(folder, scenarios, differences):
    back = list(ScenarioDataset(folder))
    assert [difference for a, b in zip(scenarios, back, strict=True) for difference in differences(a, b)] == []


def test_odd_values_and_missing_tables_come_back(tmp_path, scenarios, differences):
    one = scenarios[2]
    position, valid = one.tracks.position.copy(), one.tracks.valid.copy()
    valid[0, 5:8] = False
    position[0, 5:8, 0] = np.nan, -0.0, -np.inf
    one = replace(
        one,
        tracks=replace(one.tracks, position=position, valid=valid),
        map_features=replace(one.map_features, topology=LaneTopology()),
    )
    write_dataset([one], tmp_path / "data")
    assert differences(one, ScenarioDataset(tmp_path / "data")[0]) == []


def test_the_rest_of_polygons_is_kept(tmp_path, scenarios, differences):
    one = next(iter(scenarios))
    rest = np.ones_like(one.map_features.points)
    one = replace(one, map_features=replace(one.map_features, polygon_rest=rest))
    write_dataset([one], tmp_path / "data")
    assert differences(one, ScenarioDataset(tmp_path / "data")[0]) == []


def test_scenarios_are_found_by_position_and_id(folder):
    dataset = ScenarioDataset(folder)
    assert len(dataset) == 5
    assert dataset.scenario_ids == ["id0", "id1", "id2", "id3", "id4"]
    assert dataset[-1] is dataset[4] is dataset["id4"] is dataset.by_id("id4")
    assert "id3" in dataset
    assert "id9" not in dataset
    with pytest.raises(DataError, match="no scenario 'id9'"):
        dataset["id9"]
    with pytest.raises(IndexError):
        dataset[5]


def test_a_folder_may_be_a_text_and_the_embedded_data_set_has_a_name(folder):
    assert ScenarioDataset(str(folder)).scenario_ids == ScenarioDataset(folder).scenario_ids
    assert len(ScenarioDataset("synthetic")) == 240
    assert read_manifest("synthetic").counts == {"testing": 40, "training": 160, "validation": 40}


def test_a_split_shows_only_its_scenarios(folder):
    dataset = ScenarioDataset(folder, "validation")
    assert dataset.scenario_ids == [dataset[0].scenario_id] == ["id4"]
    assert dataset.index["split"].to_pylist() == ["validation"]
    with pytest.raises(DataError, match="no split 'testing', only training, validation"):
        ScenarioDataset(folder, "testing")


def test_the_same_object_comes_back_while_it_is_cached(folder):
    dataset = ScenarioDataset(folder, cache_size=2)
    first, second = dataset[0], dataset[1]
    assert dataset[0] is first
    dataset[2]  # pushes out the least recently used one: 1
    assert dataset[0] is first
    assert dataset[1] is not second


def test_many_scenarios_are_spread_over_shards(tmp_path, scenarios):
    write_dataset(iter(scenarios), tmp_path / "data", scenarios_per_shard=2)
    dataset = ScenarioDataset(tmp_path / "data")
    assert [entry.num_rows for entry in dataset.manifest.shards] == [2, 2, 1]
    assert [scenario.scenario_id for scenario in dataset] == dataset.scenario_ids == ["id0", "id1", "id2", "id3", "id4"]


def test_the_manifest_says_where_the_data_comes_from(tmp_path, scenarios):
    write_dataset(scenarios, tmp_path / "data", license_note="CC0", provenance={"seed": 3})
    manifest = json.loads((tmp_path / "data" / "manifest.json").read_text())
    assert manifest["license_note"] == "CC0"
    assert manifest["provenance"] == {"seed": 3}
    assert manifest["counts"] == {"unknown": 5}


def test_the_same_scenarios_give_the_same_bytes(tmp_path, scenarios):
    for name in ("a", "b"):
        write_dataset(scenarios, tmp_path / name)
    for path in (tmp_path / "a").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


def test_the_fingerprint_is_that_of_the_content_of_a_split(tmp_path, scenarios):
    moved = [*scenarios[:3], move_scenario(scenarios[3], 0.0, (0.0, 0.5))]
    for name, some in {"first": scenarios[:4], "elsewhere": scenarios[:4], "grown": scenarios, "moved": moved}.items():
        write_dataset(
            some,
            tmp_path / name,
            split=lambda s: "validation" if s.scenario_id == "id4" else "training",
            scenarios_per_shard=4,
        )
    found = {name: ScenarioDataset(tmp_path / name, "training") for name in ("first", "elsewhere", "grown", "moved")}
    first, elsewhere, grown, other = (one.fingerprint for one in found.values())
    assert first == elsewhere == grown  # of another split no file has a part in it
    assert first != other
    assert found["first"].manifest.index_sha256 == found["moved"].manifest.index_sha256  # an index has no poses


def test_another_process_can_open_the_data_set_again(folder):
    again = pickle.loads(pickle.dumps(ScenarioDataset(folder, "training")))
    assert again.scenario_ids == ["id0", "id1", "id2", "id3"]


def test_an_error_while_writing_leaves_nothing(tmp_path, scenarios):
    with pytest.raises(DataError, match="id0 is in the data set already"):
        write_dataset([*scenarios, scenarios[0]], tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_not_overwritten(folder, scenarios):
    with pytest.raises(DataError, match="not an empty folder"):
        write_dataset(scenarios, folder)


def test_a_full_disk_leaves_no_half_a_data_set(tmp_path, scenarios, monkeypatch):
    def full(self, batch):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pyarrow.ipc.RecordBatchFileWriter.write_batch", full)
    with pytest.raises(DataError, match=r"cannot write .*00000\.arrow \(No space left on device\): make room"):
        write_dataset(scenarios, tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("field", ["position", "heading", "velocity", "size"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_valid_state_that_is_no_number_is_refused_by_name(tmp_path, scenarios, field, value):
    getattr(scenarios[1].tracks, field)[1, 30] = value
    way_out = "correct the value or mark the state as not valid"
    with pytest.raises(
        DataError, match=rf"scenario id1: track 101 has a NaN or infinite {field} at step 30, .*{way_out}"
    ):
        write_dataset(scenarios, tmp_path / "data")
    scenarios[1].tracks.valid[1, 30] = False
    write_dataset(scenarios, tmp_path / "data")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenario_id": 5}, "scenario id 5 is no file name, .*: write it as text"),
        ({"scenario_id": "x" * 300}, "scenario id 'x.* is no file name, .*: write it as text of at most 200 bytes"),
        ({"ego_index": -1}, "scenario id1: ego_index names track index -1, but there are 2 tracks"),
        ({"ego_index": 999}, "scenario id1: ego_index names track index 999, but there are 2 tracks"),
        ({"tracks_to_predict": np.array([2], np.int32)}, "tracks_to_predict names track index 2, but there are 2"),
        ({"object_id": np.array([7, 7])}, "object id 7 belongs to 2 tracks"),
        ({"object_type": np.array([1, 9], np.int8)}, "track 101: type 9 is none of 0 unset, 1 vehicle"),
        ({"size": np.full((2, 91, 3), (4, 0, 2), np.float32)}, "track 100: width is 0 at the current step"),
        ({"size": np.full((2, 91, 3), (4, 2, -1), np.float32)}, "track 100: height is -1 at the current step"),
    ],
)
def test_a_scenario_that_breaks_the_contract_is_refused(tmp_path, scenarios, changes, message):
    scenario, tracks = replace(scenarios[1]), replace(scenarios[1].tracks)
    object.__setattr__(scenario, "tracks", tracks)
    for name, value in changes.items():  # past run-time checks of types
        object.__setattr__(tracks if hasattr(tracks, name) else scenario, name, value)
    with pytest.raises(DataError, match=message):
        write_dataset([scenario], tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_a_size_of_zero_is_fine_where_a_track_is_not_valid_now(tmp_path, scenarios):
    scenarios[1].tracks.size[0, 10] = 0
    scenarios[1].tracks.valid[0, 10] = False
    scenarios[1].tracks.size[1, 11:] = 0
    assert write_dataset(scenarios, tmp_path / "data").num_scenarios == 5


@pytest.mark.parametrize(("far_m", "is_refused"), [(1e5, False), (2e5, True), (1e7, True)])
def test_positions_where_float32_is_coarse_are_refused(tmp_path, far_m, is_refused):
    moved = move_scenario(scenes.lone_agent(), 0.0, (far_m, 0.0))
    refused = pytest.raises(DataError, match=r"float32 resolves [\d.]+ m: subtract an origin")
    with refused if is_refused else nullcontext():
        write_dataset([moved], tmp_path / "data")


def test_a_wrong_dtype_is_refused_before_it_is_written(tmp_path, scenarios):
    tracks = replace(scenarios[0].tracks)
    object.__setattr__(tracks, "heading", tracks.heading.astype(np.float64))  # past run-time checks of types
    with pytest.raises(DataError, match=r"id0: tracks\.heading is float64, it must be float32"):
        write_dataset([replace(scenarios[0], tracks=tracks)], tmp_path / "data")


def shard_of(folder):
    (path,) = (folder / "shards").glob("*.arrow")
    return path


def test_a_flipped_byte_in_a_shard_is_found_when_its_row_is_read(folder):
    path = shard_of(folder)
    data = bytearray(path.read_bytes())
    for offset in range(len(data) // 2, len(data) // 2 + 64, 8):
        data[offset] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"shard .*00000\.arrow.* damaged .*: delete the file and run"):
        list(ScenarioDataset(folder))


def test_a_wrong_offset_in_a_shard_is_refused_instead_of_followed_out_of_the_file(folder):
    path = shard_of(folder)
    data = bytearray(path.read_bytes())
    table = pa.ipc.open_file(pa.BufferReader(bytes(data))).read_all()
    offsets = bytes(table["tracks.position.x"].chunk(0).buffers()[1])[:8]
    data[data.find(offsets) + 7] = 0xFF  # the second offset becomes negative
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"00000\.arrow is damaged .*: delete the file and run") as error:
        ScenarioDataset(folder)[0]
    assert "\n" not in str(error.value)


def test_an_index_that_names_another_row_is_refused(folder):
    table = pq.read_table(folder / "index.parquet")
    rows = pa.array([99] * len(table), pa.int32())
    pq.write_table(table.set_column(table.schema.get_field_index("row"), "row", rows), folder / "index.parquet")
    with pytest.raises(DataError, match="row 99 is damaged"):
        ScenarioDataset(folder)[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"num_scenarios": "two"}, "num_scenarios must be a whole number|Type-check error"),
        ({"counts": [1]}, "counts are no whole numbers by name|Type-check error"),
        ({"duplicates": [3]}, "is damaged"),
    ],
)
def test_a_manifest_of_other_types_is_refused(folder, change, words):
    values = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**values, **change}))
    with pytest.raises(DataError, match=words):
        ScenarioDataset(folder)


def test_a_shard_outside_the_folder_is_refused(folder):
    values = json.loads((folder / "manifest.json").read_text())
    values["shards"][0]["file"] = "../../other.arrow"
    (folder / "manifest.json").write_text(json.dumps(values))
    with pytest.raises(DataError, match="leads out of the folder"):
        ScenarioDataset(folder)


def test_a_truncated_shard_is_refused(folder):
    path = shard_of(folder)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match=r"00000\.arrow is damaged"):
        ScenarioDataset(folder)[0]


def test_a_missing_shard_is_named(folder):
    shard_of(folder).unlink()
    with pytest.raises(DataError, match=r"00000\.arrow is missing: run the conversion or generation that made it"):
        ScenarioDataset(folder)[0]


@pytest.mark.parametrize(
    ("file", "content", "cause"),
    [
        ("manifest.json", b"{", "not JSON, line 1"),
        ("manifest.json", b"[]", "holds a list instead of an object"),
        ("manifest.json", b'{"format": "rlftsim scenarios", "schema_version": 99}', "schema version 99"),
        ("manifest.json", b'{"format": "rlftsim scenarios", "schema_version": 1}', "is damaged"),
        ("index.parquet", b"nonsense", "cannot be read"),
        ("INCOMPLETE", b"", "was not finished"),
    ],
)
def test_damage_around_the_shards_is_refused(folder, file, content, cause):
    (folder / file).write_bytes(content)
    with pytest.raises(DataError, match=cause):
        ScenarioDataset(folder)


def test_a_folder_without_a_data_set_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"is no data set: it has no manifest\.json; name a folder"):
        ScenarioDataset(tmp_path)
    (tmp_path / "training").mkdir()
    source = tmp_path / "training" / "a.tfrecord-00000-of-00001"
    source.write_bytes(b"x")
    with pytest.raises(DataError, match="its tfrecord files have to be converted first"):
        ScenarioDataset(tmp_path)
    with pytest.raises(DataError, match=r"of-00001 is a file: convert it with `rlftsim convert`"):
        ScenarioDataset(source)
    with pytest.raises(DataError, match=r"no such folder$"):
        ScenarioDataset(tmp_path / "none")
    with pytest.raises(DataError, match="did you mean 'synthetic'"):
        ScenarioDataset("syntetic")


def test_the_home_folder_may_be_written_as_a_tilde(folder, monkeypatch):
    monkeypatch.setenv("HOME", str(folder.parent))
    assert len(ScenarioDataset(f"~/{folder.name}")) == len(ScenarioDataset(folder))


@pytest.mark.official
def test_every_official_scenario_comes_back_bit_by_bit_and_small(shared, tmp_path, differences):
    scenarios = list(read_scenarios(shared / "data/womd"))
    write_dataset(scenarios, tmp_path / "data")
    dataset = ScenarioDataset(tmp_path / "data")
    assert [difference for a, b in zip(scenarios, dataset, strict=True) for difference in differences(a, b)] == []
    size = sum(path.stat().st_size for path in (tmp_path / "data").rglob("*.*") if path.is_file())
    assert size / len(scenarios) < 120_000


def test_values_cached_on_a_scenario_go_with_it_and_are_not_pickled():
    @cached_on_scenario
    def neighbors(scenario):
        return [scenario]  # refers to the scenario

    drawn = scenes.straight_road("a")
    assert neighbors(drawn) is neighbors(drawn)
    copied = pickle.loads(pickle.dumps(drawn))
    assert neighbors(copied) == [copied]
    reference = weakref.ref(drawn)
    del drawn
    gc.collect()
    assert reference() is None
