"""From the words of a command line to a verb with its settings."""

import importlib
import io
import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from rlftsim.cli.mistakes import FLAG, explain, flags_of
from rlftsim.cli.stand_ins import stand_ins
from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import log

HELP = ("-h", "--help")
COUNTS = (
    "jobs", "processes", "num_rollouts", "num_scenarios", "limit", "seeds", "top_k", "nodes", "cores", "measure"
)  # fmt: skip
"""Fields of verbs that are 1 or more."""
EITHER_OR = {"--goal-logit-bias": "True", "--no-goal-logit-bias": "False"}
"""Switches that may also be left out, which is a third value. tyro has no such kind: it is handed the value."""
ADDRESS = re.compile(r"\w{2,}:/")
"""Beginning of an address such as s3://bucket, of which a path keeps one slash."""


def parse(words: Sequence[str], verbs: Mapping[str, tuple[str, str]]) -> Any:
    """The verb of a command line with its settings; has a method `run`.

    Args:
        words: the verb and what follows it.
        verbs: name -> module and class.

    Raises:
        ConfigError: the words make no sense; says which word and what it may have meant.
        SystemExit: they ask for help, which has been printed.
    """
    name, *rest = words
    # switches that may be left out get the value that tyro expects
    rest = [part for word in rest for part in (["--goal-logit-bias", EITHER_OR[word]] if word in EITHER_OR else [word])]
    # help leaves here by SystemExit
    if any(word in HELP for word in rest):
        try:
            with stand_ins():
                _parsed(name, rest, verbs)
        # A package that computes with torch, when it is imported or in a recipe, fails with stand-ins in ways of
        # its own. Then help waits for the real libraries, and so does the message of a real mistake.
        except Exception as error:
            log.debug(f"help without torch failed: {error!r}")
    return _parsed(name, rest, verbs)


def _parsed(name: str, words: list[str], verbs: Mapping[str, tuple[str, str]], recipe: str | None = None) -> Any:
    """The verb, or its help, or one line of complaint. Defaults are those of a recipe; None = guessed."""
    # Imported late: the overview of verbs does not need tyro, and most verbs do not need recipes.
    import tyro

    module, attribute = verbs[name]
    verb, stored = getattr(importlib.import_module(module), attribute), words
    has_settings = hasattr(verb, "sections")
    if has_settings:
        from rlftsim.cli.recipe_verb import with_settings

        verb, stored = with_settings(verb, words, recipe)

    def cli(these: list[str]) -> Any:
        return tyro.cli(verb, args=these, prog=f"rlftsim {name}", config=(tyro.conf.OmitSubcommandPrefixes,))

    if any(word in HELP for word in words):
        return cli(stored)
    # tyro prints a box of lines and exits; the box is caught and made one line.
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint), _wide():
            parsed = cli(stored)
    except SystemExit:
        # The first word may be an action ("data verify"), which has flags of its own.
        chosen = [word for word in words[:1] if not word.startswith("-")]
        message = explain(words, complaint.getvalue(), _help_text(cli, chosen))
        # A setting of a file is a flag that the user never typed: the file is to blame.
        blamed = FLAG.match(message)
        if blamed and blamed[0] in set(flags_of(stored)) - set(flags_of(words)):
            message = f"{stored[stored.index('--config') + 1]}: {message.removeprefix('--')}"
        raise ConfigError(message) from None
    # A word behind a switch may have been mistaken for its value; tyro knows which word is the recipe.
    if has_settings and parsed.recipe != verb.starting_name:
        return _parsed(name, words, verbs, parsed.recipe)
    # Warnings on the way, such as that of a reward that is registered twice, are shown after all.
    if complaint.getvalue():
        log.warning(complaint.getvalue().rstrip())
    _refuse_values(parsed, [name, *words])
    if hasattr(parsed, "refuse_useless"):
        parsed.refuse_useless(flags_of(words))
    return parsed


def _help_text(cli: Any, chosen: list[str]) -> str:
    """Help of an action, or of the verb where the action does not exist."""
    text = io.StringIO()
    for words in ([*chosen, "--help"], ["--help"]):
        try:
            with redirect_stdout(text), redirect_stderr(io.StringIO()), _wide():
                cli(words)
        except SystemExit as stop:
            if not stop.code:
                break
    return text.getvalue()


@contextmanager
def _wide() -> Iterator[None]:
    """Let tyro write lines as long as they are: each message stands on one line of its box."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _refuse_values(verb: Any, words: Sequence[str]) -> None:
    """Refuse zero and less where something is counted, no value where some are listed, and addresses of buckets in
    place of paths.

    Args:
        verb: as parsed, or a part of it.
        words: the whole command.

    Raises:
        ConfigError: names the flag, or the commands that do it.
    """
    for field in fields(verb):
        value, flag = getattr(verb, field.name), f"--{field.name.replace('_', '-')}"
        if field.name in COUNTS and isinstance(value, int) and value < 1:
            raise ConfigError(f"{flag} must be at least 1, got {value}.")
        if value == [] and flag in words:
            raise ConfigError(f"{flag} needs at least one value.")
        if isinstance(value, Path) and ADDRESS.match(str(value)):
            _refuse_address(value, words)
        # Fields of these two are shown without a prefix, so they belong to the verb.
        if field.name in ("config", "action") and is_dataclass(value):
            _refuse_values(value, words)


def _refuse_address(path: Path, words: Sequence[str]) -> None:
    """Refuse an address of a bucket in place of a path, with the commands that bring the result there.

    Args:
        path: made of the address.
        words: the whole command.

    Raises:
        ConfigError: always.
    """
    address = next((word for word in words if "://" in word and Path(word) == path), str(path))
    if words[0] not in ("convert", "synthesize"):
        raise ConfigError(
            f"{address} is an address: name a folder or a file of this machine here, and copy it by the bucket's own "
            "tools (docs/machines.md)."
        )
    command = shlex.join("FOLDER" if word == address else word for word in words)
    raise ConfigError(
        f"{address} is an address, and a data set is made in a folder: `rlftsim {command}`, then "
        f"`rlftsim data push FOLDER {address}`."
    )
