"""Scenario A, its golden numbers and the model that they were computed with.

Everything here needs the official material.
"""

import json
import runpy
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors.numpy import save_file

from golden_files import Golden
from rlftsim.policies.smart.catk_checkpoint import import_catk
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.policy import Sampling
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import Scenario
from rlftsim.scenario.womd import read_scenarios

FRAMES = {"centred": "map", "absolute": "world"}
"""Our name of each frame of the golden files."""


@pytest.fixture(scope="session")
def golden(shared) -> Golden:
    return Golden(shared / "golden" / "smart")


@pytest.fixture(scope="session")
def token_tables(shared) -> list[Path]:
    return [shared / "data" / "tokens" / name for name in ("agent_vocab_555_s2.npz", "map_traj_token5.npz")]


@pytest.fixture(scope="session")
def record(shared) -> Path:
    return shared / "data" / "womd" / "motion_data_one_scenario.tfrecord"


@pytest.fixture(scope="session")
def scenario_a(record) -> Scenario:
    return next(iter(read_scenarios(record)))


@pytest.fixture(scope="session")
def batch_a(scenario_a, golden) -> Callable[[str], ScenarioBatch]:
    """Scenario A in a frame ("centred" or "absolute").

    The public code feeds the mean size over all logged steps, the future included; here a model has the size at
    the current step.
    """
    shape = torch.from_numpy(golden.arrays("scenario_A/preprocessed")["shape"])[None]
    return cache(lambda frame: replace(collate([scenario_a], frame=FRAMES[frame]), size=shape))


@pytest.fixture(scope="session")
def nano(golden, token_tables) -> SmartPolicy:
    """The public code's nano with the golden weights. Not to be changed: copy it."""
    return whole_softmax(import_catk(golden.folder / "nano_seed1003_lightning.ckpt", token_tables).policy)


@pytest.fixture(scope="session")
def tiny(golden, token_tables, tmp_path_factory) -> SmartPolicy:
    """The public code's tiny; its weights are drawn by the golden files' recipe."""
    recipe = runpy.run_path(str(golden.folder / "make_weights.py"))
    shapes = json.loads((golden.folder / "state_dict_shapes.json").read_text())["tiny"]
    path = tmp_path_factory.mktemp("tiny") / "tiny.safetensors"
    save_file(recipe["make_weights"](shapes, 1003), path)
    return whole_softmax(import_catk(path, token_tables).policy)


def whole_softmax(policy):
    """The model without the sampling of the public code's validation: reference numbers are of the whole softmax."""
    policy.sampling = Sampling()
    return policy
