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
from typing import Any

from rlftsim import __version__
from rlftsim.errors import ConfigError, RlftsimError, in_short, shorten
from rlftsim.jobs.interruption import signals_like_ctrl_c
from rlftsim.jobs.threads import keep_freed_memory

VERBS = (
    "demo", "doctor", "plugins", "convert", "data", "synthesize", "recipe", "tokens", "pretrain", "finetune", "runs",
    "augment", "models", "model", "goals", "simulate", "drive", "failures", "studio", "score", "evaluate", "compare",
    "submit",
    "experiment",
)  # fmt: skip
"""Verbs in the order in which a newcomer needs them."""

OVERVIEW = f"""rlftsim {__version__}: traffic agents that behave like real road users.

usage: rlftsim VERB ...      rlftsim VERB --help explains a verb

  demo         run the whole pipeline on synthetic scenarios, in minutes, on a CPU
  doctor       check this machine and print what to do about each problem
  plugins      list what other installed packages add, and why one fails

  convert      convert logged scenarios, such as WOMD tfrecords, to a portable data set
  data         check a data set, or print its statistics
  synthesize   make synthetic scenarios with SUMO

  recipe       list the recipes (models and training settings), or print one
  tokens       build a vocabulary of motion and map tokens, or measure its coverage
  pretrain     train a model on logged tracks
  finetune     fine-tune a model in closed loop with a realism reward, also with goals
  runs         list training runs: how far they are, how good, and which settings differ
  augment      sample further goals for goal-conditioned fine-tuning
  models       list the models in the box and those of other packages
  model        average models; import a checkpoint of the public CAT-K code, or export one
  goals        propose goals for agents and write a goals file, or check one
  simulate     roll out scenarios with a model
  drive        let a planner drive among simulated traffic, and score both
  failures     estimate how often a planner fails in realistic traffic, and show how
  studio       ask agents for things in the browser, and look at what happens

  score        score rollouts of any simulator with the official realism meta-metric
  evaluate     evaluate a model with the official realism meta-metric
  compare      compare two evaluations scenario by scenario
  submit       build an archive for the Sim Agents leaderboard, or check one before it is uploaded
  experiment   repeat an experiment of the paper: a table, verdicts and a figure; or sit the exam

  join VERB .. put the shares of a command together that ran on several machines (--share K/N)
"""

STARTS_ANEW = ("doctor", "plugins", "data", "recipe", "tokens", "runs", "models", "model", "goals", "studio", "compare")
"""Verbs that keep nothing of an interrupted run."""
JOIN = "join"
HAVE_SHARES = ("augment", "convert", "evaluate", "failures", "score", "simulate", "submit build", "synthesize")
"""Commands with --share, whose shares `join` puts together."""
SIGNALLED = 128
"""Added to the number of the signal that ended the command: 130 = Ctrl-C, 143 = SIGTERM, 138 = SIGUSR1."""
USER_MISTAKE = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit status."""
    keep_freed_memory()
    for stream in (sys.stdout, sys.stderr):
        # A sign that the terminal does not have is no reason to end in a traceback after hours of work.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    with signals_like_ctrl_c():
        return _run(list(sys.argv[1:] if arguments is None else arguments))


def _run(words: list[str]) -> int:
    """Run a command line; returns the exit status."""
    if not words or words[0] in ("-h", "--help", "help"):
        print(OVERVIEW, end="")
        return 0 if words else USER_MISTAKE
    if words[0] in ("-V", "--version"):
        print(f"rlftsim {__version__}")
        return 0
    verb = words[0]
    if verb not in VERBS and verb != JOIN:
        near = difflib.get_close_matches(verb, [*VERBS, JOIN], 1)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(VERBS)}."
        _print_error(f"no verb {in_short(verb)}: {hint}")
        return USER_MISTAKE
    try:
        return parse(words).run()
    except RlftsimError as error:
        _print_error(str(error))
        return error.exit_status
    except KeyboardInterrupt as stop:
        # Training says where it goes on.
        what_next = str(stop) or ("starts anew" if verb in STARTS_ANEW else "continues where this one stopped")
        print(file=sys.stderr)
        _print_error(f"stopped. The same command {what_next}.")
        return SIGNALLED + getattr(stop, "number", signal.SIGINT)
    except BrokenPipeError:
        # `rlftsim ... | head` has read enough
        return 0
    except Exception as error:
        line = _in_words(error)
        if line is None:
            # A bug of this package: its traceback is what a report needs.
            raise
        _print_error(line)
        return 1


def _print_error(message: str) -> None:
    """Print one line: without control characters that a user's text may bring, and of a length that can be read."""
    print(f"rlftsim: {shorten(message)}", file=sys.stderr)


def parse(words: Sequence[str]) -> Any:
    """The verb of a command line with its settings; has a method `run`.

    Raises:
        ConfigError: The words make no sense.
        SystemExit: They ask for help, which has been printed.
    """
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:  # bytes that are no text, as Python keeps them; tables and messages take none
            raise ConfigError(f"{in_short(word)} is no text in UTF-8: rename the file or folder.") from None
    # Imported late: the overview is printed without it.
    from rlftsim.cli.parse import parse as parse_words

    if words[0] != JOIN:
        return parse_words(words)
    command = words[1:]
    if "--share" in command or not any(" ".join(command[:length]) in HAVE_SHARES for length in (1, 2)):
        raise ConfigError(
            f"{' '.join(words[:3])}: write the command of a share behind {JOIN}, without --share; commands with shares "
            f"are {', '.join(HAVE_SHARES)}."
        )
    return parse_words([*command, "--share", JOIN])


def _in_words(error: Exception) -> str | None:
    """One line about what the machine lacks; None for any other error."""
    # Libraries wrap a full disk in errors of their own, so the text decides, not the class.
    if getattr(error, "errno", None) == errno.ENOSPC or os.strerror(errno.ENOSPC) in str(error):
        where = getattr(error, "filename", None)
        return f"the disk is full{f', writing {where}' if where else ''}: free some space and repeat the command."
    # By name: torch is not imported for this.
    if type(error).__name__ == "OutOfMemoryError":
        return (
            "the GPU has too little memory: lower the number of scenarios or rollouts in memory at once (see --help)."
        )
    if isinstance(error, OSError):
        return f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}"
    return None
