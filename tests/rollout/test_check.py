from dataclasses import dataclass

import pytest
import torch

import scenes
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity, PointMass
from rlftsim.rollout.check import CHECKS, check_policy
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary


@pytest.fixture(scope="module")
def scenarios():
    return [scenes.junction_with_light(), scenes.with_gaps(), scenes.lone_agent()]


@pytest.fixture(scope="module")
def vocabulary(scenarios):
    config = TokensConfig(num_tokens=48, num_map_prototypes=16)
    return build_vocabulary([*scenarios, scenes.crowd(num_agents=40)], config)[0]


def small_smart(vocabulary, **changes):
    torch.manual_seed(3)
    config = {"dim": 16, "num_heads": 2, "head_dim": 8, "num_map_layers": 1, "num_decoder_layers": 1}
    policy = SmartPolicy(SmartConfig(**config, num_frequencies=8, **changes), vocabulary)
    with torch.no_grad():  # fresh weights are so timid that nothing would show
        for name, weight in policy.named_parameters():
            if name.startswith("network.decoder.head") and weight.dim() == 2:
                weight.mul_(3.0)
    return policy


def test_constant_velocity_keeps_the_contract(scenarios):
    report = check_policy(ConstantVelocity(), scenarios)
    assert report.is_passed, str(report)
    skipped = [r.rule for r in report.results if r.outcome == "not applicable"]
    assert len(skipped) == 7  # what is said of weights and of chance


@pytest.mark.parametrize(
    "changes", [{}, {"max_agent_neighbors": 3, "max_agent_map_neighbors": 7, "max_map_neighbors": 5}]
)
def test_smart_keeps_the_contract(scenarios, vocabulary, changes):
    report = check_policy(small_smart(vocabulary, **changes), scenarios)
    assert report.is_passed, str(report)
    assert [r for r in report.results if r.outcome == "not applicable"] == []


def test_smart_takes_another_reference(scenarios, vocabulary):
    torch.manual_seed(7)
    policy = small_smart(vocabulary)
    report = check_policy(policy, scenarios[1:], reference=small_smart(vocabulary))
    broken = [r.rule for r in report.failures]
    assert broken == ["The KL divergence from another policy is not negative, and somewhere positive"]


def test_checking_leaves_the_policy_as_it_was(scenarios, vocabulary):
    policy = small_smart(vocabulary).train()
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    check_policy(policy, scenarios[1:])
    assert policy.training
    assert all(p.grad is None and p.requires_grad for p in policy.parameters())
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


@dataclass(frozen=True)
class Forgetful(ConstantVelocity):
    """Scores as if everybody stood still, and does not go where it is told."""

    def score(self, context, rollouts):
        return _Certain(torch.zeros_like(rollouts.decision))

    def advance(self, context, state, decision, forced=None):
        return super().advance(context, state, decision)


@dataclass(frozen=True)
class _Certain(PointMass):
    def log_prob(self, decision, sampling=None):
        return -(decision - self.decision).norm(dim=-1)


def test_a_policy_that_breaks_rules_is_told_which_and_by_how_much(scenarios):
    report = check_policy(Forgetful(), scenarios)
    broken = {r.rule: r.detail for r in report.failures}
    assert not report.is_passed
    assert broken["Scored log-probabilities equal the sampled ones"] == "largest gap 11, allowed 0.0001"
    assert (
        "where they were put"
        in broken["Scored log-probabilities equal the sampled ones where agents are forced for a while"]
    )
    assert "2 broken" not in str(report).splitlines()[0]


def test_an_error_inside_a_policy_is_a_broken_rule(scenarios):
    class Crashing(ConstantVelocity):
        def score(self, context, rollouts):
            raise ValueError("cannot score")

    report = check_policy(Crashing(), scenarios)
    assert report.failures[0].detail == "raised ValueError: cannot score"


def test_every_rule_is_a_sentence():
    rules = [check.__doc__.splitlines()[0] for check in CHECKS]
    assert all(rule.endswith(".") and len(rule.split()) > 5 for rule in rules)
    assert len(set(rules)) == len(rules)
