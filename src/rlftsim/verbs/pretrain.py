"""`rs.pretrain` and `rlftsim pretrain`: training on logged tracks that leaves the given policy as it is."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from rlftsim.errors import ConfigError
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.rollout.policy import Policy, get_device
from rlftsim.scenario.open import to_scenarios
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.config import PretrainConfig
from rlftsim.verbs.arguments import Data, File, Model, ModelOrRecipe, OnUpdate, Processes, Settings
from rlftsim.verbs.inputs import check_config, to_recipe, with_checked_arguments
from rlftsim.verbs.recipe_flags import RecipeFlags, find_value
from rlftsim.verbs.runs import print_model, repeat_for_seeds
from rlftsim.verbs.training import find_held_out, load_start, train, with_changes, write_card

__all__ = ["adapt_flags", "check_flags", "pretrain", "print_model"]
ClassName = Literal["vehicle", "pedestrian", "cyclist"]


def adapt_flags(flags: RecipeFlags, words: Sequence[str]) -> RecipeFlags:
    """The flags for models like the one that is trained further, if there is one: it has its own sizes.

    Args:
        flags: Flags of the recipe.
        words: Words behind the command.
    """
    start = find_value("--init-from", words)
    if start is None:
        return flags
    return replace(flags, recipe=_to_recipe_like(flags.recipe, load_policy(start)), file_sections=("pretrain",))


def check_flags(values: Mapping[str, Any], recipe: Recipe, flags: Sequence[str]) -> None:
    """Check what a model that is trained further brings along, and that a fresh one gets its vocabulary.

    Args:
        values: Values of the command line by argument.
        recipe: Recipe with the values of its flags.
        flags: Flags that were given.

    Raises:
        ConfigError: Tokens are to be kept where there are none or no others, a flag would change what the weights are
            made for, or a vocabulary is missing or of no use.
    """
    start, vocabulary = values["init_from"], values["vocabulary"]
    if values["keep_tokens"] and (start is None or vocabulary is None):
        raise ConfigError("--keep-tokens has no effect without both --init-from and --vocabulary: leave it out.")
    for flag in flags if start is not None else ():
        if flag.startswith("--model.") and flag.removeprefix("--model.").replace("-", "_") not in recipe.free_fields:
            names = ", ".join("--model." + field.replace("_", "-") for field in recipe.free_fields)
            raise ConfigError(
                f"{flag} cannot be changed with --init-from {start}, whose weights are made for it; these can: "
                f"{names or 'none'}."
            )
    if vocabulary is None and recipe.tokens is not None and start is None:
        raise ConfigError(
            f"recipe {values['policy']} needs a vocabulary: build one with `rlftsim tokens`, then name it with "
            "--vocabulary, or train a model further with --init-from."
        )
    if vocabulary is not None and recipe.tokens is None:
        raise ConfigError(f"recipe {values['policy']} makes a model without a vocabulary: leave --vocabulary out.")


@with_checked_arguments
def pretrain(
    policy: ModelOrRecipe,
    scenarios: Data,
    out: File | None = None,
    config: Settings | None = None,
    *,
    held_out: Data | None = None,
    vocabulary: File | None = None,
    keep_tokens: tuple[ClassName, ...] = (),
    init_from: Model | None = None,
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
    """Train a model on logged tracks (SMART: to predict the next motion token of every agent), from fresh weights or
    further (--init-from).

    Writes checkpoints, metrics and the finished model, OUT/model. An interrupted run continues when the same
    command is repeated.

    Args:
        policy: Model and training settings; `rlftsim recipe` lists all recipes. The flags below change single fields.
            In Python also a recipe itself; or a policy, or a name for `load_policy`, whose weights are trained further.
        scenarios: Folder of a data set, or "synthetic" for the scenarios that ship with the package. In Python also
            scenarios with their logged futures.
        out: Folder of the run: configuration, metrics, checkpoints, model. A finished run is not repeated. In Python
            left out, no file is kept.
        config: JSON file of settings: the output of `rlftsim recipe NAME --json`, or the config.json of an earlier run.
            The latter holds only the section pretrain: sizes of the model are those of RECIPE and the flags --model.*.
            A run repeated from its own config.json, with the same recipe, flags of the model, vocabulary and data,
            gives the same weights bit for bit. Flags override the file. In Python `PretrainConfig`, in place of the
            recipe's.
        held_out: Scenarios for validation, see `config.validation`; a data set's name stands for its split validation.
        vocabulary: File that `rlftsim tokens` wrote; needed by models with a vocabulary, such as SMART. With
            --init-from its motion tokens take the places of the most similar ones of the model, which keeps its map
            pieces. In Python left out, one is built from the scenarios.
        keep_tokens: Classes whose tokens stay those of --init-from, with --vocabulary.
        init_from: Model to train further, such as one of synthetic scenarios on logs: a run, a model folder or a
            registered name. It brings its vocabulary (but see --vocabulary) and the settings --model.*; flags change
            those that its weights do not depend on, such as the number of neighbors. Left out: fresh weights.
        processes: Processes that train, in short for --pretrain.device.processes.
        limit: Number of training scenarios, from the first on; left out, all.
        max_updates: Updates after which the run ends early, with a model. A larger number later continues to the
            weights of a run that never stopped: the learning rate falls as over all epochs, and is still high at an
            early end.
        seed: Seed of the run, in short for --pretrain.seed.
        seeds: Number of runs that differ in the seed alone, from 0 on: OUT/seed-0, OUT/seed-1 and so on. A table at the
            end has the mean and the 95 % interval. In Python the policy of the first run is returned.
        on_update: Function that is called behind each update with the number of updates done and the metrics by name,
            `f(update, values)`. An error in the function ends the run, which goes on from the last checkpoint.
        split: Split of the data set to train on.
        validation_split: Split to validate on in closed loop, see --pretrain.validation.every. Left out: "tune", the
            part of "validation" that is not of the exam.
        tracker: Programs that show the run while it trains, with commas between: tensorboard, wandb, mlflow, trackio,
            those of other packages, or module:Class. metrics.jsonl is always written. Empty: none.

    Returns:
        The pre-trained policy, ready to simulate; a policy that was handed over stays as it is.

    Raises:
        ConfigError: The policy cannot be pre-trained, no scenario, or no such recipe.
        DataError: No such data set, or it has no such split.
        CheckpointError: The folder holds another run, or the run diverged.
        NotYetError: Another run is at work in the folder.
    """
    if seeds is not None:  # first, while the locals are the arguments
        return repeat_for_seeds(pretrain, locals(), seeds)
    check_config(config, "pretrain", PretrainConfig)
    training = to_scenarios(scenarios, split, limit)
    recipe, start = None, policy
    if isinstance(policy, Recipe) or (isinstance(policy, str) and policy in RECIPES.names()):
        recipe, start = policy, init_from
    elif init_from is not None or vocabulary is not None:
        raise ConfigError("init_from and vocabulary go with a recipe as the policy: name one, such as 'smart-demo'.")
    settings: Any = config or (PretrainConfig() if recipe is None else to_recipe(recipe).pretrain)
    settings = with_changes(settings, processes, seed)
    tokens = None if vocabulary is None else Vocabulary.load(Path(vocabulary))
    if held_out is None:
        held_out = find_held_out(scenarios, training, validation_split, settings.validation.every)
    held_out = None if held_out is None else to_scenarios(held_out)
    if start is None:
        assert recipe is not None
        fresh = to_recipe(recipe)  # weights are drawn with the recipe's seed
        learner: Any = (fresh if seed is None else replace(fresh, pretrain=settings)).new_policy_for(training, tokens)
        device = get_device(learner)
    else:
        learner, device = load_start(start)
        if recipe is not None:
            replaced: Any = () if tokens is None else (tokens, keep_tokens)  # recipes of others may know no tokens
            like = recipe if isinstance(recipe, Recipe) else _to_recipe_like(recipe_by_name(recipe), learner)
            learner = like.train_further(learner, *replaced)
    card = write_card("pre-trained" if start is None else "pre-trained further", training, start)
    limits: Any = {"max_updates": max_updates, "on_update": on_update, "tracker": tracker}
    return train(learner, training, out, settings, device=device, held_out=held_out, card=card, **limits)


def _to_recipe_like(recipe: Recipe, policy: Policy) -> Recipe:
    """Recipe for policies of the sizes of an existing one."""
    # A recipe of another package may know no models but its own: those are trained further as they are.
    has_one_size = recipe.policy_type is None and type(recipe).like is Recipe.like
    return recipe if has_one_size else recipe.like(policy)
