"""The way from a data set to trained policies: vocabulary, pre-training, fine-tuning by any method.

Each stage continues the work in a folder, and refuses the folder of a different run.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from rlftsim.errors import ConfigError
from rlftsim.policies.calibrated.policy import add_features
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.card import model_card
from rlftsim.rollout.policy import ConditionablePolicy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.config import CalibrateConfig, PretrainConfig
from rlftsim.training.goals import not_conditioned
from rlftsim.training.method import TrainingSettings
from rlftsim.training.registry import find_method
from rlftsim.training.run import train_policy

CACHED_SCENARIOS = 4096
"""About a megabyte each; their tokens are cached with them."""


@dataclass(frozen=True)
class GoalConditioning:
    """Goal conditioning that is added to a goal-free model before fine-tuning, see
    `SmartPolicy.with_goal_conditioning`."""

    encoding: str
    """SMART has "concat" and "indication"."""
    logit_bias: bool | None = None
    """Goals also bias the logits of tokens by their endpoints. False = no, as in the paper; None = yes, or as
    the model has it."""

    def __str__(self) -> str:
        return f", goals by {self.encoding}{', without a logit bias' if self.logit_bias is False else ''}"


def open_training(data: Path) -> ScenarioDataset:
    """The training scenarios of a data set."""
    return ScenarioDataset(data, "training", cache_size=CACHED_SCENARIOS)


def find_vocabulary(training: ScenarioDataset, config: TokensConfig, path: Path, *, origin: str) -> Vocabulary:
    """The vocabulary in a file; built from the training scenarios for a missing file, or a file of a different origin.

    Args:
        training: Training scenarios; the motions are clustered.
        config: Settings of the clustering, such as the number of tokens.
        path: file to read, or to write.
        origin: Text on the data and settings of the vocabulary; stored in the file.
    """
    if not path.exists() or Vocabulary.load(path).origin != origin:
        build_vocabulary(training, config, origin=origin)[0].save(path)
    # Always from the file: the first run and a resumed one get the very same tokens.
    return Vocabulary.load(path)


def pretrain_policy(policy: Any, training: ScenarioDataset, config: PretrainConfig, out: Path) -> Path:
    """Folder of the model that pre-training makes of a policy.

    Args:
        policy: Policy with fresh weights, such as `recipe.new_policy(vocabulary)`; trained in place.
        training: Training scenarios of a single data set, with logged futures.
        config: Settings of pre-training; a stored run resumes only with equal settings.
        out: Folder of the run. A run that was stopped there is resumed, a finished run is not repeated.

    Raises:
        CheckpointError: `out` holds a run with other settings.
    """
    card = model_card("pre-trained", training.folder, len(training))
    return train_policy(policy, training, out, config, card=card)


def finetune_model(
    base: str | Path,
    training: ScenarioDataset,
    config: TrainingSettings,
    out: Path,
    *,
    conditioning: GoalConditioning | None = None,
) -> Path:
    """Folder of the model that fine-tuning makes of a base model. The type of `config` chooses the method.

    Args:
        base: model folder, or the folder of a run.
        training: Training scenarios of a single data set, with logged futures.
        config: Settings of a training method, such as `FinetuneConfig` for a reward or `CatkConfig` for CAT-K.
        out: Folder of the run. A run that was stopped there is resumed, a finished run is not repeated; with a reward
            and more epochs it is trained further.
        conditioning: goal conditioning to add to the base model first; None = as the base model is.

    Raises:
        CheckpointError: `out` holds a run with other settings or a different base model.
        ConfigError: The base model has no weights or other goal conditioning.
    """
    policy = load_policy(str(base))
    if conditioning is not None:
        policy = with_conditioning(policy, conditioning, config.seed, name=base)

    description = f"fine-tuned ({describe_method(config)}{conditioning or ''}) from {base}"
    card = model_card(description, training.folder, len(training), base)
    return train_policy(prepare_policy(policy, config), training, out, config, card=card)


def with_conditioning(policy: Any, conditioning: GoalConditioning, seed: int, *, name: object) -> Any:
    """The policy with goal conditioning.

    Args:
        policy: Base model, whose weights are kept.
        conditioning: Goal conditioning to add.
        seed: Seed of the weights that encode goals.
        name: Name of the base model, for the message.

    Raises:
        ConfigError: The policy cannot follow goals.
    """
    if not isinstance(policy, ConditionablePolicy):
        raise ConfigError(f"{name}: {not_conditioned(policy)}")
    torch.manual_seed(seed)
    return policy.with_goal_conditioning(conditioning.encoding, logit_bias=conditioning.logit_bias)


def describe_method(config: object) -> str:
    """The method of a fine-tuning in a few words, for the README of the model: by the type of the settings."""
    method = find_method(config)
    return "" if method is None else method.describe(config)


def prepare_policy(policy: Any, config: object) -> Any:
    """Policy with the features of a calibration, all weights 0; for all other methods the policy unchanged.

    Args:
        policy: Base model. A model that has been calibrated with the same features goes on from the weights.
        config: Settings of the method.

    Raises:
        ConfigError: The policy has no weights, decides neither by tokens nor by actions, or a feature is unknown.
    """
    if not isinstance(config, CalibrateConfig):
        return policy
    return add_features(policy, config.features)


def start_from_shorter_run(out: Path, epochs: float) -> None:
    """Copy the end of the longest shorter run with a reward, if any, into a run that has not begun.

    The longer run passes through the same weights, because no update depends on the length of the run.

    Args:
        out: folder of the run to begin, beside the shorter runs, which are called "3-epochs".
        epochs: length of the run to begin.
    """

    def parse_epochs(path: Path) -> float:
        return float(path.name.removesuffix("-epochs"))

    finished = [path for path in out.parent.glob("*-epochs") if (path / "model").exists()]
    shorter = [path for path in finished if parse_epochs(path) < epochs]
    if out.exists() or not shorter:
        return
    # Copied under another name first: a copy that is interrupted must not look like a run.
    longest, copy = max(shorter, key=parse_epochs), out.with_name(f".partial-{out.name}")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(longest / "checkpoints", copy / "checkpoints")
    # with its settings, so that one of other settings is refused rather than continued
    for name in ("config.json", "metrics.jsonl"):
        shutil.copy(longest / name, copy / name)
    copy.rename(out)
