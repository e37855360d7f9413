"""From the words of a command line to a verb with its settings."""

import importlib
import io
import os
import re
import shlex
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NoReturn

import tyro

from rlftsim.cli.mistakes import FLAG, explain, explain_action, flags_of
from rlftsim.cli.stand_ins import stand_ins
from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import log
from rlftsim.verbs.commands import ACTIONS, COMMANDS, Command, dataclass_parser, describe

OLD_COMMANDS = {
    "tokens": "rlftsim.cli.tokens:Tokens",
    "pretrain": "rlftsim.cli.train:Pretrain",
    "finetune": "rlftsim.cli.train:Finetune",
    "experiment": "rlftsim.cli.experiment:RunExperiment",
}
"""Module and class of each verb that is no function yet."""
HELP = ("-h", "--help")
COUNTS = (
    "jobs", "processes", "num_rollouts", "num_scenarios", "limit", "seeds", "top_k", "nodes", "cores", "measure"
)  # fmt: skip
"""Arguments of verbs that are 1 or more."""
EITHER_OR = {"--goal-logit-bias": "True", "--no-goal-logit-bias": "False"}
"""Switches that may also be left out, which is a third value. tyro has no such kind: it is handed the value."""
ADDRESS = re.compile(r"\w{2,}:/")
"""Beginning of an address such as s3://bucket, of which a path keeps one slash."""


def parse(words: Sequence[str]) -> Any:
    """The verb of a command line with its settings; has a method `run`.

    Args:
        words: Verb, its action if it has some, and what follows.

    Raises:
        ConfigError: The words make no sense; says which word and what it may have meant.
        SystemExit: They ask for help, which has been printed.
    """
    # switches that may be left out get the value that tyro expects
    words = [
        part for word in words for part in (["--goal-logit-bias", EITHER_OR[word]] if word in EITHER_OR else [word])
    ]
    # help leaves here by SystemExit
    if any(word in HELP for word in words):
        try:
            with stand_ins():
                _parse_verb(words)
        # A package that computes with torch, when it is imported or in a recipe, fails with stand-ins in ways of
        # its own. Then help waits for the real libraries, and so does the message of a real mistake.
        except Exception as error:
            log.debug(f"help without torch failed: {error!r}")
    return _parse_verb(words)


def _parse_verb(words: Sequence[str]) -> Any:
    """The verb, or its help, or one line of complaint."""
    names = {**COMMANDS, **OLD_COMMANDS}
    name = next((name for name in (" ".join(words[:2]), words[0]) if name in names), None)
    if name is None:
        _explain_actions(words[0], words[1:])
    rest = list(words[len(name.split()) :])
    if name in COMMANDS:
        return _parsed(name, rest, COMMANDS[name])
    module, _, attribute = OLD_COMMANDS[name].partition(":")
    return _parsed(name, rest, getattr(importlib.import_module(module), attribute))


def _explain_actions(verb: str, words: Sequence[str]) -> NoReturn:
    """Print the actions of a verb, or say that one is missing or unknown."""
    actions = [name.partition(" ")[2] for name in COMMANDS if name.startswith(f"{verb} ")]
    if not any(word in HELP for word in words):
        raise ConfigError(explain_action(words, actions))
    print(f"usage: rlftsim {verb} [-h] {{{','.join(actions)}}}\n\n{ACTIONS[verb]}\n")
    for action in actions:
        summary, _, _ = describe(COMMANDS[f"{verb} {action}"].function).partition("\n")
        width = shutil.get_terminal_size().columns
        print(textwrap.fill(summary, width, initial_indent=f"  {action:9}", subsequent_indent=" " * 11))
    raise SystemExit(0)


def _parsed(name: str, words: list[str], command: Any, recipe: str | None = None) -> Any:
    """The verb, or its help, or one line of complaint. Defaults are those of a recipe; None = guessed."""
    verb, stored = command, words
    has_settings = hasattr(verb, "sections")
    if has_settings:
        # imported late: most verbs need no recipes
        from rlftsim.cli.recipe_verb import with_settings

        verb, stored = with_settings(verb, words, recipe)

    parser = command.parser() if isinstance(command, Command) else dataclass_parser(verb)

    def cli(arguments: list[str]) -> Any:
        return tyro.cli(parser, args=arguments, prog=f"rlftsim {name}", config=(tyro.conf.OmitSubcommandPrefixes,))

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
        return _parsed(name, words, command, parsed.recipe)
    # Warnings on the way, such as that of a reward that is registered twice, are shown after all.
    if complaint.getvalue():
        log.warning(complaint.getvalue().rstrip())
    _check_values(parsed, [*name.split(), *words])
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


def _check_values(verb: Any, words: Sequence[str]) -> None:
    """Check that what is counted is positive, that lists have values, and that paths are no addresses of buckets.

    Args:
        verb: Verb as parsed, or settings whose flags stand among those of the verb.
        words: The whole command.

    Raises:
        ConfigError: A value that makes no sense; names the flag, or the commands that do it.
    """
    values = getattr(verb, "values", None) or {field.name: getattr(verb, field.name) for field in fields(verb)}
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        if name in COUNTS and isinstance(value, int) and value < 1:
            raise ConfigError(f"{flag} must be at least 1, got {value}.")
        if value in ([], ()) and flag in words:
            raise ConfigError(f"{flag} needs at least one value.")
        if isinstance(value, Path) and ADDRESS.match(str(value)):
            _explain_address(value, words)
        if name in ("config", "action", "work", "sampling") and is_dataclass(value):
            _check_values(value, words)


def _explain_address(path: Path, words: Sequence[str]) -> None:
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
