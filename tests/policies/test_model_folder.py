import json
import shutil

import pytest
import torch
from torch import nn

from rlftsim.errors import CheckpointError
from rlftsim.jobs.arrays import read_tensors
from rlftsim.jobs.files import save_tensors
from rlftsim.policies.checkpoint import SHIPPED_MODELS, load_strictly
from rlftsim.policies.registry import load_policy


@pytest.fixture(params=["demo-base", "trafficbots-base"])
def folder(request, tmp_path):
    return shutil.copytree(SHIPPED_MODELS / request.param, tmp_path / "model")


def set_values(folder, **values):
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


@pytest.mark.parametrize(("name", "value"), [("dim", 10**9), ("num_map_layers", 10**9), ("num_heads", 10**30)])
def test_sizes_that_no_model_has_are_refused(folder, name, value):
    set_values(folder, **{name: value})
    with pytest.raises(CheckpointError, match=rf"settings do not fit .*{name} must be at most"):
        load_policy(folder)


@pytest.mark.parametrize(("name", "value"), [("dim", 32_768), ("num_map_layers", 200)])
def test_sizes_other_than_the_weights_have_are_refused_before_anything_is_built(folder, name, value, monkeypatch):
    set_values(folder, **{name: value})
    monkeypatch.setattr(nn.Module, "load_state_dict", lambda *_: pytest.fail("the model was built"))
    with pytest.raises(CheckpointError, match="weights do not fit this model"):
        load_policy(folder)


@pytest.mark.parametrize("prefix", ["_orig_mod.", "module.", "module._orig_mod.", "_orig_mod.module."])
def test_weights_of_compiled_and_distributed_models_are_read(folder, prefix):
    weights, _ = read_tensors(folder / "model.safetensors", "")
    expected = load_policy(folder)
    save_tensors(folder / "model.safetensors", {prefix + name: value for name, value in weights.items()})
    loaded = load_policy(folder)
    assert all(torch.equal(value, expected.state_dict()[name]) for name, value in loaded.state_dict().items())


def test_a_prefix_that_is_a_part_of_the_names_stays():
    module = nn.ModuleDict({"module": nn.Linear(1, 1)})
    load_strictly(module, {"module.weight": torch.ones(1, 1), "module.bias": torch.ones(1)}, source="x")
    assert module["module"].bias.item() == 1.0


def test_whole_numbers_are_no_weights():
    with pytest.raises(CheckpointError, match=r"weight is torch\.int64 instead of torch\.float32"):
        load_strictly(nn.Linear(1, 1, bias=False), {"weight": torch.ones(1, 1, dtype=torch.int64)}, source="x")
