import re
from dataclasses import dataclass, replace

import pytest
import torch

import scenes
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity, PointMass
from rlftsim.rollout.check import Rules, check_policy
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary

STRAIGHT = (scenes.junction_with_light(), scenes.with_gaps(), scenes.lone_agent())
BENDING = (scenes.bend(), scenes.bend("pair", 2), scenes.bend("single", 1))
INVARIANCE = "scores are invariant to rotation and translation"


def small_vocabulary(scenarios):
    config = TokensConfig(num_tokens=48, num_map_prototypes=16)
    return build_vocabulary([*scenarios, scenes.crowd(num_agents=40)], config)[0]


def small_smart(vocabulary, seed=3, **changes):
    torch.manual_seed(seed)
    sizes = {"dim": 16, "num_heads": 2, "head_dim": 8, "num_map_layers": 1, "num_decoder_layers": 1}
    # pieces of 5 m on a straight line are exactly 10 m from the next but one, the usual radius
    config = {**sizes, "num_frequencies": 8, "map_radius_m": 12.0, **changes}
    policy = SmartPolicy(SmartConfig(**config), vocabulary)
    with torch.no_grad():  # fresh weights are so timid that nothing would show
        for name, weight in policy.named_parameters():
            if name.startswith("network.decoder.head") and weight.dim() == 2:
                weight.mul_(3.0)
            if name.startswith("network.decoder.scores"):  # these are not timid
                weight.mul_(0.3)
    return policy


def test_constant_velocity_keeps_the_contract():
    report = check_policy(ConstantVelocity(), STRAIGHT)
    assert report.is_passed, str(report)
    skipped = [r.rule for r in report.results if r.outcome == "not applicable"]
    assert len(skipped) == 8  # rules on weights and on random decisions


@pytest.mark.parametrize(
    "limits",
    # map pieces are 5 m apart both ways: a limit to their neighbors would cut between equally near ones
    [
        {"max_map_neighbors": None},
        {"max_agent_neighbors": 3, "max_agent_map_neighbors": 7, "max_map_neighbors": None},
        {"continuation_scores": True, "seed": 4, "max_map_neighbors": None},
    ],
    ids=["all neighbors", "few neighbors", "continuation scores"],
)
def test_smart_keeps_the_contract(limits):
    policy = small_smart(small_vocabulary(BENDING), **limits).train()
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    report = check_policy(policy, BENDING)
    assert report.is_passed, str(report)
    assert [r for r in report.results if r.outcome == "not applicable"] == []
    # and is left as it was
    assert policy.training
    assert all(p.grad is None and p.requires_grad for p in policy.parameters())
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


def test_smart_keeps_the_contract_on_straight_roads():
    # What lies exactly behind has a bearing of +180 or -180 degrees, as rounding has it, and an angle's embedding
    # is not periodic: the seam of angles lies a little off.
    report = check_policy(small_smart(small_vocabulary(STRAIGHT), max_map_neighbors=None), STRAIGHT)
    assert report.is_passed, str(report)


def test_the_public_codes_sign_of_180_degrees_shows_on_straight_roads():
    policy = small_smart(small_vocabulary(STRAIGHT), max_map_neighbors=None, catk_compat=True)
    assert {r.rule for r in check_policy(policy, STRAIGHT).failures} == {INVARIANCE}


def test_a_reference_that_is_the_policy_itself_is_noticed():
    policy = small_smart(small_vocabulary(BENDING))
    report = check_policy(policy, BENDING[2:], reference=policy)
    rule = "kl from another policy is positive"
    assert [(r.rule, r.detail) for r in report.failures] == [(rule, "the KL from another policy is 0 everywhere")]


@dataclass(frozen=True)
class Forgetful(ConstantVelocity):
    """Scores as if all agents stood still, and ignores forced states."""

    def score(self, context, rollouts):
        return _Certain(torch.zeros_like(rollouts.decision))

    def advance(self, context, state, decision, forced=None):
        return super().advance(context, state, decision)


@dataclass(frozen=True)
class _Certain(PointMass):
    def log_prob(self, decision, sampling=None):
        return -(decision - self.decision).norm(dim=-1)


def test_violated_rules_are_listed_with_their_measurements():
    report = check_policy(Forgetful(), STRAIGHT)
    broken = {r.rule: r.detail for r in report.failures}
    assert not report.is_passed
    assert broken["scored log probs equal sampled ones"] == "largest gap 11, allowed 0.0001"
    assert "from their imposed positions" in broken["scored log probs equal sampled ones with forced agents"]
    passed = sum(result.outcome == "passed" for result in report.results)
    assert str(report).startswith(f"Forgetful: {passed} rules passed, {len(broken)} failed.")


@dataclass(frozen=True)
class Hasty(ConstantVelocity):
    """Drives faster by a fraction of its own in each rollout."""

    initial_noise_size = 1
    is_forgotten: bool = False

    def begin(self, context, num_rollouts, goals, noise):
        return replace(super().begin(context, num_rollouts, goals, noise), draws=noise)

    def advance(self, context, state, decision, forced=None):
        draws = torch.rand_like(state.draws) if self.is_forgotten else state.draws
        return super().advance(context, state, decision * (1 + draws), forced)


def test_decisions_of_a_policy_that_draws_once_per_rollout_are_replayed_with_its_draws():
    rule = "replayed decisions give same poses"
    outcomes = {r.rule: r.outcome for r in check_policy(Hasty(), STRAIGHT).results}
    assert "failed" not in outcomes.values()
    assert outcomes[rule] == "passed"
    assert rule in [r.rule for r in check_policy(Hasty(is_forgotten=True), STRAIGHT).failures]


def test_an_error_inside_a_policy_is_a_failed_rule():
    class Crashing(ConstantVelocity):
        def score(self, context, rollouts):
            raise ValueError("cannot score")

    class Misshapen(ConstantVelocity):
        def score(self, context, rollouts):
            return torch.nn.functional.linear(torch.zeros(1, 2), torch.zeros(3, 5))  # raises inside torch

    report = check_policy(Crashing(), STRAIGHT)
    detail = report.failures[0].detail
    assert re.fullmatch(r"raised ValueError: cannot score \(test_check\.py:\d+ in score\)", detail)
    assert re.search(r"\(test_check\.py:\d+ in score\)$", check_policy(Misshapen(), STRAIGHT).failures[0].detail)


def test_rules_have_names_without_docstrings():
    """As under python -OO."""
    rules = [result.rule for result in check_policy(ConstantVelocity(), STRAIGHT[-1:]).results]
    assert rules == [name.replace("_", " ") for name in vars(Rules) if not name.startswith("_")]
    assert len(set(rules)) == len(rules)
