"""Write the site's reference: command line, settings, errors, extension points and Python names, read from the package.

    python docs/write_reference.py    # to build/pages/reference

`docs/build_site.py` does the same, so the pages are not in git.
"""

import ast
import contextlib
import inspect
import io
import json
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path

import rlftsim
from rlftsim import errors
from rlftsim.cli.main import OVERVIEW, VERBS, main
from rlftsim.plugins import is_ours
from rlftsim.recipes.docstrings import read_field_texts, summarize_docstring
from rlftsim.recipes.registry import RECIPES
from rlftsim.recipes.settings import list_sections
from rlftsim.training.run_folder import to_plain
from rlftsim.verbs.plugins import POINTS

ROOT = Path(__file__).resolve().parents[1]
ACTIONS = re.compile(r"\A\s*usage: .* \{([\w,-]+)\}$", re.MULTILINE)
REFERENCE = ROOT / "build" / "pages" / "reference"
PACKAGE = ROOT / "src" / "rlftsim"
CONFIGS = {
    "Evaluate and score": ("rlftsim.evaluation.results:EvaluateConfig", "rlftsim.evaluation.score_files:ScoreConfig"),
    "Sampling": ("rlftsim.rollout.policy:Sampling",),
    "Environments": ("rlftsim.envs.config:EnvConfig",),
}
"""Heading -> settings that belong to no recipe."""
MODULES = ("rlftsim.rollout.policy", "rlftsim.realism", "rlftsim.rewards", "rlftsim.rollout.check", "rlftsim.plugins")
"""Modules that docs/extending.md builds on, documented after the public names."""


def pages() -> dict[str, str]:
    """Text of every page by its path below the reference's folder."""
    found = {"cli/index.md": cli_index(), "fields.md": fields_page(), "errors.md": errors_page()}
    found |= {f"cli/{verb}.md": cli_page(verb) for verb in VERBS}
    return found | {"plugins.md": plugins_page(), "python.md": python_page()}


def cli_index() -> str:
    """The overview that `rlftsim --help` prints, with a link for each verb."""
    described = re.findall(r"^  (\w+) +(.+)$", OVERVIEW, re.M)  # `join VERB` has no page of its own
    rows = [f"| [`{verb}`]({verb}.md) | {text} |" for verb, text in described if verb in VERBS]
    lines = [
        "# Command line",
        "",
        "`rlftsim VERB --help` prints these pages.",
        "",
        "| verb | what it does |",
        "|---|---|",
    ]
    return "\n".join([*lines, *rows, ""])


def help_of(*words: str) -> str:
    """Help text of a verb or an action, in one column: tyro sets boxes side by side from 130 characters on."""
    before, os.environ["COLUMNS"] = os.environ.get("COLUMNS"), "129"
    # A stream that says that it is UTF-8 gets boxes of lines instead of hyphens.
    text = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    if before is None:
        del os.environ["COLUMNS"]
    else:
        os.environ["COLUMNS"] = before
    text.seek(0)
    return re.sub(r"\x1b\[[0-9;]*m", "", text.read())


def cli_page(verb: str) -> str:
    """Usage and flags of a verb and of its actions."""
    text = help_of(verb)
    actions = ACTIONS.search(text) or ("", "exam,true-world" if verb == "experiment" else "")
    parts = [f"# rlftsim {verb}\n", described(text)]
    for action in filter(None, actions[1].split(",")):
        parts += [f"## rlftsim {verb} {action}\n", described(help_of(verb, action))]
    return "\n".join(parts)


def described(text: str) -> str:
    """A help text of tyro as Markdown: usage, description, and a table for each of its boxes."""
    head = text.partition("╭")[0].split("\n\n")
    parts = [f"```text\n{head[0].strip()}\n```\n", *(f"{plain(part)}\n" for part in head[1:] if part.strip())]
    for title, rows in boxes(text):
        if title != "subcommands":
            parts += [f"**{title}**\n", "| flag | meaning |\n|---|---|"]
            parts += [f"| `{flag.replace('|', chr(92) + '|')}` | {plain(meaning)} |" for flag, meaning in rows]
            parts.append("")
    return "\n".join(parts)


def boxes(text: str) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Title of each box of a help text, and its flags with their meanings."""
    for title, inside in re.findall(r"^╭─ (.+?) ─+╮\n(.*?)^╰", text, re.M | re.S):
        rows: list[tuple[str, str]] = []
        for line in (line.strip("│").rstrip() for line in inside.splitlines()):
            if line.startswith("   ") and rows:
                flag, meaning = rows[-1]
                rows[-1] = flag, f"{meaning} {line.strip()}".strip()
            elif line.startswith(" -") or (title == "positional arguments" and line.strip()):
                flag, _, meaning = line.strip().partition("  ")
                rows.append((flag, meaning.strip()))
        if rows:
            yield title, rows


def plain(text: str) -> str:
    """Text on one line in which no character ends a table's cell or begins a tag."""
    parts = " ".join(text.split()).split("`")
    # Between backquotes only the pipe is special.
    parts[::2] = [part.replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_") for part in parts[::2]]
    return "`".join(parts).replace("|", "\\|")


def fields_page() -> str:
    """Every setting of every recipe section, with its value in the recipes, and other configurations."""
    recipes = {name: list_sections(RECIPES.get(name)()) for name in ("smart-tiny", "smart-demo", "trafficbots")}
    lines = [
        "# Settings", "",
        "Every setting of a recipe is a flag, `--finetune.learning-rate 1e-5`, and a key of `config.json`.",
        "`rlftsim recipe NAME` prints a recipe. Empty cells: the recipe has no such setting.", "",
    ]  # fmt: skip
    for section in dict.fromkeys(name for sections in recipes.values() for name in sections):
        owners = [sections.get(section) for sections in recipes.values()]
        summary = summarize_docstring(type(next(o for o in owners if o is not None)))
        lines += [f"## {section}", "", f"{plain(summary)}", ""]
        lines += [f"| setting | {' | '.join(f'`{name}`' for name in recipes)} | meaning |", "|---|---|---|---|---|"]
        columns = [dict(settings_of(owner)) if owner is not None else {} for owner in owners]
        for name in dict.fromkeys(name for column in columns for name in column):
            values = " | ".join(shown(column[name][0]) if name in column else "" for column in columns)
            meaning = next(column[name][1] for column in columns if name in column)
            lines.append(f"| `{section}.{name}` | {values} | {plain(meaning)} |")
        lines.append("")
    for heading, places in CONFIGS.items():
        lines += [f"## {heading}", "", "| setting | default | meaning |", "|---|---|---|"]
        for place in places:
            module, _, name = place.partition(":")
            config = getattr(import_module(module), name)
            rows = settings_of(config())
            lines += [f"| `{name}.{field}` | {shown(value)} | {plain(meaning)} |" for field, (value, meaning) in rows]
        lines.append("")
    return "\n".join(lines)


def settings_of(config: object, prefix: str = "") -> Iterator[tuple[str, tuple[object, str]]]:
    """Dotted name, value and documentation of each field of a dataclass."""
    documentation = read_field_texts(type(config))
    for field in fields(config):
        value, name = getattr(config, field.name), f"{prefix}{field.name}"
        if is_dataclass(value):
            yield from settings_of(value, f"{name}.")
        else:
            yield name, (value, documentation.get(field.name, ""))


def shown(value: object) -> str:
    """A value as JSON in a table's cell."""
    try:
        text = json.dumps(to_plain(value))
    except TypeError:
        text = type(value).__name__
    return f"`{text}`".replace("|", "\\|")


def errors_page() -> str:
    """Every message that the package raises on purpose, by module, with … for the values in it."""
    for path in PACKAGE.rglob("*.py"):
        if re.search(r"^class \w+\(\w*Error\b", path.read_text(), re.M):
            import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
    kinds = [errors.RlftsimError, *subclasses_of(errors.RlftsimError)]
    lines = [
        "# Errors", "",
        "Every message names the value, the cause and the way out. `…` stands for values. On the command line a",
        "message is one line; in Python all are `rlftsim.RlftsimError`.", "", "| class | exit status | raised for |",
        "|---|---|---|",
        *(f"| `{kind.__name__}` | {kind.exit_status} | {plain(summary(kind))} |" for kind in kinds), "",
    ]  # fmt: skip
    names = {kind.__name__ for kind in kinds}
    for path in sorted(PACKAGE.rglob("*.py")):
        messages = list(messages_of(path, names))
        if messages:
            # No headings: the search would find a module before the page that explains it.
            lines += [f"**{path.relative_to(PACKAGE).with_suffix('').as_posix().replace('_', chr(92) + '_')}**", ""]
            lines += [f"- {kind}: {message}" for kind, message in dict.fromkeys(messages)]
            lines.append("")
    return "\n".join(lines)


def subclasses_of(kind: type) -> list[type]:
    """Subclasses of an error in this package, and theirs, those of `errors` first."""
    found = [one for direct in kind.__subclasses__() for one in (direct, *subclasses_of(direct))]
    return sorted(
        (one for one in found if is_ours(one)), key=lambda one: (one.__module__ != errors.__name__, one.__module__)
    )


def messages_of(path: Path, names: set[str]) -> Iterator[tuple[str, str]]:
    """Class and message of each `raise` in a file that writes its message in place, and of each error that does."""
    tree = ast.parse(path.read_text())
    # An error may also write its message itself.
    for kind in (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name in names):
        for call in (node for node in ast.walk(kind) if isinstance(node, ast.Call) and node.args):
            message = text_of(call.args[0])
            if ast.unparse(call.func) == "super().__init__" and message != "…":
                yield kind.name, plain(message.replace("`", "'"))
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args):
            continue
        message = text_of(node.exc.args[0])
        if isinstance(node.exc.func, ast.Name) and node.exc.func.id in names and len(message.strip(" …:.")) > 3:
            yield node.exc.func.id, plain(message.replace("`", "'"))


def text_of(node: ast.expr) -> str:
    """Constant parts of a string, with … between them."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left) + text_of(node.right)
    return "…"


def summary(documented: object) -> str:
    """First paragraph of a docstring."""
    return (inspect.getdoc(documented) or "").partition("\n\n")[0]


def plugins_page() -> str:
    """Entry-point groups with the names that ship."""
    lines = [
        "# Extension points", "",
        "Another package announces objects in these entry-point groups ([extending](../extending.md),",
        "[a package to copy](../plugin_template/README.md)). `rlftsim plugins` lists what is installed, and failures.",
        "",
        "| group | one of them is a | where it is read | names that ship |", "|---|---|---|---|",
    ]  # fmt: skip
    for group, place in POINTS.items():
        module, _, attribute = place.partition(":")
        point = getattr(import_module(module), attribute)
        names = ", ".join(f"`{name}`" for name in point.names())
        lines.append(f"| `{group}` | {point.kind} | `{place}` | {names} |")
    return "\n".join([*lines, ""])


def python_page() -> str:
    """Directives for mkdocstrings: the public names, then the modules for extensions."""
    lines = [
        "# Python", "",
        "`import rlftsim as rs` offers these names, loaded on first use. One scenario, several, a data set or a batch",
        "are taken everywhere, paths may be text, and agents are addressed by object id.", "",
    ]  # fmt: skip
    for name in rlftsim.__all__:
        lines += [f"::: rlftsim.{name}", ""]
    lines += ["## For extensions", ""]
    for module in MODULES:
        lines += [f"::: {module}", ""]
    return "\n".join(lines)


def write_pages(folder: Path = REFERENCE) -> None:
    """Write every page to a folder, which is emptied first."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, text in pages().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


if __name__ == "__main__":
    write_pages()
