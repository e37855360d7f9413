"""`rs.recipe` and `rlftsim recipe`: settings of every stage by name."""

import inspect
from typing import Any

from rlftsim.jobs.progress import print_line, print_lines
from rlftsim.recipes.registry import RECIPES
from rlftsim.recipes.settings import recipe_as_json, recipe_as_text
from rlftsim.verbs.arguments import Name
from rlftsim.verbs.inputs import to_recipe, with_checked_arguments


@with_checked_arguments
def recipe(name: Name = "") -> Any:
    """Print every setting of a recipe with its documentation; without a name, list the recipes.

    Example: `rlftsim recipe smart-nano --json > mine.json`, then `rlftsim finetune smart-nano --config mine.json ...`

    Args:
        name: Recipe: "smart-tiny" (the paper), "smart-mini", "smart-nano", "smart-demo" (minutes on two CPU cores), or
            one of another package.

    Returns:
        A frozen dataclass with the sections tokens, model, pretrain, finetune, catk, gcsl and calibrate;
        `dataclasses.replace` makes one with other values. Without a name the summaries of all recipes by name.

    Raises:
        ConfigError: No such recipe.
    """
    if name == "":
        return {name: _summarize(RECIPES.get(name)) for name in RECIPES.names()}
    return to_recipe(name)


def _summarize(make: Any) -> str:
    """First paragraph of a docstring on one line."""
    return " ".join((inspect.getdoc(make) or "").partition("\n\n")[0].split())


def print_recipe(recipe: Any, *, json: bool = False) -> None:
    """Print the settings of a recipe, or the names of all.

    Args:
        recipe: Recipe, or summaries by name.
        json: Print JSON without documentation, which --config of pretrain, finetune and tokens reads back.
    """
    if isinstance(recipe, dict):
        for name, summary in recipe.items():
            print_line(f"{name:{max(map(len, recipe))}}  {summary}")
    else:
        print_lines(recipe_as_json(recipe) if json else recipe_as_text(recipe))
