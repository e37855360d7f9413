"""One thread where several would wait for each other, and no page fetched twice."""

import contextlib
import platform
import subprocess
import sys

import pytest
import torch

from rlftsim.jobs.threads import one_thread

FAULTS = """
import resource, sys, torch
from rlftsim.jobs.threads import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
def step():
    return [torch.ones(1 << 20) for _ in range(32)] + [torch.ones(1 << 24)]  # 128 MiB in pieces, 64 in one
step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(3):
    step()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def test_one_thread_and_afterwards_as_many_as_before():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with contextlib.suppress(ValueError), one_thread():
            inside = torch.get_num_threads()
            raise ValueError
        assert (inside, torch.get_num_threads()) == (1, 2)
    finally:
        torch.set_num_threads(before)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library manages memory in its own way")
def test_freed_memory_is_used_again_without_fetching_its_pages():
    faults = {how: int(subprocess.check_output([sys.executable, "-c", FAULTS, how])) for how in ("keep", "default")}
    assert faults["keep"] < faults["default"] / 3
