"""Pre-training: predict the next motion token along logged tracks, or minimize the policy's own imitation loss."""

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rlftsim.training.imitation import ImitationConfig, imitate, loss_along_log
from rlftsim.training.run import TrainingScenarios, as_scenarios, require_trainable


@dataclass(frozen=True)
class PretrainConfig(ImitationConfig):
    """Pre-training. The defaults, which recipes change, are those of the published SMART-tiny on WOMD."""


def pretrain(
    model: object,
    scenarios: TrainingScenarios,
    out: str | os.PathLike[str],
    config: PretrainConfig,
    *,
    held_out: TrainingScenarios | None = None,
    card: str = "",
) -> Path:
    """Pre-train a model in place; resumes where a run in `out` was stopped.

    Args:
        model: an nn.Module that is a PretrainablePolicy or an ImitatedPolicy; its own loss goes first. Others are
            refused.
        scenarios: a data set, a list or one scenario, with their futures.
        out: the run's folder.
        config: see its fields.
        held_out: scenarios to validate on, see `config.validation`; None = no validation.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the model cannot be pre-trained, or there is no scenario.
        CheckpointError: `out` holds another run, or the run diverged.
        NotYetError: another run is at work in `out`.
    """
    scenarios = as_scenarios(scenarios)
    policy = require_trainable(model, scenarios, "pre-training", imitated=True)
    return imitate(
        policy, scenarios, out, config, partial(loss_along_log, policy),
        title="pre-train", held_out=None if held_out is None else as_scenarios(held_out), card=card,
    )  # fmt: skip
