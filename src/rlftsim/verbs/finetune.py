"""`rs.finetune` and `rlftsim finetune`: training in closed loop that leaves the given policy as it is."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from rlftsim.errors import ConfigError
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.settings import list_sections, read_settings
from rlftsim.recipes.train import GoalConditioning, describe_method, prepare_policy, with_conditioning
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.open import to_scenarios
from rlftsim.training.config import (
    NOT_VALIDATED,
    CalibrateConfig,
    CatkConfig,
    FinetuneConfig,
    GcslConfig,
    PretrainConfig,
    RoadConfig,
)
from rlftsim.training.registry import METHODS, find_method, method_by_name
from rlftsim.verbs.arguments import AnyRecipe, Data, File, Model, OnUpdate, Processes, Settings
from rlftsim.verbs.commands import FINETUNING
from rlftsim.verbs.inputs import check_config, to_recipe, with_checked_arguments
from rlftsim.verbs.recipe_flags import RecipeFlags, check_no_settings, find_value
from rlftsim.verbs.runs import print_model, repeat_for_seeds
from rlftsim.verbs.training import find_held_out, load_start, train, with_changes, write_card

__all__ = ["adapt_flags", "check_flags", "finetune", "print_model"]


def adapt_flags(flags: RecipeFlags, words: Sequence[str]) -> RecipeFlags:
    """The flags with those of the method, of a recipe with goals if there are some.

    Args:
        flags: Flags of the recipe.
        words: Words behind the command.
    """
    method = choose_method(flags.recipe, words)
    section = find_section(method)
    sections = tuple(dict.fromkeys((*flags.sections, section)))
    recipe = _complete_recipe(flags.recipe, section, has_goals=bool(find_value("--goal", words)))
    recipe = replace(recipe, method=method)
    return replace(flags, recipe=recipe, sections=sections, file_sections=sections, run_section=section)


def choose_method(recipe: Recipe, words: Sequence[str]) -> str:
    """Method of a command line: the named one, else the one whose settings are given, else rlft with goals, else the
    recipe's.

    Args:
        recipe: Recipe whose method is the last resort.
        words: Words behind the command.

    Raises:
        ConfigError: A file of settings that cannot be read.
    """
    if name := find_value("--method", words):
        return name
    given = [section for section in FINETUNING if any(word.startswith(f"--{section}.") for word in words)]
    if not given and (file := find_value("--config", words)):
        given = _find_sections(read_settings(Path(file)), recipe)
    if len(given) == 1:
        return "rlft" if given[0] == "finetune" else given[0]
    return "rlft" if find_value("--goal", words) else recipe.method


def _find_sections(values: Mapping[str, Any], recipe: Recipe) -> list[str]:
    """Sections of fine-tuning in a file: of a printed recipe by name, of a run's config.json the one that has most of
    the fields."""
    present = {name: section for name, section in list_sections(recipe).items() if name in FINETUNING}
    named = [name for name in present if name in values]
    counts = {name: sum(entry.name in values for entry in fields(section)) for name, section in present.items()}
    return named or [max(counts, key=counts.__getitem__)]


def check_flags(values: Mapping[str, Any], recipe: Recipe, flags: Sequence[str]) -> None:
    """Check that there are no settings of other methods, and no flags that need another flag.

    Args:
        values: Values of the command line by argument.
        recipe: Recipe with the values of its flags.
        flags: Flags that were given.

    Raises:
        ConfigError: A flag has no effect, or the recipe has no settings of the method.
    """
    method, goal, bias = recipe.method, values["goal"], values["goal_logit_bias"]
    section = find_section(method)
    other_sections = [name for name in FINETUNING if name != section]
    check_no_settings(flags, other_sections, f"with --method {method}: its settings are --{section}.*")
    if goal is None and bias is not None:
        flag = "--goal-logit-bias" if bias else "--no-goal-logit-bias"
        raise ConfigError(f"{flag} has no effect without goals: add --goal concat or --goal indication.")
    if method == "gcsl" and values["validation_split"]:
        raise ConfigError(f"--validation-split {values['validation_split']} has no effect: {NOT_VALIDATED}")
    _find_settings(recipe, values["recipe"], method)


@with_checked_arguments
def finetune(
    policy: Model,
    scenarios: Data,
    out: File | None = None,
    config: Settings | None = None,
    *,
    recipe: AnyRecipe | None = None,
    method: Annotated[str | None, tyro.conf.arg(metavar="rlft|catk|road|gcsl|calibrate|NAME")] = None,
    goal: Literal["concat", "indication"] | None = None,
    goal_logit_bias: Annotated[bool | None, tyro.conf.arg(metavar="/ --no-goal-logit-bias")] = None,
    processes: Processes = None,
    limit: int | None = None,
    max_updates: int | None = None,
    seed: int | None = None,
    seeds: int | None = None,
    on_update: OnUpdate | None = None,
    split: str = "training",
    validation_split: str | None = None,
    tracker: str = "tensorboard",
) -> Policy:
    """Fine-tune a model in closed loop: by policy gradient on a realism reward (RLFTSim), by CAT-K, by RoaD or by
    calibration.

    Example: rlftsim finetune smart-tiny --model runs/base --data data/womd --out runs/tuned --finetune.epochs 0.5

    Writes checkpoints, metrics and the finished model, OUT/model. An interrupted run continues when the same
    command is repeated.

    Args:
        policy: Model to start from: a run, a model folder or a registered name. rlft also uses it as the frozen KL
            reference. In Python also a policy, which stays as it is.
        scenarios: Folder of a data set, or "synthetic" for the scenarios that ship with the package. In Python also
            scenarios with their logged futures.
        out: Folder of the run: configuration, metrics, checkpoints, model. A finished run is not repeated; with a
            reward and more epochs it is trained further. In Python left out, no file is kept.
        config: JSON file of settings: the output of `rlftsim recipe NAME --json`, or the config.json of an earlier run
            by the same method. A run repeated from its own config.json, with the same model and data, gives the same
            weights bit for bit. Flags override the file. In Python settings such as
            `FinetuneConfig(reward="mloo", epochs=0.5)` or `recipe("smart-demo").finetune`, in place of the recipe's;
            their class says the method.
        recipe: Settings to start from; `rlftsim recipe` lists all recipes. The flags below change single fields. The
            model brings its own architecture, so any recipe fits any model. In Python also a recipe itself; left out,
            the paper's settings.
        method: Training method. Left out: the method whose settings are given, rlft with goals, else the recipe's: for
            models of the demo's size calibrate, for others the paper's rlft. rlft: policy gradient on a realism reward,
            fields finetune.*. catk: supervised fine-tuning along rollouts that choose the token closest to the log
            among the top K, fields catk.*. road: supervised fine-tuning on the model's own rollouts, guided by the log,
            fields road.*. gcsl: train the goal-conditioned weights on the model's own rollouts, relabelled with their
            endpoints, as a start for rlft with goals (--model OUT), fields gcsl.*. calibrate: fit the weights of a few
            named features of a decision, no weight of the model, to a realism reward without a change of speed,
            fields calibrate.*. Another NAME: the method that another package has registered, fields NAME.*.
        goal: Fine-tune with goals, and how the model encodes them. Every agent's goal is its logged endpoint (see
            --finetune.goals.augmented for others). rlft then uses the reward gcft, catk trains the goal-conditioned
            weights alone. Left out, the model keeps the goal conditioning it has.
        goal_logit_bias: With --goal: add a goal-progress bias to the token logits (ours, not the paper's). Left out:
            yes where goal conditioning is added, unchanged where the model has it.
        processes: Processes that train, in short for the method's device.processes.
        limit: Number of training scenarios, from the first on; left out, all.
        max_updates: Updates after which the run ends early, with a model. A larger number later continues to the
            weights of a run that never stopped: a learning rate that falls (catk, road, gcsl) falls as over all epochs
            and is still high at an early end. Not for calibrate.
        seed: Seed of the run, in short for the method's seed.
        seeds: Number of runs that differ in the seed alone, from 0 on: OUT/seed-0, OUT/seed-1 and so on. A table at the
            end has the mean and the 95 % interval. In Python the policy of the first run is returned.
        on_update: Function that is called behind each update with the number of updates done and the metrics by name,
            `f(update, values)`. An error in the function ends the run, which goes on from the last checkpoint.
        split: Split of the data set to train on.
        validation_split: With rlft, catk and road: split to validate on in closed loop, see
            --finetune.validation.every. Left out: "tune", the part of "validation" that is not of the exam.
        tracker: Programs that show the run while it trains, with commas between: tensorboard, wandb, mlflow, trackio,
            those of other packages, or module:Class. metrics.jsonl is always written. Empty: none.

    Returns:
        The fine-tuned policy, ready to simulate.

    Raises:
        ConfigError: A policy without weights, no scenario, or settings of no method.
        DataError: No such data set, or it has no such split.
        CheckpointError: The folder holds another run, or the run diverged (the message names its last good checkpoint).
        NotYetError: Another run is at work in the folder.
    """
    if seeds is not None:  # first, while the locals are the arguments
        return repeat_for_seeds(finetune, locals(), seeds)
    if isinstance(config, PretrainConfig) or find_method(config) is None:
        check_config(config, "finetune", FinetuneConfig, CatkConfig, GcslConfig, CalibrateConfig)
    training = to_scenarios(scenarios, split, limit)
    settings: Any = _choose_settings(recipe, method, has_goals=goal is not None) if config is None else config
    settings = with_changes(settings, processes, seed)
    trainer = find_method(settings)
    interval = settings.validation.every if trainer is not None and trainer.validates else 0
    held_out = find_held_out(scenarios, training, validation_split, interval)
    learner, device = load_start(policy)
    conditioning = "" if goal is None else GoalConditioning(goal, goal_logit_bias)
    if conditioning:
        name = policy if isinstance(policy, str | os.PathLike) else type(policy).__name__
        learner = with_conditioning(learner, conditioning, settings.seed, name=name)
    card = write_card(f"fine-tuned ({describe_method(settings)}{conditioning})", training, policy)
    learner = prepare_policy(learner, settings)
    limits: Any = {"max_updates": max_updates, "on_update": on_update, "tracker": tracker}
    return train(learner, training, out, settings, device=device, held_out=held_out, card=card, **limits)


def find_section(method: str) -> str:
    """Section of a recipe with the settings of a method of fine-tuning: "finetune" for rlft, else the method's name.

    Raises:
        ConfigError: Unknown, with the nearest known name, or "pretrain", which is no fine-tuning.
    """
    if method == "pretrain":
        raise ConfigError("method 'pretrain' has a command of its own: rlftsim pretrain --init-from MODEL.")
    METHODS.get(method)
    return "finetune" if method == "rlft" else method


def _choose_settings(recipe: AnyRecipe | None, method: str | None, *, has_goals: bool) -> Any:
    """Settings of a method, of a recipe or the paper's; None = the recipe's method, with goals rlft.

    Raises:
        ConfigError: The recipe has none.
    """
    base = Recipe(road=RoadConfig(), calibrate=CalibrateConfig()) if recipe is None else to_recipe(recipe)
    # a recipe that is handed over has what it should have
    is_complete = isinstance(recipe, Recipe)
    method = method or ("rlft" if has_goals and not is_complete else base.method)
    if not is_complete:
        base = _complete_recipe(base, find_section(method), has_goals=has_goals)
    return _find_settings(base, type(base).__name__ if is_complete else recipe, method)


def _complete_recipe(recipe: Recipe, section: str, *, has_goals: bool) -> Recipe:
    """The recipe with the settings of a method of another package, and with goals."""
    if not hasattr(recipe, section):
        recipe = recipe.with_section(section, method_by_name(section).settings())
    return recipe.with_goals() if has_goals else recipe


def _find_settings(recipe: Recipe, name: object, method: str) -> Any:
    """Settings of a method, of a recipe with this name.

    Raises:
        ConfigError: The recipe has none.
    """
    settings = getattr(recipe, find_section(method), None)
    if settings is None:
        raise ConfigError(
            f"recipe {name} has no section {method}: for a model with a vocabulary name another recipe, any "
            "other model is trained by --method rlft, or by calibrate."
        )
    return settings
