"""Processor time of help texts: they must not import torch, which alone takes longer than a reader waits."""

import contextlib
import functools
import os
import re
import resource
import subprocess
import sys

import pytest
import torch  # noqa: F401  help is compared with that of the real libraries

from rlftsim.cli.main import VERBS, main
from rlftsim.verbs.commands import COMMANDS

OVERVIEW_SECONDS = 0.3
WORD = re.compile(r"[\w.-]*\w")
ACTIONS = {"data": ["verify"], "goals": ["propose"], "model": ["import"]}
"""Verbs whose flags are those of an action."""


def run_for(*arguments: str) -> tuple[float, str]:
    """Processor time of the interpreter with these arguments in seconds (user and system), and its output."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", "COLUMNS": "100"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


@functools.cache
def print_help(*line: str, attempt: int = 0) -> tuple[float, str]:
    """Processor time and text of a help for which torch is not imported, of a process that several tests look at."""
    code = f"from rlftsim.cli import main\ntry:\n main({[*line]})\nfinally:\n assert 'torch' not in sys.modules"
    return run_for("-c", f"import sys; {code}")


def shortest(*line: str, limit: float) -> float:
    """Least processor time of a few tries: the first one may compile Python files, others share a busy machine."""
    times: list[float] = []
    while len(times) < 3 and not (times and min(times) <= limit):
        times.append(print_help(*line, attempt=len(times))[0])
    return min(times)


@pytest.fixture(scope="module")
def torch_seconds() -> float:
    """Least processor time of importing torch: the first try may read it from a cold disk."""
    return min(run_for("-c", "import torch")[0] for _ in range(2))


def test_the_overview_is_there_at_once():
    assert shortest("--help", limit=OVERVIEW_SECONDS) <= OVERVIEW_SECONDS


@pytest.mark.parametrize("verb", VERBS)
def test_the_help_of_a_verb_is_there_before_torch_would_be(verb, torch_seconds):
    assert shortest(verb, *ACTIONS.get(verb, []), "--help", limit=torch_seconds) <= torch_seconds


LINES = [["--help"], *([verb, *ACTIONS.get(verb, []), "--help"] for verb in VERBS)]


@pytest.mark.parametrize("line", [*LINES, ["experiment", "exam", "--help"], ["finetune", "smart-demo", "--help"]])
def test_help_does_not_import_torch_and_is_the_help_with_torch(line, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    _, printed = print_help(*line, attempt=0)
    assert "usage" in printed
    # that of this process is made with the real libraries, because torch is loaded here
    assert "torch" in sys.modules
    with contextlib.suppress(SystemExit):
        main(line)
    assert WORD.findall(printed) == WORD.findall(capsys.readouterr().out)


@pytest.mark.parametrize("line", ["evaluate", "experiment exam", "finetune"])
def test_help_is_folded_to_the_terminal_without_breaking_a_word(line, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main([*line.split(), "--help"])
    printed = capsys.readouterr().out
    assert [text for text in printed.splitlines() if len(text) > 80] == []
    description = COMMANDS[line].function.__doc__.partition("\n\n")[0]
    assert " ".join(description.split()) in " ".join(printed.split())
