"""Verbs with settings: each section of a recipe becomes flags, `--finetune.learning-rate 1e-5`."""

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from rlftsim.cli.mistakes import flags_of
from rlftsim.errors import ConfigError
from rlftsim.recipes.base import SECTIONS, Recipe
from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.recipes.settings import flags_of_file, list_sections

DEFAULT_RECIPE = "smart-tiny"
"""Recipe whose values a help text shows where none is named."""
Processes = Annotated[int | Literal["auto"] | None, tyro.conf.arg(metavar="INT|auto")]


class RecipeVerb:
    """Base of verbs that take the sections of a recipe as flags.

    `with_settings` adds a field to the verb for each of its sections, with the values of the recipe as defaults.
    """

    sections: ClassVar[tuple[str, ...]]
    """Sections whose fields have an effect."""
    shown_sections: ClassVar[tuple[str, ...]]
    """Sections that became fields."""
    starting_recipe: ClassVar[Recipe]
    starting_name: ClassVar[str]
    """Name of the recipe that the defaults are from. The parsed field `recipe` may turn out to be another."""
    recipe: str
    processes: Processes = None
    """Processes that train; a flag of the verbs that do."""

    @property
    def settings(self) -> Recipe:
        """The recipe with the values of the command line."""
        sections = {name: getattr(self, name) for name in self.shown_sections}
        recipe = dataclasses.replace(self.starting_recipe, **sections)
        return recipe if self.processes is None else recipe.with_processes(self.processes)

    @classmethod
    def recipe_name_in(cls, words: Sequence[str]) -> str:
        """Name of the recipe as far as it can be seen before the words are parsed."""
        return recipe_name(words)

    @classmethod
    def recipe_for(cls, name: str, words: Sequence[str]) -> Recipe:
        """The recipe of a command line, before its settings change anything.

        Args:
            name: of the recipe.
            words: the words behind the verb.
        """
        return recipe_by_name(name)

    @classmethod
    def sections_for(cls, words: Sequence[str]) -> tuple[str, ...]:
        """Sections whose fields are flags of a command line, of those that the recipe has."""
        return cls.sections

    @classmethod
    def sections_in_file(cls, words: Sequence[str]) -> tuple[str, ...]:
        """Sections that are read from the file of settings, of those that the recipe has."""
        return cls.sections_for(words)

    @classmethod
    def run_section(cls, words: Sequence[str]) -> str:
        """Section that the config.json of a run of this command line holds."""
        return cls.sections[-1]

    def refuse_useless(self, flags: Sequence[str]) -> None:
        """Refuse flags that are settings of the verb but have no effect beside its other flags.

        Raises:
            ConfigError: one of them has none.
        """


def with_settings(
    verb: type[RecipeVerb], words: Sequence[str], name: str | None = None
) -> tuple[type[RecipeVerb], list[str]]:
    """A verb with a field for each section, and the words it is parsed from.

    Args:
        verb: a dataclass.
        words: the words behind the verb. They override the settings of `--config FILE`, which override the recipe.
        name: of the recipe; None = guessed from the words.

    Raises:
        ConfigError: an unknown recipe, or a file of settings that cannot be used.
    """
    # 1. settings of another verb get a clearer message than "no such flag"
    foreign = [section for section in SECTIONS if section not in verb.sections]
    used = " and ".join(f"--{section}.*" for section in verb.sections)
    refuse_settings(flags_of(words), foreign, f"here: the settings of {verb.__name__.lower()} are {used}.")
    # 2. the recipe gives the sections and their defaults
    name = name or verb.recipe_name_in(words)
    recipe = verb.recipe_for(name, words)
    names = verb.sections_for(words)
    shown = {name: section for name, section in list_sections(recipe).items() if name in names}
    fields: list[Any] = [(name, type(section), dataclasses.field(default=section)) for name, section in shown.items()]
    complete = dataclasses.make_dataclass(
        verb.__name__,
        fields,
        bases=(verb,),
        namespace={
            "shown_sections": tuple(shown),
            "starting_recipe": recipe,
            "starting_name": name,
            "__doc__": verb.__doc__,
        },
        frozen=True,
        kw_only=True,
    )
    # 3. settings of a file are flags before the user's own, which therefore win; a flag ends a list of values,
    # which would otherwise go on with the recipe
    file = value_of("--config", words)
    in_file = tuple(name for name in shown if name in verb.sections_in_file(words))
    stored = flags_of_file(Path(file), recipe, in_file, verb.run_section(words)) if file else []
    return complete, [*stored, "--config", file, *words] if file else list(words)


def value_of(flag: str, words: Sequence[str]) -> str | None:
    """Last value of a flag in a command line that has not been parsed; None where it is not given.

    Args:
        flag: e.g. "--config".
        words: the words behind the verb.
    """
    found = None
    for word, after in pairwise([*words, ""]):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == flag and name.startswith("--"):  # tyro takes both spellings
            found = value if equals else after or found
    return found


def recipe_name(words: Sequence[str]) -> str:
    """Most likely name of the positional recipe. Only tyro knows for certain, once it has parsed the words."""
    # The value of a flag follows the flag, so it is not free. Second values of a flag are taken for free words;
    # they are names of recipes only by accident.
    free, others = [], []
    for before, word in zip(("", *words), words):
        if not word.startswith("-"):
            (others if before.startswith("--") and "=" not in before else free).append(word)
    # Behind a switch, which takes no value, the recipe looks like the value of a flag.
    known = next((word for word in (*free, *others) if RECIPES.find(word) is not None), None)
    # Nothing known: the first free word is most likely a mistyped recipe, unless it is a number.
    unknown = next((word for word in free if word.partition("-")[0].isalpha()), None)
    return known or unknown or DEFAULT_RECIPE


def refuse_settings(flags: Sequence[str], sections: Sequence[str], reason: str) -> None:
    """Refuse flags of sections that have no effect.

    Args:
        flags: flags that were given, e.g. "--catk.num-candidates".
        sections: sections without effect.
        reason: end of the message.

    Raises:
        ConfigError: a flag belongs to one of the sections.
    """
    for flag in flags:
        if flag.startswith(tuple(f"--{section}." for section in sections)):
            raise ConfigError(f"{flag} has no effect {reason}")
