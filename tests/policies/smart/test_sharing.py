"""Passes over the same scenarios share scene and neighbors, where frozen weights are equal and nowhere else."""

import copy
from dataclasses import replace

import pytest
import torch
from torch import nn

import tiny
from rlftsim.goals.types import Goals
from rlftsim.policies.distributions import TokenDistribution
from rlftsim.policies.smart.network import AgentDecoder
from rlftsim.rollout.policy import SharingPolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.freezing import freeze_untrained
from rlftsim.training.parallel import start_fabric
from rlftsim.training.reward import prepare, update_policy
from tiny_fixtures import drawn_scenarios, vocabulary  # noqa: F401

ROUNDING = 1e-5
"""Of logits: with and without gradient the attention goes through different kernels."""


@pytest.fixture(scope="module")
def batch(drawn_scenarios):  # noqa: F811
    return collate(drawn_scenarios[:2])


@pytest.fixture
def policy(vocabulary):  # noqa: F811
    policy = tiny.tiny_policy(vocabulary).eval()
    freeze_untrained(policy, "decoder")
    return policy


@pytest.fixture
def reference(policy):
    """Other layers and another head, the same frozen weights."""
    reference = copy.deepcopy(policy).requires_grad_(False)
    for part in policy.fine_tuned_modules():
        move(part)
    return reference


def move(module):
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for weight in module.parameters():
            weight.add_(0.05 * torch.randn(weight.shape, generator=generator))


def num_looks(monkeypatch):
    """A list that grows with every search for neighbors."""
    looks, original = [], AgentDecoder.look

    def counted(self, *arguments, **named):
        looks.append(self)
        return original(self, *arguments, **named)

    monkeypatch.setattr(AgentDecoder, "look", counted)
    return looks


def scored(policy, reference, batch, rollouts):
    """Contexts and distributions of both, with the policy's own context as the one to share."""
    with torch.no_grad():
        context = policy.encode(batch)
        ref_context = reference.encode_like(batch, context)
    own = policy.encode_like(batch, context)
    return (context, own, ref_context), policy.score_with_reference(own, rollouts, reference, ref_context, rollouts)


def test_what_frozen_and_equal_weights_see_is_computed_once(policy, reference, batch, monkeypatch):
    rollouts = simulate(policy, batch, num_rollouts=3, seed=1)
    alone = (
        policy.score(policy.encode(batch), rollouts).logits,
        reference.score(reference.encode(batch), rollouts).logits,
    )
    assert not torch.equal(*alone)
    looks = num_looks(monkeypatch)
    (context, own, ref_context), together = scored(policy, reference, batch, rollouts)
    assert own.scene is context.scene is ref_context.scene
    assert len(looks) == 2  # at the history, and along the rollouts
    for dist, logits in zip(together, alone):
        torch.testing.assert_close(dist.logits, logits, atol=ROUNDING, rtol=0)
    assert together[0].logits.requires_grad
    assert not together[1].logits.requires_grad


def test_other_frozen_weights_are_not_shared(policy, reference, batch):
    move(reference.network.map_encoder)
    rollouts = simulate(policy, batch, num_rollouts=2, seed=1)
    expected = reference.score(reference.encode(batch), rollouts).logits
    (context, _, ref_context), (_, found) = scored(policy, reference, batch, rollouts)
    assert ref_context.scene is not context.scene
    torch.testing.assert_close(found.logits, expected, atol=ROUNDING, rtol=0)


def test_weights_in_training_are_not_shared(policy, reference, batch):
    freeze_untrained(policy, "all")
    rollouts = simulate(policy, batch, num_rollouts=2, seed=1)
    (context, own, ref_context), (dist, _) = scored(policy, reference, batch, rollouts)
    assert own.scene is not context.scene
    assert ref_context.scene is not context.scene
    dist.log_prob(rollouts.decision).sum().backward()
    assert all(weight.grad is not None for weight in policy.network.map_encoder.parameters())


def test_dropout_is_not_shared(policy, batch):
    policy.train()
    assert policy.encode_like(batch, context := policy.encode(batch)).scene is not context.scene


@pytest.mark.parametrize("encoding", ["concat", "indication"])
def test_goals_have_their_own_part(policy, batch, encoding):
    """Goal parts differ between policy and reference, and a reference may have no goals at all."""
    policy = policy.with_goal_conditioning(encoding, logit_bias=False).eval()
    freeze_untrained(policy, "decoder")
    reference = copy.deepcopy(policy).requires_grad_(False)
    for part in policy.goal_modules():
        move(part)
    goals = Goals.of_scenarios(batch.position[:, :, 10] + 15.0, batch.agent_mask).repeat(2)
    rollouts = simulate(policy, batch, num_rollouts=2, seed=1, goals=goals)
    goal_free = simulate(reference, batch, num_rollouts=2, seed=1)
    for ref_rollouts in (rollouts, goal_free):
        with torch.no_grad():
            context = policy.encode(batch)
            ref_context = reference.encode_like(batch, context)
            both = policy.score_with_reference(context, rollouts, reference, ref_context, ref_rollouts)
            alone = policy.score(context, rollouts), reference.score(reference.encode(batch), ref_rollouts)
        for dist, expected in zip(both, alone):
            torch.testing.assert_close(dist.logits, expected.logits, atol=ROUNDING, rtol=0)
        assert not torch.equal(both[0].logits, both[1].logits)


class Plain(nn.Module):
    """A policy of another package: the five methods and no more, and a distribution with four."""

    steps_per_decision, noise_size, initial_noise_size = 5, 1, 0

    def __init__(self, policy):
        super().__init__()
        self.policy = policy
        self.encode, self.begin, self.advance = policy.encode, policy.begin, policy.advance
        self.decide, self.fine_tuned_modules = policy.decide, policy.fine_tuned_modules

    def __deepcopy__(self, memo):
        return Plain(copy.deepcopy(self.policy, memo))

    def score(self, context, rollouts):
        dist = self.policy.score(context, rollouts)
        return TokenDistribution(dist.logits, dist.mask)


@pytest.mark.parametrize("trained", ["decoder", "all"])
def test_an_update_is_that_of_a_policy_that_shares_nothing(vocabulary, batch, trained):  # noqa: F811
    config = replace(tiny.FINETUNE, num_rollouts=3, rollouts_per_pass=2, trained=trained, entropy_bonus=0.1)
    fabric, found = start_fabric(tiny.CPU), []
    for wrap in (nn.Identity(), Plain):
        policy = wrap(tiny.tiny_policy(vocabulary))
        assert isinstance(policy, SharingPolicy) == (wrap is not Plain)
        learner = prepare(policy, config, fabric.device)
        for part in learner.reference.fine_tuned_modules():
            move(part)
        values = update_policy(learner, batch, config, fabric)
        found.append(({n.removeprefix("policy."): g for n, g in tiny.gradients_of(policy).items()}, values))
    (gradients, values), (plain_gradients, plain_values) = found
    assert gradients.keys() == plain_gradients.keys()
    for name, gradient in plain_gradients.items():
        torch.testing.assert_close(gradients[name], gradient, atol=1e-6, rtol=1e-5, msg=name)
    for name in ("kl", "entropy", "score_gap", "gradient_norm"):
        assert values[name] == pytest.approx(plain_values[name], rel=1e-5, abs=1e-6), name
    assert values["kl"] > 1e-3


def test_agents_that_stand_share_a_list_in_all_rollouts_and_decisions(policy, batch):
    corners = policy.vocabulary.corners.clone()
    corners[:, 0] = corners[:, 0, :1]  # token 0 does not move
    policy.vocabulary = replace(policy.vocabulary, corners=corners)
    noise = torch.rand(*batch.agent_mask.shape, 1)[:, None].expand(-1, 4, -1, -1)
    with torch.no_grad():
        context = policy.encode(batch)
        state = policy.begin(context, 4, None, noise[..., :0])
        for _ in range(3):
            policy.decide(context, state)
            state = policy.advance(context, state, torch.zeros(state.heading.shape, dtype=torch.long))
    view = policy.network.decoder.look(context.scene, state.pending, state.past)
    num_agents = int(batch.agent_mask.sum())
    assert len(view.rows[0]) == 4 * num_agents
    assert sum(len(block.neighbors) for block in view.map_tokens.blocks) <= num_agents
    assert torch.equal(state.heading, context.history.heading[..., -1].expand_as(state.heading))
