"""Clusters of scenarios, and the splits tune and exam that are drawn by them."""

import json
import shutil
from dataclasses import replace

import pytest

import scenes
from rlftsim.errors import DataError
from rlftsim.scenario.dataset import MANIFEST, ScenarioDataset, is_in_exam, write_dataset
from rlftsim.scenario.synthetic import pack_path

EXAM_LOGS = [8, 9, 13, 15, 19, 21]


def written(folder, ids, source="womd", split="validation"):
    """A data set of one scene under several ids."""
    scene = scenes.straight_road()
    write_dataset([replace(scene, scenario_id=i, source=source) for i in ids], folder, split=split)
    return folder


def test_synthetic_scenarios_are_of_the_networks_of_their_shards():
    held_out = ScenarioDataset("synthetic", "validation")
    assert len(held_out) == len(held_out.clusters) == 40
    assert sorted(set(held_out.clusters)) == ["2026/1/0", "2026/1/1", "2026/1/2", "2026/1/3"]
    assert len(set(ScenarioDataset("synthetic").clusters)) == 60


def test_windows_of_a_recording_are_one_cluster_and_other_scenarios_are_their_own(tmp_path):
    recordings = written(tmp_path / "av2", ["r1-0", "r1-19", "r2-0"], source="av2")
    assert ScenarioDataset(recordings).clusters.tolist() == ["r1", "r1", "r2"]
    assert ScenarioDataset(written(tmp_path / "womd", ["r1-0", "r1-19"])).clusters.tolist() == ["r1-0", "r1-19"]


def test_a_fixed_third_of_the_held_out_recordings_is_the_exam(tmp_path):
    ids = [f"log{k}" for k in range(60)]
    folder = written(tmp_path / "a", ids)
    exam, tune = (ScenarioDataset(folder, split).scenario_ids for split in ("exam", "tune"))
    assert sorted(exam + tune) == sorted(ids)
    assert 10 <= len(exam) <= 30
    # of other data the same scenarios: who adds logs moves none from one split to the other
    more = written(tmp_path / "b", [*ids[::-1], "log60", "log61"])
    assert set(exam) <= set(ScenarioDataset(more, "exam").scenario_ids)
    assert set(tune) <= set(ScenarioDataset(more, "tune").scenario_ids)
    # both windows of a recording are on one side
    windows = written(tmp_path / "av2", [f"{i}-{first}" for i in ids for first in (0, 19)], source="av2")
    assert ScenarioDataset(windows, "exam").scenario_ids == [f"{i}-{first}" for i in exam for first in (0, 19)]
    # never changes: choices of years depend on it
    assert [k for k in range(24) if is_in_exam(f"log{k}")] == EXAM_LOGS


def test_of_generated_scenarios_tune_is_all_of_validation_and_the_exam_is_made_elsewhere(tmp_path):
    assert ScenarioDataset("synthetic", "tune").scenario_ids == ScenarioDataset("synthetic", "validation").scenario_ids
    with pytest.raises(DataError, match="has no split 'exam'"):
        ScenarioDataset("synthetic", "exam")


def test_stored_splits_of_these_names_are_taken_as_they_are(tmp_path):
    folder = written(tmp_path / "a", ["x", "y", "z"], split="exam")
    assert ScenarioDataset(folder, "exam").scenario_ids == ["x", "y", "z"]
    with pytest.raises(DataError, match="has no split 'tune'"):
        ScenarioDataset(folder, "tune")


def test_a_manifest_without_its_networks_is_called_damaged(tmp_path):
    folder = shutil.copytree(pack_path(), tmp_path / "pack")
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["provenance"]["networks"] = [{"shard": 3}]
    (folder / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(DataError, match="list of networks is damaged"):
        _ = ScenarioDataset(folder).clusters
