"""Settings of a recipe as flags of a command line: `--finetune.learning-rate 1e-5`."""

import dataclasses
import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.recipes.base import SECTIONS, Recipe
from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.recipes.settings import list_sections, read_flags
from rlftsim.verbs.commands import Call, Command, list_flags, read_arguments

DEFAULT_RECIPE = "smart-tiny"
"""Recipe whose values a help text shows where none is named."""


@dataclass(frozen=True)
class RecipeFlags:
    """Flags of a command line for the fields of a recipe's sections, with the recipe's values as defaults."""

    name: str
    """Name of the recipe. The words may turn out to name another one once they are parsed."""
    recipe: Recipe
    sections: Sequence[str]
    """Sections whose fields are flags, of those that the recipe has."""
    file_sections: Sequence[str]
    """Sections that are read from a file of settings, likewise."""
    run_section: str
    """Section that the config.json of a run of this command line holds."""

    @property
    def settings(self) -> dict[str, Any]:
        """Settings with flags, by section."""
        return {name: section for name, section in list_sections(self.recipe).items() if name in self.sections}

    def read_file(self, words: Sequence[str]) -> list[str]:
        """The words of a command line behind the settings of its `--config FILE`, which therefore give way.

        Raises:
            ConfigError: The file cannot be used.
        """
        file = find_value("--config", words)
        if not file:
            return list(words)
        sections = tuple(name for name in self.settings if name in self.file_sections)
        # a flag ends a list of values, which would otherwise go on with the recipe
        return [*read_flags(Path(file), self.recipe, sections, self.run_section), "--config", file, *words]

    def finish(self, call: Call, flags: Sequence[str]) -> Call:
        """The call with a recipe that has the values of the command line, in place of the recipe's name.

        Args:
            call: Call as tyro read it.
            flags: Flags that were given.

        Raises:
            ConfigError: A flag has no effect, as the verb's own `check_flags` says.
        """
        recipe = dataclasses.replace(self.recipe, **{name: call.values[name] for name in self.settings})
        check = getattr(importlib.import_module(call.command.module), "check_flags", None)
        if check is not None:
            check(call.values, recipe, flags)
        return dataclasses.replace(call, values={**call.values, call.command.recipe: recipe, "config": None})


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
    adapt = getattr(importlib.import_module(command.module), "adapt_flags", None)
    return flags if adapt is None else adapt(flags, words)


def find_value(flag: str, words: Sequence[str]) -> str | None:
    """Last value of a flag in a command line that has not been parsed; None where it is not given.

    Args:
        flag: Flag with its hyphens, such as "--config".
        words: Words behind the command.
    """
    value = None
    for word, following in pairwise([*words, ""]):
        name, equals, attached = word.partition("=")
        if name.replace("_", "-") == flag and name.startswith("--"):  # tyro takes both spellings
            value = attached if equals else following or value
    return value


def guess_recipe_name(words: Sequence[str]) -> str:
    """Most likely name of the positional recipe. Only tyro knows for certain, once it has parsed the words."""
    # The value of a flag follows the flag, so it is not free. Second values of a flag are taken for free words;
    # they are names of recipes only by accident.
    free, others = [], []
    for before, word in zip(("", *words), words):
        if not word.startswith("-"):
            (others if before.startswith("--") and "=" not in before else free).append(word)
    # Behind a switch, which takes no value, the recipe looks like the value of a flag.
    registered = next((word for word in (*free, *others) if RECIPES.find(word) is not None), None)
    # Nothing registered: the first free word is most likely a mistyped recipe, unless it is a number.
    mistyped = next((word for word in free if word.partition("-")[0].isalpha()), None)
    return registered or mistyped or DEFAULT_RECIPE


def check_no_settings(flags: Sequence[str], sections: Sequence[str], reason: str) -> None:
    """Check that no flag belongs to a section without effect.

    Args:
        flags: Flags that were given, such as "--catk.num-candidates".
        sections: Sections without effect.
        reason: End of the message.

    Raises:
        ConfigError: A flag belongs to one of the sections.
    """
    for flag in flags:
        if flag.startswith(tuple(f"--{section}." for section in sections)):
            raise ConfigError(f"{flag} has no effect {reason}")
