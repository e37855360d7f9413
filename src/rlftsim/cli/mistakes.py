"""Words of a command line that make no sense, explained in a line."""

import difflib
import re
from collections.abc import Sequence
from itertools import pairwise

from rlftsim.cli.signatures import FLAG, list_flags

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


def explain(words: Sequence[str], complaint: str, help_text: str) -> str:
    """Line about a mistake in a command line.

    Args:
        words: Words behind the verb.
        complaint: Output of tyro, a box of lines.
        help_text: Help of the verb, for the flags that exist.
    """
    flags = list(dict.fromkeys(FLAG.findall(help_text)))
    for flag in list_flags(words):
        if flag not in flags:
            suggestion = nearest(flag, flags)
            return f"no flag {flag}: " + (f"did you mean {suggestion}?" if suggestion else "`--help` lists them all.")
    # `--switch yes`: tyro complains about the value alone
    left_over = re.search(r"Unrecognized options: (\S+)", complaint)
    for flag, word in pairwise(words):
        group, dot, last = flag.replace("_", "-").removeprefix("--").rpartition(".")
        off = f"--{group}{dot}no-{last}"
        if left_over and word == left_over[1] and flag.startswith("--") and off in flags:
            return f"{flag} is a switch, it takes no value: write {flag} or {off}."
    return _one_line(complaint)


def nearest(flag: str, flags: Sequence[str]) -> str | None:
    """The flag nearest to a mistyped flag; None = all are far.

    Args:
        flag: Mistyped flag, such as "--finetune.lr", "--learning-rate" or "--finetune.learnig-rate".
        flags: Flags that exist.
    """
    group, _, last = flag.removeprefix("--").rpartition(".")
    siblings = [name for name in flags if name.removeprefix("--").rpartition(".")[0].startswith(group)]
    # 1. the right name without its group, 2. initials, 3. a typing mistake in the last part, 4. one anywhere
    parts = [(name.removeprefix("--").rpartition(".")[2], name) for name in reversed(siblings)]  # the first one stays
    by_last = dict(parts)
    by_initials = {"".join(word[:1] for word in part.split("-")): name for part, name in parts}
    close = [by_last[part] for part in difflib.get_close_matches(last, by_last, n=1, cutoff=0.75)]
    match = by_last.get(last) or by_initials.get(last) or next(iter(close), None)
    if match or (group and siblings):  # the group is right: a flag of another one would be a wild guess
        return match
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
