"""Pre-training and fine-tuning of a tiny TrafficBots: learning, resuming, recipes."""

from dataclasses import replace

import pytest
import torch

import scenes
import tiny
from rlftsim.errors import ConfigError
from rlftsim.policies.trafficbots.config import TrafficBotsConfig
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.training.finetune import finetune
from rlftsim.training.pretrain import pretrain
from rlftsim.training.run_folder import read_metrics

TINY = TrafficBotsConfig(
    dim=32, num_heads=2, num_map_layers=1, num_light_layers=1, num_agent_layers=1, map_neighbors=4,
    light_neighbors=2, agent_map_neighbors=8, agent_light_neighbors=2, agent_neighbors=4, radius_m=100.0,
    light_radius_m=100.0, steps_per_pass=80, forcing_updates=2,
)  # fmt: skip
PRETRAIN = replace(
    tiny.PRETRAIN, batch_size=2, epochs=2.0, context_radius_m=None, trained_radius_m=1000.0, max_trained_agents=None
)


@pytest.fixture(scope="module")
def scenarios():
    return [scenes.bend("one", 3), scenes.bend("two", 2)]


def new_policy(**changes):
    torch.manual_seed(0)
    return TrafficBotsPolicy(replace(TINY, **changes))


def weights_of(policy):
    return {name: value.clone() for name, value in policy.state_dict().items()}


@pytest.mark.slow
def test_its_loss_falls_and_its_terms_are_logged(scenarios, tmp_path):
    config = replace(PRETRAIN, epochs=40.0, learning_rate=3e-3, checkpoint_every=100)
    pretrain(new_policy(dropout=0.0, input_drop=0.0, prior_probability=0.0), scenarios, tmp_path, config)
    lines = read_metrics(tmp_path)
    assert lines[-1]["imitation_loss"] < 0.5 * lines[0]["imitation_loss"]
    assert lines[-1]["destination_loss"] < lines[0]["destination_loss"]
    assert {"personality_loss", "light_loss", "loss", "gradient_norm"} <= set(lines[0])


def test_a_resumed_run_ends_with_the_same_weights(scenarios, tmp_path):
    whole, part, rest = new_policy(), new_policy(), new_policy()
    config = replace(PRETRAIN, epochs=4.0, checkpoint_every=2)
    pretrain(whole, scenarios, tmp_path / "whole", config)
    folder = tmp_path / "part"
    pretrain(part, scenarios, folder, config)
    for late in (folder / "checkpoints").glob("update-*4*"):
        late.rename(tmp_path / "gone")
    pretrain(rest, scenarios, folder, config)
    assert all(torch.equal(value, weights_of(rest)[name]) for name, value in weights_of(whole).items())


def test_the_gradient_does_not_depend_on_the_number_of_decisions_in_memory(scenarios, tmp_path):
    norms = []
    for steps in (80, 9):
        config = replace(PRETRAIN, epochs=1.0)
        pretrain(new_policy(steps_per_pass=steps, dropout=0.0), scenarios, tmp_path / str(steps), config)
        norms.append(read_metrics(tmp_path / str(steps))[0]["gradient_norm"])
    assert norms[0] == pytest.approx(norms[1], rel=1e-5)


def test_mixed_precision_gives_nearly_the_same_loss(scenarios, tmp_path):
    losses = []
    for precision in ("32-true", "bf16-mixed"):
        config = replace(PRETRAIN, epochs=1.0, device=replace(tiny.CPU, precision=precision))
        pretrain(new_policy(dropout=0.0), scenarios, tmp_path / precision, config)
        losses.append(read_metrics(tmp_path / precision)[0]["loss"])
    assert losses[0] == pytest.approx(losses[1], rel=0.05)


def test_rewards_train_what_decides_and_nothing_that_draws(scenarios, tmp_path):
    policy = new_policy()
    before = weights_of(policy)
    finetune(policy, scenarios, tmp_path, replace(tiny.FINETUNE, epochs=2.0, reward="mloo + 0.1*minade_rloo"))
    moved = {name.split(".")[1] for name, value in weights_of(policy).items() if not torch.equal(value, before[name])}
    assert moved == {"agents", "destination_map", "destination_pose", "add_destination", "add_personality", "actions"}
    lines = read_metrics(tmp_path)
    assert all(line["score_gap"] < 1e-3 for line in lines)
    assert all(line["kl"] >= 0 for line in lines)


def test_goals_are_refused_in_words(scenarios, tmp_path):
    config = replace(tiny.FINETUNE, goals=replace(tiny.FINETUNE.goals, probability=1.0), reward="gcft")
    with pytest.raises(ConfigError, match="not goal-conditioned"):
        finetune(new_policy(), scenarios, tmp_path, config)


@pytest.mark.parametrize("name", ["trafficbots", "trafficbots-demo"])
def test_recipes_make_their_policy_and_name_a_counterpart(name):
    recipe = recipe_by_name(name)
    policy = recipe.new_policy(None)
    assert isinstance(policy, TrafficBotsPolicy)
    assert recipe.tokens is recipe.catk is recipe.gcsl is None
    assert recipe.like(new_policy()).model == TINY
    back = recipe_by_name(recipe_by_name(recipe.counterpart).counterpart)
    assert type(back) is type(recipe)
