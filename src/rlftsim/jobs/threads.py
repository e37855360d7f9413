"""Use of the processor and of memory by this process: a single thread, and freed memory that stays."""

import ctypes
import platform
from collections.abc import Iterator
from contextlib import contextmanager

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
"""Parameters of glibc's `mallopt`."""
KEPT_BYTES = 1 << 30


def keep_freed_memory() -> None:
    """Let glibc keep freed memory for the next allocation. Other C libraries stay unchanged.

    By default glibc returns most memory to the system after every simulated step and gets pages again one at a time,
    which takes up to a twelfth of a rollout or of an update.
    """
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        # the heap keeps its free top, and large blocks are taken from it, too, instead of mapped one by one
        libc.mallopt(_TRIM_THRESHOLD, KEPT_BYTES)
        libc.mallopt(_MMAP_MAX, 0)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute with a single thread inside the block.

    Rollouts consist of small steps, between which threads mostly wait for each other. With a single thread neither the
    number of cores nor the number of processes changes a result.
    """
    import torch  # not at the top: `--help` does not need it and would wait seconds

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
