"""The table of docs/training_settings.md is what the code does."""

import re
from pathlib import Path

import pytest
import torch

from rlftsim.recipes.smart import smart_demo_rlftsim, smart_tiny_rlftsim

PAGE = Path(__file__).parents[2] / "docs" / "training_settings.md"
PAPER = {
    "learning_rate": 3e-6, "betas": (0.9, 0.999), "warmup_updates": 100, "entropy_bonus": 0.0, "num_rollouts": 4,
    "weight_decay": 0.01, "batch_size": 8, "gradient_clip": 1.0, "kl.horizon": 5.0, "kl.min_beta": 1e-3,
    "kl.max_beta": 1e3,
    "kl.target": 0.01, "kl.reference_sync_every": 500, "kl.reference_ema": 0.005, "reward": "mloo", "metric": "2025",
}  # fmt: skip
"""Bold values of the paper's table of hyper-parameters."""


def rows():
    """Field and the two columns of values."""
    cells = (line.strip("|\n ").split(" | ") for line in PAGE.read_text().splitlines() if "| `finetune." in line)
    return [(row[2].strip("`"), row[3], row[4]) for row in cells if len(row) == 5]


def value_of(recipe, field):
    for name in field.split("."):
        recipe = getattr(recipe, name)
    return recipe


def read(text, like):
    if isinstance(like, tuple):
        return tuple(float(part) for part in text.split(","))
    return text if isinstance(like, str) else type(like)(text)


@pytest.mark.parametrize(("field", "default", "demo"), rows(), ids=lambda cell: cell)
def test_every_row_of_the_table_is_a_field_with_that_default(field, default, demo):
    for recipe, text in ((smart_tiny_rlftsim(), default), (smart_demo_rlftsim(), demo)):
        value = value_of(recipe, field)
        assert read(text, value) == value


def test_every_hyper_parameter_of_the_paper_is_in_the_table_and_the_default():
    listed = {field for field, _, _ in rows()}
    assert {f"finetune.{name}" for name in PAPER} <= listed
    for name, value in PAPER.items():
        assert value_of(smart_tiny_rlftsim().finetune, name) == value


def test_every_metric_of_a_run_is_explained(measured):
    from rlftsim.rewards import compute_rewards, parse_reward
    from rlftsim.training.experience import Experience, describe_scenarios
    from rlftsim.training.monitoring import DRIFT_MONITORS

    scores, rollouts, batch, _ = measured
    rewards = compute_rewards(parse_reward("mloo"), scores, rollouts, batch)
    no_credits = torch.zeros(0, *rollouts.heading.shape[:3], dtype=torch.float64)
    names = {
        *describe_scenarios(Experience(batch, rollouts, scores, rewards, no_credits)),
        *(monitor.alarm for monitor in DRIFT_MONITORS),
    }
    explained = set(re.findall(r"`(\w+)`", PAGE.read_text()))
    assert names - {"reward_mloo_mean", "reward_mloo_std", "reward_mloo_missing_rate"} <= explained
