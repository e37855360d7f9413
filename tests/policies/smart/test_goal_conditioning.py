"""Goal-conditioned models: fresh weights change nothing, trained ones change goal-conditioned agents only."""

import copy
from dataclasses import replace

import pytest
import torch

import scenes
from rlftsim.errors import CheckpointError, ConfigError, RlftsimError
from rlftsim.goals.types import Goals
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.goal_conditioning import GoalLogitBias, encode_goals, suitability
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.check import check_policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary

BENDING = (scenes.bend(), scenes.bend("pair", 2), scenes.bend("single", 1))
SMALL = SmartConfig(
    dim=16, num_heads=2, head_dim=8, num_map_layers=1, num_decoder_layers=2, num_frequencies=4,
    map_radius_m=12.0, max_map_neighbors=None,
)  # fmt: skip
each_encoding = pytest.mark.parametrize("encoding", ["concat", "indication"])
each_part = pytest.mark.parametrize("bias", [False, True], ids=["encoding", "logit bias"])


@pytest.fixture(scope="module")
def base():
    """A goal-free model with larger logits than a fresh one has."""
    config = TokensConfig(num_tokens=48, num_map_prototypes=16)
    vocabulary = build_vocabulary([*BENDING, scenes.crowd(num_agents=40)], config)[0]
    torch.manual_seed(3)
    policy = SmartPolicy(SMALL, vocabulary).eval()
    with torch.no_grad():
        for name, weight in policy.named_parameters():
            if name.startswith("network.decoder.head") and weight.dim() == 2:
                weight.mul_(3.0)
    return policy


@pytest.fixture(scope="module")
def batch():
    return collate(BENDING)


def far_goals(batch, chosen=slice(None)):
    """Goals of every other agent, 100 m ahead: far outside of where agents look at the map."""
    position = batch.position[:, :, 10] + torch.tensor([100.0, 30.0])
    mask = torch.zeros_like(batch.agent_mask)
    mask[:, ::2] = batch.agent_mask[:, ::2]
    mask[:, chosen] &= True
    return Goals.of_scenarios(position, mask)


def learned(policy, encoding, size=0.5, *, bias=False):
    """A goal-conditioned copy with random goal weights; with `bias` only those of the logit bias are random."""
    policy = policy.with_goal_conditioning(encoding, logit_bias=bias)
    generator = torch.Generator().manual_seed(11)
    encoder, *biases = policy.goal_modules()
    with torch.no_grad():
        for weight in (biases[0] if bias else encoder).parameters():
            weight.add_(size * torch.randn(weight.shape, generator=generator))
    return policy


def logits(policy, batch, rollouts):
    return policy.score(policy.encode(batch), rollouts).logits


@each_encoding
def test_a_model_with_fresh_goal_weights_decides_as_the_goal_free_one(encoding, base, batch):
    policy = base.with_goal_conditioning(encoding)
    rollouts = simulate(base, batch, num_rollouts=3, seed=5)
    before = logits(base, batch, rollouts)
    assert logits(policy, batch, rollouts).equal(before)  # bit for bit
    goals = far_goals(batch)
    conditioned = [replace(rollouts, goals=replace(goals, position=goals.position * s).repeat(3)) for s in (1.0, -0.3)]
    with_goals = logits(policy, batch, conditioned[0])
    assert with_goals.equal(logits(policy, batch, conditioned[1]))
    # with goals the current step goes through the decoder together with the later ones: sums in another order
    torch.testing.assert_close(with_goals, before, atol=3e-6, rtol=0)
    context = policy.encode(batch)
    first = [policy.decide(context, policy.begin(context, 3, g, torch.zeros(0))) for g in (None, conditioned[0].goals)]
    torch.testing.assert_close(first[0].logits, first[1].logits, atol=3e-6, rtol=0)
    assert simulate(policy, batch, num_rollouts=3, seed=5, goals=goals).decision.equal(rollouts.decision)


@each_encoding
@each_part
def test_the_first_decision_and_every_other_look_at_the_goal(encoding, bias, base, batch):
    policy, goals = learned(base, encoding, bias=bias), far_goals(batch).repeat(1)
    rollouts = simulate(policy, batch, num_rollouts=1, seed=5)
    free = policy.score(policy.encode(batch), rollouts).log_prob(rollouts.decision)
    conditioned = policy.score(policy.encode(batch), replace(rollouts, goals=goals)).log_prob(rollouts.decision)
    differs = (conditioned - free).abs().amax((1,)) > 1e-4  # [B, A, L]
    carriers = goals.goal_mask[:, 0]
    assert differs[carriers].all()
    alone = carriers.sum(-1) == batch.agent_mask.sum(-1)
    assert alone.tolist() == [False, False, True]


@each_encoding
def test_another_goal_is_another_behaviour(encoding, base, batch):
    policy = learned(base, encoding)
    one = far_goals(batch)
    other = replace(one, position=one.position - torch.tensor([150.0, 10.0]))
    paths = [simulate(policy, batch, num_rollouts=2, seed=5, goals=g).position for g in (one, other)]
    assert not torch.equal(*paths)


@each_encoding
def test_who_has_no_goal_is_asked_nothing(encoding, base):
    """Goals that no agent has change nothing; one agent's goal changes nothing for agents out of its reach."""
    policy = learned(base, encoding)
    batch = collate([scenes.crowd(num_agents=12)])
    goals = far_goals(batch).repeat(2)
    free = simulate(policy, batch, num_rollouts=2, seed=5)
    empty = goals.only(torch.zeros_like(goals.goal_mask))
    nonsense = replace(empty, position=torch.full_like(goals.position, torch.nan))
    assert simulate(policy, batch, num_rollouts=2, seed=5, goals=nonsense).decision.equal(free.decision)
    only_first = goals.only(torch.arange(12).expand_as(goals.goal_mask) == 0)
    isolated = copy.deepcopy(policy)
    isolated.network.decoder.config = replace(policy.config, agent_radius_m=1e-3)  # no agent attends to another one
    context = isolated.encode(batch)
    dists = [
        isolated.decide(context, isolated.begin(context, 2, g, torch.zeros(0))).log_probs for g in (None, only_first)
    ]
    gap = (dists[0] - dists[1]).abs().amax(-1).view(2, 12)
    assert (gap[:, 0] > 1e-4).all()
    assert (gap[:, 1:] < 1e-5).all()


@each_encoding
@each_part
def test_goals_may_differ_between_rollouts(encoding, bias, base, batch):
    policy, goals = learned(base, encoding, bias=bias), far_goals(batch).repeat(2)
    first_only = goals.only(torch.tensor([True, False]).view(1, 2, 1).expand_as(goals.goal_mask))
    mixed = simulate(policy, batch, num_rollouts=2, seed=5, goals=first_only)
    free = simulate(policy, batch, num_rollouts=2, seed=5)
    whole = simulate(policy, batch, num_rollouts=2, seed=5, goals=goals)
    torch.testing.assert_close(mixed.position[:, 0], whole.position[:, 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(mixed.position[:, 1], free.position[:, 1], atol=1e-4, rtol=0)


@each_encoding
@each_part
def test_a_model_that_sees_goals_keeps_the_contract(encoding, bias, base):
    small = SmartPolicy(replace(SMALL, num_decoder_layers=1), base.vocabulary)
    report = check_policy(learned(small, encoding, 0.1 if bias else 0.5, bias=bias), BENDING[1:])
    assert report.is_passed, str(report)


def scored(policy, batch, rollouts):
    """Mean log-probability of what was decided and its gradient."""
    policy.zero_grad()
    decided = policy.score(policy.encode(batch), rollouts).log_prob(rollouts.decision)[rollouts.decision_mask].mean()
    decided.backward()
    return float(decided.detach()), {
        name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None
    }


@each_encoding
@pytest.mark.parametrize("trained", ["all", "parts"])
def test_goals_are_seen_in_half_precision_too(encoding, trained, base, batch):
    policy, goals = learned(base, encoding), far_goals(batch)
    if trained == "parts":
        policy.requires_grad_(False)
        for part in policy.fine_tuned_modules():
            part.requires_grad_(True)
    with torch.autocast("cpu", torch.bfloat16):
        rollouts = simulate(policy, batch, num_rollouts=2, seed=5, goals=goals)
        torch.clear_autocast_cache()  # as at the end of an update's rollouts
        mixed, mixed_gradients = scored(policy, batch, rollouts)
    exact, gradients = scored(policy, batch, rollouts)
    assert mixed != exact
    assert mixed == pytest.approx(exact, rel=0.02)
    assert mixed_gradients.keys() == gradients.keys()
    sizes = [sum(float(g.square().sum()) for g in found.values()) ** 0.5 for found in (mixed_gradients, gradients)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.2)
    assert any(".goal." in name for name in gradients)


@each_encoding
def test_a_model_that_sees_goals_is_saved_and_read(encoding, base, batch, tmp_path):
    policy = learned(base, encoding)
    policy.save_pretrained(tmp_path)
    again = SmartPolicy.from_pretrained(tmp_path).eval()
    assert again.is_goal_conditioned
    paths = [simulate(p, batch, num_rollouts=1, seed=5, goals=far_goals(batch)).position for p in (policy, again)]
    assert torch.equal(*paths)


def test_sight_is_given_once(base):
    policy = base.with_goal_conditioning("concat")
    assert policy.with_goal_conditioning("concat") is policy
    with pytest.raises(ConfigError, match="goal-conditioned by concat, not by indication"):
        policy.with_goal_conditioning("indication")


@each_encoding
def test_without_aim_a_model_is_the_papers(encoding, base, batch):
    plain = base.with_goal_conditioning(encoding, logit_bias=False)
    assert plain.with_goal_conditioning(encoding) is plain  # a goal-conditioned model keeps its encoding
    assert [type(part).__name__ for part in plain.goal_modules()] == [
        {"concat": "GoalEmbedding", "indication": "GoalEdgeEmbedding"}[encoding]
    ]
    biased = base.with_goal_conditioning(encoding)
    assert {*biased.network.state_dict()} - {*plain.network.state_dict()} == {"decoder.aim.weight"}
    assert biased.with_goal_conditioning(encoding, logit_bias=True) is biased
    for model, bias in ((biased, False), (plain, True)):
        with pytest.raises(ConfigError, match=f"goal-conditioned {'without' if bias else 'with'} a goal logit bias"):
            model.with_goal_conditioning(encoding, logit_bias=bias)


def test_guidance_counts_an_aim_several_times(base, batch):
    policy = learned(base, "concat", 0.1, bias=True)
    rollouts = simulate(policy, batch, num_rollouts=1, seed=5, goals=far_goals(batch))
    scored = [logits(p, batch, rollouts) for p in (policy.with_guidance(0.0), policy, policy.with_guidance(3.0))]
    exists = scored[0] > -1e8
    once, thrice = (dists[exists] - scored[0][exists] for dists in scored[1:])
    torch.testing.assert_close(thrice, 3 * once, atol=2e-2, rtol=1e-3)
    free = [simulate(p, batch, num_rollouts=1, seed=5).position for p in (policy, policy.with_guidance(3.0))]
    assert free[0].equal(free[1])
    assert policy.with_guidance(1.0) is policy
    for times in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="a number of 0 or more"):
            policy.with_guidance(times)
    with pytest.raises(ConfigError, match="has no goal logit bias"):
        base.with_guidance(2.0)


def test_an_aim_without_sight_is_refused():
    with pytest.raises(ConfigError, match="the model is goal-free"):
        replace(SMALL, goal_logit_bias=True)


def test_how_tokens_suit_by_hand():
    """A goal 12 m ahead.

    Tokens: stand, 2 m ahead (4 m/s), 2 m to the left; one decision left, then four (1.5 s after the token).
    """
    moves = torch.tensor([[[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]])
    goal = torch.tensor([[12.0, 0.0]]).repeat(2, 1)
    found = suitability(goal, torch.tensor([1, 4]), torch.tensor([0, 0]), moves)
    aside = (144.0 + 4.0) ** 0.5
    ends = (144.0 + 8.0**2) ** 0.5  # 2 m and three times 2 m to the left
    expected = [
        [[0.0, 2.0, 12.0 - aside], [-12.0, -10.0, -aside], [-12.0, -10.0, -aside]],
        [[0.0, 2.0, 12.0 - aside], [-12 / 2.5, -4 / 2.5, -(aside - 6) / 2.5], [-12 / 2.5, -4 / 2.5, -ends / 2.5]],
    ]
    rounded = torch.tensor(expected)
    rounded[:, 1:] = -(rounded[:, 1:].square() + 0.25).sqrt()
    torch.testing.assert_close(found, rounded)


@pytest.mark.parametrize("ahead_m", [5.0, 40.0, 100.0])
def test_the_goal_logit_bias_prefers_the_speed_that_gets_there_in_time(ahead_m):
    """At the first of 16 decisions, of tokens straight ahead; the farther the faster."""
    bias = GoalLogitBias()
    with torch.no_grad():
        bias.weight.fill_(1.0)
        bias.weight[..., 0] = 0.0  # whatever leads nearer at once aside
    steps_m = torch.linspace(0, 15, 301)
    moves = torch.stack([steps_m, torch.zeros(301)], -1)[None]
    goal, first, vehicle = torch.tensor([[ahead_m, 0.0]]), torch.tensor([16]), torch.tensor([0])
    best = steps_m[bias(suitability(goal, first, vehicle, moves), first, vehicle).argmax()]
    assert best == pytest.approx(ahead_m / 16, abs=0.06)


def test_an_unknown_goal_encoding_is_refused(base, tmp_path):
    base.save_pretrained(tmp_path)
    config = tmp_path / "config.json"
    config.write_text(config.read_text().replace('"goal": null', '"goal": "telepathy"'))
    with pytest.raises(RlftsimError, match="telepathy"):
        SmartPolicy.from_pretrained(tmp_path)


def test_a_model_without_goals_cannot_be_read_as_one_with(base, tmp_path):
    base.save_pretrained(tmp_path)
    config = tmp_path / "config.json"
    config.write_text(config.read_text().replace('"goal": null', '"goal": "concat"'))
    with pytest.raises(CheckpointError, match=r"missing decoder\.goal\.frequencies"):
        SmartPolicy.from_pretrained(tmp_path)


def test_the_goal_polyline_is_the_nearest_token_of_the_own_scenario():
    points = torch.tensor([[[0.0, 0.0], [10.0, 0.0], [torch.inf, torch.inf]], [[9.0, 1.0], [0.0, 2.0], [40.0, 0.0]]])
    position = torch.tensor([[[[9.0, 1.0], [3.0, 0.0]]], [[[9.0, 1.0], [2000.0, 0.0]]]])
    goals = Goals(position, torch.tensor([[[True, False]], [[True, True]]]))
    # scenario 0: token 1, and no goal; scenario 1: token 3 + 0, and a goal that is nowhere near the map
    assert encode_goals(goals, points).polyline.tolist() == [[[1, -1]], [[3, -1]]]


@each_encoding
@each_part
@pytest.mark.parametrize("lies", ["beyond all of the map", "nowhere"])
def test_a_goal_nowhere_is_none_and_one_far_from_the_map_has_no_polyline(encoding, bias, lies, base):
    policy, batch = learned(base, encoding, bias=bias), collate([scenes.crowd(num_agents=40)])
    goals = far_goals(batch)
    near = goals.position + (1000.0 if lies == "beyond all of the map" else torch.nan)
    first = torch.zeros_like(goals.goal_mask)
    first[:, :, 0] = True
    conditioned = replace(goals, position=torch.where(first[..., None], near, goals.position))
    paths = [
        simulate(policy, batch, num_rollouts=1, seed=5, goals=g).position
        for g in (conditioned, conditioned.only(first))
    ]
    assert all(path.isfinite().all() for path in paths)
    free = simulate(policy, batch, num_rollouts=1, seed=5).position
    is_seen = lies == "beyond all of the map" and (bias or encoding == "concat")
    assert paths[1].equal(free) != is_seen


def test_a_goal_beyond_a_large_map_has_no_polyline():
    points = torch.stack([torch.arange(300.0), torch.zeros(300)], -1)[
        None
    ]  # so many that only those around are looked at
    position = torch.tensor([[[[100.2, 450.0], [torch.nan, 0.0]]]])
    encoded = [encode_goals(Goals(position, torch.tensor([[mask]])), points) for mask in ([True, False], [True, True])]
    assert [goals.polyline.tolist() for goals in encoded] == [[[[-1, -1]]]] * 2
    assert encoded[1].goal_mask.tolist() == [[[True, False]]]  # what is no point is no goal
