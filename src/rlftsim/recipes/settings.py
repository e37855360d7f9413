"""Settings as text: a recipe printed with documentation, and files of settings read back as flags."""

import difflib
import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, get_type_hints

from rlftsim.errors import ConfigError
from rlftsim.jobs.documents import read_json
from rlftsim.recipes.base import SECTIONS, Recipe, list_sections
from rlftsim.recipes.docstrings import read_field_texts, summarize_docstring
from rlftsim.training.run_folder import RUN_INPUTS, flatten, to_plain


def recipe_as_json(recipe: Recipe) -> str:
    """A recipe as JSON, a mapping for each section; `--config FILE` reads the file."""
    return json.dumps({name: to_plain(section) for name, section in list_sections(recipe).items()}, indent=1)


def recipe_as_text(recipe: Recipe) -> str:
    """A recipe with the documentation of every field as a comment above, in the notation of YAML."""
    method = f"# {read_field_texts(Recipe)['method']}\nmethod: {recipe.method}"
    sections = [
        "\n".join([f"# {summarize_docstring(type(section))}", f"{name}:", *_write_lines(section, "  ")])
        for name, section in list_sections(recipe).items()
    ]
    return "\n\n".join([method, *sections])


def _write_lines(section: Any, indent: str) -> Iterator[str]:
    documentation = read_field_texts(type(section))
    for field in fields(section):
        value = getattr(section, field.name)
        # A section without a docstring of its own is described by its class.
        text = documentation.get(field.name) or (summarize_docstring(type(value)) if is_dataclass(value) else "")
        yield from (f"{indent}# {line}" for line in textwrap.wrap(text, 110))
        if is_dataclass(value):
            yield f"{indent}{field.name}:"
            yield from _write_lines(value, f"{indent}  ")
        else:
            yield f"{indent}{field.name}: {json.dumps(to_plain(value))}"


def read_flags(path: Path, recipe: Recipe, sections: Sequence[str], run_section: str) -> list[str]:
    """Settings of a file as flags of the command line, which checks the values.

    Args:
        path: JSON that `rlftsim recipe NAME --json` printed, or the config.json of a run.
        recipe: Recipe with the names and types that settings may have.
        sections: Sections that are used; further sections in the file are skipped.
        run_section: Section that the config.json of a run belongs to.

    Raises:
        ConfigError: A file that cannot be read, or an unknown setting; the message has the nearest known name.
    """
    # 1. sections by name
    values = read_settings(path)
    run_fields = [field.name for field in fields(getattr(recipe, run_section))]
    is_run, is_recipe = set(values) & {*run_fields, *RUN_INPUTS}, set(values) & {*SECTIONS, *list_sections(recipe)}
    # A run's config.json holds one section without its name; a printed recipe holds sections by name. A single
    # known name tells which it is, so that a mistyped one beside it is complained about in the right words.
    if is_run and not is_recipe:
        values = {run_section: {name: value for name, value in values.items() if name not in RUN_INPUTS}}
    for name in is_recipe:
        if not isinstance(values[name], Mapping):
            raise ConfigError(f"{path}: {name} is {json.dumps(values[name])}, not settings by name.")
    # 2. unknown names are refused here, in the words of the file; tyro would name a flag that was never given
    expected_names = {
        f"{name}.{field}" for name, section in list_sections(recipe).items() for field in flatten(to_plain(section))
    }
    values_by_name = flatten(values)
    unexpected_names = sorted(set(values_by_name) - expected_names)
    if unexpected_names:
        inside = [name for name in expected_names if name.startswith(f"{unexpected_names[0]}.")]
        names = sorted(expected_names) if is_run or is_recipe else [*run_fields, *sorted(expected_names)]
        candidates = sorted(inside) or difflib.get_close_matches(unexpected_names[0], names, n=1)
        hint = f"did you mean {candidates[0]}?" if candidates else f"sections are {', '.join(list_sections(recipe))}."
        raise ConfigError(f"{path}: no setting {unexpected_names[0][:100]}: {hint}")
    # 3. values become words; tyro checks their types
    words: list[str] = []
    for name, value in values_by_name.items():
        if name.partition(".")[0] in sections:
            group, _, last = name.rpartition(".")
            owner = attrgetter(group)(recipe)
            words += to_flag_words(name, value, is_switch=get_type_hints(type(owner)).get(last) is bool)
    return words


def to_flag_words(name: str, value: Any, *, is_switch: bool) -> list[str]:
    """A setting as words of the command line.

    Args:
        name: Dotted name, e.g. "finetune.kl.target".
        value: Value in JSON: a number, a text, true, false, null or a list.
        is_switch: True = written `--name` or `--no-name`, without a value.
    """
    group, dot, last = name.replace("_", "-").rpartition(".")
    if is_switch and isinstance(value, bool):
        return [f"--{group}{dot}{'' if value else 'no-'}{last}"]
    values = value if isinstance(value, list | tuple) else [value]
    return [f"--{group}{dot}{last}", *(str(item) for item in values)]


def read_settings(path: Path) -> dict[str, Any]:
    """Values of a file of settings, such as the config.json of a run.

    Raises:
        ConfigError: No such file, or no JSON.
    """
    way_out = "`rlftsim recipe NAME --json` prints one"
    if not path.is_file():
        problem = "a folder, not a file" if path.is_dir() else "no such file"
        raise ConfigError(f"--config {path}: {problem}; {way_out}.")
    return read_json(path, way_out, allow_nan=True, error=ConfigError)
