"""The verb that prints recipes: recipe."""

import inspect
from dataclasses import dataclass
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.recipes.settings import recipe_as_json, recipe_as_text


@dataclass(frozen=True)
class PrintRecipe:
    """Print every setting of a recipe with its documentation; without a name, list the recipes.

    Example: `rlftsim recipe smart-nano --json > mine.json`, then `rlftsim finetune smart-nano --config mine.json ...`
    """

    name: Annotated[Positional[str | None], tyro.conf.arg(metavar="NAME")] = None
    """Recipe to print."""
    json: bool = False
    """Print JSON without documentation, which --config of pretrain, finetune and tokens reads back."""

    def run(self) -> int:
        """Print one recipe, or the list."""
        if self.name is not None:
            recipe = recipe_by_name(self.name)
            print(recipe_as_json(recipe) if self.json else recipe_as_text(recipe))
            return 0
        names = RECIPES.names()
        for name in names:
            # A docstring that wraps is joined: one line for each recipe.
            summary = " ".join((inspect.getdoc(RECIPES.get(name)) or "").partition("\n\n")[0].split())
            print(f"{name:{max(map(len, names))}}  {summary}")
        return 0
