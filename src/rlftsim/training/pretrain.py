"""Pre-training: predict the next motion token along logged tracks, or minimize the policy's own imitation loss."""

import os
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from rlftsim.rollout.policy import ImitatedPolicy, ImitationLoss, Prediction, PretrainablePolicy
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.imitation import ImitationConfig, imitate
from rlftsim.training.run import TrainingScenarios, as_scenarios, require_trainable


@dataclass(frozen=True)
class PretrainConfig(ImitationConfig):
    """Pre-training. The defaults are those of the published SMART-tiny on WOMD."""


def pretrain(
    model: PretrainablePolicy | ImitatedPolicy,
    scenarios: TrainingScenarios,
    out: str | os.PathLike[str],
    config: PretrainConfig,
    *,
    held_out: TrainingScenarios | None = None,
    card: str = "",
) -> Path:
    """Pre-train a model in place; resumes where a run in `out` was stopped.

    Args:
        model: an nn.Module that is a PretrainablePolicy or an ImitatedPolicy; its own loss goes first.
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
    """
    scenarios = as_scenarios(scenarios)
    own_loss = getattr(model, "imitation_loss", None)
    # One of the two is enough; a policy with neither is refused with both names.
    either = ("teacher_forced", "imitation_loss")
    needs = () if any(hasattr(model, name) for name in either) else either
    policy = require_trainable(model, scenarios, "pre-training", needs=needs)

    def predict_along_log(
        batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int
    ) -> Prediction | ImitationLoss:
        return policy.teacher_forced(batch, trained) if own_loss is None else own_loss(batch, trained, update)

    return imitate(
        policy, scenarios, out, config, predict_along_log,
        title="pre-train", held_out=None if held_out is None else as_scenarios(held_out), card=card,
    )  # fmt: skip
