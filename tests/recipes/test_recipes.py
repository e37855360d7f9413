"""Every recipe that ships can be built, and `field=value` changes it or is refused in words."""

import contextlib
import inspect
from dataclasses import fields, is_dataclass
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlftsim.cli.train import RecipeName
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.recipes import models, smart
from rlftsim.recipes.configure import configure
from rlftsim.recipes.models import load_policy, load_policy_or_oracle
from rlftsim.recipes.smart import RECIPES, SmartRecipe, smart_demo_rlftsim, smart_tiny_rlftsim
from rlftsim.rollout.baselines import ConstantVelocity

SHIPPED = [
    f for _, f in inspect.getmembers(smart, inspect.isfunction)
    if f.__module__ == smart.__name__ and inspect.signature(f).return_annotation is SmartRecipe
]  # fmt: skip


@pytest.mark.parametrize("recipe", SHIPPED, ids=lambda f: f.__name__)
def test_every_recipe_can_be_built(recipe):
    built = recipe()
    assert isinstance(built, SmartRecipe)
    assert built == recipe()
    assert recipe.__doc__


def test_the_command_lines_recipes_are_shipped_ones():
    assert set(RECIPES.values()) <= set(SHIPPED)
    assert len(SHIPPED) >= 5


def test_the_papers_recipe_has_the_papers_numbers():
    finetune = smart_tiny_rlftsim().finetune
    assert (finetune.learning_rate, finetune.warmup_updates, finetune.batch_size) == (3e-6, 100, 8)
    assert (finetune.num_rollouts, finetune.epochs, finetune.reward) == (4, 1.0, "mloo")
    assert (finetune.betas[0], finetune.weight_decay, finetune.gradient_clip) == (0.9, 0.01, 1.0)
    assert (finetune.kl.target, finetune.kl.horizon, finetune.entropy_bonus) == (0.01, 5.0, 0.0)
    assert (finetune.kl.min_beta, finetune.kl.max_beta) == (1e-3, 1e3)
    assert (finetune.kl.reference_every, finetune.kl.reference_share) == (500, 0.005)
    assert smart_tiny_rlftsim().pretrain.epochs == 32.0


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("pretrain.epochs=2", 2.0),
        ("pretrain.epochs=0.5", 0.5),
        ("pretrain.trained_radius_m=50", 50.0),
        ("pretrain.max-trained-agents=16", 16),
        ("finetune.kl.target=0.02", 0.02),
        ("finetune.learning-rate=1e-5", 1e-5),
        ("finetune.reward=rloo", "rloo"),
        ("finetune.trained=all", "all"),
        ("finetune.betas=(0.8, 0.95)", (0.8, 0.95)),
        ("finetune.device.accelerator=cpu", "cpu"),
        ("tokens.mirror=false", False),
        ("model.public_code_quirks=True", True),
    ],
)
def test_a_good_override_changes_one_field(override, value):
    before = smart_demo_rlftsim()
    after = configure(before, [override])
    path = override.split("=")[0].replace("-", "_").split(".")
    found = after
    for name in path:
        found = getattr(found, name)
    assert found == value
    assert type(found) is type(value)
    assert len(differences(before, after)) == 1


def differences(a, b, path=""):
    """Names of the leaves in which two configurations differ."""
    if is_dataclass(a):
        return [d for f in fields(a) for d in differences(getattr(a, f.name), getattr(b, f.name), f"{path}.{f.name}")]
    return [] if a == b else [path]


def leaves(config, path=""):
    """Names of all leaves of a configuration."""
    if is_dataclass(config):
        return [name for f in fields(config) for name in leaves(getattr(config, f.name), f"{path}.{f.name}")]
    return [path]


def test_later_overrides_win():
    config = configure(smart_demo_rlftsim(), ["pretrain.seed=1", "model.dim=64", "pretrain.seed=2"])
    assert (config.pretrain.seed, config.model.dim) == (2, 64)


def test_fields_that_depend_on_each_other_may_come_in_any_order():
    overrides = ["finetune.kl.min_beta=0.5", "finetune.kl.initial_beta=1"]
    kl = configure(smart_demo_rlftsim(), overrides).finetune.kl
    assert (kl.min_beta, kl.initial_beta) == (0.5, 1.0)


def test_none_is_a_value_where_a_field_allows_it():
    config = configure(smart_tiny_rlftsim(), ["pretrain.max_trained_agents=none"])
    assert config.pretrain.max_trained_agents is None


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("pretrain.epoch=2", "no field 'epoch' here, known are epochs, batch_size, .*seed"),
        ("training.epochs=2", "no field 'training' here, known are tokens, model, pretrain, finetune"),
        ("finetune.kl.goal=1", "no field 'goal' here, known are target, horizon"),
        ("finetune.kl=1", "name one of its fields: target, horizon"),
        ("finetune.seed.x=1", "'seed' has no fields of its own"),
        ("pretrain.epochs", "is not field=value"),
        ("pretrain.epochs=many", "expected float"),
        ("pretrain.batch_size=2.5", "expected int"),
        ("pretrain.batch_size=true", "expected int"),
        ("pretrain.batch_size=none", "expected int"),
        ("tokens.mirror=1", "expected bool"),
        ("finetune.trained=some", "expected one of decoder, goals, all"),
        ("finetune.reward=joy", "unknown reward 'joy': known are collision_offroad"),
        ("finetune.num_rollouts=1", "at least 2 rollouts"),
        ("model.dropout=1.5", r"shares in \[0, 1\)"),
        ("finetune.kl.target=0", "must be positive"),
        ("pretrain.epochs=inf", "epochs must be a finite number, got inf"),
        ("pretrain.weight_decay=-1", "weight_decay must not be negative, got -1"),
        ("catk.gradient_clip=-1", "gradient_clip must be positive, got -1"),
        ("catk.final_learning_rate_share=nan", r"final_learning_rate_share is a share in \[0, 1\], got nan"),
        ("pretrain.label_smoothing_kind=spatial", "has no effect: set label_smoothing"),
        ("pretrain.max_skipped_in_a_row=0", "max_skipped_in_a_row must be positive"),
        ("pretrain.validation.seed=-1", "seed must not be negative"),
        ("pretrain.device.devices=0", "devices must be positive"),
        ("finetune.device.threads=-1", "threads must not be negative"),
        ("finetune.betas=0.9,2", r"betas are shares in \[0, 1\)"),
        ("finetune.entropy_bonus=inf", "entropy_bonus must be a finite number"),
        ("model.num_frequencies=0", "num_frequencies must be positive"),
        ("model.map_radius_m=nan", "map_radius_m must be positive, got nan"),
        ("model.agent_radius_m=inf", "agent_radius_m must be a finite number"),
        ("model.max_map_neighbors=-1", "max_map_neighbors must be positive"),
        ("tokens.straight_up_to_mps=inf", "straight_up_to_mps must be a finite number"),
        ("tokens.seed=-1", "seed must not be negative"),
        ("tokens.trajtok.vehicle.x_max_m=inf", "x_max_m must be a finite number"),
        ("tokens.trajtok.num_neighbors=-1", "num_neighbors must not be negative"),
    ],
)
def test_a_bad_override_is_refused_in_words(override, words):
    with pytest.raises(ConfigError, match=words):
        configure(smart_demo_rlftsim(), [override])


LEAVES = [path[1:] for path in leaves(smart_demo_rlftsim()) if not path.endswith("betas")]


@given(st.one_of(st.sampled_from(LEAVES), st.text(max_size=12)), st.one_of(st.text(max_size=8), st.floats().map(str), st.integers().map(str)))  # fmt: skip
def test_any_override_is_taken_or_refused_in_words(name, value):
    with contextlib.suppress(ConfigError):
        configure(smart_demo_rlftsim(), [f"{name}={value}"])


def test_a_metrics_year_is_a_name():
    assert configure(smart_demo_rlftsim(), ["finetune.metric=2024"]).finetune.metric == "2024"


@pytest.mark.parametrize("override", ["finetune.betas=0.9", "finetune.betas=(0.9,)", "finetune.betas=('a', 'b')"])
def test_a_tuple_needs_all_its_values(override):
    with pytest.raises(ConfigError):
        configure(smart_demo_rlftsim(), [override])


# ---- models by name ---------------------------------------------------------------------------------------------------


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


def test_the_command_line_knows_every_recipe():
    assert set(get_args(RecipeName)) == set(RECIPES)


def test_a_gpu_that_is_not_there_is_refused_and_auto_does_without(monkeypatch):
    monkeypatch.setattr(models.torch.cuda, "is_available", lambda: False)
    assert models.find_device("auto").type == "cpu"
    with pytest.raises(ConfigError, match="--device cuda, but torch sees no CUDA device"):
        models.find_device("cuda")
