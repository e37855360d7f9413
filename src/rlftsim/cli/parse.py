"""From the words of a command line to a verb with settings; words that make no sense are explained in a line."""

import difflib
import io
import os
import re
import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import is_dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NoReturn

import tyro

from rlftsim.cli.signatures import FLAG, Call, describe, list_flags, make_parser
from rlftsim.cli.stand_ins import stand_ins
from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import log
from rlftsim.verbs.commands import COMMANDS, VERBS

RULE = re.compile(r"^(╭|╰|─{4}|-{4})")


def explain_action(words: Sequence[str], actions: Sequence[str]) -> str:
    """One line that says which action is missing or unknown.

    Args:
        words: Words behind the verb.
        actions: Actions of the verb.
    """
    if not words or words[0].startswith("-"):
        return f"missing: one of {','.join(actions)}."
    matches = difflib.get_close_matches(words[0], actions, 1)
    hint = f"did you mean {matches[0]}?" if matches else f"known are {', '.join(actions)}."
    return f"no action {words[0]}: {hint}"


ANSWERS = {
    "--resume": "what can be continued continues with the same command.",
    "--train-split": "all trainings learn from the split training of --data.",
}
"""Flags of other programs -> what is done here instead."""
SYNONYMS = {"gpus": "processes", "devices": "processes"}
"""Flags of other programs -> flags of the same meaning."""


def explain(words: Sequence[str], complaint: str, flags: Sequence[str], usage: str, section: str) -> str:
    """Line about a mistake in a command line.

    Args:
        words: Words behind the verb.
        complaint: Output of tyro, a box of lines.
        flags: Flags of the verb.
        usage: Command with all words without a flag, such as "evaluate MODEL".
        section: Section whose settings count, such as that of the method in force; empty without sections.
    """
    for flag in list_flags(words):
        if flag not in flags:
            if flag[2:].upper() in usage.split():
                return f"no flag {flag}: write the value without a flag, as in `rlftsim {usage}`."
            suggestion = nearest(flag, flags, section)
            advice = f"did you mean {suggestion}?" if suggestion else "`--help` lists them all."
            return f"no flag {flag}: {ANSWERS.get(flag, advice)}"
    # `--switch yes`: tyro complains about the value alone
    left_over = re.search(r"Unrecognized options: (\S+)", complaint)
    for flag, word in pairwise(words):
        group, dot, last = flag.replace("_", "-").removeprefix("--").rpartition(".")
        off = f"--{group}{dot}no-{last}"
        if left_over and word == left_over[1] and flag.startswith("--") and off in flags:
            return f"{flag} is a switch, it takes no value: write {flag} or {off}."
    return _one_line(complaint)


def nearest(flag: str, flags: Sequence[str], section: str = "") -> str | None:
    """The flag nearest to a mistyped flag, or all of the same name in several sections; None = all are far.

    Args:
        flag: Mistyped flag, such as "--finetune.lr", "--learning-rate" or "--finetune.learnig-rate".
        flags: Flags that exist.
        section: Section whose flag is meant where several have it, such as that of the method in force.
    """
    group, _, last = flag.removeprefix("--").rpartition(".")
    last = SYNONYMS.get(last, last)
    by_last: dict[str, list[str]] = {}
    for name in flags:
        prefix, _, part = name.removeprefix("--").rpartition(".")
        if prefix.startswith(group):
            by_last.setdefault(part, []).append(name)
    # 1. the right name without its group, 2. initials, 3. a typing mistake in the last part, 4. a group, 5. any
    by_initials = {"".join(word[:1] for word in part.split("-")): part for part in reversed(by_last)}
    close = difflib.get_close_matches(last, by_last, n=1, cutoff=0.75)
    part = last if last in by_last else by_initials.get(last) or next(iter(close), None)
    if part:
        siblings = by_last[part]
        preferred = [name for name in (f"--{part}", f"--{section}.{part}") if name in siblings]
        return " or ".join(preferred[:1] or siblings)
    members = [name for name in flags if name.startswith(f"--{group}") and f".{last}." in name]
    if members:
        return next((name for name in members if name.startswith(f"--{section}.")), members[0])
    if group and by_last:  # the group is right: a flag of another one would be a wild guess
        return None
    # without the hyphens, which all have in common: "--limit" is not "--split"
    names = [name.removeprefix("--") for name in flags]
    return next((f"--{name}" for name in difflib.get_close_matches(flag.removeprefix("--"), names, 1, 0.65)), None)


def _one_line(complaint: str) -> str:
    """The message inside tyro's box, without the frame, the advice and the help texts around it."""
    lines = [line.strip("│| ") for line in complaint.splitlines()]
    # The first lines are the top of the frame and the title. A terminal without Unicode gets rules of hyphens.
    title = next((i for i, line in enumerate(lines) if RULE.search(line)), 0)
    inside = lines[title + 1 :]
    # The message ends at the next rule or empty line; behind it stand help texts.
    end = next((i for i, line in enumerate(inside) if not line or RULE.search(line)), len(inside))
    message = " ".join(inside[:end]) or complaint.strip()
    if message.startswith("Missing from"):
        # Several flags may be missing. Help texts, of one line or more, stand deeper than the names.
        rows = [line.strip("│|").rstrip() for line in complaint.splitlines()[title + 2 :][: end - 1]]
        depth = min(len(row) - len(row.lstrip()) for row in rows)
        return f"missing: {', '.join(row.split()[0] for row in rows if not row[depth].isspace())}."
    message = message.removeprefix("Error parsing ")
    for pattern, words in _REWORDED:
        message = re.sub(pattern, words, message)
    return message


def _choices(match: re.Match[str]) -> str:
    """The choices of a flag without None, which is no word to type; tyro has no order of its own for these."""
    names = match[3].split(", ")
    if "'None'" in names:
        names = sorted({*names} - {"'None'"})
    return f"{match[2]} {match[1]}: expected one of {', '.join(names)}."


_REWORDED = (
    (r"^Unrecognized options: (.*)$", r"not understood: \1 (one word too many, or a pattern without quotes)."),
    (r"^invalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*?),?\)\.$", _choices),
    (r"^Missing value for argument '(.*)'\. Expected 1 values\.$", r"\1 needs a value."),
    (r"^Missing value for argument '(.*)'\. Expected (\d+) values\.$", r"\1 needs \2 values."),
    (r"^(.*): no type matching (.*) could be instantiated from \['?(.*?)'?\]\.$", r"\1 \3: expected \2."),
    (r"^(.*): could not convert string to float: '(.*)'$", r"\1 \2: expected a number."),
    (r"^(.*): invalid literal for int\(\) with base 10: '(.*)'$", r"\1 \2: expected a whole number."),
    (r"^Expected one of \{(.*)\}\.$", r"missing: one of \1."),
)
"""Messages of tyro and Python, and ours."""


HELP = ("-h", "--help")
COUNTS = (
    *("jobs", "processes", "num_rollouts", "num_scenarios", "limit", "max_updates", "seeds", "top_k", "nodes", "cores"),
    "measure",
)
"""Arguments of verbs that are 1 or more."""
EITHER_OR = {"--goal-logit-bias": "True", "--no-goal-logit-bias": "False"}
"""Switches that may also be left out, which is a third value. tyro has no such kind: it is handed the value."""
ADDRESS = re.compile(r"\w{2,}:/")
"""Beginning of an address such as s3://bucket, of which a path keeps one slash."""


def parse(words: Sequence[str]) -> Call:
    """The call of a verb that a command line stands for.

    Args:
        words: Verb, action if any, and all further words.

    Raises:
        ConfigError: The words make no sense; says which word, and a likely meaning.
        SystemExit: Help was asked for, and has been printed.
    """
    # switches that may be left out get the value that tyro expects
    words = list(chain.from_iterable(["--goal-logit-bias", EITHER_OR[w]] if w in EITHER_OR else [w] for w in words))
    name = find_command(words)
    if name is None:
        _explain_actions(words[0], words[1:])
    arguments = words[len(name.split()) :]
    # help leaves here by SystemExit
    if any(word in HELP for word in words):
        try:
            with stand_ins():
                _parse_call(name, arguments)
        # A package that computes with torch, when it is imported or in a recipe, fails with stand-ins in ways of
        # its own. Then help waits for the real libraries, and so does the message of a real mistake.
        except Exception as error:
            log.debug(f"help without torch failed: {error!r}")
    return _parse_call(name, arguments)


def find_command(words: Sequence[str]) -> str | None:
    """Command that words begin with, a verb or a verb with an action; None if there is none."""
    return next((name for name in (" ".join(words[:2]), words[0]) if name in COMMANDS), None)


def list_actions(verb: str) -> list[str]:
    """Actions of a verb."""
    return [name.partition(" ")[2] for name in COMMANDS if name.startswith(f"{verb} ")]


def _explain_actions(verb: str, words: Sequence[str]) -> NoReturn:
    """Print the actions of a verb, or say that the action is missing or unknown."""
    actions = list_actions(verb)
    if not any(word in HELP for word in words):
        raise ConfigError(explain_action(words, actions))
    with stand_ins():
        summaries = [describe(COMMANDS[f"{verb} {action}"].function).partition("\n")[0] for action in actions]
    print(f"usage: rlftsim {verb} [-h] {{{','.join(actions)}}}\n\n{VERBS[verb].description}\n")
    columns = shutil.get_terminal_size().columns
    for action, summary in zip(actions, summaries):
        print(textwrap.fill(summary, columns, initial_indent=f"  {action:9}", subsequent_indent=" " * 11))
    raise SystemExit(0)


def _parse_call(name: str, words: list[str], recipe: str | None = None) -> Call:
    """The call of a command, or the help, or a line of complaint. Defaults are those of a recipe; None = guessed."""
    command, flags, complete = COMMANDS[name], None, words
    if command.sections:
        # Imported late: most verbs do not need recipes.
        from rlftsim.cli.recipes import finish_call, select_flags

        flags = select_flags(name, command, words, recipe)
        complete = flags.read_file(words)
    parser = make_parser(command, flags.settings if flags else {})

    def read(arguments: list[str]) -> Any:
        return tyro.cli(parser, args=arguments, prog=f"rlftsim {name}")

    if any(word in HELP for word in words):
        _print_help(read, complete)
    # tyro prints a box of lines and exits; the box is caught and made one line.
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint), _wide():
            call = read(complete)
    except SystemExit:
        usage = " ".join([name, *(command.names.get(label, label.upper()) for label in command.positional)])
        names = list(dict.fromkeys(FLAG.findall(_help_text(read))))
        message = explain(words, complaint.getvalue(), names, usage, flags.run_section if flags else "")
        # A setting of a file is a flag that the user never typed: the file is to blame.
        blamed = FLAG.match(message)
        if blamed and blamed[0] in set(list_flags(complete)) - set(list_flags(words)):
            message = f"{complete[complete.index('--config') + 1]}: {message.removeprefix('--')}"
        raise ConfigError(message) from None
    # A word behind a switch may have been mistaken for its value; tyro knows which word is the recipe.
    if flags and call.values[command.recipe] != flags.name:
        return _parse_call(name, words, call.values[command.recipe])
    # Warnings on the way, such as that of a reward that is registered twice, are shown after all.
    if complaint.getvalue():
        log.warning(complaint.getvalue().rstrip())
    flag_values = {argument: value for argument, value in call.values.items() if argument not in command.sections}
    _check_values(flag_values, [*name.split(), *words])
    return finish_call(call, flags, list_flags(words)) if flags else call


def _print_help(read: Any, words: list[str]) -> NoReturn:
    """Print the help of a command. Its description, of which tyro makes a line for each paragraph, is folded."""
    # tyro asks where the help goes to for colors and the characters of boxes
    terminal = sys.stdout
    text = type("Help", (io.StringIO,), {"isatty": lambda self: terminal.isatty(), "encoding": terminal.encoding})()
    with redirect_stdout(text), suppress(SystemExit):
        read(words)
    columns = shutil.get_terminal_size().columns
    for line in text.getvalue().splitlines():
        is_sentence = line[:1].isupper()
        print(textwrap.fill(line, columns) if is_sentence else line)
    raise SystemExit(0)


def _help_text(read: Any) -> str:
    """Help of a command."""
    text = io.StringIO()
    with redirect_stdout(text), redirect_stderr(io.StringIO()), _wide(), suppress(SystemExit):
        read(["--help"])
    return text.getvalue()


@contextmanager
def _wide() -> Iterator[None]:
    """Let tyro write lines as long as they are: each message stands on one line of its box."""
    columns = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _check_values(values: Mapping[str, Any], words: Sequence[str]) -> None:
    """Check that what is counted is positive, that lists have values, and that paths are no addresses of buckets.

    Args:
        values: Values of a verb by argument, or of settings whose flags stand among those of the verb.
        words: Words of the whole command.

    Raises:
        ConfigError: A value that makes no sense; names the flag, or the commands that do it.
    """
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        if name in COUNTS and isinstance(value, int) and value < 1:
            raise ConfigError(f"{flag} must be at least 1, got {value}.")
        if value in ([], ()) and flag in words:
            raise ConfigError(f"{flag} needs at least one value.")
        if isinstance(value, Path) and ADDRESS.match(str(value)):
            _explain_address(name, value, words)
        if is_dataclass(value):
            _check_values(vars(value), words)


def _explain_address(argument: str, path: Path, words: Sequence[str]) -> None:
    """Refuse an address of a bucket in place of a path, with the commands that bring the result there.

    Args:
        argument: Name of the argument; only the destination of a data set has such commands.
        path: Path that was made of the address.
        words: Words of the whole command.

    Raises:
        ConfigError: Always.
    """
    address = next((word for word in words if "://" in word and Path(word) == path), str(path))
    if argument != "destination":
        raise ConfigError(
            f"{address} is an address: name a folder or a file of this machine here, and copy it by the bucket's own "
            "tools (docs/machines.md)."
        )
    command = shlex.join("FOLDER" if word == address else word for word in words)
    raise ConfigError(
        f"{address} is an address, and a data set is made in a folder: `rlftsim {command}`, then "
        f"`rlftsim data push FOLDER {address}`."
    )
