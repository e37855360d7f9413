"""Reads the command line, runs the verb, and turns a user's mistakes into one line."""

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from rlftsim.cli.data import Convert, Data, Synthesize
from rlftsim.cli.demo import Demo
from rlftsim.cli.doctor import Doctor
from rlftsim.cli.results import Compare, Evaluate
from rlftsim.cli.simulate import Simulate
from rlftsim.cli.train import Finetune, Pretrain, Tokens
from rlftsim.errors import RlftsimError

Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[Data, tyro.conf.subcommand("data")]
    | Annotated[Synthesize, tyro.conf.subcommand("synthesize")]
    | Annotated[Tokens, tyro.conf.subcommand("tokens")]
    | Annotated[Pretrain, tyro.conf.subcommand("pretrain")]
    | Annotated[Finetune, tyro.conf.subcommand("finetune")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)

DESCRIPTION = """Traffic agents that behave like real road users: read WOMD, pre-train a next-token traffic model, fine-tune it \
closed-loop against the official realism meta-metric, measure it.

Start with `rlftsim demo`: the whole pipeline on the synthetic scenarios that ship with the package."""

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit status."""
    command = tyro.cli(
        Command, args=arguments, prog="rlftsim", description=DESCRIPTION, config=(tyro.conf.OmitSubcommandPrefixes,)
    )
    try:
        return command.run()
    except RlftsimError as error:
        print(f"rlftsim: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nrlftsim: stopped. The same command goes on where it was.", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        return 0
    except OSError as error:
        print(f"rlftsim: {error.strerror or error}: {error.filename or 'no file named'}", file=sys.stderr)
        return 1
