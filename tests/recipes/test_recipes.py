"""Every recipe that ships can be built, and values out of range are refused in words."""

import inspect
import math
from dataclasses import dataclass, field, replace

import pytest
import torch

from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies import registry
from rlftsim.policies.registry import load_policy, load_policy_or_oracle
from rlftsim.recipes import smart, trafficbots
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.card import model_card
from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.recipes.settings import list_sections
from rlftsim.recipes.smart import SmartRecipe, smart_demo_rlftsim, smart_tiny_rlftsim
from rlftsim.recipes.trafficbots import TrafficBotsRecipe
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.dataset import dataset_folder
from rlftsim.scenario.open import open_dataset
from rlftsim.tokens.clustering import build_vocabulary

SHIPPED = [
    f for module, kind in ((smart, SmartRecipe), (trafficbots, TrafficBotsRecipe))
    for _, f in inspect.getmembers(module, inspect.isfunction)
    if f.__module__ == module.__name__ and inspect.signature(f).return_annotation is kind
]  # fmt: skip


@pytest.mark.parametrize("recipe", SHIPPED, ids=lambda f: f.__name__)
def test_every_recipe_can_be_built(recipe):
    built = recipe()
    assert isinstance(built, Recipe)
    assert built == recipe()
    assert recipe.__doc__


def test_the_recipes_with_names_are_shipped_ones():
    assert {RECIPES.get(name) for name in RECIPES.names()} <= set(SHIPPED)
    assert len(SHIPPED) >= 5


def test_the_papers_recipe_has_the_papers_numbers():
    finetune = smart_tiny_rlftsim().finetune
    assert (finetune.learning_rate, finetune.warmup_updates, finetune.batch_size) == (3e-6, 100, 8)
    assert (finetune.num_rollouts, finetune.epochs, finetune.reward) == (4, 1.0, "mloo")
    assert (finetune.betas[0], finetune.weight_decay, finetune.gradient_clip) == (0.9, 0.01, 1.0)
    assert (finetune.kl.target, finetune.kl.horizon, finetune.entropy_bonus) == (0.01, 5.0, 0.0)
    assert (finetune.kl.min_beta, finetune.kl.max_beta) == (1e-3, 1e3)
    assert (finetune.kl.reference_sync_every, finetune.kl.reference_ema) == (500, 0.005)
    assert smart_tiny_rlftsim().pretrain.epochs == 32.0


class TinyRecipe(Recipe):
    """A recipe of another package: no vocabulary, no sizes."""


def test_a_recipe_may_have_no_vocabulary_and_no_sizes():
    recipe = TinyRecipe()
    assert list(list_sections(recipe)) == ["pretrain", "finetune", "catk", "gcsl"]
    with pytest.raises(ConfigError, match="TinyRecipe describes no new policy"):
        recipe.new_policy(None)
    assert recipe.with_goals().finetune.goals.probability == 1


@dataclass(frozen=True, kw_only=True)
class Prior:
    """A section of another package."""

    width: int = 4


@dataclass(frozen=True, kw_only=True)
class ContinuousRecipe(Recipe):
    """A recipe for policies without tokens, with a section of its own."""

    catk: None = None
    gcsl: None = None
    prior: Prior = field(default_factory=Prior)
    note: str = ""


def test_a_recipe_may_leave_methods_out_and_bring_sections():
    recipe = ContinuousRecipe()
    assert list(list_sections(recipe)) == ["pretrain", "finetune", "prior"]
    with_goals = recipe.with_goals()
    assert with_goals.catk is None
    assert "goal(" in with_goals.finetune.reward


def test_a_recipe_follows_the_sizes_of_its_own_kind_of_policy_only():
    with pytest.raises(ConfigError, match="makes SMART policies, none like a ConstantVelocity"):
        smart_demo_rlftsim().like(ConstantVelocity())
    with pytest.raises(ConfigError, match="ContinuousRecipe describes no policy like a ConstantVelocity"):
        ContinuousRecipe().like(ConstantVelocity())


def test_goals_of_a_smart_recipe_keep_its_other_sections():
    recipe = replace(smart_demo_rlftsim(), catk=None).with_goals()
    assert isinstance(recipe, SmartRecipe)
    assert recipe.catk is None


def test_recipes_have_names():
    assert set(RECIPES.names()) >= {"smart-tiny", "smart-mini", "smart-nano", "smart-demo", "synthetic"}
    assert recipe_by_name("smart-tiny") == smart_tiny_rlftsim()
    with pytest.raises(ConfigError, match="unknown recipe 'smart-tinny': did you mean 'smart-tiny'"):
        recipe_by_name("smart-tinny")


def test_a_function_that_returns_no_recipe_is_refused(monkeypatch):
    monkeypatch.setitem(RECIPES._registered, "no-recipe", dict)
    with pytest.raises(ConfigError, match="recipe 'no-recipe' is of type dict: make it extend"):
        recipe_by_name("no-recipe")


def test_fresh_weights_depend_on_the_recipes_seed_alone():
    recipe = smart_demo_rlftsim()
    small = replace(recipe, model=replace(recipe.model, dim=16, num_heads=2, head_dim=8, num_decoder_layers=1))
    scenarios = open_dataset("synthetic", "validation")
    few = replace(small.tokens, num_tokens=16, num_map_prototypes=4, max_scenarios=4)
    vocabulary = build_vocabulary(scenarios, few)[0]
    torch.manual_seed(1)
    first = small.new_policy(vocabulary).state_dict()
    torch.manual_seed(2)
    again = small.new_policy(vocabulary).state_dict()
    other = replace(small, pretrain=replace(small.pretrain, seed=5)).new_policy(vocabulary).state_dict()
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert any(not torch.equal(first[key], other[key]) for key in first)


def test_a_seed_reaches_every_stage_and_nothing_else():
    recipe = smart_demo_rlftsim()
    seeded = recipe.with_seed(7)
    stages = (seeded.tokens, seeded.pretrain, seeded.finetune, seeded.calibrate)
    assert [stage.seed for stage in stages] == [7, 7, 7, 7]
    assert seeded.with_seed(0) == recipe.with_seed(0) != recipe


@pytest.mark.parametrize(
    ("section", "change", "words"),
    [
        ("finetune", {"num_rollouts": 1}, "at least 2 rollouts"),
        ("finetune", {"reward": "joy"}, "unknown reward 'joy': known are collision_offroad"),
        ("finetune", {"betas": (0.9, 2.0)}, r"in \[0, 1\)"),
        ("finetune", {"entropy_bonus": math.inf}, "entropy_bonus must be a finite number"),
        ("model", {"dropout": 1.5}, r"in \[0, 1\)"),
        ("model", {"map_radius_m": math.nan}, "map_radius_m must be positive, got nan"),
        ("model", {"agent_radius_m": math.inf}, "agent_radius_m must be a finite number"),
        ("model", {"max_map_neighbors": -1}, "max_map_neighbors must be positive"),
        ("pretrain", {"epochs": math.inf}, "epochs must be a finite number, got inf"),
        ("pretrain", {"weight_decay": -1.0}, "weight_decay must not be negative, got -1"),
        ("pretrain", {"label_smoothing_kind": "spatial"}, "has no effect: set label_smoothing"),
        ("pretrain", {"max_skipped_in_a_row": 0}, "max_skipped_in_a_row must be positive"),
        ("catk", {"gradient_clip": -1.0}, "gradient_clip must be positive, got -1"),
        ("catk", {"final_lr_ratio": math.nan}, r"final_lr_ratio .* \[0, 1\], got nan"),
        ("tokens", {"straight_up_to_mps": math.inf}, "straight_up_to_mps must be a finite number"),
        ("tokens", {"seed": -1}, "seed must not be negative"),
    ],
)
def test_a_value_out_of_range_is_refused_in_words(section, change, words):
    with pytest.raises(ConfigError, match=words):
        replace(getattr(smart_demo_rlftsim(), section), **change)


# ---- models by name ------------------------------------------------------------------------------------------------


def test_baselines_have_names():
    assert isinstance(load_policy("constant_velocity"), ConstantVelocity)
    assert load_policy_or_oracle("oracle") == "oracle"


def test_an_unknown_model_is_refused_with_the_known_names():
    with pytest.raises(ConfigError, match="'nowhere' is neither a model folder nor one of constant_velocity"):
        load_policy("nowhere")


def test_where_the_oracle_is_no_answer_it_is_not_offered():
    with pytest.raises(ConfigError) as caught:
        load_policy("oracle")
    assert "constant_velocity, oracle" not in str(caught.value)


def test_an_empty_folder_is_no_model(tmp_path):
    with pytest.raises(CheckpointError, match=r"not a model folder, config\.json is missing"):
        load_policy(str(tmp_path))


def test_a_gpu_that_is_not_there_is_refused_and_auto_does_without(monkeypatch):
    monkeypatch.setattr(registry.torch.cuda, "is_available", lambda: False)
    assert registry.find_device("auto").type == "cpu"
    with pytest.raises(ConfigError, match="device=cuda, but torch sees no CUDA device"):
        registry.find_device("cuda")


def test_the_card_of_a_model_passes_on_the_terms_of_its_start(tmp_path):
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "README.md").write_bytes(b"# Base\n\n* terms of the data: non-commercial\n* by caf\xe9\n")
    card = model_card("fine-tuned", dataset_folder("synthetic"), 2, tmp_path / "base")
    assert "* trained on 2 scenarios of synthetic\n" in card
    assert "* terms of the data: CC0-1.0" in card
    assert f"## Made from {tmp_path / 'base'}\n\n### Base\n\n* terms of the data: non-commercial\n* by caf" in card
