"""SMART learns: a real scenario by heart, and a synthetic one as fast as it always did."""

import zlib
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import cross_entropy

import scenes
from rlftsim.policies.smart.catk_checkpoint import read_catk_vocabulary
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.scenario.womd import read_scenarios
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary

SMALL = SmartConfig(
    dim=64, num_heads=4, head_dim=16, num_map_layers=1, num_decoder_layers=1, num_frequencies=16,
    max_map_neighbors=4, max_agent_map_neighbors=6, max_agent_neighbors=4, dropout=0.0, history_drop=0.0,
)  # fmt: skip


def learn(policy, batch, trained, num_updates, learning_rate):
    """Loss and accuracy along the recorded tracks, before each update; the learning rate falls to a tenth."""
    optimizer = torch.optim.AdamW(policy.parameters(), weight_decay=0.0)
    for update in range(num_updates):
        optimizer.param_groups[0]["lr"] = learning_rate * min(1.0, (update + 1) / 5) * (1 - 0.9 * update / num_updates)
        prediction = policy.teacher_forced(batch, trained)
        logits, target = prediction.logits[prediction.target_mask], prediction.target[prediction.target_mask]
        loss = cross_entropy(logits, target)
        yield loss.item(), (logits.argmax(-1) == target).float().mean().item()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()


@pytest.mark.slow
@pytest.mark.official
def test_a_real_scenario_is_learnt_by_heart(shared, token_tables):
    scenario = next(s for s in read_scenarios(shared / "data" / "womd") if s.scenario_id == "bada21415c031740")
    torch.manual_seed(0)
    policy, batch = SmartPolicy(SMALL, read_catk_vocabulary(token_tables)), collate([scenario])
    # parked cars flicker between the tokens next to standing still, and nothing that a model sees says when
    moves = batch.velocity[:, :, CURRENT_STEP].norm(dim=-1) > 0.5
    curve = learn(policy, batch, moves & batch.agent_mask, num_updates=150, learning_rate=1e-2)
    _, first = next(curve)
    assert first < 0.05
    assert any(accuracy > 0.99 for _, accuracy in curve)


def named_weights(policy):
    """Weights that depend on their names and shapes alone, not on the order in which a network is built."""
    for name, weight in policy.network.named_parameters():
        draw = torch.Generator().manual_seed(zlib.crc32(name.encode()))
        values = torch.randn(weight.shape, generator=draw, dtype=torch.float64)
        scale = (2 / sum(weight.shape)) ** 0.5 if weight.dim() == 2 else 0.1
        weight.data = (values * scale + (weight.dim() == 1 and name.endswith("weight"))).float()


def test_a_synthetic_scenario_is_learnt_as_fast_as_ever():
    scenario = scenes.bend()
    vocabulary, _ = build_vocabulary([scenario], TokensConfig(num_tokens=32, num_map_prototypes=8))
    policy = SmartPolicy(SMALL, vocabulary)
    named_weights(policy)
    batch = collate([scenario])
    losses, accuracies = zip(*learn(policy, batch, batch.agent_mask, num_updates=12, learning_rate=3e-3))
    assert losses[0] == pytest.approx(2.06555, rel=1e-4)
    assert losses[3] == pytest.approx(0.7203, rel=0.01)
    assert losses[-1] == pytest.approx(0.1187, rel=0.05)
    assert accuracies[3] == pytest.approx(0.821, abs=0.02)
    assert accuracies[-1] > 0.98


def test_frequencies_are_drawn_as_in_the_public_code_or_log_spaced():
    tables = {}
    vocabulary, _ = build_vocabulary([scenes.straight_road()], TokensConfig(num_tokens=8, num_map_prototypes=4))
    for init in ("normal", "log_spaced"):
        torch.manual_seed(0)
        policy = SmartPolicy(replace(SMALL, frequency_init=init), vocabulary)
        tables[init] = {k: v for k, v in policy.network.state_dict().items() if k.endswith("frequencies.weight")}
    assert len(tables["normal"]) == 5  # of the map, of motion, and of three relations of agents
    for name, spaced in tables["log_spaced"].items():
        assert float(tables["normal"][name].std()) == pytest.approx(0.02, rel=0.4)
        torch.testing.assert_close(spaced[:, 0], torch.full((len(spaced),), 1 / 64))
        torch.testing.assert_close(spaced[:, -1], torch.ones(len(spaced)))
        ratio = spaced[:, 1:] / spaced[:, :-1]
        torch.testing.assert_close(ratio, torch.full_like(ratio, 64 ** (1 / 15)))  # 16 of them
