"""A head for each class, and keys of tokens: routed by class, padded, saved, and unknown to the public code."""

from dataclasses import replace

import pytest
import torch

import scenes
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.smart.catk_checkpoint import write_catk
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.heads import NEVER, ClassHeads, MotionScores
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.trajtok import TrajTokConfig
from rlftsim.tokens.vocabulary import PADDING_CLASS, class_of_type

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


# ---- keys of tokens --------------------------------------------------------------------------------------------------

KEYED = replace(SMALL, head_per_class=False, token_key_dim=6)


@pytest.fixture(scope="module")
def keyed(batch):
    vocabulary = build_vocabulary(batch.scenarios, TokensConfig(num_tokens=48, num_map_prototypes=8))[0]
    torch.manual_seed(0)
    return SmartPolicy(KEYED, vocabulary).eval()


def test_a_query_meets_the_keys_of_its_class_alone():
    torch.manual_seed(0)
    scores = MotionScores(8, 3)
    hidden, class_id = torch.randn(4, 8), torch.tensor([2, 0, 1, PADDING_CLASS])
    keys = torch.randn(5, 3, 3)  # [V, C, K]
    products = scores.queries(hidden, class_id) @ keys.flatten(1).mT  # [R, V]
    for row, index in enumerate(class_id.tolist()[:3]):
        torch.testing.assert_close(products[row], keys[:, index] @ scores.query(hidden[row]))
    assert not products[3].any()


@torch.no_grad()
def test_tokens_that_lead_nearly_to_the_same_place_have_nearly_the_same_key():
    torch.manual_seed(0)
    poses = torch.randn(3, 50, 3)
    near, far = poses + 1e-3, poses + torch.tensor([2.0, 0.5, 0.3])
    scores = MotionScores(8, 4)
    keys, beside, elsewhere = (scores.keys(one) for one in (poses, near, far))
    assert keys.shape == (50, 12)
    assert (keys - beside).abs().mean() < 0.05 * (keys - elsewhere).abs().mean()


@torch.no_grad()
def test_the_logits_are_those_of_the_head_and_of_the_keys(keyed, batch):
    decoder, vocabulary = keyed.network.decoder, keyed.vocabulary
    found = keyed.teacher_forced(batch, batch.agent_mask)
    head_alone = SmartPolicy(replace(KEYED, token_key_dim=0), vocabulary).eval()
    own = {k: v for k, v in keyed.network.state_dict().items() if ".scores." not in k}
    head_alone.network.load_state_dict(own)
    added = found.logits - head_alone.teacher_forced(batch, batch.agent_mask).logits  # [R, V]
    keys = decoder.token_keys(vocabulary.poses[:, :, -1]).unflatten(1, (3, -1))  # [V, C, K]
    for class_id in found.class_id.unique().tolist():
        rows = added[found.class_id == class_id][:, vocabulary.token_mask[class_id]]
        # a row adds a combination of the six keys of its class: no more dimensions than that
        assert torch.linalg.matrix_rank(rows, atol=1e-3) <= min(len(rows), 6)
        combination = torch.linalg.lstsq(keys[vocabulary.token_mask[class_id], class_id], rows.mT).solution
        torch.testing.assert_close(
            keys[vocabulary.token_mask[class_id], class_id] @ combination, rows.mT, atol=1e-4, rtol=0
        )
        assert rows.abs().max() > 0.1


@torch.no_grad()
def test_a_saved_model_with_keys_says_the_same(keyed, batch, tmp_path):
    keyed.save_pretrained(tmp_path)
    again = SmartPolicy.from_pretrained(tmp_path).eval()
    prediction, same = (p.teacher_forced(batch, batch.agent_mask).logits for p in (keyed, again))
    assert torch.equal(prediction, same)


def test_queries_are_fine_tuned_and_keys_are_not(keyed):
    trained = {id(weight) for part in keyed.fine_tuned_parts() for weight in part.parameters()}
    scores = keyed.network.decoder.scores
    assert id(scores.query.weight) in trained
    assert not any(id(weight) in trained for weight in scores.key.parameters())


def test_keys_need_one_head_for_all_classes_and_are_unknown_to_the_public_code(keyed, tmp_path):
    with pytest.raises(ConfigError, match=r"token_key_dim=6 needs one head for all classes"):
        replace(KEYED, head_per_class=True)
    with pytest.raises(ConfigError, match=r"token_key_dim must not be negative, got -1"):
        replace(KEYED, token_key_dim=-1)
    with pytest.raises(CheckpointError, match=r"keys of tokens has no form in the public CAT-K code"):
        write_catk(keyed, tmp_path / "out.safetensors")
