"""Rollouts of another length than the metric's 8 seconds."""

import json

import numpy as np
import pytest
import torch

import rlftsim as rs
import scenes
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.open import to_scenarios


@pytest.fixture(scope="module")
def scenario():
    return to_scenarios("synthetic", "validation")[0]


@pytest.mark.parametrize("name", ["demo-base", "constant_velocity"])
def test_a_longer_rollout_begins_as_a_shorter_one_does(name, scenario):
    lengths = {seconds: rs.simulate(name, scenario, num_rollouts=2, seconds=seconds) for seconds in (4.0, 8.0, 20.0)}
    assert lengths[20.0].position.shape[3] == 200
    assert lengths[20.0].position.isfinite().all()
    for seconds in (4.0, 8.0):
        for field in ("position", "heading", "decision", "log_prob"):
            shorter, longer = (getattr(lengths[key], field) for key in (seconds, 20.0))
            assert torch.equal(shorter, longer[:, :, :, : shorter.shape[3]]), field
    # the noise goes on: it does not begin again after 8 s
    decision = lengths[20.0].decision
    assert name == "constant_velocity" or not torch.equal(decision[..., :16], decision[..., 16:32])


def test_a_model_holds_no_more_steps_than_it_looks_back(scenario):
    policy, columns = load_policy("demo-base"), []

    def watch(state, step):
        columns.append((state.past.row.shape[-1], len(state.past.sources[0])))

    simulate(policy, collate([scenario]), num_rollouts=2, seed=0, num_steps=200, force=watch)
    (most_steps, most_rows), later = np.max(columns[:16], 0), np.max(columns[16:], 0)
    assert later[0] <= most_steps
    assert later[1] <= most_rows


def test_trafficbots_goes_on_with_the_lights_of_the_eighth_second():
    batch = collate([scenes.junction_with_light()])
    rollouts = simulate(load_policy("trafficbots-base"), batch, num_rollouts=1, seed=0, num_steps=90)
    assert rollouts.position.shape[3] == 90
    assert rollouts.position.isfinite().all()


def test_other_lengths_are_refused_in_one_line(scenario):
    with pytest.raises(ConfigError, match=r"for 0\.5 s at a time: seconds must be a multiple, got 7\.3"):
        rs.simulate("demo-base", scenario, num_rollouts=1, seconds=7.3)
    with pytest.raises(ConfigError, match=r"seconds must be a multiple of 0\.1 above 0"):
        rs.simulate("demo-base", scenario, num_rollouts=1, seconds=0.0)
    ego = int(scenario.tracks.object_id[scenario.ego_index])
    goals = {ego: tuple((scenario.origin + 10).tolist())}
    with pytest.raises(ConfigError, match="goals are due after 80 steps, not after 100"):
        rs.simulate("demo-goals", scenario, num_rollouts=1, seconds=10.0, goals=goals)
    with pytest.raises(DataError, match="compares 80 steps, these rollouts have 100"):
        rs.score(scenario, rs.simulate("constant_velocity", scenario, num_rollouts=1, seconds=10.0))


def test_files_of_long_rollouts_play_and_are_not_scored(scenario, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--data", "synthetic", "--scenario", scenario.scenario_id, "--num-rollouts", "1", "--out", str(out)]
    assert main(["simulate", "constant_velocity", *options, "--seconds", "12", "--export", "page"]) == 0
    page = (out / f"{scenario.scenario_id}.html").read_text()
    assert '"steps":131' in page.replace(" ", "")
    with np.load(out / f"{scenario.scenario_id}.npz") as arrays:
        assert arrays["x"].shape[2] == 120
    assert json.loads((out / "rollouts.json").read_text())["num_steps"] == 120
    assert main(["score", str(out), "--data", "synthetic"]) != 0
    assert "rollouts of 12 s (120 steps), where 8 s are compared with the log" in capsys.readouterr().err
    assert main(["simulate", "constant_velocity", *options]) != 0  # 8 s, in a folder of 12 s
    assert "another num_steps" in capsys.readouterr().err
