"""TrafficBots as a policy: the contract, the noise, the draws, and scenes without one thing or another."""

import copy
import json
import math
from dataclasses import replace

import pytest
import torch
from tiny_trafficbots import TINY

import scenes
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.registry import load_policy
from rlftsim.policies.trafficbots.config import trafficbots_demo
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.policies.trafficbots.state import MAX_ACTION
from rlftsim.rollout.check import check_policy
from rlftsim.rollout.edge_scenes import edge_scenes
from rlftsim.rollout.policy import ImitatedPolicy, PartlyTrainedPolicy, Sampling, SharingPolicy, TrainablePolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import AgentStates
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.training.freezing import freeze_untrained


@pytest.fixture(scope="module")
def policy():
    torch.manual_seed(0)
    policy = TrafficBotsPolicy(TINY).eval()
    freeze_untrained(policy, "decoder")
    return policy


@pytest.fixture(scope="module")
def batch():
    return collate([scenes.bend("one", 3), scenes.junction_with_light("two")])


def scored(policy, batch, rollouts):
    return policy.score(policy.encode(batch), rollouts)


@pytest.mark.slow
def test_the_contract_is_kept(policy):
    report = check_policy(policy, [scenes.bend("one", 3), scenes.junction_with_light("two")])
    assert report.is_passed, str(report)


def test_it_is_a_policy_that_training_knows(policy):
    assert isinstance(policy, TrainablePolicy)
    assert isinstance(policy, PartlyTrainedPolicy)
    assert isinstance(policy, ImitatedPolicy)


@torch.no_grad()
def test_all_eighty_decisions_are_scored_as_they_were_sampled(policy, batch):
    rollouts = simulate(policy, batch, num_rollouts=2, seed=0)
    gap = scored(policy, batch, rollouts).log_prob(rollouts.decision) - rollouts.log_prob
    assert rollouts.decision.shape[3] == 80
    assert float(gap.abs().max()) < 1e-4
    # The number of decisions in memory changes nothing.
    few = TrafficBotsPolicy(replace(TINY, steps_per_pass=7)).eval()
    few.load_state_dict(policy.state_dict())
    again = scored(few, batch, rollouts).log_prob(rollouts.decision)
    assert float((again - rollouts.log_prob).abs().max()) < 1e-4


@torch.no_grad()
@pytest.mark.parametrize("changes", [False, True])
def test_lights_are_encoded_at_each_decision_also_where_they_settle(policy, batch, monkeypatch, changes):
    network, steps = policy.network, []
    if changes:  # every ten steps, so that a window of eleven is never full of a single state

        def change(features):
            steps.append(1)
            return torch.nn.functional.one_hot(torch.full(features.shape[:-1], len(steps) // 10 % 2), 5).float()

        monkeypatch.setattr(network, "next_light_logits", change)
    context = policy.encode(batch)
    steps.clear()
    scene = context.scene
    neighborhoods = network.lights.neighborhoods(scene, context.map_features)
    window = scene.light_state[:, None, :, : network.lights.window]
    for step in range(80):
        features = network.lights(window, neighborhoods)
        assert torch.equal(context.light_features[:, step], features[:, 0])
        window = torch.cat([window[..., 1:], network.next_light_logits(features).argmax(-1)[..., None]], -1)


def test_mean_actions_differ_by_draws_alone(policy, batch):
    first, second = (
        simulate(policy, batch, num_rollouts=2, seed=0, sampling=Sampling(temperature=0.0)) for _ in range(2)
    )
    assert torch.equal(first.position, second.position)
    assert not torch.equal(first.position[:, 0], first.position[:, 1])
    # Same draws: the same rollout again.
    context, draws = policy.encode(batch), first.draws[:, :1]
    state = policy.start(context, draws)
    for step in range(5):
        dist = policy.decide(context, state)
        taken = first.decision[:, :1, :, step]
        assert torch.allclose(dist.mean[dist.mask], taken[dist.mask], atol=1e-6)
        state = policy.advance(context, state, taken)


def test_along_its_own_rollouts_a_policy_with_a_trained_head_computes_no_features_again(batch, monkeypatch):
    torch.manual_seed(0)
    learner = TrafficBotsPolicy(TINY).eval()
    reference = copy.deepcopy(learner).requires_grad_(False)
    freeze_untrained(learner, "head")
    with torch.no_grad():
        context = learner.encode(batch)
        others = simulate(learner, batch, num_rollouts=2, seed=1, context=context)
        rollouts = simulate(learner, batch, num_rollouts=2, seed=0, context=context)
    counted = []
    features = learner.network.features
    monkeypatch.setattr(learner.network, "features", lambda *inputs: counted.append(1) or features(*inputs))
    for number, one in enumerate((rollouts, others, rollouts.select(slice(0, 1)))):
        own = learner.encode_like(batch, context)
        dist, ref_dist = learner.score_with_reference(own, one, reference, reference.encode_like(batch, context), one)
        assert bool(counted) == (number > 0)  # others than those of the record, or a part of them
        assert torch.allclose(dist.log_prob(one.decision), one.log_prob, atol=1e-4)
        assert torch.allclose(ref_dist.mean, dist.mean, atol=1e-6)
    # Of rollouts that take turns, the record is of the last that began.
    with torch.no_grad():
        first, second = (learner.start(context, one.draws) for one in (rollouts, others))
        first, *_ = (learner.advance(context, s, learner.decide(context, s).mean) for s in (first, second))
        learner.decide(context, first)
    assert torch.equal(context.record.draws, others.draws)
    assert len(context.record.poses) == 1
    # A policy that has learned other features has no use for the record.
    with torch.no_grad():
        next(learner.network.agents.parameters()).add_(0.1)
    assert learner.encode_like(batch, replace(context, model=reference)).record is not context.record


@torch.no_grad()
def test_the_noise_has_its_size_and_correlation(policy, batch):
    rollouts = simulate(policy, batch, num_rollouts=8, seed=1)
    context = policy.encode(batch)
    correlated = scored(policy, batch, rollouts)
    white = TrafficBotsPolicy(replace(TINY, noise_correlation=0.0)).eval()
    white.load_state_dict(policy.state_dict())
    mean = white.score(context, rollouts).mean  # without the part of the last residual
    stays = correlated.mask.all(-1)  # [B, N, A] agents that do not leave the map
    unit = torch.tensor(MAX_ACTION)[context.scene.agent_class][:, None, :, None]  # m/s² and rad/s where tanh is linear
    noise = ((rollouts.decision - mean) * unit)[stays]  # [agents, 80, 2]
    assert len(noise) > 40
    assert noise.std((0, 1)).tolist() == pytest.approx([0.3, 0.03], rel=0.1)
    lag = (noise[:, 1:] * noise[:, :-1]).mean((0, 1)) / noise.square().mean((0, 1))
    assert lag.tolist() == pytest.approx([0.9, 0.9], abs=0.03)
    later, first = correlated.std[stays][:, 1:], correlated.std[stays][:, :1]
    assert torch.allclose(later, first * math.sqrt(1 - 0.81), rtol=1e-5)


@pytest.mark.parametrize("trained", ["decoder", "head"])
def test_scoring_with_a_reference_is_scoring_twice(batch, trained):
    """Where only the head is trained the features of both models are computed once."""
    torch.manual_seed(0)
    learner = TrafficBotsPolicy(TINY).eval()
    reference = copy.deepcopy(learner).requires_grad_(False)
    freeze_untrained(learner, trained)
    with torch.no_grad():
        for weight in learner.parameters():
            weight.add_(0.02 * torch.randn_like(weight) if weight.requires_grad else 0.0)
    assert isinstance(learner, SharingPolicy)
    assert learner.shares_agent_features(reference) == (trained == "head")
    with torch.no_grad():
        rollouts = simulate(learner, batch, num_rollouts=2, seed=0)
        ref_context = reference.encode(batch)
        ref_alone = reference.score(ref_context, rollouts)
    context = learner.encode_like(batch, ref_context)
    assert context.map_features is ref_context.map_features
    dist, ref_dist = learner.score_with_reference(context, rollouts, reference, ref_context, rollouts)
    gradients = []
    for one in (dist, learner.score(learner.encode(batch), rollouts)):
        learner.zero_grad()
        one.log_prob(rollouts.decision).sum().backward(retain_graph=True)
        gradients.append([w.grad.clone() for w in learner.parameters() if w.grad is not None])
    assert torch.allclose(dist.log_prob(rollouts.decision), rollouts.log_prob, atol=1e-4)
    assert torch.allclose(ref_dist.mean, ref_alone.mean, atol=1e-6)
    assert not ref_dist.mean.requires_grad
    assert len(gradients[0]) == sum(w.requires_grad for w in learner.parameters())
    for own, alone in zip(*gradients):
        assert torch.allclose(own, alone, rtol=1e-3, atol=1e-3 * float(alone.abs().max()))


def test_nothing_is_shared_in_training_mode_or_with_other_settings(batch):
    torch.manual_seed(0)
    learner = TrafficBotsPolicy(TINY).requires_grad_(False).eval()
    same, other = copy.deepcopy(learner), TrafficBotsPolicy(replace(TINY, map_neighbors=2)).requires_grad_(False).eval()
    other.load_state_dict(learner.state_dict())
    assert learner.shares_scene_features(same)
    assert learner.shares_agent_features(same)
    assert not learner.shares_scene_features(other)
    # Dropout would give each model features of its own.
    same.train()
    assert not learner.shares_scene_features(same)
    assert not learner.shares_agent_features(same)
    context = same.eval().encode(batch)
    same.network.map.requires_grad_(True)
    assert learner.encode_like(batch, context).map_features is not context.map_features


def test_fine_tuning_the_head_leaves_pedestrians_as_they_are(batch):
    torch.manual_seed(0)
    learner = TrafficBotsPolicy(TINY).eval()
    reference = copy.deepcopy(learner).requires_grad_(False)
    freeze_untrained(learner, "head")
    with torch.no_grad():
        rollouts = simulate(learner, batch, num_rollouts=1, seed=0)
        for weight in learner.parameters():
            weight.add_(0.1 if weight.requires_grad else 0.0)
        context = learner.encode(batch)
        dist, ref_dist = learner.score_with_reference(context, rollouts, reference, context, rollouts)
    is_vehicle = (context.scene.agent_class == 0)[:, None, :, None].expand(dist.mask.shape)
    differs = (dist.mean != ref_dist.mean).any(-1)
    assert differs[is_vehicle & dist.mask].all()
    others = ~is_vehicle & dist.mask
    assert others.any()
    assert not differs[others].any()


def test_the_score_function_has_mean_zero_and_pays_each_decision_for_itself():
    """E[grad log pi] = 0 over 80 decisions with correlated noise, within five standard errors.

    The first acceleration rises by as much as the head's bias does, so that rewarding it has the gradient 1. A score
    that missed the correlation of the noise would pay the bias for the decisions after it, too: about 10.
    """
    torch.manual_seed(0)
    policy, batch, size = TrafficBotsPolicy(TINY).eval(), collate([scenes.lone_agent()]), 16
    head = policy.requires_grad_(False).network.actions
    biases = [layers[0].bias.requires_grad_() for layers in (head.acceleration, head.yaw_rate)]
    with torch.no_grad():
        rollouts = simulate(policy, batch, num_rollouts=512, seed=0)
    reward = rollouts.decision[0, :, 0, 0, 0]
    reward = reward - reward.mean()  # [512]
    scores, estimates = [], []
    for start in range(0, 512, size):
        own = slice(start, start + size)
        part = rollouts.select(own)
        by_rollout = scored(policy, batch, part).log_prob(part.decision).sum(-1)[0, :, 0]  # [size]
        for values, weight in ((scores, torch.ones(size)), (estimates, reward[own])):
            values.append(torch.cat(torch.autograd.grad((by_rollout * weight).mean(), biases, retain_graph=True)))
    scores, estimates = torch.stack(scores), torch.stack(estimates)  # [32, 2]
    assert (scores.mean(0).abs() < 5 * scores.std(0) / math.sqrt(len(scores))).all()
    error = float(estimates[:, 0].std()) / math.sqrt(len(estimates))
    assert error < 0.3
    assert float(estimates[:, 0].mean()) == pytest.approx(1.0, abs=5 * error)


WALKERS = [scenes.Mover(scenes.ObjectType.PEDESTRIAN, x_m=3.0 * k) for k in range(3)]
AWKWARD = edge_scenes(scenes.bend("x", 3)) | {
    "only pedestrians": scenes.build_scenario("walkers", WALKERS),
    "no road edges": scenes.without_road_edges(),
    "no agent at the current step": scenes.without_agents(slice(CURRENT_STEP, CURRENT_STEP + 1)),
    "no agent at any step": scenes.without_agents(slice(None)),
}


@pytest.mark.parametrize("name", AWKWARD)
def test_scenes_without_something_are_simulated_scored_and_trained_on(policy, name):
    batch = collate([AWKWARD[name]])
    rollouts = simulate(policy, batch, num_rollouts=1, seed=0)
    assert rollouts.position.isfinite().all()
    # elementwise: without agents there is no maximum
    assert ((scored(policy, batch, rollouts).log_prob(rollouts.decision) - rollouts.log_prob).abs() < 1e-4).all()
    found = policy.imitation_loss(batch, batch.agent_mask, 0)
    assert found.loss.isfinite()
    found.loss.backward()
    grads = [p.grad for p in policy.parameters() if p.grad is not None]
    assert all(grad.isfinite().all() for grad in grads)
    policy.zero_grad()


def test_the_yaw_rate_of_pedestrians_has_noise_of_its_own(policy):
    movers = [scenes.Mover(kind, x_m=6.0 * k) for k, kind in enumerate(scenes.SIZES_M)]  # one of each class
    batch = collate([scenes.build_scenario("mixed", movers)])
    wide = TrafficBotsPolicy(replace(policy.config, noise_pedestrian_yaw_rate_radps=0.3))
    stds = []
    for one in (policy, wide):
        context = one.encode(batch)
        stds.append(one.decide(context, one.begin(context, 1, None, torch.full((1, 1, 3, 17), 0.5))).std[0, 0])
    ratio = stds[1] / stds[0]
    is_pedestrian = context.scene.agent_class[0] == 1
    assert ratio[is_pedestrian].tolist() == [[1.0, pytest.approx(10.0)]]
    assert (ratio[~is_pedestrian] == 1).all()


def test_an_agent_that_leaves_the_map_goes_on_straight_and_decides_nothing(policy):
    batch = collate([scenes.bend("leaving", 3)])
    context = policy.encode(batch)
    box = context.scene.map_box.clone()
    box[:, 1] = 5.0  # x: the ego passes it soon
    context = replace(context, scene=replace(context.scene, map_box=box))
    # Its decisions leave every mean once it has left.
    rollouts = simulate(policy, batch, num_rollouts=1, seed=0, context=context)
    decides = rollouts.decision_mask[0, 0, 0]
    assert decides[0]
    assert not decides[-1]
    assert (rollouts.log_prob[0, 0, 0][~decides] == 0).all()
    assert torch.equal(policy.score(context, rollouts).mask[0, 0, 0], decides)

    state = policy.begin(context, 1, None, torch.full((1, 1, 3, 17), 0.5))
    for _ in range(20):
        dist = policy.decide(context, state)
        state = policy.advance(context, state, dist.mean)
    assert not state.traffic.alive[0, 0, 0]
    dist = policy.decide(context, state)
    assert float(dist.entropy()[0, 0, 0].detach()) == 0
    after = policy.advance(context, state, dist.mean)
    moved = (after.poses - state.poses)[0, 0, 0, 0]
    assert float(moved[:2].norm().detach()) == pytest.approx(
        0.1 * abs(float(state.traffic.windows.motion[0, 0, 0, -1, 0])), rel=1e-3
    )
    assert float(moved[2].detach()) == pytest.approx(0.0, abs=1e-6)


def test_an_agent_that_is_put_back_onto_the_map_decides_again_and_padding_never(policy):
    batch = collate([scenes.bend("leaving", 3), scenes.lone_agent()])
    context = policy.encode(batch)
    box = context.scene.map_box.clone()
    box[0, 1] = 5.0  # x: the ego passes it soon
    context = replace(context, scene=replace(context.scene, map_box=box))
    state = first = policy.begin(context, 1, None, torch.full((2, 1, 3, 17), 0.5))
    for _ in range(20):
        state = policy.advance(context, state, policy.decide(context, state).mean)
    assert not state.traffic.alive[0, 0, 0]

    heading = state.poses[..., 2]  # [B, N, A, 1]
    back = AgentStates(torch.zeros(2, 1, 3, 1, 2), heading, torch.ones(2, 1, 3, 1, dtype=torch.bool))
    state = policy.advance(context, state, policy.decide(context, state).mean, back)
    assert torch.equal(state.traffic.alive, batch.agent_mask[:, None])
    # Its noise begins anew: no part of the residual before, and the whole standard deviation.
    dist, begun = policy.decide(context, state), policy.decide(context, first)
    assert torch.equal(dist.mean, state.memo.mean)
    assert torch.equal(dist.std, begun.std)


def test_it_is_saved_and_loaded_by_folder(policy, batch, tmp_path):
    policy.save_pretrained(tmp_path / "model")
    again = load_policy(tmp_path / "model")
    assert again.config == TINY
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in policy.state_dict().items())
    config = json.loads((tmp_path / "model" / "config.json").read_text())
    lacking = {k: v for k, v in config.items() if k not in ("noise_correlation", "noise_pedestrian_yaw_rate_radps")}
    for change, words in (
        (config | {"dim": 48}, "weights do not fit this model"),
        (config | {"num_head": 2}, r"missing: none; unknown: num_head"),
        (
            config | {"noise_acceleration_mps2": -1.0},
            r"config.json: settings do not fit .*noise_acceleration_mps2 must be positive, got -1",
        ),
        (lacking, r"missing: noise_correlation, noise_pedestrian_yaw_rate_radps; unknown: none"),
    ):
        (tmp_path / "model" / "config.json").write_text(json.dumps(change))
        with pytest.raises(CheckpointError, match=words):
            load_policy(tmp_path / "model")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dim": 40}, "multiple of 16"),
        ({"noise_correlation": 1.0}, r"noise_correlation is in \[0, 1\)"),
        ({"forced_fractions": ()}, r"one or more fractions in \[0, 1\], got \(\)"),
        ({"forced_fractions": (1.5,)}, "forced_fractions are one or more fractions"),
    ],
)
def test_wrong_sizes_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        replace(trafficbots_demo(), **changes)


def test_top_k_is_refused(policy, batch):
    with pytest.raises(ConfigError, match="needs a policy with categories"):
        simulate(policy, batch, num_rollouts=1, seed=0, sampling=Sampling(top_k=5))
