"""Policies by name: registered ones, those of other packages, model folders and runs' folders."""

import itertools

import pytest
import torch
from safetensors.torch import load_file, save_file

import scenes
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.checkpoint import find_model, read_model, save_model
from rlftsim.policies.registry import POLICIES, load_policy, load_policy_or_oracle, with_guidance
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from third_party import installed

SMALL = SmartConfig(dim=8, num_heads=1, head_dim=4, num_map_layers=1, num_decoder_layers=1, num_frequencies=2)

CRUISE = '''
"""Half the speed of the current step, or another fraction."""

import torch
from torch import nn

from rlftsim.policies.checkpoint import read_model, save_model
from rlftsim.rollout.baselines import ConstantVelocity


class Cruise(ConstantVelocity, nn.Module):
    architecture = "{name}"

    def __init__(self, unit: str = "m/s"):
        super().__init__()
        self.unit = unit
        self.fraction = nn.Parameter(torch.tensor(0.5))

    def decide(self, context, state):
        dist = super().decide(context, state)
        return type(dist)(self.fraction * dist.decision)

    def save_pretrained(self, folder, *, card=""):
        save_model(folder, self, {{"unit": self.unit}}, card=card)

    @classmethod
    def from_pretrained(cls, folder):
        return read_model(folder).load(cls)


class Half(ConstantVelocity):
    """No folder, no weights."""
'''
numbers = itertools.count()


@pytest.fixture
def cruise(tmp_path, monkeypatch):
    """Name of a policy of another package, another one in each test: modules of one name are imported once."""
    # found entry points stay registered: forget them after the test
    monkeypatch.setattr(POLICIES, "_registered", dict(POLICIES._registered))
    name = f"cruise{next(numbers)}"
    entries = {name: f"{name}_package:Cruise", f"{name}_half": f"{name}_package:Half"}
    with installed(tmp_path / "site", f"{name}_package", CRUISE.format(name=name), {"rlftsim.policies": entries}):
        yield name


@pytest.fixture(scope="module")
def smart():
    torch.manual_seed(0)
    vocabulary = build_vocabulary([scenes.crowd(num_agents=20)], TokensConfig(num_tokens=8, num_map_prototypes=4))[0]
    return SmartPolicy(SMALL, vocabulary)


# ---- policies of other packages ------------------------------------------------------------------


def test_a_policy_of_another_package_has_a_name(cruise):
    policy = load_policy(cruise)
    assert type(policy).__name__ == "Cruise"
    assert not policy.training
    assert not policy.fraction.requires_grad
    assert type(load_policy(f"{cruise}_half")).__name__ == "Half"


@pytest.mark.parametrize("nested", [False, True], ids=["a model folder", "a run's folder"])
def test_its_folder_is_read_by_its_own_class(cruise, nested, tmp_path):
    policy = type(load_policy(cruise))(unit="km/h")
    with torch.no_grad():
        policy.fraction.fill_(0.25)
    folder = tmp_path / "run"
    policy.save_pretrained(folder / "model" if nested else folder, card="# Cruise\n")
    again = load_policy(folder)
    assert (type(again), again.unit, float(again.fraction)) == (type(policy), "km/h", 0.25)
    assert fingerprint_policy(again) == fingerprint_policy(policy)
    batch = collate([scenes.bend()])
    ends = [simulate(p, batch, num_rollouts=1, seed=0).position for p in (load_policy(str(folder)), policy.eval())]
    assert ends[0].equal(ends[1])


def test_a_folder_of_a_class_that_cannot_read_one_says_what_to_write(cruise, tmp_path):
    policy = load_policy(f"{cruise}_half")
    type(policy).architecture = f"{cruise}_half"
    save_model(tmp_path / "half", policy, {})
    assert read_model(tmp_path / "half").config == {}
    with pytest.raises(ConfigError, match=r"give its class .* a classmethod from_pretrained\(folder\)"):
        load_policy(tmp_path / "half")


def test_a_folder_of_a_package_that_is_not_installed_names_its_architecture(tmp_path):
    (tmp_path / "config.json").write_text('{"architecture": "trafficbotz"}')
    with pytest.raises(ConfigError, match=r"unknown policy 'trafficbotz': .*known are"):
        load_policy(tmp_path)


def test_a_class_without_an_architecture_is_told_to_declare_one(tmp_path):
    with pytest.raises(ConfigError, match='an attribute such as architecture = "anonymous"'):
        save_model(tmp_path, type("Anonymous", (), {})(), {})


def test_settings_of_another_architecture_keep_their_names_and_values(tmp_path):
    class Foreign:
        architecture = "foreign"

    settings = {"format": "csv", "licence": "MIT", "goal_aim": True, "goals": {"share": 0.5, "kind": "recorded"}}
    save_model(tmp_path, Foreign(), settings)
    assert read_model(tmp_path).config == settings


@pytest.mark.parametrize(
    "thing",
    [dict, lambda: None, lambda: ConstantVelocity, 3],
    ids=["a class", "a function without a result", "a function that returns a class", "a number"],
)
def test_an_entry_point_that_is_no_policy_is_refused(thing, monkeypatch):
    monkeypatch.setitem(POLICIES._registered, "broken", thing)
    with pytest.raises(ConfigError, match="policy 'broken'"):
        load_policy("broken")


# ---- names and folders ---------------------------------------------------------------------------


def test_a_name_comes_before_a_folder_and_dot_slash_is_the_folder(smart, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    smart.save_pretrained("constant_velocity")
    smart.save_pretrained("smart")
    assert isinstance(load_policy("constant_velocity"), ConstantVelocity)
    assert isinstance(load_policy("./constant_velocity"), SmartPolicy)
    assert isinstance(load_policy("smart"), SmartPolicy)  # this name alone is no policy


def test_an_architecture_without_its_weights_is_refused_in_words(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="policy 'smart' needs its weights: name a model folder"):
        load_policy("smart")


def test_a_typo_gets_the_nearest_name():
    with pytest.raises(ConfigError, match="did you mean 'constant_velocity'"):
        load_policy("constant_velocty")
    with pytest.raises(ConfigError, match="did you mean 'oracle'"):
        load_policy_or_oracle("oracel")
    with pytest.raises(ConfigError, match=r"on Hugging Face it is hf://somebody/traffic$"):
        load_policy("somebody/traffic")


@pytest.mark.parametrize("kind", [str, lambda path: path])
@pytest.mark.parametrize("nested", ["", "model"])
def test_a_smart_model_is_read_from_a_text_or_path_of_a_model_or_run(kind, nested, smart, tmp_path):
    smart.save_pretrained(kind(tmp_path / "run" / nested))
    again = SmartPolicy.from_pretrained(kind(tmp_path / "run"))
    assert fingerprint_policy(again) == fingerprint_policy(smart)
    assert fingerprint_policy(load_policy(kind(tmp_path / "run"))) == fingerprint_policy(smart)


def test_a_run_without_a_model_yet_says_so(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "config.json").write_text('{"epochs": 1}')
    with pytest.raises(CheckpointError, match="the run has not finished"):
        load_policy(tmp_path)


def test_weights_that_are_not_finite_are_refused_by_name(smart, tmp_path):
    smart.save_pretrained(tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    name = sorted(weights)[0]
    weights[name].view(-1)[0] = torch.nan
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(CheckpointError, match=rf"not finite \({name}\)"):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"dim": 8', '"dim": "wide"', "settings do not fit SmartConfig"),
        ('"dim": 8', '"dims": 8', r"settings do not fit SmartConfig .*dims"),
        ('"dim": 8', '"dim": -8', "dim must be positive"),
        ('"dim": 8', '"dim": 16', "weights do not fit this model"),
        ('"architecture": "smart"', '"architecture": "cruise"', "not a smart model, its architecture is 'cruise'"),
        ('"dim"', "dim", "damaged model folder"),
    ],
)
def test_settings_that_do_not_fit_are_no_damage(old, new, words, smart, tmp_path):
    smart.save_pretrained(tmp_path)
    text = (tmp_path / "config.json").read_text()
    assert old in text
    (tmp_path / "config.json").write_text(text.replace(old, new))
    with pytest.raises((CheckpointError, ConfigError), match=words) as caught:
        SmartPolicy.from_pretrained(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("file", ["config.json", "model.safetensors", "vocabulary.safetensors"])
def test_a_missing_file_is_named(file, smart, tmp_path):
    smart.save_pretrained(tmp_path)
    (tmp_path / file).unlink()
    with pytest.raises(CheckpointError, match=f"{file} is missing"):
        SmartPolicy.from_pretrained(tmp_path)


def test_guidance_needs_a_goal_logit_bias(smart):
    assert with_guidance(smart, 1.0) is smart
    for policy in (smart, ConstantVelocity(), "oracle"):
        with pytest.raises(ConfigError, match="has no goal logit bias"):
            with_guidance(policy, 2.0)


def test_a_folder_of_runs_names_them(tmp_path):
    for name in ("pretrain", "finetune"):
        save_model(tmp_path / "demo" / name / "model", ConstantVelocity(), {})
    (tmp_path / "demo" / "evaluations").mkdir()
    demo = tmp_path / "demo"
    with pytest.raises(CheckpointError, match=rf"is missing: did you mean {demo}/finetune or {demo}/pretrain\?$"):
        load_policy(demo)
    for load in (load_policy, find_model):
        with pytest.raises(ConfigError, match=rf"did you mean '{demo}/pretrain'"):
            load(demo / "pretrian")
        with pytest.raises(ConfigError, match=rf"config\.json' is a file: name its folder, {demo}/pretrain/model\.$"):
            load(demo / "pretrain" / "model" / "config.json")


def test_the_oracle_is_no_policy():
    with pytest.raises(ConfigError, match="only evaluate takes it"):
        load_policy("oracle")
