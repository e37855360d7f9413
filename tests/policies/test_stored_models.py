"""Model folders that release 0.1 wrote: they open, with the same fingerprints, and simulate the same futures."""

import json
import tarfile
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from rlftsim.goals.logged import logged_goals
from rlftsim.policies.registry import load_policy, with_guidance
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import is_goal_conditioned
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset

STORED = Path(__file__).parents[1] / "data" / "stored_0_1"
EXPECTED = json.loads((STORED / "expected.json").read_text())
TOLERANCE_M = 1e-3
"""Of final positions: CPUs round differently, and a chosen token that differs would move them by decimeters."""


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("stored")
    with tarfile.open(STORED / "stored.tar.xz") as archive:
        archive.extractall(folder)
    return folder


def policy_of(stored, name):
    if name == "constant_velocity":
        return load_policy(name)
    model, _, scale = name.partition(", guided ")
    return with_guidance(load_policy(stored / "models" / model), float(scale or 1))


@pytest.mark.parametrize("name", EXPECTED["fingerprints"])
def test_fingerprints_are_those_of_0_1(name, stored):
    assert fingerprint_policy(policy_of(stored, name)) == EXPECTED["fingerprints"][name]


@pytest.mark.parametrize("name", EXPECTED["ends"])
def test_agents_end_where_they_did(name, stored):
    batch = collate([ScenarioDataset(stored / "data", "validation")[0]])
    policy = policy_of(stored, name)
    goals = logged_goals(batch) if is_goal_conditioned(policy) else None
    ends = simulate(policy, batch, num_rollouts=2, seed=7, goals=goals).position[0, :, :, -1]
    torch.testing.assert_close(ends, torch.tensor(EXPECTED["ends"][name]), atol=TOLERANCE_M, rtol=0)


@pytest.mark.parametrize("name", EXPECTED["ends"])
def test_saving_a_stored_model_again_changes_no_weight_and_names_its_architecture(name, stored, tmp_path):
    old = stored / "models" / name
    SmartPolicy.from_pretrained(str(old)).save_pretrained(tmp_path, card=(old / "README.md").read_text())
    for file in ("model.safetensors", "README.md"):
        assert (tmp_path / file).read_bytes() == (old / file).read_bytes(), file
    vocabularies = [load_file(folder / "vocabulary.safetensors") for folder in (old, tmp_path)]  # metadata in any order
    assert vocabularies[0].keys() == vocabularies[1].keys()
    assert all(value.equal(vocabularies[1][key]) for key, value in vocabularies[0].items())
    before, after = (json.loads((folder / "config.json").read_text()) for folder in (old, tmp_path))
    assert after.pop("architecture") == "smart"
    assert before.pop("format") == "rlftsim-smart-1"
    # later settings, which 0.1 did not have
    assert (after.pop("frequency_init"), after.pop("continuation_scores")) == ("normal", False)
    assert list(before.values()) == list(after.values())  # some fields have other names
    assert SmartPolicy.from_pretrained(tmp_path).config == SmartPolicy.from_pretrained(old).config
