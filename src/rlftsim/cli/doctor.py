"""The verb that checks the machine: doctor."""

import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import torch
from rich.table import Table
from rich.text import Text

from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import print_wide
from rlftsim.scenario.inspect import verify_dataset
from rlftsim.scenario.synthetic import pack_path

GOOD, WARNING, BAD = "good", "warning", "bad"
MIN_FREE_GB = 2.0


@dataclass(frozen=True)
class Diagnosis:
    """Result of one check."""

    what: str
    state: str
    found: str


@dataclass(frozen=True)
class Doctor:
    """Check this machine: versions, threads, GPU, disk, the embedded scenarios. Prints what to do about each
    problem. With --plan: measure how long work on many machines would take, and what it would cost."""

    plan: Literal["convert", "evaluate", "submit"] | None = None
    """Forecast this work for the Waymo Open Motion Dataset instead, from its cost on this machine."""
    model: str = "demo-base"
    """With --plan evaluate or submit: the model."""
    data: str = "synthetic"
    """With --plan: data set to measure on; for convert, files to convert (all of them are)."""
    measure: int = 5
    """With --plan evaluate or submit: scenarios to measure, of all sizes."""
    num_scenarios: int | None = None
    """With --plan: scenarios of the whole work. Left out: 576000 to convert, 44100 to evaluate, 44920 to submit."""
    nodes: int = 1
    """With --plan: machines."""
    cores: int = 16
    """With --plan: cores of a machine."""
    price: float = 0.04
    """With --plan: price of a core for an hour, in dollars."""

    def refuse_useless(self, flags: Sequence[str]) -> None:
        """Refuse the flags of a forecast without one.

        Raises:
            ConfigError: there are some.
        """
        if self.plan is None and flags:
            raise ConfigError(f"{flags[0]} has no effect: add --plan evaluate, convert or submit.")

    def run(self) -> int:
        """Print the results; exit status 1 if a check failed."""
        if self.plan is not None:
            from rlftsim.cli.plan import measure_cost, plan_table

            cost = measure_cost(self.plan, self.model, self.data, self.measure)
            print_wide(
                plan_table(
                    self.plan, cost,
                    num_scenarios=self.num_scenarios, nodes=self.nodes, cores=self.cores, price=self.price,
                )
            )  # fmt: skip
            return 0
        diagnoses = [*_versions(), _threads(), _gpu(), _sumo(), _disk(), _pack()]
        table = Table(show_header=False)
        color = {GOOD: "green", WARNING: "yellow", BAD: "red"}
        for d in diagnoses:
            table.add_row(d.what, Text(d.state, style=color[d.state]), d.found)
        print_wide(table)
        return int(any(d.state == BAD for d in diagnoses))


def _versions() -> Iterator[Diagnosis]:
    """Python and torch, each with the oldest version that will do."""
    for what, version_text, oldest in (
        ("Python", platform.python_version(), (3, 11)),
        ("torch", torch.__version__, (2, 10)),
    ):
        number = tuple(int(part) for part in version_text.split("+")[0].split(".")[:2])
        if number >= oldest:
            yield Diagnosis(what, GOOD, version_text)
        else:
            yield Diagnosis(what, BAD, f"{version_text}: needs {oldest[0]}.{oldest[1]} or newer")


def _threads() -> Diagnosis:
    """Compare two threads with one. Where two are slower, cores are shared and waiting threads spin."""
    # torch keeps the number of threads for the process, so it is put back.
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
    # The first product is not timed: it starts the threads.
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
