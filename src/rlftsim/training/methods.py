"""Fine-tuning by any method: the type of the settings chooses it."""

import os
from pathlib import Path

from rlftsim.errors import ConfigError
from rlftsim.rollout.policy import Policy
from rlftsim.training.calibrate import CalibrateConfig, calibrate
from rlftsim.training.catk import CatkConfig, RoadConfig, catk_finetune
from rlftsim.training.finetune import finetune
from rlftsim.training.finetune_config import FinetuneConfig
from rlftsim.training.goal_relabeling import GcslConfig, gcsl_finetune
from rlftsim.training.run import TrainingScenarios

FinetuningConfig = FinetuneConfig | CatkConfig | GcslConfig | CalibrateConfig
"""Settings of a fine-tuning; the type says which method: a reward, CAT-K (RoaD with a
`RoadConfig`), goal-conditioned supervised learning, or calibration."""


def finetune_policy(
    policy: Policy,
    scenarios: TrainingScenarios,
    out: str | os.PathLike[str],
    config: FinetuningConfig,
    *,
    held_out: TrainingScenarios | None = None,
    card: str = "",
) -> Path:
    """Fine-tune a policy in place; resumes where a run in `out` was stopped.

    Args:
        policy: an nn.Module that implements what the method needs.
        scenarios: a data set, a list or one scenario, with their futures.
        out: the run's folder.
        config: settings, whose type is that of the method.
        held_out: scenarios for validation; CAT-K and RoaD only, see `config.validation`.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy cannot be trained so, or the method has no validation.
        CheckpointError: `out` holds another run, or the run diverged.
        NotYetError: another run is at work in `out`.
    """
    if held_out is not None and not isinstance(config, CatkConfig):
        raise ConfigError("held_out has no effect: of the methods of fine-tuning only CAT-K and RoaD validate.")
    match config:
        case FinetuneConfig():
            return finetune(policy, scenarios, out, config, card=card)
        case CatkConfig():
            return catk_finetune(policy, scenarios, out, config, held_out=held_out, card=card)
        case GcslConfig():
            return gcsl_finetune(policy, scenarios, out, config, card=card)
        case CalibrateConfig():
            return calibrate(policy, scenarios, out, config, card=card)


def describe_method(config: FinetuningConfig) -> str:
    """The method of a fine-tuning in a few words, for the README of its model."""
    match config:
        case FinetuneConfig():
            return config.reward
        case RoadConfig():
            return "RoaD"
        case CatkConfig():
            return f"CAT-K, {config.choice}"
        case GcslConfig():
            return "own rollouts, relabelled"
        case CalibrateConfig():
            return f"calibration of {len(config.features)} features, {config.reward}"
