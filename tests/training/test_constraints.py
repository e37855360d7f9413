"""Means that fine-tuning holds: prices, how a change is measured, and which rollouts are scored."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

import tiny
from rlftsim.errors import ConfigError
from rlftsim.realism import score_rollouts
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.config import FinetuneConfig
from rlftsim.training.constraints import (
    CONSTRAINTS,
    Constraint,
    Prices,
    constraint_by_name,
    credit_constraints,
    register_constraint,
)
from rlftsim.training.experience import compute_reward
from rlftsim.training.reward import prepare, update_policy
from rlftsim.training.run import train_policy
from rlftsim.training.scored_rollouts import draw_rollouts

CONFIG = replace(tiny.FINETUNE, num_rollouts=4, credit="agent", constraints=("speed", "kinematic"))


@pytest.fixture
def batch(drawn_scenarios):
    return collate(drawn_scenarios[:2])


def score(batch, rollouts):
    return score_rollouts(batch, rollouts, "2025")[1]


# ---- prices ----------------------------------------------------------------------------------------------------------


def no_moments(count):
    return np.zeros((count + 1, count))


@pytest.mark.parametrize("pull", [-0.02, 0.01])
def test_prices_bring_a_mean_back_that_the_reward_pulls_away(pull):
    prices, speed, path = Prices(("speed",)), 0.0, []
    for _ in range(600):
        prices.watch(0.06, no_moments(1), [speed])
        speed += pull - prices.price("speed")  # the model gives way to reward and price
        path.append(speed)
    assert max(map(abs, path)) < 0.1 * abs(600 * pull)
    assert abs(path[-1]) < 0.01
    assert min(path) * max(path) >= -0.2 * max(map(abs, path)) ** 2  # it hardly swings to the other side


def test_a_change_that_is_allowed_has_no_price():
    prices = Prices(("kinematic", "min_ade"))
    for _ in range(5):
        prices.watch(1.0, no_moments(2), [0.1, -0.3])  # the sub-score rises, the error falls
    assert [prices.price(name) for name in prices.names] == [0.0, 0.0]
    prices.watch(1.0, no_moments(2), [-0.001, 0.1])
    assert prices.price("kinematic") < 0 < prices.price("min_ade")


def test_prices_follow_the_unit_of_the_reward():
    prices, tenfold = Prices(("speed",)), Prices(("speed",))
    for each, spread in ((prices, 0.06), (tenfold, 0.6)):
        each.watch(spread, np.array([[4.0], [0.0]]), [-0.2])
    assert tenfold.price("speed") == pytest.approx(10 * prices.price("speed"))
    assert prices.price("speed") < 0  # slower than before: speed is paid for


def test_what_rewards_pay_for_a_mean_is_its_price_from_the_first_update_on():
    credits = np.random.default_rng(0).normal(size=(2, 50))
    rewards = -0.3 * credits[0] + 0.1 * credits[1]
    prices = Prices(("speed", "evaluated_speed"))
    prices.watch(0.1, np.concatenate([credits, rewards[None]]) @ credits.T, [0.0, 0.0])
    assert [prices.price(name) for name in prices.names] == pytest.approx([-0.3, 0.1])


def test_prices_go_on_from_a_checkpoint():
    prices = Prices(("speed", "stops"))
    prices.watch(0.3, np.arange(6.0).reshape(3, 2), [-0.2, 0.02])
    resumed = Prices(("speed", "stops"))
    resumed.load_numbers(prices.to_numbers())
    assert resumed.to_numbers() == prices.to_numbers()
    assert [resumed.price(name) for name in resumed.names] == [prices.price(name) for name in prices.names]


def test_a_measurement_that_is_not_finite_changes_no_price():
    prices = Prices(("speed",))
    prices.watch(0.3, no_moments(1), [-0.2])
    before = prices.price("speed")
    prices.watch(math.nan, no_moments(1), [math.nan])
    assert prices.price("speed") == before


# ---- what is measured ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("probability", [0.0, 1.0], ids=["goal-free", "goals"])
def test_a_policy_that_is_the_reference_has_not_changed(vocabulary, batch, fabric, probability):
    config = replace(CONFIG, constraints=("speed", "min_ade", "kinematic", "stops"))
    config = replace(config, goals=replace(config.goals, probability=probability))
    policy = tiny.tiny_policy(vocabulary)
    if probability:  # it has learned to see goals
        policy = policy.with_goal_conditioning("concat")
        torch.nn.init.normal_(policy.network.decoder.goal.out[-1].weight)
    learner = prepare(policy, config, fabric.device)
    values = update_policy(learner, batch, config, fabric)
    assert [values[f"change_{name}"] for name in config.constraints] == [0.0] * 4


def test_a_slower_policy_is_measured_as_slower_and_speed_is_paid_for(vocabulary, batch, fabric):
    config = replace(CONFIG, learning_rate=1e-30)
    learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
    speed = learner.policy.vocabulary.corners[0, :, -1, :, 0].mean(-1)  # way of a vehicle's token, m
    with torch.no_grad():
        learner.policy.network.decoder.head[-1].bias[: len(speed)] -= 0.3 * (speed - speed.mean())
    values = update_policy(learner, batch, config, fabric)
    means = []
    for policy in (learner.policy, learner.reference):
        seed = derive_seed(config.seed, "rollouts", 0)
        rollouts = simulate(policy, batch, num_rollouts=4, seed=seed)
        speeds = torch.cat([batch.position[:, None, :, 10:11].expand(-1, 4, -1, -1, -1), rollouts.position], 3)
        speeds = speeds.diff(dim=3).norm(dim=-1) / 0.1  # [B, N, A, T]
        valid = (batch.valid[:, :, 11:] & batch.valid[:, :, 10:-1] & batch.agent_mask[..., None])[:, None]
        of_agents = (speeds * valid).sum(-1) / valid.sum(-1).clamp(min=1)
        means.append((of_agents.sum(-1) / valid.any(-1).sum(-1)).mean())
    assert means[0] < means[1]
    assert values["change_speed"] == pytest.approx(float(means[0] - means[1]), rel=1e-4)
    assert values["price_speed"] < 0


def test_the_price_is_taken_from_the_rewards_of_the_agents(vocabulary, batch, fabric):
    config = replace(CONFIG, constraints=("speed",), gradient_clip=1e9)
    gradients = []
    for lasting in (-1e6, 1e6):  # speed is worth far more than realism, or costs as much
        learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
        learner.prices.spread, learner.prices.lasting["speed"] = 1.0, lasting
        update_policy(learner, batch, config, fabric)
        gradients.append(torch.cat([gradient.flatten() for gradient in tiny.gradients_of(learner.policy).values()]))
    assert functional.cosine_similarity(*gradients, dim=0) < -0.999
    rollouts = simulate(learner.policy, batch, num_rollouts=4, seed=0)
    *_, credits = compute_reward(batch, rollouts, config)
    assert credits.shape == (1, *rollouts.decision_mask.shape[:3])
    assert credits.sum() == pytest.approx(0.0, abs=1e-9)


def test_the_mean_of_the_weights_is_what_a_run_gives(vocabulary, drawn_scenarios, tmp_path):
    config = replace(CONFIG, ema_decay=0.9, epochs=1.0, device=tiny.CPU)
    policy = tiny.tiny_policy(vocabulary)
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    train_policy(policy, drawn_scenarios, tmp_path, config)
    plain = tiny.tiny_policy(vocabulary)
    train_policy(plain, drawn_scenarios, tmp_path / "plain", replace(config, ema_decay=None))
    name = "network.decoder.head.3.weight"
    averaged, last, first = (state[name] for state in (policy.state_dict(), plain.state_dict(), before))
    assert 0 < (averaged - first).norm() < (last - first).norm()


# ---- constraints of one's own ----------------------------------------------------------------------------------------


def test_a_constraint_of_a_notebook_is_held_by_its_name(vocabulary, batch, fabric):
    @register_constraint("turning", tolerance=0.1)
    def turning(batch, rollouts, agents):
        turned = (rollouts.heading[..., -1] - batch.heading[:, None, :, 10]).abs()
        return turned * batch.agent_mask[:, None]

    try:
        assert isinstance(turning, Constraint)
        config = replace(CONFIG, constraints=("turning",))
        learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
        assert math.isfinite(update_policy(learner, batch, config, fabric)["change_turning"])
        with pytest.raises(ConfigError, match="'speed' ships with rlftsim"):
            register_constraint("speed", tolerance=1.0)(turning.shares)
    finally:
        CONSTRAINTS.remove("turning")


@pytest.fixture
def register():
    """Register a constraint "mine" of a function, and forget it after the test."""
    yield lambda function, **settings: register_constraint("mine", tolerance=0.1, **settings)(function)
    CONSTRAINTS.remove("mine")


def share_evenly(batch, rollouts, agents):
    return torch.full_like(rollouts.heading[..., 0], 0.25)


@pytest.mark.parametrize(
    ("function", "result"),
    [
        (lambda *_: share_evenly(*_).sum(-1), r"shape \[2, 4\]"),
        (lambda *_: share_evenly(*_)[..., None], r"shape \[2, 4, 8, 1\]"),
        (lambda *_: 0.5, "a float"),
    ],
)
def test_shares_that_are_none_of_agents_are_refused(vocabulary, batch, fabric, register, function, result):
    register(function)
    config = replace(CONFIG, constraints=("mine",))
    learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
    with pytest.raises(
        ConfigError, match=rf"constraint 'mine' of test_constraints gives {result}, expected \[2, 4, 8\]"
    ):
        update_policy(learner, batch, config, fabric)


@pytest.mark.parametrize("convert", [torch.Tensor.bool, torch.Tensor.int], ids=["bool", "count"])
def test_shares_may_be_truths_and_counts(vocabulary, batch, fabric, register, convert):
    register(lambda batch, rollouts, agents: convert(rollouts.decision_mask.sum(-1)))
    config = replace(CONFIG, constraints=("mine",))
    learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
    assert update_policy(learner, batch, config, fabric)["change_mine"] == 0.0


def test_a_constraint_has_a_score_of_scenarios_and_a_name_of_its_own():
    with pytest.raises(ConfigError, match=r"constraint 'mine': there is no score 'map': take one of meta_metric, kin"):
        register_constraint("mine", tolerance=0.1, score="map")
    for name in ("kl", "rmm", "length", "offroad_rate"):
        with pytest.raises(ConfigError, match=f"constraint '{name}' has the name of a column that is measured"):
            register_constraint(name, tolerance=0.1)(share_evenly)
        assert CONSTRAINTS.find(name) is None


@pytest.mark.parametrize("tolerance", [0.0, -1.0, math.nan])
def test_a_tolerance_is_above_zero(tolerance):
    with pytest.raises(ConfigError, match="above 0"):
        register_constraint("never", tolerance=tolerance)


def test_a_constraint_that_is_named_twice_is_refused(vocabulary, drawn_scenarios, tmp_path):
    config = replace(CONFIG, constraints=("speed", "speed"))
    with pytest.raises(ConfigError, match="constraints are different names, got speed, speed"):
        train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)


def test_goals_and_constraints_do_not_go_together():
    with pytest.raises(ConfigError, match="the speed that goals of reward"):
        replace(CONFIG, reward="gcft", goals=replace(CONFIG.goals, probability=1.0))


def test_stops_are_those_of_moving_agents_whose_log_goes_on(batch, vocabulary):
    policy = tiny.tiny_policy(vocabulary)
    rollouts = simulate(policy, batch, num_rollouts=2, seed=0)
    stands = replace(rollouts, position=batch.position[:, None, :, 10:11].expand_as(rollouts.position).clone())
    shares = constraint_by_name("stops").shares(batch, stands, score(batch, stands))
    logged = batch.position[:, :, 10:].diff(dim=-2).norm(dim=-1) / 0.1
    is_moving = (logged.mean(-1) > 1) & batch.evaluated_mask
    assert is_moving.any()
    assert (shares.sum(-1) <= 1 + 1e-6).all()
    assert shares.sum() > 0
    assert (shares.sum(1)[~batch.evaluated_mask] == 0).all()


# ---- rollouts that are scored ----------------------------------------------------------------------------------------


def test_rollouts_are_drawn_by_their_reward_and_stand_for_all_on_average():
    config = replace(FinetuneConfig(), num_rollouts=6, num_scored=2)
    reward = torch.tensor([0.0, 0.1, 0.1, 0.2, 0.6, 0.0])[None, :, None]
    counts, total = torch.zeros(6), torch.zeros(6)
    for update in range(4000):
        index, weight = draw_rollouts(reward, config, update, ["a"])
        assert weight.max() <= 2 * 6 / 2 + 1e-5
        counts.index_add_(0, index[0], torch.ones(2))
        total.index_add_(0, index[0], weight[0])
    torch.testing.assert_close(total / 4000, torch.ones(6), atol=0.1, rtol=0)
    assert counts[4] > 2 * counts[1] > 0
    assert counts[0] > 0


def test_scenarios_draw_alike_alone_and_in_a_batch():
    config = replace(FinetuneConfig(), num_rollouts=5, num_scored=3)
    reward = torch.rand(2, 5, 4, generator=torch.Generator().manual_seed(0))
    index, weight = draw_rollouts(reward, config, 7, ["a", "b"])
    alone, alone_weight = draw_rollouts(reward[1:], config, 7, ["b"])
    assert torch.equal(index[1:], alone)
    assert torch.equal(weight[1:], alone_weight)


def test_scored_rollouts_without_any_reward_are_drawn_evenly():
    config = replace(FinetuneConfig(), num_rollouts=4, num_scored=2)
    index, weight = draw_rollouts(torch.zeros(1, 4, 3), config, 0, ["a"])
    assert torch.equal(weight, torch.full((1, 2), 2.0))
    assert index.unique().numel() == 2


def test_where_fewer_are_rolled_out_all_are_scored(vocabulary, batch, fabric):
    gradients = []
    for num_scored in (None, 9):
        config = replace(CONFIG, num_scored=num_scored)
        learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
        update_policy(learner, batch, config, fabric)
        gradients.append(tiny.gradients_of(learner.policy))
    for name, gradient in gradients[0].items():
        assert torch.equal(gradient, gradients[1][name])


@pytest.mark.parametrize("changes", [{"num_scored": 0}, {"credit_clip": 0.0}, {"ema_decay": 1.0}])
def test_settings_of_the_estimator_have_bounds(changes):
    with pytest.raises(ConfigError, match=next(iter(changes))):
        replace(CONFIG, **changes)


def test_hindsight_scores_all_rollouts(vocabulary, drawn_scenarios, tmp_path):
    goals = replace(CONFIG.goals, probability=1.0, hindsight=0.5)
    config = replace(CONFIG, constraints=(), reward="gcft", goals=goals, num_scored=2)
    policy = tiny.tiny_policy(vocabulary).with_goal_conditioning("concat")
    with pytest.raises(ConfigError, match=r"hindsight needs all rollouts, and finetune\.num_scored is 2"):
        train_policy(policy, drawn_scenarios, tmp_path, config)


def test_credits_are_zero_for_agents_that_decide_nothing(batch, vocabulary):
    rollouts = simulate(tiny.tiny_policy(vocabulary), batch, num_rollouts=3, seed=0)
    credits = credit_constraints(("speed",), batch, rollouts, score(batch, rollouts))
    decides = rollouts.decision_mask.any(-1)
    assert (credits[0][~decides] == 0).all()
    assert credits[0][decides].abs().max() > 0
