"""How this process uses the processor: with one thread, and without handing memory back and forth."""

import ctypes
import platform
from collections.abc import Iterator
from contextlib import contextmanager

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's `mallopt`."""
KEPT_BYTES = 1 << 30
LARGEST_KEPT_BYTES = 1 << 25
"""What is larger is always handed back; glibc takes no larger limit."""


def keep_freed_memory() -> None:
    """Let glibc keep freed memory for what is needed next. Other C libraries stay as they are.

    By default it hands most of it back to the system after every simulated step and gets it again page by page, which is up to a
    twelfth of a rollout.
    """
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(_TRIM_THRESHOLD, KEPT_BYTES)
        libc.mallopt(_MMAP_THRESHOLD, LARGEST_KEPT_BYTES)


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch computes with a single thread: rollouts consist of small steps, between which threads mostly wait for each other. And
    neither the number of threads nor that of processes changes a result."""
    import torch  # here: nobody who asks for help waits for it

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
