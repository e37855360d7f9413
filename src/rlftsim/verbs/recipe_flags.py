"""Settings of a recipe as flags of a command line: `--finetune.learning-rate 1e-5`."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.settings import list_sections, read_flags

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
