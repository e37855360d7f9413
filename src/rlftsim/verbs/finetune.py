"""Public `recipe`, `pretrain` and `finetune`: training that leaves the given policy as it is."""

import copy
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import nn

from rlftsim.errors import ConfigError
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.card import append_cards, model_card
from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.recipes.train import describe_method, prepare_policy
from rlftsim.rollout.policy import Policy, get_device
from rlftsim.scenario.any_form import AnyScenarios, Name, to_scenarios
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.clustering import build_vocabulary
from rlftsim.training.calibrate import CalibrateConfig
from rlftsim.training.catk import CatkConfig
from rlftsim.training.finetune_config import FinetuneConfig
from rlftsim.training.goal_relabeling import GcslConfig
from rlftsim.training.imitation import PretrainConfig
from rlftsim.training.registry import find_method
from rlftsim.training.run import train_policy
from rlftsim.verbs.inputs import to_policy


def pretrain(
    policy: Policy | Recipe | Name,
    scenarios: AnyScenarios,
    out: Name | None = None,
    config: PretrainConfig | None = None,
    *,
    held_out: AnyScenarios | None = None,
) -> Policy:
    """Pre-train a policy to predict the next decision along logged tracks, and return a new one.

    Args:
        policy: a recipe or its name, for a policy with fresh weights and a vocabulary built from the scenarios. Or a
            policy, or a name for `load_policy`, whose weights are trained further; it stays as it is.
        scenarios: training scenarios with their logged futures; a name of a data set stands for its split training.
        out: folder of the run; an interrupted run goes on there, a finished one is not repeated. None keeps no files.
        config: settings; None stands for those of the recipe, or the defaults.
        held_out: scenarios for validation in closed loop, see `config.validation`; a name of a data set stands for its
            split validation.

    Returns:
        The pre-trained policy, ready to simulate.

    Raises:
        ConfigError: the policy cannot be pre-trained, no scenario, or no such recipe.
        DataError: no such data set, or it has no such split.
        CheckpointError: `out` holds another run, or the run diverged.
        NotYetError: another run is at work in `out`.
    """
    _require_config(config, "pretrain", PretrainConfig)
    training = to_scenarios(scenarios, "training")
    if isinstance(policy, str) and policy in RECIPES.names():
        policy = recipe_by_name(policy)
    if isinstance(policy, Recipe):
        config = config or policy.pretrain
        vocabulary = None if policy.tokens is None else build_vocabulary(training, policy.tokens)[0]
        start: Any = policy.new_policy(vocabulary)
        card = _card("pre-trained", training)
    else:
        start = to_policy(policy)
        card = _card("pre-trained further", training, policy)
    settings = config or PretrainConfig()
    validation = None if held_out is None else to_scenarios(held_out)
    return _train_copy(
        start,
        out,
        lambda learner, folder: train_policy(learner, training, folder, settings, held_out=validation, card=card),
    )


def finetune(
    policy: Policy | Name,
    scenarios: AnyScenarios,
    out: Name | None = None,
    config: Any = None,
) -> Policy:
    """Fine-tune a policy in closed loop, and return a new one; the given policy stays as it is.

    Equals `rlftsim finetune` with the same settings.

    Args:
        policy: a policy, or a name for `load_policy`.
        scenarios: training scenarios with their logged futures; a name of a data set stands for its split training.
        out: folder of the run; an interrupted run goes on there, a finished one is not repeated, and with a reward and
            more epochs it is trained further. None keeps no files.
        config: settings, such as `FinetuneConfig(reward="mloo", epochs=0.5)` or `recipe("smart-demo").finetune`; those
            of a recipe's `catk`, `gcsl` or `calibrate` choose that method, and so do those of a method of another
            package. None stands for the paper's settings.

    Returns:
        The fine-tuned policy, ready to simulate.

    Raises:
        ConfigError: a policy without weights, or no scenario.
        DataError: no such data set, or it has no split training.
        CheckpointError: `out` holds another run, or the run diverged (the message names its last good checkpoint).
        NotYetError: another run is at work in `out`.
    """
    if isinstance(config, PretrainConfig) or find_method(config) is None:
        _require_config(config, "finetune", FinetuneConfig, CatkConfig, GcslConfig, CalibrateConfig)
    training, settings = to_scenarios(scenarios, "training"), config or FinetuneConfig()
    card = _card(f"fine-tuned ({describe_method(settings)})", training, policy)
    start = prepare_policy(to_policy(policy), settings)
    return _train_copy(start, out, lambda learner, folder: train_policy(learner, training, folder, settings, card=card))


def _require_config(config: object, section: str, *kinds: type) -> None:
    """Refuse settings of another kind, mostly a whole recipe.

    Args:
        config: None or settings.
        section: of a recipe, for the message.
        kinds: settings that are taken.

    Raises:
        ConfigError: settings of no such kind.
    """
    if not isinstance(config, (*kinds, type(None))):
        *most, last = (kind.__name__ for kind in kinds)
        names = f"{', '.join(most)} or {last}" if most else last
        raise ConfigError(
            f"config must be a {names}, got {type(config).__name__}: pass rs.recipe(name).{section} or make one."
        )


def _train_copy(policy: Policy, out: Name | None, train: Callable[[Any, Path], object]) -> Any:
    """A trained copy of a policy, on the policy's device.

    Args:
        policy: stays as it is.
        out: folder of the run; None = a temporary one.
        train: trains a policy in place with a folder for its files.
    """
    # Without weights there is nothing to copy; `train` refuses such a policy with a message.
    # Weights of a loaded policy are frozen; each method freezes again what it does not train.
    learner = copy.deepcopy(policy).requires_grad_(True) if isinstance(policy, nn.Module) else policy
    if out is None:
        with tempfile.TemporaryDirectory(prefix="rlftsim-") as folder:
            train(learner, Path(folder))
    else:
        train(learner, Path(out))
    assert isinstance(learner, nn.Module)
    return learner.eval().requires_grad_(False).to(get_device(policy))


def _card(what: str, scenarios: Scenarios, start: Policy | Name | None = None) -> str:
    """README of the model folder; terms are known of data sets and of starts that have a name."""
    name = start if isinstance(start, str | os.PathLike) else None
    if start is not None:
        what = f"{what} from {name or type(start).__name__}"
    if isinstance(scenarios, ScenarioDataset):
        return model_card(what, scenarios.folder, len(scenarios), name)
    card = f"# Traffic model, {what}\n\n* trained on {len(scenarios)} scenarios handed over in Python\n"
    return append_cards(card, [] if name is None else [name])
