"""Models that ship with the package."""

import functools
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import rlftsim as rs
from rlftsim.errors import ConfigError
from rlftsim.policies import shipped
from rlftsim.policies.registry import POLICIES
from rlftsim.rollout.fingerprint import fingerprint_policy

FOLDER = Path(shipped.__file__).parent
MOST_BYTES = 4 << 20


@functools.cache
def score(name, limit):
    """RMM of the first scenarios, which several tests look at."""
    return rs.evaluate(name, rs.load_dataset("synthetic", "validation"), num_rollouts=4, limit=limit)["meta_metric"]


def test_the_shipped_base_is_more_realistic_than_constant_velocity():
    # Measured 0.79 and 0.51 on these three.
    assert np.mean(score("demo-base", 20)[:3]) > np.mean(score("constant_velocity", 8)[:3]) + 0.1


def test_the_shipped_trafficbots_is_more_realistic_than_constant_velocity():
    # Measured 0.67 and 0.58 on these eight.
    assert np.mean(score("trafficbots-base", 8)) > np.mean(score("constant_velocity", 8)) + 0.03


def test_the_shipped_tuned_model_is_more_realistic_than_its_base():
    # Measured +0.031 on these twenty, +0.019 on all forty with 32 rollouts.
    assert np.mean(score("demo-tuned", 20)) > np.mean(score("demo-base", 20))


def test_the_shipped_student_is_small_and_more_realistic_than_its_teachers_base():
    # Measured 0.783 on these twenty; its teacher, demo-tuned, has 0.792, demo-base 0.761.
    assert sum(weight.numel() for weight in rs.load_policy("demo-fast").parameters()) <= 65_000  # type: ignore[attr-defined]
    assert np.mean(score("demo-fast", 20)) > np.mean(score("demo-base", 20))


def test_a_copy_of_the_shipped_students_folder_is_the_same_model(tmp_path):
    shutil.copytree(FOLDER / "demo-fast", tmp_path / "copy")
    policies = rs.load_policy("demo-fast"), rs.load_policy(tmp_path / "copy")
    assert len({fingerprint_policy(policy) for policy in policies}) == 1


def test_shipped_weights_are_computed_with_in_float32():
    weights = list(rs.load_policy("demo-base").parameters())  # type: ignore[attr-defined]
    assert {weight.dtype for weight in weights} == {torch.float32}


def test_the_shipped_goal_model_follows_goals_and_is_the_base_model_without_them():
    data = rs.load_dataset("synthetic", "validation")
    scenario = data["9d639de83d6f5239"]
    base, goals = (rs.load_policy(name) for name in ("demo-base", "demo-goals"))
    free, same = (rs.simulate(policy, scenario, num_rollouts=4, seed=1).position for policy in (base, goals))
    assert torch.equal(free, same)
    # The ego's logged end, 8 s ahead.
    place = {scenario.scenario_id: {179: (-36.715, -2.361)}}
    led = rs.simulate(goals, scenario, num_rollouts=4, seed=1, goals=place).position
    track = int(np.flatnonzero(scenario.tracks.object_id[scenario.simulated_indices] == 179)[0])
    end = torch.as_tensor(np.array(place[scenario.scenario_id][179]) - scenario.origin, dtype=torch.float32)
    away = [(one[0, :, track, -1] - end).norm(dim=-1).median() for one in (free, led)]
    assert away[1] < 0.5 * away[0]


@pytest.mark.parametrize("name", ["demo-base", "demo-goals", "trafficbots-base"])
def test_from_pretrained_says_how_a_shipped_model_is_loaded(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=rf"^'{name}' is no folder but .*: rs.load_policy\('{name}'\) loads it\.$"):
        rs.SmartPolicy.from_pretrained(name)


def test_shipped_models_are_small_and_say_what_they_are():
    assert sum(file.stat().st_size for file in FOLDER.rglob("*") if file.is_file()) < MOST_BYTES
    folders = [path for path in FOLDER.iterdir() if any(path.glob("*.safetensors"))]
    assert folders
    for folder in folders:
        assert folder.name in POLICIES.names()
        assert "CC0" in (folder / "README.md").read_text()
