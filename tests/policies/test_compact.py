"""A compact policy keeps the contract of policies, and is read back as it was written."""

from dataclasses import replace

import pytest
import torch

import scenes
import tiny
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.calibrated.features import FEATURES
from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.compact import CompactPolicy
from rlftsim.policies.smart.config import CompactConfig
from rlftsim.rollout.check import check_policy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate

SCENES = (scenes.bend(), scenes.bend("pair", 2), scenes.junction_with_light())
SMALL = CompactConfig(dim=8, hidden=16)


@pytest.fixture(scope="module")
def vocabulary():
    return tiny.small_vocabulary([*SCENES, scenes.crowd(num_agents=40)])


def compact(vocabulary, config=SMALL, seed=0):
    torch.manual_seed(seed)
    return CompactPolicy(config, vocabulary)


def test_a_compact_policy_keeps_the_contract(vocabulary):
    report = check_policy(compact(vocabulary), SCENES)
    assert report.is_passed, str(report)


def test_a_calibrated_compact_policy_keeps_the_contract(vocabulary):
    names = tuple(FEATURES.names())
    report = check_policy(CalibratedTokenPolicy(compact(vocabulary), names, [0.2] * len(names)), SCENES[:2])
    assert report.is_passed, str(report)


def test_a_student_of_512_tokens_has_at_most_65_000_weights(vocabulary):
    policy = compact(vocabulary, CompactConfig())
    spare = 512 - vocabulary.num_tokens
    assert sum(w.numel() for w in policy.parameters()) + spare * (policy.network.head.in_features + 1) == 63_200


def test_a_compact_policy_is_read_back_as_it_was_written(vocabulary, tmp_path):
    policy = compact(vocabulary).eval()
    policy.save_pretrained(tmp_path)
    stored = load_policy(tmp_path)
    assert fingerprint_policy(stored) == fingerprint_policy(policy)
    batch = collate(SCENES)
    first, second = (simulate(one, batch, num_rollouts=2, seed=1).position for one in (policy, stored))
    assert torch.equal(first, second)
    (tmp_path / "vocabulary.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"vocabulary\.safetensors is missing"):
        load_policy(tmp_path)


def test_lights_that_change_give_the_features_of_an_encoding_from_the_start(vocabulary):
    policy = compact(vocabulary).eval()
    batch = collate([scenes.straight_road(), scenes.junction_with_light()])  # red until step 50
    green = replace(batch, light_step=80)
    with torch.no_grad():
        red, fresh = policy.encode(batch), policy.encode(green).scene
        relit = policy.relight(red, green).scene
        assert torch.equal(relit.map_sources, fresh.map_sources)
        assert torch.equal(relit.lights.candidates, fresh.lights.candidates)
        changed = (relit.map_sources != red.scene.map_sources).any(-1).view(2, -1)
        assert not changed[0].any()
        assert 0 < changed[1].sum() < red.scene.tokens.token_mask[1].sum()
        assert policy.relight(red, batch).scene is red.scene


def test_nearest_map_tokens_are_those_of_all_tokens(vocabulary):
    batch = collate([scenes.junction_with_light(), scenes.bend()])
    scene = compact(vocabulary).encode(batch).scene
    generator = torch.Generator().manual_seed(0)
    scenario = torch.arange(200) % 2
    start = torch.randint(int(scene.tokens.token_mask.sum(1).min()), (200,), generator=generator)
    points = scene.tokens.position[scenario, start] + 8 * torch.randn(200, 2, generator=generator)
    index, mask = (values.mT for values in scene.grid.find_nearest(points[:, None], scenario, 5))
    positions = scene.tokens.position.masked_fill(~scene.tokens.token_mask[..., None], torch.inf)
    distance = (positions[scenario] - points[:, None]).norm(dim=-1)
    nearest = distance.topk(5, largest=False).values
    found = (scene.tokens.position.flatten(0, 1)[index] - points[:, None]).norm(dim=-1)
    found, order = found.sort()
    assert torch.equal(mask.gather(1, order), nearest < SMALL.map_radius_m)
    torch.testing.assert_close(found[mask.gather(1, order)], nearest[nearest < SMALL.map_radius_m])


def test_no_agent_without_a_map_or_alone_is_left_without_a_decision(vocabulary):
    policy = compact(vocabulary).eval()
    batch = collate([scenes.bend("alone", 1)])
    assert simulate(policy, batch, num_rollouts=2, seed=0).log_prob.isfinite().all()


@pytest.mark.parametrize("changes", [{"dim": 0}, {"map_radius_m": float("inf")}, {"max_lights": -1}])
def test_sizes_that_make_no_sense_are_refused(changes):
    with pytest.raises(ConfigError, match=next(iter(changes))):
        CompactConfig(**changes)


def test_a_scene_that_is_made_again_by_other_weights_is_that_of_these_weights(vocabulary):
    policy, other = compact(vocabulary).eval(), compact(vocabulary, seed=1).eval()
    batch = collate(SCENES)
    with torch.no_grad():
        again, fresh = other.encode_again(batch, policy.encode(batch)), other.encode(batch)
        first, second = (other.decide(c, other.begin(c, 2, None, torch.empty(0))).logits for c in (again, fresh))
    assert torch.equal(first, second)
