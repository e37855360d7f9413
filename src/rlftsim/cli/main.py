"""Reads the command line, runs the verb, and turns a user's mistakes into one line.

Only the verb that is asked for is imported: nobody waits for torch to read a help text.
"""

import difflib
import importlib
import sys
from collections.abc import Sequence
from typing import Any

from rlftsim import __version__
from rlftsim.errors import RlftsimError
from rlftsim.processor import keep_freed_memory

VERBS = {
    "demo": ("rlftsim.cli.demo", "Demo"),
    "doctor": ("rlftsim.cli.doctor", "Doctor"),
    "convert": ("rlftsim.cli.data", "Convert"),
    "data": ("rlftsim.cli.data", "Data"),
    "synthesize": ("rlftsim.cli.data", "Synthesize"),
    "tokens": ("rlftsim.cli.tokens", "Tokens"),
    "pretrain": ("rlftsim.cli.train", "Pretrain"),
    "finetune": ("rlftsim.cli.train", "Finetune"),
    "augment": ("rlftsim.cli.augment", "Augment"),
    "model": ("rlftsim.cli.model", "Model"),
    "goals": ("rlftsim.cli.goals", "Goals"),
    "simulate": ("rlftsim.cli.simulate", "Simulate"),
    "score": ("rlftsim.cli.results", "Score"),
    "evaluate": ("rlftsim.cli.results", "Evaluate"),
    "compare": ("rlftsim.cli.results", "Compare"),
    "experiment": ("rlftsim.cli.experiment", "RunExperiment"),
}
"""Module and class of each verb, in the order a newcomer meets them."""

OVERVIEW = f"""rlftsim {__version__}: traffic agents that behave like real road users.

usage: rlftsim VERB ...      rlftsim VERB --help explains a verb

  demo         see the whole pipeline work on synthetic scenarios, in minutes, on a CPU
  doctor       look at this machine and say what to do about what is wrong

  convert      WOMD tfrecords to a portable data set
  data         check a data set, or say what is in it
  synthesize   make synthetic scenarios with SUMO

  tokens       build a vocabulary of motion and map tokens, or look at one
  pretrain     train a model to predict the next motion token
  finetune     fine-tune a model closed-loop with a realism reward, with goals if asked
  augment      draw further goals for fine-tuning with goals
  model        take a checkpoint from the public CAT-K code, or hand one back
  goals        say what agents may be asked to do, and write it to a file
  simulate     roll scenarios out with a model

  score        score anybody's rollouts with the official realism meta-metric
  evaluate     measure a model with the official realism meta-metric
  compare      compare two evaluations scenario by scenario
  experiment   answer a question of the paper with a table and a figure
"""

STARTS_ANEW = ("doctor", "data", "tokens", "model", "goals", "compare")
"""Verbs that keep nothing of what they were stopped in."""
INTERRUPTED = 130
USER_MISTAKE = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit status."""
    keep_freed_memory()
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help", "help"):
        print(OVERVIEW, end="")
        return 0 if words else USER_MISTAKE
    if words[0] in ("-V", "--version"):
        print(f"rlftsim {__version__}")
        return 0
    if words[0] not in VERBS:
        near = difflib.get_close_matches(words[0], VERBS, 1)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(VERBS)}."
        print(f"rlftsim: no verb {words[0]!r}: {hint}", file=sys.stderr)
        return USER_MISTAKE
    return _run(words)


def parse(words: Sequence[str]) -> Any:
    """The verb of a command line with its settings; has a method `run`.

    Raises:
        SystemExit: the words make no sense, or ask for help; what was wrong has been printed.
    """
    import tyro

    words = join_settings(words)

    module, name = VERBS[words[0]]
    verb = getattr(importlib.import_module(module), name)
    config = (tyro.conf.OmitSubcommandPrefixes,)
    return tyro.cli(verb, args=list(words[1:]), prog=f"rlftsim {words[0]}", config=config)


def join_settings(words: Sequence[str]) -> list[str]:
    """The same words with the values of all `--set` after the last one: it may be given once or many times."""
    rest: list[str] = []
    values: list[str] = []
    is_value = False
    for word in words:
        is_value = word == "--set" or (is_value and not word.startswith("-"))
        (values if is_value else rest).append(word)
    settings = [value for value in values if value != "--set"]
    return [*rest, "--set", *settings] if "--set" in values else rest


def _run(words: list[str]) -> int:
    try:
        return parse(words).run()
    except RlftsimError as error:
        print(f"rlftsim: {error}", file=sys.stderr)
        return USER_MISTAKE
    except KeyboardInterrupt:
        what_next = "starts anew" if words[0] in STARTS_ANEW else "goes on where it was"
        print(f"\nrlftsim: stopped. The same command {what_next}.", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        return 0
    except OSError as error:
        where = f": {error.filename}" if error.filename else ""
        print(f"rlftsim: {error.strerror or error}{where}", file=sys.stderr)
        return 1
