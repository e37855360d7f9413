"""Signals that end a command: Ctrl-C, SIGTERM, SIGHUP of a terminal that closes, and SIGUSR1, which SLURM sends
before the time of a job is over.

Each raises a KeyboardInterrupt in the main thread of the process that a user started, never in child processes: the
main process ends its children.
"""

import logging
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
"""Ctrl-C and what is like it. Windows has neither SIGHUP nor SIGUSR1."""
log = logging.getLogger("rlftsim")


class Interruption(KeyboardInterrupt):
    """A signal other than Ctrl-C.

    Args:
        number: The signal's, on which the exit status of the command depends.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def raise_interruption(number: int, *_: object) -> None:
    """Raise an `Interruption`; handler of a signal."""
    raise Interruption(number)


@contextmanager
def signals_like_ctrl_c() -> Iterator[None]:
    """Context in which SIGTERM, SIGHUP and SIGUSR1 interrupt as Ctrl-C does, instead of ending the process at once.

    Outside of the main thread all signals stay unchanged, as does a signal that is ignored or has a handler of the
    caller's.
    """
    is_main = threading.current_thread() is threading.main_thread()
    changed = [number for number in SIGNALS if is_main and signal.getsignal(number) is signal.SIG_DFL]
    for number in changed:
        signal.signal(number, raise_interruption)
    try:
        yield
    finally:
        for number in changed:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def ctrl_c_waits(*, enabled: bool = True) -> Iterator[Callable[[], bool]]:
    """Hold Ctrl-C back until the block ends, and raise there; yields a function that is True once Ctrl-C was pressed.

    So an update that has begun is finished, and the run can store the update. A second Ctrl-C is raised at once. The
    same holds for the signals that interrupt like Ctrl-C. Outside of the main thread, and where a signal is ignored or
    has a handler of the caller's, signals stay unchanged.

    Args:
        enabled: False leaves all signals unchanged.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    ours = (signal.default_int_handler, raise_interruption)
    is_main = threading.current_thread() is threading.main_thread()
    handlers: dict[int, Any] = {number: signal.getsignal(number) for number in SIGNALS if enabled and is_main}
    handlers = {number: handler for number, handler in handlers.items() if handler in ours}
    received: list[int] = []

    def restore() -> None:
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def keep_back(number: int, *_: object) -> None:
        received.append(number)
        restore()
        name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        log.info(f"stopping at the end of this update; {name} once more stops at once.")

    for number in handlers:
        signal.signal(number, keep_back)
    try:
        yield lambda: bool(received)
    finally:
        restore()
    if received:
        handlers[received[0]](received[0], None)


@contextmanager
def ctrl_c_blocked() -> Iterator[None]:
    """Context in which Ctrl-C and similar signals wait. Processes started in the context never see these signals.

    Ctrl-C reaches all processes of a terminal, SLURM's signals all of a job, but only the parent process is to react,
    and ends its children.
    """
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
