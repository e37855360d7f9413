"""Models with a sampling of their nature: a part of the distribution, of config.json and of the fingerprint."""

import json
from dataclasses import replace

import pytest
import torch

import scenes
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.distributions import LazyTokenDistribution, TokenDistribution
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.check import check_policy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary

SMALL = SmartConfig(dim=8, num_heads=1, head_dim=4, num_map_layers=1, num_decoder_layers=1, num_frequencies=2)
TOP, FULL = Sampling(top_k=3), Sampling()


@pytest.fixture(scope="module")
def full():
    torch.manual_seed(0)
    vocabulary = build_vocabulary([scenes.crowd(num_agents=20)], TokensConfig(num_tokens=8, num_map_prototypes=4))[0]
    return SmartPolicy(SMALL, vocabulary).eval()


@pytest.fixture(scope="module")
def truncated(full):
    policy = SmartPolicy(full.config, full.vocabulary, TOP).eval()
    policy.load_state_dict(full.state_dict())
    return policy


def roll(policy, sampling=FULL):
    return simulate(policy, collate([scenes.bend()]), num_rollouts=8, seed=1, sampling=sampling)


def test_a_model_draws_as_if_its_sampling_were_asked_for(full, truncated):
    rollouts, asked = roll(truncated), roll(full, TOP)
    assert torch.equal(rollouts.position, asked.position)
    assert torch.equal(rollouts.log_prob, asked.log_prob)
    assert not torch.equal(rollouts.position, roll(full).position)


@pytest.mark.parametrize(
    ("asked", "sampling"),
    [
        (Sampling(top_k=2), Sampling(top_k=2)),
        (Sampling(top_k=5), TOP),
        (Sampling(temperature=0.5), Sampling(0.5, 3)),
        (Sampling(temperature=0.0), Sampling(0.0)),
    ],
)
def test_a_sampling_that_is_asked_for_narrows_the_models(full, truncated, asked, sampling):
    assert torch.equal(roll(truncated, asked).position, roll(full, sampling).position)


def test_fine_tuning_sees_the_distribution_that_is_sampled(truncated):
    generator = torch.Generator().manual_seed(0)
    logits, other = torch.randn(2, 50, 8, generator=generator, dtype=torch.float64)
    mask = torch.ones(50, dtype=torch.bool)
    dist, reference = TokenDistribution(logits, mask, TOP), TokenDistribution(other, mask, TOP)
    threshold = logits.sort(-1, descending=True).values[:, 2:3]
    p = torch.where(logits >= threshold, logits, -torch.inf).softmax(-1)
    q = torch.where(logits >= threshold, other, -torch.inf).softmax(-1)
    decision = p.argmax(-1)
    torch.testing.assert_close(dist.log_prob(decision), p.amax(-1).log(), atol=1e-12, rtol=0)
    torch.testing.assert_close(dist.entropy(), -torch.special.xlogy(p, p).sum(-1), atol=1e-12, rtol=0)
    expected = (torch.special.xlogy(p, p) - torch.special.xlogy(p, q)).sum(-1)
    torch.testing.assert_close(dist.kl(reference), expected, atol=1e-12, rtol=0)
    assert dist.log_prob(p.argmin(-1)).isneginf().all()
    # along the rollouts of a model, too, where an update asks for all three at once
    rollouts = roll(truncated)
    scored = truncated.score(truncated.encode(collate([scenes.bend()])), rollouts)
    assert isinstance(scored, LazyTokenDistribution)
    statistics = scored.statistics(rollouts.decision, scored)
    torch.testing.assert_close(statistics.log_prob, rollouts.log_prob, atol=1e-5, rtol=0)
    assert statistics.log_prob.isfinite().all()
    assert statistics.log_prob.requires_grad
    assert statistics.kl.abs().max() == 0.0


def test_the_contract_holds_with_a_sampling(truncated):
    report = check_policy(truncated, [scenes.bend(), scenes.bend("pair", 2)])
    assert report.is_passed, str(report)


def test_the_sampling_is_stored_with_the_model_and_tells_it_apart(full, truncated, tmp_path):
    truncated.save_pretrained(tmp_path / "truncated")
    full.save_pretrained(tmp_path / "full")
    stored = json.loads((tmp_path / "truncated" / "config.json").read_text())
    assert stored["sampling"] == {"temperature": 1.0, "top_k": 3}
    assert "sampling" not in json.loads((tmp_path / "full" / "config.json").read_text())
    loaded = load_policy(str(tmp_path / "truncated"))
    assert loaded.sampling == TOP
    assert fingerprint_policy(loaded) == fingerprint_policy(truncated) != fingerprint_policy(full)


def test_a_draw_that_ties_with_an_excluded_token_keeps_its_probability():
    logits = torch.tensor([[2.0, 1.0, 1.0 - 1e-5, 0.0]])
    dist = TokenDistribution(logits, torch.ones(1, dtype=torch.bool), Sampling(top_k=2))
    first, second, third = (dist.log_prob(torch.tensor([token])) for token in (1, 2, 3))
    torch.testing.assert_close(second, first, atol=1e-4, rtol=0)
    assert third.isneginf()


def test_models_made_of_a_model_sample_as_it_does(truncated):
    assert truncated.with_goal_conditioning("concat").sampling == TOP
    assert truncated.with_settings(truncated.config, None, ()).sampling == TOP
    calibrated = CalibratedTokenPolicy(truncated, ("edge_0.5s",), eta=[0.5]).eval()
    assert calibrated.sampling == TOP
    rollouts = roll(calibrated)
    scored = calibrated.score(calibrated.encode(collate([scenes.bend()])), rollouts)
    torch.testing.assert_close(scored.log_prob(rollouts.decision), rollouts.log_prob, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    "sampling", [7, {"top_k": 0, "temperature": 1.0}, {"top_k": "3", "temperature": 1.0}, {"k": 3}]
)
def test_a_damaged_sampling_is_refused(truncated, tmp_path, sampling):
    truncated.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config | {"sampling": sampling}))
    with pytest.raises(CheckpointError, match=r"config\.json: .*(sampling|Sampling)"):
        load_policy(str(tmp_path))


def test_the_mode_alone_is_no_sampling_of_a_model(full, truncated, tmp_path):
    with pytest.raises(ConfigError, match="temperature above 0"):
        SmartPolicy(full.config, full.vocabulary, Sampling(temperature=0.0))
    truncated.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config | {"sampling": {"temperature": 0.0, "top_k": None}}))
    with pytest.raises(ConfigError, match=r"config\.json: .*temperature above 0"):
        load_policy(str(tmp_path))


def test_a_temperature_that_makes_logits_infinite_is_refused(full):
    with pytest.raises(ConfigError, match="not below 1e-30 unless it is 0, got 1e-320"):
        Sampling(temperature=1e-320)
    sharp = roll(full, Sampling(temperature=1e-30))
    assert torch.equal(sharp.position, roll(full, Sampling(temperature=0.0)).position)


def test_a_radius_that_nothing_is_in_is_a_setting_like_others(full):
    alone = SmartPolicy(replace(SMALL, map_radius_m=1e-320, agent_radius_m=1e-9), full.vocabulary).eval()
    assert roll(alone.requires_grad_(False)).position.isfinite().all()
