"""From a data set to trained policies, stage by stage. Each does what is missing in its folder and refuses another's."""

from dataclasses import dataclass
from pathlib import Path

import torch

from rlftsim.errors import ConfigError
from rlftsim.policies.smart.config import GoalSight, SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.recipes.card import model_card
from rlftsim.recipes.models import load_policy
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.catk import CatkConfig, catk_finetune
from rlftsim.training.finetune import FinetuneConfig, finetune
from rlftsim.training.gcsl import GcslConfig, gcsl_finetune
from rlftsim.training.pretrain import PretrainConfig, pretrain

CACHED_SCENARIOS = 4096
"""About a megabyte each; with them stay their tokens."""


@dataclass(frozen=True)
class NewSight:
    """How a model that sees no goals is to see them; see `SmartPolicy.with_goal_sight`."""

    goal: GoalSight
    aim: bool | None = None
    """Tokens are weighed by where they lead, too; False = as in the paper, None = yes, or as the model has it."""


def open_training(data: Path) -> ScenarioDataset:
    """The training scenarios of a data set."""
    return ScenarioDataset(data, "training", cache_size=CACHED_SCENARIOS)


def find_vocabulary(training: ScenarioDataset, config: TokensConfig, path: Path, *, origin: str) -> Vocabulary:
    """The vocabulary in a file; built from the training scenarios where there is none of this origin."""
    if not path.exists() or Vocabulary.load(path).origin != origin:
        build_vocabulary(training, config, origin=origin)[0].save(path)
    return Vocabulary.load(path)


def pretrain_smart(
    vocabulary: Vocabulary,
    training: ScenarioDataset,
    model: SmartConfig,
    config: PretrainConfig,
    out: Path,
    *,
    held_out: ScenarioDataset | None = None,
) -> Path:
    """Folder of a model pre-trained from fresh weights.

    Raises:
        CheckpointError: `out` holds a run with other settings.
    """
    torch.manual_seed(config.seed)
    policy = SmartPolicy(model, vocabulary)
    card = model_card("pre-trained", training.folder, len(training))
    return pretrain(policy, training, out, config, held_out=held_out, card=card)


def finetune_with_reward(
    base: str | Path,
    training: ScenarioDataset,
    config: FinetuneConfig,
    out: Path,
    *,
    sight: NewSight | None = None,
) -> Path:
    """Folder of a model fine-tuned closed-loop from a base model, which is given sight of goals if `sight` says how.

    Raises:
        CheckpointError: `out` holds a run with other settings or another base model.
        ConfigError: the base model has no weights, or sees goals in another way.
    """
    card = model_card(f"fine-tuned ({config.reward}{_by(sight)}) from {base}", training.folder, len(training))
    return finetune(_learner(base, sight, config.seed), training, out, config, card=card)


def finetune_with_catk(
    base: str | Path,
    training: ScenarioDataset,
    config: CatkConfig,
    out: Path,
    *,
    sight: NewSight | None = None,
    held_out: ScenarioDataset | None = None,
) -> Path:
    """Folder of a model fine-tuned with CAT-K from a base model, which is given sight of goals if `sight` says how.

    Raises:
        CheckpointError: `out` holds a run with other settings or another base model.
        ConfigError: the base model has no weights, or sees goals in another way.
    """
    card = model_card(f"fine-tuned (CAT-K, {config.choice}{_by(sight)}) from {base}", training.folder, len(training))
    return catk_finetune(_learner(base, sight, config.seed), training, out, config, held_out=held_out, card=card)


def teach_goals(
    base: str | Path,
    training: ScenarioDataset,
    config: GcslConfig,
    out: Path,
    *,
    sight: NewSight | None = None,
) -> Path:
    """Folder of a model that knows what goals are, from a base model, which is given sight of goals if `sight` says how.

    Raises:
        CheckpointError: `out` holds a run with other settings or another base model.
        ConfigError: the base model has no weights, sees no goals, or sees them in another way.
    """
    card = model_card(f"told where its own rollouts led{_by(sight)}, from {base}", training.folder, len(training))
    return gcsl_finetune(_learner(base, sight, config.seed), training, out, config, card=card)


def _by(sight: NewSight | None) -> str:
    if sight is None:
        return ""
    return f", goals by {sight.goal}{', without an aim' if sight.aim is False else ''}"


def _learner(base: str | Path, sight: NewSight | None, seed: int) -> Policy:
    """A policy to fine-tune."""
    policy = load_policy(str(base))
    if sight is None:
        return policy
    if not isinstance(policy, SmartPolicy):
        raise ConfigError(f"{base} has no weights, so it cannot learn to see goals: name a model folder.")
    torch.manual_seed(seed)
    return policy.with_goal_sight(sight.goal, aim=sight.aim)
