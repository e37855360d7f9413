"""The verb that looks at the machine: doctor."""

import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from rich.table import Table
from rich.text import Text

from rlftsim.progress import print_wide
from rlftsim.scenario.inspect import verify_dataset
from rlftsim.scenario.synthetic import pack_path

GOOD, WARNING, BAD = "good", "warning", "bad"
MIN_FREE_GB = 2.0


@dataclass(frozen=True)
class Diagnosis:
    """One thing that was looked at."""

    what: str
    state: str
    found: str


@dataclass(frozen=True)
class Doctor:
    """Look at this machine: versions, threads, GPU, disk, the embedded scenarios. Says what to do about what is wrong."""

    def run(self) -> int:
        """Print the diagnoses; exit status 1 if something is bad."""
        checks: tuple[Callable[[], Diagnosis], ...] = (_python, _torch, _threads, _gpu, _sumo, _disk, _pack)
        diagnoses = [check() for check in checks]
        table = Table(show_header=False)
        colour = {GOOD: "green", WARNING: "yellow", BAD: "red"}
        for d in diagnoses:
            table.add_row(d.what, Text(d.state, style=colour[d.state]), d.found)
        print_wide(table)
        return int(any(d.state == BAD for d in diagnoses))


def _python() -> Diagnosis:
    good = sys.version_info[:2] >= (3, 11)
    found = platform.python_version() + ("" if good else ": needs 3.11 or newer")
    return Diagnosis("Python", GOOD if good else BAD, found)


def _torch() -> Diagnosis:
    number = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    good = number >= (2, 10)
    return Diagnosis("torch", GOOD if good else BAD, torch.__version__ + ("" if good else ": needs 2.10 or newer"))


def _threads() -> Diagnosis:
    """Two threads must not be slower than one; where they are, cores are shared and waiting threads spin."""
    before = torch.get_num_threads()
    seconds = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        seconds.append(_seconds_of_work())
    torch.set_num_threads(before)
    found = f"{os.cpu_count()} cores, 2 threads take {seconds[1] / seconds[0]:.1f} times as long as 1"
    if seconds[1] > 1.5 * seconds[0]:
        policy = os.environ.get("OMP_WAIT_POLICY", "not set")
        return Diagnosis("threads", WARNING, f"{found}: OMP_WAIT_POLICY is {policy}, set it to PASSIVE or use 1 thread")
    return Diagnosis("threads", GOOD, found)


def _seconds_of_work() -> float:
    x, w = torch.rand(4096, 64), torch.rand(64, 64)
    torch.relu(x @ w)
    start = time.perf_counter()
    for _ in range(200):
        torch.relu(x @ w).sum()
    return time.perf_counter() - start


def _gpu() -> Diagnosis:
    if not torch.cuda.is_available():
        return Diagnosis("GPU", WARNING, "none: the demo runs on the CPU, training on WOMD wants one")
    return Diagnosis("GPU", GOOD, torch.cuda.get_device_name())


def _sumo() -> Diagnosis:
    try:
        return Diagnosis("SUMO", GOOD, version("eclipse-sumo"))
    except PackageNotFoundError:
        hint = 'not installed: only `rlftsim synthesize` needs it (pip install "rlftsim[synthetic]")'
        return Diagnosis("SUMO", WARNING, hint)


def _disk() -> Diagnosis:
    free = {str(folder): shutil.disk_usage(folder).free / 1e9 for folder in (Path.cwd(), Path(tempfile.gettempdir()))}
    state = GOOD if min(free.values()) >= MIN_FREE_GB else WARNING
    return Diagnosis(
        "disk", state, ", ".join(f"{gigabytes:.1f} GB free in {folder}" for folder, gigabytes in free.items())
    )


def _pack() -> Diagnosis:
    damaged = [f for f in verify_dataset(pack_path()) if f.problem.is_damage]
    if damaged:
        return Diagnosis("synthetic scenarios", BAD, f"{damaged[0]}: install rlftsim again")
    return Diagnosis("synthetic scenarios", GOOD, "whole")
