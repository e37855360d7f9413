"""Entry point: reads the command line, runs the verb, and turns user errors into one line.

Only the module of the verb is imported, and help texts do not import torch.
"""

import difflib
import errno
import io
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rlftsim import __version__
from rlftsim.errors import PERMISSION_WAY_OUT, ConfigError, RlftsimError, find_package_error, in_short, shorten
from rlftsim.jobs.interruption import signals_like_ctrl_c
from rlftsim.jobs.threads import keep_freed_memory
from rlftsim.verbs.commands import COMMANDS, UNCHECKED, VERBS

JOIN = "join"
DEBUG = "--debug"
"""Word of any command that shows an error with its traceback, not as one line."""
COMPLETION = "--completion"
"""Word that is followed by a shell, whose script is printed, or by the words that the script wants continued."""
SYNONYMS = {
    **dict.fromkeys(("train", "fit"), "pretrain or finetune"),
    **dict.fromkeys(("rollout", "sample", "predict", "infer", "generate"), "simulate"),
    **dict.fromkeys(("test", "validate", "benchmark"), "evaluate"),
    **dict.fromkeys(("metric", "metrics", "rmm"), "score"),
    **dict.fromkeys(("play", "view", "visualize"), "studio"),
    **{"render": "export film", "plan": "drive", "download": "data pull", "upload": "model push", "list": "models"},
}
"""Verbs of other programs -> those of the same meaning."""
OVERVIEW = "\n".join(
    [
        f"rlftsim {__version__}: traffic agents that behave like real road users.\n",
        "usage: rlftsim VERB ...      rlftsim VERB --help explains a verb\n",
        *("\n" * verb.begins_group + f"  {name:12} {verb.summary}" for name, verb in VERBS.items()),
        f"\n  {JOIN} VERB .. put the shares of a command together that ran on several machines (--share K/N)\n"
        f"\n  With {DEBUG} any command shows the traceback of an error.\n"
        f'  eval "$(rlftsim {COMPLETION} bash)", or zsh: the shell completes verbs and flags.\n',
    ]
)
SIGNALLED = 128
"""Added to the number of the signal that ended a command: 129 = SIGHUP, 130 = Ctrl-C, 138 = SIGUSR1, 143 = SIGTERM."""
USER_MISTAKE = 2


@signals_like_ctrl_c()
def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit status."""
    keep_freed_memory()
    for stream in (sys.stdout, sys.stderr):
        # A sign that the terminal does not have is no reason to end in a traceback after hours of work.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    words = list(sys.argv[1:] if arguments is None else arguments)
    shows_traceback = DEBUG in words
    words = [word for word in words if word != DEBUG]
    try:
        if not words or words[0] in ("-h", "--help", "help"):
            print(OVERVIEW, end="", flush=True)
            return 0 if words else USER_MISTAKE
        if words[0] in ("-V", "--version"):
            print(f"rlftsim {__version__}", flush=True)
            return 0
        if words[0] == COMPLETION:
            from rlftsim.cli.completion import SCRIPT, list_next_words

            print(SCRIPT if words[1:] in (["bash"], ["zsh"]) else "\n".join(list_next_words(words[1:])))
            return 0
        call = parse(words)
        verb = call.command.function
        # The parser has checked names and numbers of the arguments.
        return call.show((UNCHECKED.get(verb) or verb)(**call.arguments))
    except RlftsimError as error:
        if shows_traceback:
            raise
        _print_error(str(error))
        return error.exit_status
    except KeyboardInterrupt as stop:
        # Training says where it goes on.
        starts_anew = words[0] in VERBS and VERBS[words[0]].starts_anew
        what_next = str(stop) or ("starts anew" if starts_anew else "continues where this one stopped")
        print(file=sys.stderr)
        _print_error(f"stopped. The same command {what_next}.")
        return SIGNALLED + getattr(stop, "number", signal.SIGINT)
    except BrokenPipeError:
        # `rlftsim ... | head` has read enough
        return 0
    except Exception as error:
        line = _in_words(error) or find_package_error(error)
        if line is None or shows_traceback:
            # A bug of this package: its traceback is what a report needs.
            raise
        _print_error(str(line))
        return 1


def _print_error(message: str) -> None:
    """Print a line without control characters of a user's text, and of a length that can be read."""
    print(f"rlftsim: {shorten(message)}", file=sys.stderr)


def parse(words: Sequence[str]) -> Any:
    """The call of a verb that a command line stands for, see `Call`.

    Raises:
        ConfigError: The words make no sense.
        SystemExit: They ask for help, which has been printed.
    """
    if words[0] not in (*VERBS, JOIN):
        verbs = [*VERBS, JOIN]
        match = SYNONYMS.get(words[0]) or next(iter(difflib.get_close_matches(words[0], verbs, 1)), None)
        hint = f"did you mean {match}?" if match else f"known are {', '.join(verbs)}."
        raise ConfigError(f"no verb {in_short(words[0])}: {hint}")
    for word in words:
        if not word.strip():
            raise ConfigError(f"{in_short(word)} is no word, as of a variable that is not set: write a value.")
        try:
            word.encode()
        except UnicodeEncodeError:  # bytes that are no text, as Python keeps them; tables and messages take none
            raise ConfigError(f"{in_short(word)} is no text in UTF-8: rename the file or folder.") from None
    # Imported late: the overview is printed without it.
    from rlftsim.cli.parse import parse as parse_words

    if words[0] != JOIN:
        return parse_words(words)
    command, names = words[1:], sorted(name for name, command in COMMANDS.items() if command.has_shares)
    if "--share" in command or not any(" ".join(command[:length]) in names for length in (1, 2)):
        raise ConfigError(
            f"{' '.join(words[:3])}: write the command of a share behind {JOIN}, without --share; commands with shares "
            f"are {', '.join(names)}."
        )
    return parse_words([*command, "--share", JOIN])


def _in_words(error: Exception) -> str | None:
    """Line about a lack of the machine; None for any other error."""
    # Libraries wrap a full disk in errors of their own, so the text decides, not the class.
    if getattr(error, "errno", None) == errno.ENOSPC or os.strerror(errno.ENOSPC) in str(error):
        filename = getattr(error, "filename", None)
        return f"the disk is full{f', writing {filename}' if filename else ''}: free some space and repeat the command."
    # By name: torch is not imported for this.
    if type(error).__name__ == "OutOfMemoryError":
        return (
            "the GPU has too little memory: lower the number of scenarios or rollouts in memory at once (see --help)."
        )
    if isinstance(error, OSError):
        path, way_out = error.filename, ": choose a shorter name." if error.errno == errno.ENAMETOOLONG else ""
        if isinstance(error, PermissionError) and path:
            # the folder that is closed, not a file that was looked for inside
            folders = (folder for folder in reversed(Path(path).parents) if folder.is_dir())
            path = next((folder for folder in folders if not os.access(folder, os.X_OK)), path)
            way_out = f": {PERMISSION_WAY_OUT}."
        return f"{error.strerror or error}{f': {path}' if path else ''}{way_out}"
    return None
