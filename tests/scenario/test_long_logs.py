"""Logs of another length than 9.1 s: made, stored, cut, batched, encoded, learned from."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import rlftsim as rs
import scenes
from rlftsim.errors import ConfigError
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.batch import collate
from rlftsim.scenario.synthetic import sumo
from rlftsim.scenario.synthetic.generate import SyntheticRequest, generate, plan_networks
from rlftsim.training.data import batch_with_futures


@pytest.fixture(scope="module")
def long_log(tmp_path_factory):
    if not sumo.is_available():
        pytest.skip("the extra `synthetic` is not installed")
    folder = tmp_path_factory.mktemp("long") / "data"
    generate(folder, num_scenarios=1, seed=900, num_steps=400, splits={"validation": 1.0}, show_progress=False)
    (scenario,) = rs.load_dataset(folder, "validation")
    return scenario


@pytest.mark.slow
def test_a_long_log_is_made_and_read_and_a_window_of_it_is_a_scenario(long_log):
    assert long_log.num_steps == 400
    assert long_log.tracks.valid[long_log.ego_index].all()
    enters = ~long_log.tracks.valid[:, 10] & long_log.tracks.valid.any(1)
    assert enters.any()  # traffic comes and goes
    window = long_log.window(200)
    assert window.num_steps == 91
    assert np.array_equal(window.tracks.position, long_log.tracks.position[:, 200:291])
    window.check_consistency()
    for lane in np.unique(window.lights.lane_id):
        now = window.lights.state[(window.lights.lane_id == lane) & (window.lights.step == 10)]
        logged = long_log.lights.state[(long_log.lights.lane_id == lane) & (long_log.lights.step == 210)]
        assert np.array_equal(now, logged)
    # rollouts read no more of it than the history
    short, whole = (rs.simulate("demo-base", log, num_rollouts=1, seed=1) for log in (long_log.window(0, 11), long_log))
    assert torch.equal(short.position, whole.position)
    assert float(rs.score(long_log, whole).meta_metric) == float(rs.score(long_log.window(0), whole).meta_metric)


def test_logs_of_different_lengths_share_a_batch_and_train_on_the_first_nine_seconds():
    short, log = scenes.straight_road(), scenes.bend()
    steps = np.arange(150).clip(max=90)
    names = ("position", "heading", "velocity", "size", "valid")
    tracks = replace(log.tracks, **{name: getattr(log.tracks, name)[:, steps] for name in names})
    long = replace(log, tracks=tracks, timestamps_s=np.round(np.arange(150) * 0.1, 1))
    assert collate([short, long]).valid.shape[2] == 150
    assert batch_with_futures([short, long], [0, 1]).valid.shape[2] == 91
    policy = load_policy("demo-base")
    alone, together = policy.encode(collate([long])), policy.encode(collate([log]))
    assert torch.equal(alone.features, together.features)


def test_long_data_sets_have_no_freeways_and_lengths_have_limits():
    kinds = {task.network_type for task in plan_networks(SyntheticRequest(200, 0, num_steps=700))}
    assert kinds == {"city", "quiet"}
    for steps in (90, 1201):
        with pytest.raises(ConfigError, match=r"last 9\.1 to 120 s"):
            SyntheticRequest(10, 0, num_steps=steps)
