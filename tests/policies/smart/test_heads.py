"""Heads of each class, and continuation scores: routed by class, padded, saved, and unknown to the public code."""

from dataclasses import replace

import pytest
import torch

import scenes
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.smart.catk_checkpoint import write_catk
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.embeddings import NEVER, ClassHeads, ContinuationScores
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.trajtok import TrajTokConfig
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, PADDING_CLASS, class_of_type

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


# ---- continuation scores ---------------------------------------------------------------------------------------------

CONTINUING = replace(SMALL, head_per_class=False, continuation_scores=True)


@pytest.fixture(scope="module")
def continuing(batch):
    vocabulary = build_vocabulary(batch.scenarios, TokensConfig(num_tokens=48, num_map_prototypes=8))[0]
    torch.manual_seed(0)
    return SmartPolicy(CONTINUING, vocabulary).eval()


@pytest.fixture(scope="module")
def scores():
    torch.manual_seed(0)
    return ContinuationScores(8)


def scored(scores, hidden, last, class_id, ends):
    """Scores [R, V] of tokens with these ends; the last one led to `last`."""
    before = scores.keys(last.expand(3, -1, -1)).last_phase[class_id.clamp(max=2), torch.arange(len(last))]
    return scores.queries(hidden, before, class_id) @ scores.keys(ends).keys.mT


@torch.no_grad()
def test_a_token_is_scored_by_its_change_of_speed_and_where_it_turns(scores):
    ends, hidden, last = torch.randn(3, 20, 3), torch.randn(4, 8), torch.randn(4, 3)
    class_id = torch.tensor([2, 0, 1, PADDING_CLASS])
    found = scored(scores, hidden, last, class_id, ends)
    a, b = scores.query(hidden).chunk(2, -1)
    for row, index in enumerate(class_id.tolist()[:3]):
        length = CLASS_BOXES_M[index][0]
        along, across, turn = ends[index].unbind(-1)  # [V]
        change = torch.stack([(along - last[row, 0]) / length, across / length, turn], -1)
        angle = change[:, scores.axis] * scores.frequency
        expected = (a[row] * angle.cos() + b[row] * angle.sin()).sum(-1)
        torch.testing.assert_close(found[row], expected, atol=1e-4, rtol=0)
    assert not found[3].any()  # padding


@torch.no_grad()
def test_what_is_learned_at_one_speed_holds_at_any(scores):
    hidden, class_id = torch.randn(1, 8), torch.tensor([0])
    ends = torch.randn(3, 20, 3)
    slow, fast = torch.tensor([[1.0, 0.3, 0.1]]), torch.tensor([[15.0, -0.2, 0.2]])
    shifted = ends + (fast - slow) * torch.tensor([1.0, 0.0, 0.0])
    at_slow = scored(scores, hidden, slow, class_id, ends)
    at_fast = scored(scores, hidden, fast, class_id, shifted)
    torch.testing.assert_close(at_slow, at_fast, atol=1e-4, rtol=0)
    assert at_slow.std() > 0.1


@torch.no_grad()
def test_a_saved_model_with_continuation_scores_says_the_same(continuing, batch, tmp_path):
    continuing.save_pretrained(tmp_path)
    again = SmartPolicy.from_pretrained(tmp_path).eval()
    prediction, same = (p.teacher_forced(batch, batch.agent_mask).logits for p in (continuing, again))
    assert torch.equal(prediction, same)


def test_continuation_scores_are_fine_tuned_with_the_head(continuing):
    weight = continuing.network.decoder.scores.query.weight
    for parts in (continuing.fine_tuned_modules(), continuing.head_modules()):
        assert any(weight is one for part in parts for one in part.parameters())


def test_continuation_scores_need_one_head_for_all_classes_and_are_unknown_to_the_public_code(continuing, tmp_path):
    with pytest.raises(ConfigError, match=r"continuation_scores=True needs one head for all classes"):
        replace(CONTINUING, head_per_class=True)
    with pytest.raises(CheckpointError, match=r"continuation_scores has no form in the public CAT-K code"):
        write_catk(continuing, tmp_path / "out.safetensors")
