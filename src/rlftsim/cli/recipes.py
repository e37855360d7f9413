"""From the words of a command line to the settings of a recipe; imports torch."""

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module

from rlftsim.cli.signatures import Call, list_flags, read_arguments
from rlftsim.recipes.base import SECTIONS
from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.verbs.commands import Command
from rlftsim.verbs.recipe_flags import DEFAULT_RECIPE, RecipeFlags, check_no_settings, find_value


def select_flags(label: str, command: Command, words: Sequence[str], name: str | None = None) -> RecipeFlags:
    """Flags of a command for its recipe, as the verb's own `adapt_flags` wants them.

    Args:
        label: Name of the command, for messages.
        command: Command with sections of a recipe.
        words: Words behind the command.
        name: Name of the recipe; None = guessed from the words.

    Raises:
        ConfigError: An unknown recipe, or settings of another command.
    """
    # settings of another command get a clearer message than "no such flag"
    foreign = [section for section in SECTIONS if section not in command.sections]
    used = " and ".join(f"--{section}.*" for section in command.sections)
    check_no_settings(list_flags(words), foreign, f"here: the settings of {label} are {used}.")
    if command.recipe in command.positional:
        name = name or guess_recipe_name(words)
    else:
        name = str(name or find_value("--recipe", words) or read_arguments(command.function)[command.recipe].default)
    flags = RecipeFlags(name, recipe_by_name(name), command.sections, command.sections, command.sections[-1])
    adapt = getattr(import_module(command.module), "adapt_flags", None)
    return flags if adapt is None else adapt(flags, words)


def finish_call(call: Call, recipe_flags: RecipeFlags, flags: Sequence[str]) -> Call:
    """The call with a recipe that has the values of the command line, in place of the recipe's name.

    Args:
        call: Call as tyro read it.
        recipe_flags: Flags of the recipe.
        flags: Flags that were given.

    Raises:
        ConfigError: A flag has no effect, as the verb's own `check_flags` says.
    """
    recipe = replace(recipe_flags.recipe, **{name: call.values[name] for name in recipe_flags.settings})
    check = getattr(import_module(call.command.module), "check_flags", None)
    if check is not None:
        check(call.values, recipe, flags)
    return replace(call, values={**call.values, call.command.recipe: recipe, "config": None})


def guess_recipe_name(words: Sequence[str]) -> str:
    """Most likely name of the positional recipe. Only tyro knows for certain, once it has parsed the words."""
    # The value of a flag follows the flag, so it is not free. Second values of a flag are taken for free words;
    # they are names of recipes only by accident.
    free, flag_values = [], []
    for preceding_word, word in zip(("", *words), words):
        if not word.startswith("-"):
            (flag_values if preceding_word.startswith("--") and "=" not in preceding_word else free).append(word)
    # Behind a switch, which takes no value, the recipe looks like the value of a flag.
    registered = next((word for word in (*free, *flag_values) if RECIPES.find(word) is not None), None)
    # Nothing registered: the first free word is most likely a mistyped recipe, unless it is a number.
    mistyped = next((word for word in free if word.partition("-")[0].isalpha()), None)
    return registered or mistyped or DEFAULT_RECIPE
