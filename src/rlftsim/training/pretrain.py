"""Pre-training: predict the next motion token along recorded tracks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from jaxtyping import Bool
from torch import Tensor, nn

from rlftsim.errors import ConfigError
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.training.imitation import ImitationConfig, Prediction, imitate


@runtime_checkable
class NextTokenModel(Protocol):
    """A model that can be pre-trained."""

    def teacher_forced(self, scenarios: ScenarioBatch, trained: Bool[Tensor, "B A"]) -> Prediction:
        """Predictions of the next token of every agent at every step of its recorded track."""
        ...

    def save_pretrained(self, folder: Path, *, card: str = "") -> None:
        """Write the model into a folder."""
        ...


@dataclass(frozen=True)
class PretrainConfig(ImitationConfig):
    """How a model is pre-trained. The defaults are those of the published SMART-tiny on WOMD."""


def pretrain(
    model: NextTokenModel,
    scenarios: Scenarios,
    out: Path,
    config: PretrainConfig,
    *,
    held_out: Scenarios | None = None,
    card: str = "",
) -> Path:
    """Pre-train a model in place; go on where a run in `out` was stopped.

    Args:
        model: an nn.Module that is a NextTokenModel.
        scenarios: with their futures; scenarios without are refused.
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
    if not isinstance(model, nn.Module) or not isinstance(model, NextTokenModel):
        raise ConfigError(f"{type(model).__name__} cannot be pre-trained: it needs teacher_forced and save_pretrained.")

    def along_the_record(batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> Prediction:
        return model.teacher_forced(batch, trained)

    return imitate(model, scenarios, out, config, along_the_record, title="pre-train", held_out=held_out, card=card)
