"""Recipes by name, of this and all installed packages."""

from collections.abc import Callable

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint
from rlftsim.recipes.base import Recipe

RECIPES: ExtensionPoint[Callable[[], Recipe]] = ExtensionPoint(
    "recipe",
    "rlftsim.recipes",
    {
        "smart-tiny": "rlftsim.recipes.smart:smart_tiny_rlftsim",
        "smart-mini": "rlftsim.recipes.smart:smart_mini_rlftsim",
        "smart-nano": "rlftsim.recipes.smart:smart_nano_rlftsim",
        "smart-demo": "rlftsim.recipes.smart:smart_demo_rlftsim",
        "smart-demo-long": "rlftsim.recipes.smart:smart_demo_long",
        "synthetic": "rlftsim.recipes.smart:smart_synthetic",
        "trafficbots": "rlftsim.recipes.trafficbots:trafficbots_v15_rlftsim",
        "trafficbots-demo": "rlftsim.recipes.trafficbots:trafficbots_demo_rlftsim",
    },
    use=lambda name: recipe_by_name(name),
)


def recipe_by_name(name: str) -> Recipe:
    """The recipe of a name, from this or any installed package.

    Raises:
        ConfigError: An unknown name, with the nearest known names, or not a recipe.
    """
    # Registered functions come from other packages, so their result is checked.
    recipe = RECIPES.get(name)()
    if not isinstance(recipe, Recipe):
        raise ConfigError(
            f"recipe {name!r} is of type {type(recipe).__name__}: make it extend rlftsim.recipes.base.Recipe."
        )
    return recipe
