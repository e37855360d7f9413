"""Ctrl-C between two updates: the one that has begun is finished, so that the run can store it."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rlftsim.progress import log


@contextmanager
def ctrl_c_waits(*, enabled: bool = True) -> Iterator[Callable[[], bool]]:
    """Keep Ctrl-C back until the block ends, and raise it there; yields a function that is True once it was pressed.

    A second Ctrl-C is raised at once. Outside of the main thread, and where Ctrl-C is ignored or has a handler of the
    caller's, all stays as it is.

    Args:
        enabled: False = do nothing.

    Raises:
        KeyboardInterrupt: it was pressed.
    """
    is_pressed = False

    def keep_back(*_: object) -> None:
        nonlocal is_pressed
        is_pressed = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        log.info("stopping at the end of this update; Ctrl-C once more stops at once.")

    can_handle = threading.current_thread() is threading.main_thread()
    if not (enabled and can_handle and signal.getsignal(signal.SIGINT) is signal.default_int_handler):
        yield lambda: False
        return
    signal.signal(signal.SIGINT, keep_back)
    try:
        yield lambda: is_pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if is_pressed:
        raise KeyboardInterrupt
