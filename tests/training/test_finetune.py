"""One update of closed-loop fine-tuning, taken apart."""

import copy
import json
import math
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

import scenes
import tiny
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rewards import REWARDS, register_reward
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.training import experience
from rlftsim.training import reward as module
from rlftsim.training.config import FinetuneConfig, KlConfig
from rlftsim.training.data import trained_agents
from rlftsim.training.experience import compute_reward
from rlftsim.training.parallel import start_fabric
from rlftsim.training.policy_gradient import masked_sum
from rlftsim.training.reward import prepare, update_policy
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

CONFIG = replace(tiny.FINETUNE, num_rollouts=4, gradient_clip=1e9)


@pytest.fixture
def batch(drawn_scenarios):
    return collate(drawn_scenarios[:2])


@pytest.fixture
def learner(vocabulary, fabric):
    return prepare(tiny.tiny_policy(vocabulary), CONFIG, fabric.device)


@pytest.fixture
def reward_of():
    """Register a reward for the length of a test; gives its name."""
    names = []

    def register(reward):
        names.append(f"test_{len(names)}")
        register_reward(names[-1])(reward)
        return names[-1]

    yield register
    for name in names:
        REWARDS.remove(name)


def nothing(realism, rollouts, batch):
    return torch.zeros_like(realism.single_meta_metric)


def move_weights(policy, size=0.05):
    """A policy beside the one it was."""
    generator = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.add_(size * torch.randn(weight.shape, generator=generator))


def snapshot(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def moved(module, before):
    return [name for name, value in module.state_dict().items() if not torch.equal(value, before[name])]


def test_an_update_moves_the_decoder_and_nothing_else(learner, batch, fabric):
    before, reference = snapshot(learner.policy), snapshot(learner.reference)
    update_policy(learner, batch, CONFIG, fabric)
    changed = moved(learner.policy, before)
    assert changed
    parts = ("time_layers", "map_layers", "agent_layers", "head")
    assert all(name.startswith(tuple(f"network.decoder.{part}" for part in parts)) for name in changed)
    assert moved(learner.reference, reference) == []


def test_a_run_says_how_many_weights_it_trains(vocabulary, drawn_scenarios, tmp_path, capsys):
    policy = tiny.tiny_policy(vocabulary)
    total = sum(value.numel() for value in policy.parameters())
    head = sum(value.numel() for value in policy.network.decoder.head.parameters())
    train_policy(policy, drawn_scenarios, tmp_path, replace(tiny.FINETUNE, trained="head"))
    assert f" updates of {head:,} of {total:,} weights.\n" in capsys.readouterr().err


def test_training_everything_reaches_the_map_encoder(vocabulary, batch, fabric):
    config = replace(CONFIG, trained="all")
    learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
    before = snapshot(learner.policy)
    update_policy(learner, batch, config, fabric)
    assert any("map_encoder" in name for name in moved(learner.policy, before))


def test_scored_log_probs_equal_the_sampled_ones_and_the_gap_is_logged(learner, batch, fabric):
    values = update_policy(learner, batch, CONFIG, fabric)
    assert 0 <= values["score_gap"] < 1e-4


def test_scored_log_probs_equal_the_sampled_ones_of_a_car_that_backs_up(learner, fabric):
    back = scenes.Mover(x_m=30.0, y_m=4.0, speed_mps=-5.0)
    batch = collate([scenes.build_scenario("back", (*scenes.TRAFFIC, back))])
    start = learner.policy.begin(learner.policy.encode(batch), 1, None, torch.zeros(1, 1, batch.heading.shape[1], 0))
    assert torch.equal(start.position[0, 0, -1], batch.position[0, -1, CURRENT_STEP])
    assert 0 <= update_policy(learner, batch, CONFIG, fabric)["score_gap"] < 1e-4


def test_the_logged_gap_would_show_a_policy_that_is_scored_otherwise_than_sampled(learner, batch, fabric, monkeypatch):
    original = experience.simulate

    def sampled_with_other_weights(policy, *args, **options):
        other = copy.deepcopy(policy)
        move_weights(other, 0.02)
        return original(other, *args, **options)

    monkeypatch.setattr(experience, "simulate", sampled_with_other_weights)
    assert update_policy(learner, batch, CONFIG, fabric)["score_gap"] > 1e-3


def test_credit_by_agent_weighs_each_agents_decisions_by_what_it_earned(learner, batch, fabric):
    config = replace(CONFIG, credit="agent", credit_mixing=0.25)
    found = gradients_with(learner, batch, fabric, config, beta=0.0)
    seed = derive_seed(config.seed, "rollouts", learner.update)
    rollouts = simulate(learner.policy, batch, num_rollouts=4, seed=seed)
    earned = compute_reward(batch, rollouts, config)[1].by_agent  # [B, N, A]
    learner.policy.zero_grad()
    log_prob = learner.policy.score(learner.policy.encode(batch), rollouts).log_prob(rollouts.decision)
    decisions = rollouts.decision_mask.sum((2, 3))  # of a rollout
    by_hand = 0.0
    for b in range(2):
        for n in range(4):
            for a in range(batch.agent_mask.shape[1]):
                if batch.agent_mask[b, a]:
                    by_hand = by_hand - earned[b, n, a] * log_prob[b, n, a].sum() / decisions[b, n] / 2
    by_hand.backward()
    for name, gradient in tiny.gradients_of(learner.policy).items():
        torch.testing.assert_close(found[name], gradient, atol=1e-6, rtol=1e-4, msg=name)
    by_rollout = gradients_with(learner, batch, fabric, CONFIG, beta=0.0)
    assert any(not torch.allclose(found[name], by_rollout[name], atol=1e-6, rtol=1e-2) for name in found)


@pytest.mark.parametrize("top_k", [None, 8])
@pytest.mark.parametrize("continuation_scores", [False, True])
def test_half_precision_scores_what_it_sampled(top_k, continuation_scores, vocabulary, batch):
    config = replace(tiny.WITHOUT_CHANCE, continuation_scores=continuation_scores)
    torch.manual_seed(0)
    policy = SmartPolicy(config, vocabulary, Sampling(top_k=top_k))
    device = replace(tiny.CPU, precision="bf16-mixed")
    half = start_fabric(device)
    values = update_policy(prepare(policy, replace(CONFIG, device=device), half.device), batch, CONFIG, half)
    assert values["gradient_norm"] > 0
    # bfloat16 has 8 bits, so logits of some nats are off by hundredths; tokens at the edge of a truncation come and go
    assert top_k or values["score_gap"] < 0.15


def test_every_term_of_the_reward_is_logged_for_itself(learner, batch, fabric):
    config = replace(CONFIG, reward="mloo - 0.1*minade_rloo")
    values = update_policy(learner, batch, config, fabric)
    alone = {n: update_policy(copy.deepcopy(learner), batch, replace(config, reward=n), fabric) for n in ("mloo",)}
    assert {name for name in values if name.startswith("reward_")} == {
        "reward_mean", "reward_std", "reward_zero_rate",
        "reward_mloo_mean", "reward_mloo_std", "reward_mloo_missing_rate",
        "reward_minade_rloo_mean", "reward_minade_rloo_std", "reward_minade_rloo_missing_rate",
    }  # fmt: skip
    assert alone["mloo"]["reward_mloo_std"] == alone["mloo"]["reward_std"]
    assert values["reward_minade_rloo_std"] > values["reward_mloo_std"] > 0  # metres against fractions of the metric
    assert values["reward_mloo_mean"] == pytest.approx(0.0, abs=1e-6)


def test_the_first_update_has_no_kl_and_the_next_one_has(learner, batch, fabric):
    assert update_policy(learner, batch, CONFIG, fabric)["kl"] == pytest.approx(0.0, abs=1e-6)
    assert update_policy(learner, batch, CONFIG, fabric)["kl"] > 1e-6


def assert_same_gradients(found):
    """Of several updates, each with what it logged."""
    whole = found[0][0]
    assert max(float(g.abs().max()) for g in whole.values()) > 1e-3
    for gradients, _ in found[1:]:
        for name, gradient in whole.items():
            torch.testing.assert_close(gradients[name], gradient, atol=1e-6, rtol=1e-5, msg=name)


def test_gradients_do_not_depend_on_how_many_rollouts_are_scored_at_once(vocabulary, batch, fabric):
    found = []
    for rollouts_per_pass in (4, 2, 1, 3):
        config = replace(CONFIG, rollouts_per_pass=rollouts_per_pass)
        learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
        move_weights(learner.reference)
        values = update_policy(learner, batch, config, fabric)
        found.append((tiny.gradients_of(learner.policy), values))
    assert_same_gradients(found)
    logged = found[0][1]
    for _, values in found[1:]:
        for name in ("kl", "entropy", "gradient_norm"):
            assert values[name] == pytest.approx(logged[name], rel=1e-5), name


def test_gradients_do_not_depend_on_how_many_scenarios_are_in_memory_at_once(vocabulary, drawn_scenarios, fabric):
    batch, found = collate(drawn_scenarios), []  # of different sizes, one with gaps in its log
    base = replace(
        CONFIG, num_rollouts=3, num_scored=2, reward="mloo + 0.1*collision_offroad_ade", credit="agent",
        credit_clip=1.0, constraints=("speed", "stops"),
    )  # fmt: skip
    for micro_batch_size in (8, 3, 1):
        config = replace(base, micro_batch_size=micro_batch_size)
        learner = prepare(tiny.tiny_policy(vocabulary), config, fabric.device)
        move_weights(learner.reference)
        values = update_policy(learner, batch, config, fabric)
        found.append((tiny.gradients_of(learner.policy), values))
    assert_same_gradients(found)
    logged = found[0][1]
    for _, values in found[1:]:
        for name in logged.keys() - {"score_gap"}:
            if not name.startswith("seconds"):
                assert values[name] == pytest.approx(logged[name], rel=1e-4, abs=1e-5), name


def gradients_with(learner, batch, fabric, config, beta):
    twin = copy.deepcopy(learner)
    twin.optimizer = torch.optim.AdamW(twin.parameters, lr=0.0)
    twin.beta = beta
    update_policy(twin, batch, config, fabric)
    return tiny.gradients_of(twin.policy)


def test_with_a_reward_of_zero_the_gradient_is_beta_times_that_of_the_kl(learner, batch, fabric, reward_of):
    config = replace(CONFIG, reward=reward_of(nothing))
    move_weights(learner.reference)
    found = gradients_with(learner, batch, fabric, config, beta=0.3)
    rollouts = simulate(
        learner.policy, batch, num_rollouts=4, seed=derive_seed(config.seed, "rollouts", learner.update)
    )
    learner.policy.zero_grad()
    dist = learner.policy.score(learner.policy.encode(batch), rollouts)
    with torch.no_grad():
        ref_dist = learner.reference.score(learner.reference.encode(batch), rollouts)
    kl = masked_sum(dist.kl(ref_dist), rollouts.decision_mask) / rollouts.decision_mask.sum()
    kl.backward()
    for name, gradient in tiny.gradients_of(learner.policy).items():
        torch.testing.assert_close(found[name], 0.3 * gradient, atol=1e-6, rtol=1e-4, msg=name)


def test_with_a_reward_of_zero_and_no_distance_from_the_reference_nothing_pulls(learner, batch, fabric, reward_of):
    config = replace(CONFIG, reward=reward_of(nothing))
    values = update_policy(learner, batch, config, fabric)
    assert values["gradient_norm"] < 1e-6


def test_the_sum_over_decisions_pulls_harder_than_their_mean(learner, batch, fabric):
    mean = gradients_with(learner, batch, fabric, CONFIG, beta=0.0)
    total = gradients_with(learner, batch, fabric, replace(CONFIG, log_prob_reduction="sum"), beta=0.0)
    norms = [math.sqrt(sum(float(g.square().sum()) for g in gs.values())) for gs in (mean, total)]
    assert norms[1] > 16 * norms[0]  # 16 decisions of at least one agent are added up instead of averaged


def test_a_reward_that_is_no_number_counts_as_none(batch, learner, reward_of):
    def broken(realism, rollouts, batch):
        values = realism.single_meta_metric.clone()
        values[0, 1] = torch.nan
        return values

    rollouts = simulate(learner.policy, batch, num_rollouts=4, seed=0)
    reward = compute_reward(batch, rollouts, replace(CONFIG, reward=reward_of(broken)))[1].total
    assert reward[0].tolist() == [0.0] * 4
    assert reward[1].abs().min() > 0


def test_a_scenario_without_map_has_a_reward(learner):
    batch = collate([scenes.without_map()])
    rollouts = simulate(learner.policy, batch, num_rollouts=4, seed=0)
    reward = compute_reward(batch, rollouts, CONFIG)[1].total
    assert reward.isfinite().all()
    assert reward.abs().max() > 0
    assert float(reward.sum()) == pytest.approx(0.0, abs=1e-6)


def poison_from(monkeypatch, update):
    """Rewards are NaN from the n-th update on."""
    original, calls = module.compute_reward, []

    def poisoned(*args):
        calls.append(1)
        realism, rewards, credits = original(*args)
        poison = torch.nan if len(calls) >= update else 1.0
        return realism, replace(rewards, by_agent=rewards.by_agent * poison), credits

    monkeypatch.setattr(module, "compute_reward", poisoned)


def test_an_update_that_is_not_finite_is_skipped(learner, batch, fabric, monkeypatch):
    update_policy(learner, batch, CONFIG, fabric)
    before, beta = snapshot(learner.policy), learner.beta
    moments = copy.deepcopy(learner.optimizer.state_dict()["state"])
    poison_from(monkeypatch, 1)
    values = update_policy(learner, batch, CONFIG, fabric)
    assert values["skipped"] == 1.0
    assert moved(learner.policy, before) == []
    assert learner.beta == beta
    for index, state in learner.optimizer.state_dict()["state"].items():
        assert all(torch.equal(value, moments[index][name]) for name, value in state.items())
    monkeypatch.undo()
    assert update_policy(learner, batch, CONFIG, fabric)["skipped"] == 0.0
    assert moved(learner.policy, before)


def test_an_update_whose_kl_exploded_is_skipped(learner, batch, fabric):
    move_weights(learner.reference, 0.5)
    before = snapshot(learner.policy)
    values = update_policy(learner, batch, replace(CONFIG, max_kl=1e-3), fabric)
    assert values["kl"] > 1e-3
    assert values["skipped"] == 1.0
    assert moved(learner.policy, before) == []


def test_a_run_that_diverges_stops_and_names_its_last_good_checkpoint(
    vocabulary, drawn_scenarios, tmp_path, monkeypatch, capsys
):
    poison_from(monkeypatch, 4)  # three good updates, a checkpoint after the second
    config = replace(tiny.FINETUNE, epochs=1.5, max_skipped_in_a_row=3)
    with pytest.raises(CheckpointError, match=r"3 updates in a row .*update-00000002.*learning_rate"):
        train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    assert [line["skipped"] for line in read_metrics(tmp_path)] == [0, 0, 0, 1, 2, 3]
    warnings = [line for line in capsys.readouterr().err.splitlines() if "skipped" in line]
    assert warnings == [
        f"update {3 + n} skipped: its gradient is not finite ({n} in a row, the run stops at 3)" for n in (1, 2, 3)
    ]
    assert not (tmp_path / "model").exists()
    monkeypatch.undo()  # and it goes on from there once the cause is gone
    train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    assert (tmp_path / "model" / "config.json").exists()


def test_a_run_whose_kl_exploded_says_so_and_stops(vocabulary, drawn_scenarios, tmp_path, capsys):
    config = replace(tiny.FINETUNE, epochs=5.0, max_kl=1e-9, max_skipped_in_a_row=2)
    with pytest.raises(CheckpointError, match=r"2 updates in a row .*KL above max_kl"):
        train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    warnings = [line for line in capsys.readouterr().err.splitlines() if "skipped" in line]
    assert "nats per decision is above max_kl=1e-09 (1 in a row, the run stops at 2)" in warnings[0]


def test_a_short_run_that_skipped_every_update_has_not_succeeded(vocabulary, drawn_scenarios, tmp_path, monkeypatch):
    poison_from(monkeypatch, 1)
    config = replace(tiny.FINETUNE, epochs=0.5, max_skipped_in_a_row=5)  # two updates
    with pytest.raises(CheckpointError, match="2 updates in a row were skipped"):
        train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    assert not (tmp_path / "model").exists()


def test_the_reference_moves_every_so_many_updates(learner, batch, fabric):
    config = replace(CONFIG, kl=KlConfig(reference_sync_every=2, reference_ema=0.25))
    first = snapshot(learner.reference)
    update_policy(learner, batch, config, fabric)
    assert moved(learner.reference, first) == []
    update_policy(learner, batch, config, fabric)
    name = moved(learner.reference, first)[0]
    expected = 0.25 * learner.policy.state_dict()[name] + 0.75 * first[name]
    torch.testing.assert_close(learner.reference.state_dict()[name], expected)


def test_beta_adapts_to_the_kl_of_the_update(learner, batch, fabric):
    values = update_policy(learner, batch, CONFIG, fabric)  # KL 0, far below the target: beta falls by 0.2 / horizon
    assert values["beta"] == 0.1
    assert learner.beta == pytest.approx(0.1 * (1 - 0.2 / 5))


def test_the_entropy_bonus_pulls_towards_the_uniform_distribution(learner, batch, fabric, reward_of):
    config = replace(CONFIG, reward=reward_of(nothing), entropy_bonus=0.1, learning_rate=1e-2, warmup_updates=1)
    values = [update_policy(learner, batch, config, fabric)["entropy"] for _ in range(3)]
    assert values[0] < values[1] < values[2]


def test_the_imitation_term_is_the_weighted_mean_of_the_pretraining_loss(learner, batch, fabric, reward_of):
    config = replace(CONFIG, reward=reward_of(nothing), imitation_weight=2.0)
    learner.beta = 0.0
    first = snapshot(learner.policy)
    trained = {name for name, weight in learner.policy.named_parameters() if weight.requires_grad}
    prediction = learner.policy.teacher_forced(batch, trained_agents(batch, 0, radius_m=math.inf, limit=None, seed=0))
    mask = prediction.target_mask
    loss = functional.cross_entropy(prediction.logits[mask], prediction.target[mask])
    loss.backward()
    expected = {name: 2 * gradient for name, gradient in tiny.gradients_of(learner.policy).items() if name in trained}
    for micro_batch_size in (2, 1):  # the mean is over predictions, however the scenarios are grouped
        learner.policy.load_state_dict(first)
        values = update_policy(learner, batch, replace(config, micro_batch_size=micro_batch_size), fabric)
        assert values["imitation_loss"] == pytest.approx(float(loss.detach()), rel=1e-5)
        found = tiny.gradients_of(learner.policy)
        for name, gradient in expected.items():
            torch.testing.assert_close(found[name], gradient, rtol=1e-3, atol=1e-6)


def test_the_imitation_term_pulls_towards_the_log(learner, batch, fabric, reward_of):
    config = replace(CONFIG, reward=reward_of(nothing), imitation_weight=1.0, learning_rate=1e-3, warmup_updates=1)
    losses = [update_policy(learner, batch, config, fabric)["imitation_loss"] for _ in range(4)]
    assert losses == sorted(losses, reverse=True)


def test_a_policy_without_a_pretraining_loss_has_no_imitation_term(drawn_scenarios, tmp_path):
    class Learned(ConstantVelocity, torch.nn.Module):
        def __init__(self):
            torch.nn.Module.__init__(self)

        def save_pretrained(self, folder, *, card=""):
            raise AssertionError("refused before anything is saved")

    with pytest.raises(ConfigError, match="it has no teacher_forced and no imitation_loss"):
        train_policy(Learned(), drawn_scenarios, tmp_path, replace(tiny.FINETUNE, imitation_weight=0.1))


def test_gradients_are_clipped_and_weights_decay(learner, batch, fabric, reward_of):
    update_policy(learner, batch, replace(CONFIG, gradient_clip=1e-3), fabric)
    norm = math.sqrt(sum(float(g.square().sum()) for g in tiny.gradients_of(learner.policy).values()))
    assert norm == pytest.approx(1e-3, rel=1e-3)
    # with nothing to learn a weight shrinks by learning_rate * weight_decay
    config = replace(CONFIG, reward=reward_of(nothing), weight_decay=0.5, learning_rate=0.1, warmup_updates=1)
    fresh = prepare(learner.policy, config, fabric.device)
    before = snapshot(fresh.policy)
    fresh.beta = 0.0
    update_policy(fresh, batch, config, fabric)
    name = next(name for name, p in fresh.policy.named_parameters() if p.requires_grad and p.dim() == 2)
    torch.testing.assert_close(fresh.policy.state_dict()[name], before[name] * (1 - 0.1 * 0.5))


def test_beta_of_a_run_follows_its_closed_form(vocabulary, drawn_scenarios, tmp_path):
    config = replace(tiny.FINETUNE, epochs=1.5, kl=KlConfig(target=2e-4, horizon=2.0))
    train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    lines, beta = read_metrics(tmp_path), 0.1
    for line in lines:
        assert line["beta"] == pytest.approx(beta, rel=1e-12)
        error = max(-0.2, min(0.2, line["kl"] / 2e-4 - 1))
        beta = max(1e-3, min(1e3, beta * (1 + error / 2)))
    assert len({line["beta"] > lines[i - 1]["beta"] for i, line in enumerate(lines) if i}) == 2  # it fell and rose


def test_the_learning_rate_warms_up(learner, batch, fabric):
    config = replace(CONFIG, warmup_updates=4, learning_rate=4e-4)
    rates = [update_policy(learner, batch, config, fabric)["learning_rate"] for _ in range(5)]
    assert rates == pytest.approx([1e-4, 2e-4, 3e-4, 4e-4, 4e-4])


def test_a_run_leaves_what_docs_training_promises(vocabulary, drawn_scenarios, tmp_path):
    config = replace(tiny.FINETUNE, epochs=0.5)
    model = train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config, card="a card\n")
    assert model == tmp_path / "model"
    assert {p.name for p in model.iterdir()} == {
        "config.json", "model.safetensors", "vocabulary.safetensors", "README.md",
    }  # fmt: skip
    assert (model / "README.md").read_text() == "a card\n"
    assert json.loads((tmp_path / "config.json").read_text())["num_rollouts"] == 2
    assert json.loads((tmp_path / "environment.json").read_text())["packages"]["torch"] == torch.__version__
    assert list((tmp_path / "tensorboard").glob("events*"))
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["update-00000002"]


def test_a_policy_without_weights_is_refused(drawn_scenarios, tmp_path):
    with pytest.raises(ConfigError, match="ConstantVelocity has no weights"):
        train_policy(ConstantVelocity(), drawn_scenarios, tmp_path, tiny.FINETUNE)


def test_parts_that_a_policy_does_not_have_are_refused_before_the_folder_is_claimed(
    vocabulary, drawn_scenarios, tmp_path
):
    policy = tiny.tiny_policy(vocabulary)
    with pytest.raises(ConfigError, match="trained=goals, but"):
        train_policy(policy, drawn_scenarios, tmp_path / "run", replace(tiny.FINETUNE, trained="goals"))
    assert not (tmp_path / "run").exists()


def test_a_run_says_that_its_first_update_has_no_reward(vocabulary, drawn_scenarios, tmp_path, capsys, reward_of):
    reward = reward_of(lambda realism, rollouts, batch: realism.single_meta_metric * torch.nan)
    config = replace(tiny.FINETUNE, reward=reward, epochs=1e-3)
    train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    assert "update 1, no reward reached a trained weight" in capsys.readouterr().err


@pytest.mark.parametrize("processes", [1, 2])
def test_a_reward_that_is_no_number_is_said_once_and_counted(
    processes, vocabulary, drawn_scenarios, tmp_path, capsys, reward_of
):
    def broken(realism, rollouts, batch):
        values = realism.single_meta_metric.clone()
        values[[one.scenario_id == drawn_scenarios[0].scenario_id for one in batch.scenarios], 0] = torch.nan
        return values

    config = replace(
        tiny.FINETUNE, reward=f"mloo + {reward_of(broken)}", batch_size=2, epochs=2.0,
        device=replace(tiny.CPU, processes=processes),
    )  # fmt: skip
    train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios[:2], tmp_path, config)
    lines = [line for line in capsys.readouterr().err.splitlines() if "not finite" in line]
    assert lines == ["update 1, reward test_0: not finite in 1 of 2 scenarios, counted as 0"]
    logged = read_metrics(tmp_path)
    assert [(one["reward_mloo_missing_rate"], one["reward_test_0_missing_rate"]) for one in logged] == [(0, 0.5)] * 2


def test_more_epochs_continue_a_run_that_has_ended(vocabulary, drawn_scenarios, tmp_path):
    def train(epochs, out):
        torch.manual_seed(0)
        config = replace(tiny.FINETUNE, epochs=epochs)
        return train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios[:2], tmp_path / out, config)

    model = train(1.0, "grown")
    short, weights = read_metrics(tmp_path / "grown"), (model / "model.safetensors").read_bytes()
    grown, whole = train(2.0, "grown"), train(2.0, "whole")
    assert [line["rmm"] for line in read_metrics(tmp_path / "grown")[: len(short)]] == [line["rmm"] for line in short]
    assert (grown / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes() != weights
    with pytest.raises(CheckpointError, match=r"other settings or inputs \(epochs\)"):
        train(1.0, "grown")


def test_a_run_that_is_made_longer_and_stopped_stays_the_shorter_one(
    vocabulary, drawn_scenarios, tmp_path, monkeypatch
):
    def train(epochs, out="run", stop_behind=None):
        def stop(learner, *rest):
            if learner.update == stop_behind:
                raise KeyboardInterrupt
            return update_policy(learner, *rest)

        torch.manual_seed(0)
        config = replace(tiny.FINETUNE, epochs=epochs, checkpoint_every=1)
        with monkeypatch.context() as patch:
            patch.setattr("rlftsim.training.reward.update_policy", stop)
            return train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios[:2], tmp_path / out, config)

    def weights(model):
        return (model / "model.safetensors").read_bytes()

    def stored(name):
        return json.loads((tmp_path / "run" / name).read_text())

    short, environment = train(1.0), stored("environment.json")
    first, done = weights(short), len(read_metrics(tmp_path / "run"))
    with pytest.raises(KeyboardInterrupt):
        train(4.0, stop_behind=2 * done + 1)
    # the model and its settings still belong together; a run of another length cannot tell them apart from its own
    assert (stored("config.json")["epochs"], stored("environment.json")) == (1.0, environment)
    assert weights(short) == first
    for epochs in (1.0, 2.0):
        with pytest.raises(CheckpointError, match=rf"behind update {2 * done + 1}.*raise epochs.*is .*run/model"):
            train(epochs)
    assert weights(train(4.0)) == weights(train(4.0, out="whole")) != first
    assert stored("config.json")["epochs"] == 4.0


def test_a_run_that_was_stopped_may_be_made_longer_before_it_has_ended(
    vocabulary, drawn_scenarios, tmp_path, monkeypatch
):
    def train(epochs, out="run"):
        torch.manual_seed(0)
        config = replace(tiny.FINETUNE, epochs=epochs, checkpoint_every=1)
        return train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios[:2], tmp_path / out, config)

    def stop(learner, *rest):
        if learner.update == 1:
            raise KeyboardInterrupt
        return update_policy(learner, *rest)

    with monkeypatch.context() as patch:
        patch.setattr("rlftsim.training.reward.update_policy", stop)
        for epochs in (1.0, 4.0):
            with pytest.raises(KeyboardInterrupt):
                train(epochs)
    # there is no model of one epoch, so the run is one of four from here on
    assert json.loads((tmp_path / "run" / "config.json").read_text())["epochs"] == 4.0
    with pytest.raises(CheckpointError, match=r"other settings or inputs \(epochs\)"):
        train(1.0)
    long, whole = train(4.0), train(4.0, out="whole")
    assert (long / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()


def test_no_scenario_is_refused(vocabulary, tmp_path):
    with pytest.raises(ConfigError, match="no scenario to train on"):
        train_policy(tiny.tiny_policy(vocabulary), [], tmp_path, tiny.FINETUNE)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"num_rollouts": 1}, "at least 2 rollouts"),
        ({"batch_size": 0}, "must be positive"),
        ({"reward": "joy"}, "unknown reward 'joy': known are .*mloo"),
        ({"metric": "1999"}, "known are 2025"),
        ({"imitation_weight": -0.1}, "imitation_weight must not be negative"),
        ({"micro_batch_size": 0}, "micro_batch_size must be positive"),
    ],
)
def test_impossible_settings_are_refused_at_once(changes, words):
    with pytest.raises(ConfigError, match=words):
        FinetuneConfig(**changes)
