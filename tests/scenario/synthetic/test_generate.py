"""Planning of networks, refusals, and, where SUMO is installed, a small generation."""

import numpy as np
import pytest

from rlftsim.errors import ConfigError, DataError
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.synthetic import sumo
from rlftsim.scenario.synthetic.generate import SyntheticRequest, generate, plan_networks

needs_sumo = pytest.mark.skipif(not sumo.is_available(), reason="the extra `synthetic` is not installed")


def test_networks_of_all_splits_differ_and_give_the_number_wanted():
    tasks = plan_networks(SyntheticRequest(num_scenarios=200, seed=5))
    assert len({task.seed for task in tasks}) == len(tasks) == 20
    assert sum(task.num_scenarios for task in tasks if task.split == "training") == 160
    assert sum(task.num_scenarios for task in tasks if task.split == "validation") == 40


def test_fractions_that_do_not_sum_to_one_are_refused():
    with pytest.raises(ConfigError, match="sum to 1"):
        SyntheticRequest(num_scenarios=10, seed=0, splits={"training": 0.5})


def test_missing_sumo_is_named_in_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(sumo.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r'pip install "rlftsim\[synthetic\]"'):
        generate(tmp_path / "new", num_scenarios=1, seed=0)


@needs_sumo
def test_a_folder_with_something_else_in_it_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match="not empty"):
        generate(tmp_path, num_scenarios=1, seed=0, show_progress=False)


@needs_sumo
@pytest.mark.slow
def test_the_same_seed_gives_the_same_tracks_and_another_seed_is_refused(tmp_path):
    arguments = {"num_scenarios": 2, "splits": {"training": 1.0}, "show_progress": False}
    generate(tmp_path / "one", seed=3, **arguments)
    generate(tmp_path / "two", seed=3, **arguments)
    first, second = ScenarioDataset(tmp_path / "one"), ScenarioDataset(tmp_path / "two")
    assert first.scenario_ids == second.scenario_ids
    for a, b in zip(first, second):
        np.testing.assert_array_equal(a.tracks.position, b.tracks.position)
        np.testing.assert_array_equal(a.map_features.points, b.map_features.points)
    with pytest.raises(DataError, match="other arguments"):
        generate(tmp_path / "one", seed=4, **arguments)
    # The same call once more finds everything done.
    assert generate(tmp_path / "one", seed=3, **arguments).num_scenarios == 2


@needs_sumo
@pytest.mark.slow
def test_an_interrupted_generation_goes_on(tmp_path, monkeypatch):
    from rlftsim.scenario.synthetic import generate as module

    arguments = {"num_scenarios": 4, "seed": 3, "splits": {"training": 1.0}, "scenarios_per_network": 2}
    write, calls = module._write_shard, []

    def write_once(shards, task, *worker):
        calls.append(task.index)
        if len(calls) == 2:
            raise KeyboardInterrupt
        write(shards, task, *worker)

    def write_again(shards, task, *worker):
        calls.append(task.index)
        write(shards, task, *worker)

    monkeypatch.setattr(module, "_write_shard", write_once)
    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path / "data", show_progress=False, **arguments)
    with pytest.raises(DataError, match="not finished"):
        ScenarioDataset(tmp_path / "data")
    monkeypatch.setattr(module, "_write_shard", write_again)
    assert generate(tmp_path / "data", show_progress=False, **arguments).num_scenarios == 4
    assert calls == [0, 1, 1]
