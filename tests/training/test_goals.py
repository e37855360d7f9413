"""Fine-tuning with goals: their choice, their reward, and hindsight."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

import scenes
import tiny
from rlftsim.errors import CheckpointError, ConfigError, DataError
from rlftsim.goals.attainment import is_reached
from rlftsim.goals.types import Goals, StoredGoals, logged_goals, write_goal_file
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rewards import parse_reward, reward_by_name, write_reward
from rlftsim.rewards.base import agent_rewards_by_name
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import collate
from rlftsim.training import hindsight
from rlftsim.training.augment import augment_goals
from rlftsim.training.config import AugmentConfig, FinetuneConfig, GcslConfig, GoalConfig, ValidationConfig
from rlftsim.training.experience import Experience, compute_reward
from rlftsim.training.freezing import freeze_untrained
from rlftsim.training.goal_relabeling import relabel_with_endpoints
from rlftsim.training.goals import choose_goals
from rlftsim.training.hindsight import importance_ratio, met_goals, relabel_with_hindsight
from rlftsim.training.policy_gradient import agent_log_prob
from rlftsim.training.reward import prepare, update_policy
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

CONFIG = replace(tiny.FINETUNE, num_rollouts=3, reward="gcft", goals=GoalConfig(probability=1.0))


@pytest.fixture
def batch(drawn_scenarios):
    return collate(drawn_scenarios[:2])


@pytest.fixture(scope="module")
def policy(vocabulary):
    """Sees goals, and has seen some."""
    policy = tiny.tiny_policy(vocabulary).eval().with_goal_conditioning("concat")
    generator = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for weight in policy.network.decoder.goal.out.parameters():
            weight.add_(0.3 * torch.randn(weight.shape, generator=generator))
    return policy


# ---- the reward ----------------------------------------------------------------------------------------------------


def test_the_goal_reward_of_hand_made_paths(measured):
    """Of the junction's 8 evaluated agents 4 have goals; the rollouts meet 2, none and 1 of them."""
    batch = collate([scenes.junction_with_light()])
    rows = batch.evaluated_mask[0].nonzero()[:4, 0]
    mask = torch.zeros_like(batch.agent_mask)
    mask[0, rows] = True
    goals = logged_goals(batch, mask).repeat(3)
    position = goals.position[:, :, :, None].expand(-1, -1, -1, 80, -1) + 50.0
    position = position.clone()
    position[0, 0, rows[:2], 40] -= 50.0  # passed, not reached
    position[0, 2, rows[3], -1] -= 50.0  # reached
    rollouts = simulate_nothing(batch, position, goals)
    fractions = torch.tensor([0.5, 0.0, 0.25])
    # minus the mean of the others: 0.5 - 0.125, 0 - 0.375, 0.25 - 0.25
    soft = reward_by_name("goal")(measured[0], rollouts, batch)
    torch.testing.assert_close(soft[0], torch.tensor([0.375, -0.375, 0.0]))
    torch.testing.assert_close(soft[0], fractions - (fractions.sum() - fractions) / 2)
    hard = reward_by_name("goal")(measured[0], rollouts, batch, kind="hard")
    torch.testing.assert_close(hard[0], torch.tensor([-0.125, -0.125, 0.25]))
    own = agent_rewards_by_name("goal")(measured[3], rollouts, batch)
    torch.testing.assert_close(own.sum(-1), soft)
    assert own[0, :, rows[2]].eq(0).all()  # met in no rollout
    # in part: an agent that stays 50 m on both axes from its goal has covered what is left of its way to it
    part = reward_by_name("goal")(measured[0], rollouts, batch, kind="hard", partial=True)
    ways = (goals.position[0, 0, rows] - batch.position[0, rows, 10]).norm(dim=-1) - 2.0
    progress = 1 - ((50 * 2**0.5 - 2) / ways.clamp(min=2)).clamp(0, 1)
    assert 0 < progress.max() < 1
    ends = torch.stack([progress.mean(), progress.mean(), (progress[:3].sum() + 1) / 4])
    torch.testing.assert_close(part[0], ends - (ends.sum() - ends) / 2)
    with pytest.raises(ConfigError, match="known kinds are soft, hard"):
        reward_by_name("goal")(measured[0], rollouts, batch, kind="medium")


def test_goals_that_differ_between_rollouts_are_measured_in_all_the_others(measured):
    """Each of three rollouts meets its own goal; the second meets the first one's, too: 1 - 1/2, 1 - 0 and 1 - 0."""
    batch = collate([scenes.junction_with_light()])
    row = batch.evaluated_mask[0].nonzero()[:1, 0]
    mask = torch.zeros_like(batch.agent_mask)
    mask[0, row] = True
    position = torch.zeros(1, 3, mask.shape[1], 80, 2)
    position[0, 0, row, -1, 0], position[0, 1, row, -1, 0], position[0, 2, row, -1, 0] = 10.0, 30.0, 50.0
    position[0, 1, row, 40, 0] = 11.0
    rollouts = simulate_nothing(batch, position, Goals(position[..., -1, :], mask[:, None].expand(-1, 3, -1)))
    torch.testing.assert_close(reward_by_name("goal")(measured[0], rollouts, batch)[0], torch.tensor([0.5, 1.0, 1.0]))
    hard = reward_by_name("goal")(measured[0], rollouts, batch, kind="hard")
    torch.testing.assert_close(hard[0], torch.tensor([1.0, 1.0, 1.0]))


@pytest.mark.parametrize("unused_m", [0.0, 10.0])
def test_agents_without_a_goal_earn_nothing(unused_m, measured):
    """Only the second of three rollouts has a goal, x = 10 m, and reaches it: 1, for any unused value of the others."""
    batch = collate([scenes.junction_with_light()])
    row = batch.evaluated_mask[0].nonzero()[:1, 0]
    mask = torch.zeros(1, 3, batch.agent_mask.shape[1], dtype=torch.bool)
    mask[0, 1, row] = True
    goals = torch.full((*mask.shape, 2), unused_m)
    position = torch.zeros(*mask.shape, 80, 2) - 50.0
    goals[0, 1, row] = position[0, 1, row, -1] = torch.tensor([10.0, 10.0])
    rollouts = simulate_nothing(batch, position, Goals(goals, mask))
    for kind in ("soft", "hard"):
        reward = reward_by_name("goal")(measured[0], rollouts, batch, kind=kind)
        torch.testing.assert_close(reward[0], torch.tensor([0.0, 1.0, 0.0]))


def simulate_nothing(batch, position, goals):
    """Rollouts through given positions; the policy does not matter."""
    heading = position[..., 0]
    none = torch.zeros(*heading.shape[:3], 16)
    return Rollouts(position, heading, none.long(), none.bool(), none, goals=goals)


def test_without_goals_there_is_no_goal_reward(measured):
    scores, rollouts, batch, _ = measured
    assert not reward_by_name("goal")(scores, replace(rollouts, goals=None), batch).any()
    no_goals = rollouts.goals.only(torch.zeros_like(rollouts.goals.goal_mask))
    assert not reward_by_name("goal")(scores, replace(rollouts, goals=no_goals), batch).any()


def test_gcft_is_written_as_the_sum_it_is():
    assert (
        FinetuneConfig(reward="gcft", goals=GoalConfig(probability=1.0)).reward
        == "0.9*mloo + 0.1*goal(kind='soft', partial=False)"
    )
    hard = write_reward(parse_reward("gcft(goal_weight=0.5, kind='hard') + 0.1*collision_offroad"))
    assert hard == "0.5*mloo + 0.5*goal(kind='hard', partial=False) + 0.1*collision_offroad"
    with pytest.raises(ConfigError, match="gcft has no option 'weight': known are goal_weight, kind"):
        parse_reward("gcft(weight=0.5)")
    with pytest.raises(ConfigError, match="a weight in"):
        parse_reward("gcft(goal_weight=2)")
    with pytest.raises(ConfigError, match="needs goals: set finetune"):
        FinetuneConfig(reward="gcft")


# ---- choice of goals -----------------------------------------------------------------------------------------------


def test_all_some_or_no_agents_have_a_goal(drawn_scenarios):
    batch = collate(drawn_scenarios)
    assert choose_goals(batch, GoalConfig(), None, seed=1) is None
    every_goal = choose_goals(batch, GoalConfig(probability=1.0), None, seed=1)
    assert every_goal.goal_mask[:, 0].equal(logged_goals(batch).goal_mask[:, 0])
    some = choose_goals(batch, GoalConfig(probability=0.5), None, seed=1)
    assert 0.2 < some.goal_mask.sum() / every_goal.goal_mask.sum() < 0.8
    other = choose_goals(batch, GoalConfig(probability=0.5), None, seed=2)
    assert not other.goal_mask.equal(some.goal_mask)
    # the same for a scenario however batches are composed
    alone = choose_goals(collate(drawn_scenarios[1:2]), GoalConfig(probability=0.5), None, seed=1)
    width = alone.goal_mask.shape[-1]
    assert alone.goal_mask[0].equal(some.goal_mask[1, :, :width])


def test_contradictory_settings_are_refused():
    with pytest.raises(ConfigError, match=r"goals\.probability is a probability"):
        GoalConfig(probability=1.5)
    with pytest.raises(ConfigError, match=r"need goals: set goals\.probability"):
        GoalConfig(hindsight=1.0)
    for name in ("hindsight", "learning_rate_scale"):
        with pytest.raises(ConfigError, match=f"{name} must be a finite number, got inf"):
            GoalConfig(probability=1.0, **{name: float("inf")})
    with pytest.raises(ConfigError, match=r"goals\.hindsight has no effect with reward 'mloo': add a term"):
        FinetuneConfig(goals=GoalConfig(probability=1.0, hindsight=1.0))


# ---- the update ----------------------------------------------------------------------------------------------------


def test_an_update_with_goals_trains_the_goal_encoder_and_logs_their_rates(policy, batch, fabric):
    learner = prepare(copy.deepcopy(policy), CONFIG, fabric.device)
    before = {n: p.detach().clone() for n, p in learner.policy.named_parameters()}
    values = update_policy(learner, batch, CONFIG, fabric)
    assert {"goal_reached_rate", "goal_passed_rate", "reward_goal_std", "reward_mloo_std"} <= values.keys()
    assert 0 <= values["goal_reached_rate"] <= values["goal_passed_rate"] <= 1
    assert values["score_gap"] < 1e-4
    changed = {n for n, p in learner.policy.named_parameters() if not torch.equal(p, before[n])}
    assert any(name.startswith("network.decoder.goal") for name in changed)
    assert not any("map_encoder" in name for name in changed)


def test_the_goal_encoder_may_learn_faster(policy, fabric):
    config = replace(CONFIG, goals=GoalConfig(probability=1.0, learning_rate_scale=10.0))
    learner = prepare(copy.deepcopy(policy), config, fabric.device)
    update_policy(learner, collate([scenes.lone_agent()]), config, fabric)
    rates = {group["scale"]: group["lr"] for group in learner.optimizer.param_groups}
    assert rates[10.0] == pytest.approx(10 * rates[1.0])
    assert sum(len(group["params"]) for group in learner.optimizer.param_groups) == len(learner.parameters)


def test_a_goal_free_model_is_not_trained_with_goals(vocabulary, drawn_scenarios, tmp_path):
    with pytest.raises(ConfigError, match="not goal-conditioned: add --goal concat or --goal indication"):
        train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, CONFIG)


# ---- hindsight -----------------------------------------------------------------------------------------------------


@pytest.fixture
def experience(policy, batch):
    goals = logged_goals(batch)
    rollouts = simulate(policy, batch, num_rollouts=3, seed=2, goals=goals)
    return Experience(batch, rollouts, *compute_reward(batch, rollouts, CONFIG))


def log_prob_under(policy, experience, goals):
    """Log-probability of all of an agent's decisions."""
    rollouts = replace(experience.rollouts, goals=goals)
    with torch.no_grad():
        log_prob = policy.score(policy.encode(experience.batch), rollouts).log_prob(rollouts.decision)
    return agent_log_prob(log_prob, rollouts.decision_mask, "sum")


def test_under_its_own_goal_nothing_is_likelier(policy, experience, fabric, monkeypatch):
    """Rollouts that are scored again under their own goals: a ratio of exactly 1, in an update."""

    def keep_goals(experiences, terms):
        """The rollouts as they were sampled."""
        relabelled = relabel_with_hindsight(experiences, terms)
        return [replace(entry, rollouts=one.rollouts) for entry, one in zip(relabelled, experiences)]

    monkeypatch.setattr(hindsight, "relabel_with_hindsight", keep_goals)
    config = replace(CONFIG, goals=GoalConfig(probability=1.0, hindsight=1.0), rollouts_per_pass=2)
    learner = prepare(copy.deepcopy(policy), config, fabric.device)
    values = update_policy(learner, experience.batch, config, fabric)
    assert values["hindsight_ratio"] == 1.0


def test_ratios_are_those_of_whole_sequences_of_decisions(policy, experience):
    """Agent by agent, from the probabilities themselves; none above 10."""
    rollouts, batch = experience.rollouts, experience.batch
    elsewhere = replace(rollouts.goals, position=rollouts.goals.position + 20.0)
    old, new = (log_prob_under(policy, experience, goals) for goals in (rollouts.goals, elsewhere))
    ratio = importance_ratio(new, old)
    context = policy.encode(batch)
    with torch.no_grad():
        before, after = (
            policy.score(context, replace(rollouts, goals=goals)).log_prob(rollouts.decision)[1, 2, 0].double().exp()
            for goals in (rollouts.goals, elsewhere)
        )
    assert float(ratio[1, 2, 0]) == pytest.approx(float((after / before).prod()), rel=1e-3)
    assert (ratio - 1).abs().max() > 0.01
    assert float(importance_ratio(new + 100.0, new)[0, 0, 0]) == pytest.approx(10.0)


def test_the_goals_of_hindsight_are_met_by_the_most_realistic_rollout(experience):
    rollouts = experience.rollouts
    best = experience.realism.single_meta_metric.argmax(-1)
    goals = met_goals(rollouts, experience.realism)
    for b, n in enumerate(best.tolist()):
        assert is_reached(rollouts.position, goals)[b, n].equal(rollouts.goals.goal_mask[b, n])
        assert goals.position[b].eq(rollouts.position[b, n, :, -1]).all()


def test_hindsight_counts_as_often_as_it_is_likelier(policy, experience, fabric):
    """The gradient of an update is that under the rollouts' own goals plus the weight times that under others, each
    decision counted by its agent's ratio over the mean ratio."""
    config = replace(CONFIG, goals=GoalConfig(probability=1.0, hindsight=0.5), rollouts_per_pass=2)
    batch = experience.batch
    learner = prepare(copy.deepcopy(policy), config, fabric.device)
    start = copy.deepcopy(learner.policy)
    seed = derive_seed(config.seed, "rollouts", 0)
    rollouts = simulate(start, batch, num_rollouts=config.num_rollouts, seed=seed, goals=logged_goals(batch))
    sampled = Experience(batch, rollouts, *compute_reward(batch, rollouts, config))
    (other,) = relabel_with_hindsight([sampled], parse_reward(config.reward))
    old, new = log_prob_under(start, sampled, rollouts.goals), log_prob_under(start, sampled, other.rollouts.goals)
    ratio = (new - old).exp().clamp(max=10)
    decides = rollouts.decision_mask.any(-1)
    weight = 0.5 * ratio / ratio[decides].mean()
    loss = 0.0
    assert other.reward.abs().max() > 0
    for seen, earned in ((rollouts, sampled.rewards.by_agent), (other.rollouts, weight * other.reward)):
        log_prob = start.score(start.encode(batch), seen).log_prob(rollouts.decision)
        by_agent = agent_log_prob(log_prob, rollouts.decision_mask, "mean")
        loss = loss - (earned * by_agent).sum() / batch.num_scenarios
    loss.backward()
    learner.beta = 0.0
    update_policy(learner, batch, replace(config, gradient_clip=1e9), fabric)
    expected = tiny.gradients_of(start)
    for name, gradient in tiny.gradients_of(learner.policy).items():
        torch.testing.assert_close(gradient, expected[name], rtol=1e-3, atol=1e-6)


# ---- goals beside a data set ---------------------------------------------------------------------------------------


def test_augmented_goals_are_where_the_most_realistic_rollout_ends(policy, drawn_scenarios, tmp_path):
    config = AugmentConfig(num_rollouts=3, top_k=8, scenarios_per_part=2, seed=4)
    assert augment_goals(policy, drawn_scenarios, tmp_path, config) == 4
    files = sorted(tmp_path.glob("*.parquet"))
    assert len(files) == 2
    stored = StoredGoals(tmp_path)
    assert len(stored) == len({s.scenario_id for s in drawn_scenarios})
    batch = collate(drawn_scenarios[:1])
    rollouts = simulate(policy, batch, num_rollouts=3, seed=4, goals=logged_goals(batch), sampling=Sampling(top_k=8))
    goals = stored.of_batch(batch)
    best = compute_reward(batch, rollouts, CONFIG)[0].single_meta_metric.argmax()
    torch.testing.assert_close(goals.position[:, 0], rollouts.position[:, best, :, -1], atol=1e-3, rtol=0)
    # what is there is kept, what is missing is made again and is the same
    kept = files[0].stat().st_mtime_ns
    lost = files[1].read_bytes()
    files[1].unlink()
    augment_goals(policy, drawn_scenarios, tmp_path, config)
    assert files[0].stat().st_mtime_ns == kept
    assert files[1].read_bytes() == lost
    with pytest.raises(CheckpointError, match="belongs to a run with other settings"):
        augment_goals(policy, drawn_scenarios, tmp_path, replace(config, seed=5))


def test_goals_are_augmented_by_a_policy_without_categories_too(drawn_scenarios, tmp_path):
    policy, config = ConstantVelocity(), AugmentConfig(num_rollouts=2)
    with pytest.raises(ConfigError, match=r"top_k=32 and ConstantVelocity: .*\(--top-k None\)"):
        augment_goals(policy, drawn_scenarios, tmp_path / "goals", config)
    # The refusal has not claimed the folder for its settings.
    assert augment_goals(policy, drawn_scenarios, tmp_path / "goals", replace(config, top_k=None)) == 4


def test_a_conditioned_policy_without_parts_for_goals_alone_is_trained_as_a_whole():
    native = torch.nn.Linear(1, 1)
    native.is_goal_conditioned = True
    with pytest.raises(ConfigError, match="Linear has no part that only goals use: set trained=all"):
        freeze_untrained(native, "goals")
    with pytest.raises(ConfigError, match="a Linear cannot be given goals: take a model that can"):
        freeze_untrained(torch.nn.Linear(1, 1), "goals")


def test_stored_goals_come_to_the_agents_they_are_of(drawn_scenarios, tmp_path):
    scenario = drawn_scenarios[0]
    ids, origin = scenario.tracks.object_id, scenario.origin
    ends = origin + np.array([[5.0, 6.0], [7.0, 8.0]])
    write_goal_file(tmp_path / "part-0.parquet", {scenario.scenario_id: (ids[[3, 1]], ends)})
    batch = collate(drawn_scenarios[:2])
    goals = StoredGoals(tmp_path).of_batch(batch)
    places = {int(i): n for n, i in enumerate(batch.object_id[0].tolist())}
    assert goals.goal_mask.nonzero().tolist() == sorted([[0, 0, places[int(i)]] for i in ids[[1, 3]]])
    assert goals.position[0, 0, places[int(ids[3])]].tolist() == [5.0, 6.0]
    mixed = [
        choose_goals(
            batch, GoalConfig(probability=1.0, augmented="x", augmented_probability=s), StoredGoals(tmp_path), seed=1
        )
        for s in (0.0, 1.0)
    ]
    assert mixed[0].position.equal(logged_goals(batch).position)
    assert mixed[1].goal_mask[0].equal(goals.goal_mask[0])  # its own, and only those
    assert mixed[1].goal_mask[1].equal(logged_goals(batch).goal_mask[1])  # there are none beside the logged ones


def test_a_folder_of_goals_says_whose_they_are(drawn_scenarios, tmp_path):
    ids = [scenario.scenario_id for scenario in drawn_scenarios]
    points = np.array([3, 5]), np.zeros((2, 2))
    write_goal_file(tmp_path / "a" / "part-0.parquet", {ids[0]: points, ids[2]: points})
    write_goal_file(tmp_path / "b" / "part-0.parquet", {ids[0]: points, ids[2]: (points[0], points[1] + 1e-3)})
    stored = StoredGoals(tmp_path / "a")
    assert (stored.count_among(ids), stored.count_among(ids[1:]), stored.count_among(["elsewhere"])) == (2, 1, 0)
    assert stored.fingerprint == StoredGoals(tmp_path / "a").fingerprint != StoredGoals(tmp_path / "b").fingerprint


def test_a_folder_without_goals_is_refused(tmp_path):
    with pytest.raises(DataError, match="holds no goals: write them by `rlftsim augment`"):
        StoredGoals(tmp_path)
    (tmp_path / "part-0.parquet").write_bytes(b"no table")
    with pytest.raises(DataError, match="cannot be read"):
        StoredGoals(tmp_path)


def test_a_run_with_goals_of_all_kinds(policy, drawn_scenarios, tmp_path):
    """Mixed mode, augmented goals, hindsight, credit by agent: three updates, logged, and a goal-conditioned model."""
    augment_goals(policy, drawn_scenarios, tmp_path / "goals", AugmentConfig(num_rollouts=2, top_k=8))
    goals = GoalConfig(probability=0.7, augmented=str(tmp_path / "goals"), hindsight=0.5, learning_rate_scale=3.0)
    config = replace(CONFIG, goals=goals, epochs=0.75, credit="agent", micro_batch_size=1)
    model = train_policy(copy.deepcopy(policy), drawn_scenarios, tmp_path / "run", config)
    metrics = read_metrics(tmp_path / "run")
    assert len(metrics) == 3
    assert all(line["hindsight_ratio"] > 0 for line in metrics)
    assert '"goal": "concat"' in (model / "config.json").read_text()


def test_goal_free_rollouts_stay_if_only_the_goal_encoder_is_trained(vocabulary, drawn_scenarios, tmp_path):
    """CAT-K with goals, its candidates all tokens: imitation of the record by agents that know where it ends."""
    base = tiny.tiny_policy(vocabulary)
    start = copy.deepcopy(base).eval()
    config = replace(
        tiny.CATK, trained="goals", goal_probability=1.0, num_candidates=1000, learning_rate=1e-2, epochs=2.0
    )
    model = train_policy(base.with_goal_conditioning("concat"), drawn_scenarios, tmp_path, config)
    policy = SmartPolicy.from_pretrained(model).eval()
    batch = collate(drawn_scenarios[:2])
    goals = logged_goals(batch)
    conditioned, goal_free, before = (
        simulate(p, batch, num_rollouts=2, seed=3, goals=g) for p, g in ((policy, goals), (policy, None), (start, None))
    )
    assert goal_free.decision.equal(before.decision)
    assert goal_free.log_prob.equal(before.log_prob)
    assert not conditioned.log_prob.equal(before.log_prob)


def ends(rollouts):
    return rollouts.position[..., -1, :]


def test_a_policy_learns_where_its_own_rollouts_led(vocabulary, drawn_scenarios, tmp_path):
    """Goal-free rollouts stay; decisions become likelier under the goals they led to."""
    base = tiny.tiny_policy(vocabulary).eval()
    start = copy.deepcopy(base)
    config = GcslConfig(epochs=12.0, batch_size=1, learning_rate=3e-2, max_trained_agents=None, device=tiny.CPU)
    model = train_policy(base.with_goal_conditioning("indication"), drawn_scenarios, tmp_path, config)
    policy = SmartPolicy.from_pretrained(model).eval()
    batch = collate(drawn_scenarios[:2])
    before = simulate(start, batch, num_rollouts=8, seed=31)
    goal_free = simulate(policy, batch, num_rollouts=8, seed=31)
    assert goal_free.decision.equal(before.decision)
    assert goal_free.log_prob.equal(before.log_prob)
    relabelled = policy.score(policy.encode(batch), relabel_with_endpoints(before)).log_prob(before.decision)
    mask = before.decision_mask
    assert (relabelled - before.log_prob)[mask].mean() > 0.02
    # with the endpoint of another of its rollouts as a goal, it ends nearer to that than by chance
    elsewhere = ends(simulate(start, batch, num_rollouts=8, seed=32))
    conditioned = ends(simulate(policy, batch, num_rollouts=8, seed=31, goals=Goals(elsewhere, mask.any(-1))))
    by_chance, on_purpose = ((e - elsewhere).norm(dim=-1)[mask.any(-1)].mean() for e in (ends(before), conditioned))
    assert on_purpose < 0.8 * by_chance
    lines = read_metrics(tmp_path)
    assert lines[-1]["loss"] < lines[0]["loss"]


def test_the_reference_has_the_goals_of_the_policy_unless_set_otherwise(policy, batch, fabric):
    """The policy is its own reference: no KL under the same goals, and some against a goal-free reference."""
    found = []
    for conditioned in (True, False):
        config = replace(CONFIG, kl=replace(CONFIG.kl, condition_reference=conditioned))
        found.append(update_policy(prepare(copy.deepcopy(policy), config, fabric.device), batch, config, fabric)["kl"])
    assert found[0] == pytest.approx(0.0, abs=1e-6)
    assert found[1] > 1e-3
    free = replace(CONFIG, reward="mloo", goals=GoalConfig())
    learner = prepare(copy.deepcopy(policy), free, fabric.device)
    assert update_policy(learner, batch, free, fabric)["kl"] < 1e-6


def test_goal_relabeling_needs_a_goal_encoder_and_is_not_validated(vocabulary, drawn_scenarios, tmp_path):
    with pytest.raises(ConfigError, match="not goal-conditioned: add --goal concat"):
        train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path / "run", GcslConfig(device=tiny.CPU))
    with pytest.raises(ConfigError, match="does not change"):
        GcslConfig(validation=ValidationConfig(every=5))
    assert not (tmp_path / "run").exists()


def test_augmented_goals_belong_to_a_run_wherever_they_lie(policy, drawn_scenarios, tmp_path):
    """A typo claims no folder, a moved folder goes on, other goals under the same name do not."""
    augment_goals(policy, drawn_scenarios, tmp_path / "goals", AugmentConfig(num_rollouts=2, top_k=8))
    goals = GoalConfig(probability=1.0, augmented=str(tmp_path / "gaols"))
    config = replace(CONFIG, goals=goals, epochs=0.25)
    with pytest.raises(DataError, match="holds no goals"):
        train_policy(copy.deepcopy(policy), drawn_scenarios, tmp_path / "run", config)
    there = replace(config, goals=replace(goals, augmented=str(tmp_path / "goals")))
    strangers = [replace(drawn_scenarios[0], scenario_id="elsewhere")]
    with pytest.raises(DataError, match="its goals are of other scenarios"):
        train_policy(copy.deepcopy(policy), strangers, tmp_path / "run", there)
    assert not (tmp_path / "run").exists()
    (tmp_path / "goals").rename(tmp_path / "gaols")
    train_policy(copy.deepcopy(policy), drawn_scenarios, tmp_path / "run", config)
    (tmp_path / "gaols").rename(tmp_path / "moved")
    moved = replace(config, goals=replace(goals, augmented=str(tmp_path / "moved")))
    train_policy(copy.deepcopy(policy), drawn_scenarios, tmp_path / "run", moved)
    scenario = drawn_scenarios[0]
    point = (scenario.tracks.object_id[:1], scenario.origin[None] + 5.0)
    write_goal_file(tmp_path / "moved" / "part-000009.parquet", {scenario.scenario_id: point})
    with pytest.raises(CheckpointError, match="augmented_goals"):
        train_policy(copy.deepcopy(policy), drawn_scenarios, tmp_path / "run", moved)


def test_rows_that_are_no_goals_are_refused(tmp_path):
    write_goal_file(tmp_path / "part-0.parquet", {"s": (np.array([1]), np.array([[np.nan, 0.0]]))})
    with pytest.raises(DataError, match="rows that are not goals"):
        StoredGoals(tmp_path)


def test_goals_of_two_rollouts_cannot_be_those_of_three(policy, batch):
    goals = logged_goals(batch).repeat(2)
    with pytest.raises(ConfigError, match="goals of 2 rollouts do not fit 3 rollouts"):
        simulate(policy, batch, num_rollouts=3, seed=0, goals=goals)
    assert isinstance(goals.rollouts(slice(0, 1)), Goals)
