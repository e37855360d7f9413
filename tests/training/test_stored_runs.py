"""Runs that release 0.1 left behind resume and end as they would have then; see tests/data/stored_0_1/README.md."""

import json
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import tiny
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart import attention, dropout
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.alarms import AlarmConfig
from rlftsim.training.catk import CatkConfig, catk_finetune
from rlftsim.training.finetune import finetune
from rlftsim.training.finetune_config import FinetuneConfig
from rlftsim.training.goal_relabeling import GcslConfig, gcsl_finetune
from rlftsim.training.goals import GoalConfig
from rlftsim.training.pretrain import PretrainConfig, pretrain
from rlftsim.training.reference import KlConfig
from rlftsim.training.run_folder import read_metrics
from rlftsim.training.validation import ValidationConfig

STORED = Path(__file__).parents[1] / "data" / "stored_0_1"
EXPECTED = json.loads((STORED / "expected.json").read_text())
TOLERANCE = 1e-5
"""Of weights. Torch and MKL round otherwise on other processors, also where both have AVX-512: 4e-6 in five updates."""

ADDED_METRICS = {
    "validation_unlogged_offroad_rate", "validation_loss", "validation_loss_turning", "validation_map_use",
    "validation_map_use_turning", "reward_mloo_missing_rate", "reward_goal_missing_rate",
    "reward_collision_offroad_missing_rate",
}  # fmt: skip
"""Metrics of later versions."""

MODEL = SmartConfig(
    dim=4, num_heads=2, head_dim=2, num_map_layers=1, num_decoder_layers=1, num_frequencies=1, history_tokens=2,
    max_map_neighbors=3, max_agent_map_neighbors=3, max_agent_neighbors=3,
)  # fmt: skip
PRETRAIN = PretrainConfig(
    epochs=2.5, batch_size=2, micro_batch_size=1, learning_rate=1e-2, warmup_updates=1, checkpoint_every=2, seed=3,
    validation=ValidationConfig(every=3, num_scenarios=2, num_rollouts=2), device=tiny.CPU,
)  # fmt: skip
TUNE = FinetuneConfig(
    epochs=2.5, batch_size=2, micro_batch_size=1, num_rollouts=2, rollouts_per_pass=1, learning_rate=1e-2,
    warmup_updates=2, reward="mloo + 0.1*collision_offroad", checkpoint_every=2,
    kl=KlConfig(reference_sync_every=2, reference_ema=0.25), alarms=AlarmConfig(first_updates=2, window=2),
    device=tiny.CPU,
)  # fmt: skip
GOALS = replace(
    TUNE, num_rollouts=3, rollouts_per_pass=2, reward="gcft(goal_weight=0.3, kind='hard', partial=True)",
    credit="agent",
    goals=GoalConfig(
        probability=0.8, augmented="augmented", augmented_probability=0.5, hindsight=0.5, learning_rate_scale=2.0
    ),
    kl=replace(TUNE.kl, condition_reference=False),
)  # fmt: skip
GCSL = GcslConfig(epochs=1.25, batch_size=1, num_rollouts=2, checkpoint_every=2, device=tiny.CPU)
CATK = CatkConfig(
    epochs=1.25, batch_size=1, learning_rate=1e-2, num_candidates=4, max_distance_lengths=2.0, goal_probability=0.5,
    goal_learning_rate_scale=2.0, checkpoint_every=2, device=tiny.CPU,
)  # fmt: skip


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    with tarfile.open(STORED / "stored.tar.xz") as tar:
        tar.extractall(folder)
    return folder


@pytest.fixture
def stored(unpacked, monkeypatch):
    """The stored files as the working directory: paths in their settings are relative to it."""
    monkeypatch.chdir(unpacked)
    return unpacked


def resume(name, out):
    """The call that made a run of 0.1, in the words of today."""
    training = ScenarioDataset("data", "training", cache_size=8)
    match name:
        case "base":
            torch.manual_seed(PRETRAIN.seed)
            policy = SmartPolicy(MODEL, Vocabulary.load(Path("vocabulary.safetensors")))
            pretrain(policy, training, out, PRETRAIN, held_out=ScenarioDataset("data", "validation"))
        case "tuned":
            finetune(load_policy("models/base"), training, out, TUNE)
        case "goals":
            torch.manual_seed(GOALS.seed)
            finetune(load_policy("models/base").with_goal_conditioning("concat"), training, out, GOALS)
        case "gcsl":
            torch.manual_seed(GCSL.seed)
            gcsl_finetune(load_policy("models/tuned").with_goal_conditioning("concat"), training, out, GCSL)
        case "catk":
            catk_finetune(load_policy("models/goals"), training, out, CATK)


def draw_as_torch(x, probability):
    """Dropout's factors from torch's random numbers, as in 0.1."""
    return torch.nn.functional.dropout(torch.ones_like(x), probability)


def lines_of(folder):
    """Metrics without times, which differ from run to run."""
    return [
        {name: value for name, value in line.items() if name != "time" and not name.startswith("seconds")}
        for line in read_metrics(folder)
    ]


@pytest.mark.parametrize("name", ["base", "tuned", "goals", "gcsl", "catk"])
def test_a_run_of_0_1_that_was_stopped_resumes_and_ends_as_it_would_have(name, stored, tmp_path, monkeypatch):
    for module in (attention, dropout):
        monkeypatch.setattr(module, "draw_dropout", draw_as_torch)
    if name == "base" and torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512"):
        pytest.skip("this processor draws other fresh weights, so the run is another one")
    out = tmp_path / name
    shutil.copytree(stored / "stopped" / name, out)
    assert [path.name for path in (out / "checkpoints").iterdir()] == ["update-00000002"]
    resume(name, out)
    expected = EXPECTED["metrics"][name]
    found = lines_of(out)
    # No metric has another name; validations log more than they did.
    assert [line.keys() - ADDED_METRICS for line in found] == [line.keys() for line in expected]
    assert len(found) == 5
    for line, other in zip(found, expected):
        own = {name: value for name, value in line.items() if name in other}
        assert own == pytest.approx(other, rel=1e-3, abs=1e-4, nan_ok=True)
    weights, others = load_file(out / "model" / "model.safetensors"), load_file(f"models/{name}/model.safetensors")
    assert weights.keys() == others.keys()
    for key, value in others.items():
        torch.testing.assert_close(weights[key], value, atol=TOLERANCE, rtol=0, msg=key)


@pytest.mark.parametrize("name", sorted(EXPECTED["weights"]))
def test_models_of_0_1_keep_their_fingerprints(name, stored):
    assert fingerprint_policy(load_policy(f"models/{name}")) == EXPECTED["fingerprints"][name]


def test_a_policy_without_weights_keeps_its_fingerprint():
    assert fingerprint_policy(ConstantVelocity()) == EXPECTED["fingerprints"]["constant_velocity"]


def test_goals_that_0_1_augmented_belong_to_its_model_still(stored):
    """They are inputs of the run "goals", whose settings hold their fingerprint."""
    settings = json.loads(Path("stopped/goals/config.json").read_text())
    augmented = GOALS.goals.open_augmented(ScenarioDataset("data", "training"))
    assert augmented is not None
    assert augmented.fingerprint == settings["augmented_goals"]
