"""Pre-training and fine-tuning of a tiny TrafficBots: learning, resuming, recipes."""

from dataclasses import replace

import pytest
import torch
from tiny_trafficbots import TINY

import scenes
import tiny
from rlftsim.errors import ConfigError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.policies.trafficbots.imitation import compute_scene_loss, draw_training, imitation_terms
from rlftsim.policies.trafficbots.network import Windows
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.policies.trafficbots.scene import NO_DESTINATION, build_scene, destination_labels
from rlftsim.policies.trafficbots.state import ImposedStates, max_action, move, start_traffic
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import TOTAL_STEPS
from rlftsim.training.config import ValidationConfig
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

SETTINGS = replace(TINY, steps_per_pass=80, forcing_updates=2)
PRETRAIN = replace(
    tiny.PRETRAIN, batch_size=2, epochs=2.0, context_radius_m=None, trained_radius_m=1000.0, max_trained_agents=None
)


@pytest.fixture(scope="module")
def scenarios():
    return [scenes.bend("one", 3), scenes.bend("two", 2)]


def new_policy(**changes):
    torch.manual_seed(0)
    return TrafficBotsPolicy(replace(SETTINGS, **changes))


def weights_of(policy):
    return {name: value.clone() for name, value in policy.state_dict().items()}


@pytest.mark.slow
def test_straight_drivers_are_learned_within_fifty_updates(tmp_path):
    movers = [scenes.Mover(x_m=12.0 * (i % 8), y_m=3.5 * (i // 8), speed_mps=4 + 0.4 * i) for i in range(24)]
    scene = scenes.build_scenario("straight", movers, scenes.straight_map())
    config = replace(PRETRAIN, batch_size=1, epochs=50.0, learning_rate=3e-3, checkpoint_every=100)
    train_policy(new_policy(dropout=0.0, input_drop=0.0, prior_probability=0.0), [scene], tmp_path, config)
    lines = read_metrics(tmp_path)
    assert lines[-1]["imitation_loss"] < lines[0]["imitation_loss"] / 50
    assert lines[-1]["destination_loss"] < lines[0]["destination_loss"] / 5
    assert {"personality_loss", "light_loss", "loss", "gradient_norm"} <= set(lines[0])


def test_a_resumed_run_ends_with_the_same_weights(scenarios, tmp_path):
    whole, part, rest = new_policy(), new_policy(), new_policy()
    config = replace(PRETRAIN, epochs=4.0, checkpoint_every=2)
    train_policy(whole, scenarios, tmp_path / "whole", config)
    folder = tmp_path / "part"
    train_policy(part, scenarios, folder, config)
    for late in (folder / "checkpoints").glob("update-*4*"):
        late.rename(tmp_path / "gone")
    train_policy(rest, scenarios, folder, config)
    assert all(torch.equal(value, weights_of(rest)[name]) for name, value in weights_of(whole).items())


def test_the_gradient_does_not_depend_on_the_number_of_decisions_in_memory(scenarios, tmp_path):
    norms = []
    for steps in (80, 9):
        config = replace(PRETRAIN, epochs=1.0)
        train_policy(new_policy(steps_per_pass=steps, dropout=0.0), scenarios, tmp_path / str(steps), config)
        norms.append(read_metrics(tmp_path / str(steps))[0]["gradient_norm"])
    assert norms[0] == pytest.approx(norms[1], rel=1e-5)


def test_mixed_precision_gives_nearly_the_same_loss_and_gradient(scenarios, tmp_path):
    losses, norms = [], []
    for precision in ("32-true", "bf16-mixed"):
        config = replace(PRETRAIN, epochs=1.0, device=replace(tiny.CPU, precision=precision))
        train_policy(new_policy(dropout=0.0), scenarios, tmp_path / precision, config)
        first = read_metrics(tmp_path / precision)[0]
        losses.append(first["loss"])
        norms.append(first["gradient_norm"])
    assert losses[0] == pytest.approx(losses[1], rel=0.05)
    assert norms[0] == pytest.approx(norms[1], rel=0.05)


def test_rewards_train_what_decides_and_nothing_that_draws(scenarios, tmp_path):
    policy = new_policy()
    before = weights_of(policy)
    train_policy(policy, scenarios, tmp_path, replace(tiny.FINETUNE, epochs=2.0, reward="mloo + 0.1*minade_rloo"))
    moved = {name.split(".")[1] for name, value in weights_of(policy).items() if not torch.equal(value, before[name])}
    assert moved == {"agents", "destination_map", "destination_pose", "add_destination", "add_personality", "actions"}
    lines = read_metrics(tmp_path)
    assert all(line["score_gap"] < 1e-3 for line in lines)
    assert all(line["kl"] >= 0 for line in lines)


def test_imitation_beside_rewards_draws_the_same_in_every_run(scenarios, tmp_path):
    config, ends = replace(tiny.FINETUNE, epochs=2.0, imitation_weight=0.1), []
    for name in ("first", "second"):
        policy = new_policy()
        torch.manual_seed(len(name))  # what else draws does not matter
        train_policy(policy, scenarios, tmp_path / name, config)
        ends.append(weights_of(policy))
    assert all(torch.equal(value, ends[1][name]) for name, value in ends[0].items())


def test_imitation_beside_rewards_forces_as_at_the_end_of_pretraining(scenarios):
    batch = collate(scenarios)
    values = []
    for fractions in ((1.0, 0.0), (0.0,)):
        policy = new_policy(forced_fractions=fractions).eval()
        torch.manual_seed(0)
        values.append(float(policy.imitation_loss(batch, batch.agent_mask, 0).loss.detach()))
    assert values[0] == values[1]


def test_two_passes_have_the_gradient_of_one(scenarios):
    """Rolling out without gradient and scoring in parallel is plain back-propagation, to 1e-5."""
    policy, batch = new_policy(dropout=0.0), collate([scenarios[0], scenes.junction_with_light("two")])
    network, weights = policy.network, list(policy.parameters())
    scene = build_scene(batch, TOTAL_STEPS, None)
    labels = torch.full(scene.agent_mask.shape, NO_DESTINATION)
    for row, scenario in zip(labels, batch.scenarios):
        own = torch.from_numpy(destination_labels(scenario, None))
        row[: len(own)] = own
    draws = replace(draw_training(scene, SETTINGS, 0.3, hide=False), from_prior=False)
    found = compute_scene_loss(network, scene, labels, scene.agent_mask, draws)
    two_passes = torch.autograd.grad(found.loss, weights, allow_unused=True)

    # The imitation loss alone, step by step with gradient; the other terms are the same in both.
    map_features = network.map(scene, draws.node_mask)
    steps = torch.arange(90)[:, None]
    padded = torch.nn.functional.pad(scene.light_state, (10, 0))
    windows = padded.unfold(2, 11, 1)[:, :, :-1].transpose(1, 2)
    exists = steps + torch.arange(-10, 1) >= 0
    lights = network.lights(windows, network.lights.neighborhoods(scene, map_features), exists)
    logged = Windows(*(v[:, None, None, :, ::5] for v in (scene.valid, scene.pose, scene.motion)))
    mean = network.posterior(logged, scene.light_state[:, None, :, ::5], scene, map_features)
    personality = mean + network.posterior.log_std.exp() * draws.noise
    given = network.conditioning(scene, map_features, personality[:, None], labels[:, None])
    around = network.agents.context(scene, map_features, lights[:, 10:])
    traffic, limit = start_traffic(scene, labels[:, None]), max_action(scene.agent_class)[:, None]
    pose, speed = traffic.windows.pose[..., -1, :], traffic.windows.motion[..., -1, 0]
    losses, counted = [], []
    for step in range(11, 91):
        now = around.select_steps(slice(step - 11, step - 10))
        features = network.features(traffic.windows.add_decision_axis(), now, given, traffic.active[:, None])
        action = network.mean_actions(features, scene)[:, 0]
        pose, motion = move(pose, speed, torch.where(traffic.alive[..., None], action, 0.0), limit)
        own_pose, own_motion = scene.pose[:, None, :, step], scene.motion[:, None, :, step]
        losses.append(sum(imitation_terms(pose, motion[..., 0], own_pose, own_motion[..., 0])))
        is_logged = scene.valid[:, None, :, step]
        counted.append(traffic.alive & is_logged)
        is_put = is_logged & draws.forced[:, None]
        pose, speed = (
            torch.where(is_put[..., None], own_pose, pose),
            torch.where(is_put, own_motion[..., 0], motion[..., 0]),
        )
        with torch.no_grad():
            traffic = traffic.advance(
                action.detach(), scene, ImposedStates(is_put, own_pose, own_motion), staying=is_logged
            )
    mask = torch.stack(counted, -1)
    total = (torch.stack(losses, -1) * mask).flatten(1).sum(1) / mask.flatten(1).sum(1).clamp(min=1)
    assert float(total.sum().detach()) == pytest.approx(float(found.sums["imitation_loss"]), rel=1e-6)
    one_pass = torch.autograd.grad(total.sum(), weights, allow_unused=True)
    # Weights that only the imitation loss trains: all that decide actions.
    deciding = {id(weight) for part in policy.fine_tuned_modules() for weight in part.parameters()}
    compared = [id(weight) in deciding for weight in weights]
    ours, plain = (
        torch.cat([grad.flatten() for grad, is_one in zip(grads, compared) if is_one and grad is not None])
        for grads in (two_passes, one_pass)
    )
    assert len(ours) == len(plain) > 1000
    assert float((ours - plain).norm() / plain.norm()) < 1e-5


def test_goals_are_refused_in_words(scenarios, tmp_path):
    config = replace(tiny.FINETUNE, goals=replace(tiny.FINETUNE.goals, probability=1.0), reward="gcft")
    with pytest.raises(ConfigError, match="a TrafficBotsPolicy cannot be given goals"):
        train_policy(new_policy(), scenarios, tmp_path, config)


def test_settings_that_change_nothing_are_refused(scenarios, tmp_path):
    with pytest.raises(ConfigError, match="entropy_bonus has no effect"):
        train_policy(new_policy(), scenarios, tmp_path / "bonus", replace(tiny.FINETUNE, entropy_bonus=0.1))
    assert not (tmp_path / "bonus").exists()
    validation = ValidationConfig(every=100, num_scenarios=1, num_rollouts=2, top_k=3)
    with pytest.raises(ConfigError, match="top_k=3 needs a policy with categories"):
        train_policy(
            new_policy(), scenarios, tmp_path / "k", replace(PRETRAIN, validation=validation), held_out=scenarios
        )
    assert not (tmp_path / "k" / "metrics.jsonl").exists()


def test_top_k_is_refused_before_an_evaluation_leaves_anything(tmp_path):
    with pytest.raises(ConfigError, match="top_k=3 needs a policy with categories"):
        evaluate(new_policy(), "synthetic", tmp_path / "out", EvaluateConfig(top_k=3, limit=1))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["trafficbots", "trafficbots-demo"])
def test_recipes_make_their_policy_and_name_a_counterpart(name):
    recipe = recipe_by_name(name)
    policy = recipe.new_policy(None)
    assert isinstance(policy, TrafficBotsPolicy)
    assert recipe.tokens is recipe.catk is recipe.gcsl is None
    assert recipe.like(new_policy()).model == SETTINGS
    back = recipe_by_name(recipe_by_name(recipe.counterpart).counterpart)
    assert type(back) is type(recipe)
