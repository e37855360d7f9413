"""Tokens of one vocabulary in the places of another one's."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch

import tiny
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.recipes.smart import smart_demo_rlftsim
from rlftsim.tokens.alignment import align_vocabulary
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.vocabulary import CLASS_NAMES, STILL_TOKEN, Vocabulary
from rlftsim.verbs.pretrain import ClassName

VEHICLE, PEDESTRIAN, CYCLIST = range(3)


@pytest.fixture(scope="module")
def vocabulary():
    return tiny.small_vocabulary(tiny.pack_scenarios(4))


def shuffled(vocabulary, seed=0):
    """The same tokens in other places; the one that stands still stays."""
    order = torch.randperm(vocabulary.num_tokens - 1, generator=torch.Generator().manual_seed(seed)) + 1
    order = torch.cat([torch.tensor([STILL_TOKEN]), order])
    return replace(vocabulary, corners=vocabulary.corners[:, order], token_mask=vocabulary.token_mask[:, order])


def test_the_same_tokens_return_to_their_places(vocabulary):
    found = align_vocabulary(shuffled(vocabulary), vocabulary)
    assert torch.equal(found.corners, vocabulary.corners)
    assert torch.equal(found.token_mask, vocabulary.token_mask)


def test_new_tokens_take_the_places_of_similar_ones_and_all_of_them_are_there(vocabulary):
    other = build_vocabulary(tiny.pack_scenarios(6)[2:], TokensConfig(num_tokens=40, num_map_prototypes=8))[0]
    found = align_vocabulary(other, vocabulary, keep=["vehicle"])
    assert torch.equal(found.corners[VEHICLE], vocabulary.corners[VEHICLE])
    assert torch.equal(found.map_prototypes, vocabulary.map_prototypes)
    for index in (PEDESTRIAN, CYCLIST):
        assert torch.equal(found.corners[index, STILL_TOKEN], vocabulary.corners[index, STILL_TOKEN])
        tokens = [{tuple(t.flatten().tolist()) for t in v.corners[index, v.token_mask[index]]} for v in (found, other)]
        assert tokens[0] == tokens[1]
        # nearer to the old tokens than when turned by one
        both = found.token_mask[index] & vocabulary.token_mask[index]

        def distance(corners, index=index, both=both):
            return float((corners - vocabulary.corners[index])[both].norm(dim=-1).sum())

        rows = both.nonzero()[1:, 0]
        turned = found.corners[index].clone()
        turned[rows] = turned[rows.roll(1)]
        assert distance(found.corners[index]) < distance(turned)


def test_more_tokens_than_places_are_refused(vocabulary):
    small = build_vocabulary(tiny.pack_scenarios(2), TokensConfig(num_tokens=12, num_map_prototypes=8))[0]
    with pytest.raises(ConfigError, match=r"\d+ vehicle tokens do not fit into the 12 places .*num-tokens"):
        align_vocabulary(vocabulary, small)
    with pytest.raises(ConfigError, match="no class 'tram': classes are vehicle, pedestrian, cyclist"):
        align_vocabulary(small, vocabulary, keep=["tram"])


def test_the_command_line_knows_all_classes():
    assert get_args(ClassName) == CLASS_NAMES


def test_a_model_with_a_head_for_each_class_keeps_its_tokens(vocabulary):
    config = replace(tiny.MODEL, head_per_class=True)
    recipe = replace(smart_demo_rlftsim(), model=config)
    with pytest.raises(ConfigError, match="a head of its own"):
        recipe.train_further(SmartPolicy(config, vocabulary), vocabulary)


def test_a_model_is_trained_further_with_tokens_of_other_data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    build = [
        "tokens",
        "--data",
        "synthetic",
        "--split",
        "validation",
        "--recipe",
        "smart-demo",
        "--out",
        "v.safetensors",
    ]
    assert main([*build, "--tokens.max-scenarios", "8"]) == 0
    words = [
        "pretrain",
        "smart-demo",
        "--data",
        "synthetic",
        "--init-from",
        "demo-base",
        "--vocabulary",
        "v.safetensors",
    ]
    words += ["--pretrain.epochs", "0.02", "--processes", "1", "--pretrain.validation.every", "0"]
    assert main([*words, "--keep-tokens", "vehicle", "--out", "run"]) == 0
    trained, base, new = load_policy("run"), load_policy("demo-base"), Vocabulary.load(Path("v.safetensors"))
    assert torch.equal(trained.vocabulary.corners[VEHICLE], base.vocabulary.corners[VEHICLE])
    assert trained.vocabulary.token_mask.sum(1)[1:].tolist() == new.token_mask.sum(1)[1:].tolist()
