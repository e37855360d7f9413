"""A head for each class: routed by class, padded, saved, and unknown to the public code."""

from dataclasses import replace

import pytest
import torch

import scenes
from rlftsim.errors import CheckpointError
from rlftsim.policies.smart.catk_checkpoint import write_catk
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.heads import NEVER, ClassHeads
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.trajtok import TrajTokConfig
from rlftsim.tokens.vocabulary import class_of_type

SMALL = SmartConfig(
    dim=16, num_heads=2, head_dim=8, num_map_layers=1, num_decoder_layers=1, num_frequencies=4,
    dropout=0.0, history_drop=0.0, head_per_class=True,
    max_map_neighbors=4, max_agent_map_neighbors=6, max_agent_neighbors=6,
)  # fmt: skip


@pytest.fixture(scope="module")
def batch():
    return collate([scenes.crowd(num_agents=12), scenes.bend()])


@pytest.fixture(scope="module")
def policy(batch):
    """By TrajTok's rule classes have sizes of their own."""
    config = TokensConfig(kind="trajtok", num_map_prototypes=8, trajtok=TrajTokConfig(num_neighbors=0))
    vocabulary = build_vocabulary(batch.scenarios, config)[0]
    assert len(set(vocabulary.token_mask.sum(1).tolist())) > 1
    torch.manual_seed(0)
    return SmartPolicy(SMALL, vocabulary).eval()


def test_features_go_through_the_head_of_their_class():
    torch.manual_seed(0)
    heads = ClassHeads(8, (5, 2, 3), 6)
    features, class_id = torch.randn(7, 8), torch.tensor([2, 0, 1, 1, 0, 2, 0])
    logits = heads(features, class_id)
    assert logits.shape == (7, 6)
    for row, index in enumerate(class_id.tolist()):
        size = (5, 2, 3)[index]
        torch.testing.assert_close(logits[row, :size], heads[index](features[row]))
        assert (logits[row, size:] == NEVER).all()


def test_only_the_heads_of_classes_that_are_there_learn():
    heads = ClassHeads(8, (5, 2, 3), 5)
    heads(torch.randn(4, 8), torch.tensor([0, 0, 2, 0])).clamp(min=-10).sum().backward()
    changed = [bool(sum(p.grad.abs().sum() for p in head.parameters())) for head in heads]
    assert changed == [True, False, True]


@torch.no_grad()
def test_agents_decide_among_the_tokens_of_their_class(policy, batch):
    rollouts = simulate(policy, batch, num_rollouts=2, seed=1)
    sizes = policy.vocabulary.token_mask.sum(1)[class_of_type(batch.object_type)]
    assert (rollouts.decision < sizes[:, None, :, None]).all()
    scored = policy.score(policy.encode(batch), rollouts).log_prob(rollouts.decision)
    torch.testing.assert_close(scored, rollouts.log_prob, atol=1e-4, rtol=0)


@torch.no_grad()
def test_a_saved_model_says_the_same(policy, batch, tmp_path):
    policy.save_pretrained(tmp_path)
    again = SmartPolicy.from_pretrained(tmp_path).eval()
    assert again.config.head_per_class
    prediction, same = (p.teacher_forced(batch, batch.agent_mask).logits for p in (policy, again))
    assert torch.equal(prediction, same)


def test_weights_with_a_shared_head_are_refused(policy, tmp_path):
    SmartPolicy(replace(SMALL, head_per_class=False), policy.vocabulary).save_pretrained(tmp_path)
    config = tmp_path / "config.json"
    config.write_text(config.read_text().replace('"head_per_class": false', '"head_per_class": true'))
    with pytest.raises(CheckpointError, match=r"missing decoder.head.0.0.weight"):
        SmartPolicy.from_pretrained(tmp_path)


def test_the_public_code_has_no_form_for_it(policy, tmp_path):
    with pytest.raises(CheckpointError, match=r"head_per_class has no form in the public CAT-K code"):
        write_catk(policy, tmp_path / "out.safetensors")
    assert not list(tmp_path.iterdir())
