"""Golden numbers of TrafficBots V1.5 and the scenarios and weights that they were computed with.

Everything here needs the official material.
"""

import json
import runpy
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest
import torch
from public_names import SMALL, golden_scene, our_weights
from safetensors.numpy import load_file

from golden_files import Golden
from rlftsim.policies.trafficbots.config import TrafficBotsConfig
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.policies.trafficbots.scene import Scene
from rlftsim.scenario.types import Scenario
from rlftsim.scenario.womd import read_scenarios

FILES = {"A": "motion_data_one_scenario.tfrecord", "B": "converted/eb4b91b10ca94ff2.tfrecord"}


@pytest.fixture(scope="session")
def golden(shared) -> Golden:
    return Golden(shared / "golden" / "trafficbots")


@pytest.fixture(scope="session")
def records(shared):
    """Scenarios "A" and "B" by name."""

    @cache
    def read(name: str) -> Scenario:
        return next(iter(read_scenarios(shared / "data" / "womd" / FILES[name])))

    return read


@pytest.fixture(scope="session")
def scene(golden) -> Callable[..., Scene]:
    """Scene "A" or "B" of the golden inputs, with its history or the whole log."""
    return cache(lambda name, prefix="hist": golden_scene(golden.arrays(f"scenario_{name}/inputs"), prefix))


@pytest.fixture(scope="session")
def small(golden) -> TrafficBotsPolicy:
    """The public code's `small` with the golden weights. Not to be changed: copy it."""
    policy = TrafficBotsPolicy(replace(SMALL, steps_per_pass=20)).eval()
    policy.network.load_state_dict(our_weights(load_file(golden.folder / "small_seed1003.safetensors")))
    return policy


@pytest.fixture(scope="session")
def default(golden) -> TrafficBotsPolicy:
    """The public code's default; its weights are drawn by the golden files' recipe."""
    recipe = runpy.run_path(str(golden.folder / "make_weights.py"))
    shapes = json.loads((golden.folder / "parameter_shapes.json").read_text())["default"]
    policy = TrafficBotsPolicy(TrafficBotsConfig()).eval()
    policy.network.load_state_dict(our_weights(recipe["make_weights"](shapes, "default", 1003)))
    return policy


@pytest.fixture
def without_gradients():
    """No gradients, but where a test switches them on."""
    with torch.no_grad():
        yield
