"""SIGTERM, SIGHUP and SIGUSR1 do what Ctrl-C does, with exit statuses of their own."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

import rlftsim
from rlftsim.cli import main
from rlftsim.jobs.interruption import SIGNALS, Interruption, ctrl_c_waits, signals_like_ctrl_c


@pytest.fixture(autouse=True)
def _handlers_of_a_new_process():
    """Ray's driver leaves a handler of SIGTERM that exits, in the process of whatever test comes after it."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGUSR1, 138)],
)
def test_a_signal_ends_a_command_in_one_line_with_its_status(number, status, monkeypatch, capsys):
    handlers = [signal.getsignal(one) for one in SIGNALS]
    monkeypatch.setattr("rlftsim.verbs.plugins.plugins", lambda: signal.raise_signal(number))
    assert main(["plugins"]) == status
    assert capsys.readouterr().err == "\nrlftsim: stopped. The same command starts anew.\n"
    assert [signal.getsignal(one) for one in SIGNALS] == handlers


def test_a_signal_that_is_ignored_or_handled_by_the_caller_stays_so():
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with signals_like_ctrl_c():
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


def make_update(*numbers, done):
    """An update during which signals arrive."""
    with signals_like_ctrl_c(), ctrl_c_waits() as is_stopped:
        for number in numbers:
            signal.raise_signal(number)
        done.append(is_stopped())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1])
def test_an_update_that_has_begun_is_finished_first(number):
    done = []
    with pytest.raises(Interruption) as caught:
        make_update(number, done=done)
    assert (done, caught.value.number) == ([True], number)


def test_a_second_signal_does_not_wait():
    done = []
    with pytest.raises(Interruption):
        make_update(signal.SIGUSR1, signal.SIGTERM, done=done)
    assert done == []


SCRIPT = """
import os, signal, sys, time
from multiprocessing import active_children
from rlftsim.jobs.interruption import signals_like_ctrl_c
from rlftsim.jobs.processes import Processes

def work(item, advance, is_stopped):
    if item == 0:
        os.killpg(0, signal.{name})  # as SLURM does, to all processes of the job
    while not is_stopped():
        time.sleep(0.01)

if __name__ == "__main__":
    try:
        with signals_like_ctrl_c():
            Processes(2).run(work, [0, 1], advance=lambda count: None)
    except KeyboardInterrupt as stop:
        print("stopped", stop.number, active_children())
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGUSR1"])
def test_worker_processes_end_silently_with_the_one_that_started_them(name, tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT.format(name=name))
    done = subprocess.run(
        [sys.executable, "script.py"],
        env={**os.environ, "PYTHONPATH": str(Path(rlftsim.__file__).parents[1])},
        capture_output=True, text=True, timeout=120, cwd=tmp_path, start_new_session=True,
        preexec_fn=partial(signal.signal, signal.SIGUSR1, signal.SIG_DFL),
    )  # fmt: skip
    assert (done.stdout, done.stderr) == (f"stopped {int(getattr(signal, name))} []\n", "")
