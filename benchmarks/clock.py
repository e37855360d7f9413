"""Time and memory of a step, alike for the public code's process and for ours; needs nothing but torch."""

import resource
import time
from collections.abc import Callable
from typing import Any

import torch


class Clock:
    """Seconds of calls: CPU time on a CPU, wall time between synchronisations on a GPU; peak memory beside them."""

    def __init__(self, device: str):
        self.on_gpu = device.startswith("cuda")
        self.baseline_mib = 0.0 if self.on_gpu else self._peak_mib()

    def time(self, call: Callable[[], Any]) -> float:
        start = self._now()
        call()
        return self._now() - start

    def added_mib(self) -> float:
        """Peak since the libraries were loaded."""
        return self._peak_mib() - self.baseline_mib

    def _now(self) -> float:
        if not self.on_gpu:
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    def _peak_mib(self) -> float:
        if self.on_gpu:
            return torch.cuda.max_memory_allocated() / 2**20
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
