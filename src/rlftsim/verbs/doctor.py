"""`rlftsim doctor`: checks of the machine, and forecasts of long work."""

import inspect
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import torch
from rich.table import Table
from rich.text import Text

from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import print_wide
from rlftsim.scenario.inspect import verify_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.verbs.forecast import TrainingCommand, forecast_training, training_table
from rlftsim.verbs.plan import Plan, measure_cost, plan_table

GOOD, WARNING, BAD = "good", "warning", "bad"
MIN_FREE_GB = 2.0


Diagnosis = tuple[str, str, str]
"""Subject of a check, state, and finding."""


def doctor(
    plan: Plan | Literal["finetune", "pretrain"] | None = None,
    model: str | None = None,
    data: str = "synthetic",
    recipe: str | None = None,
    vocabulary: str | None = None,
    config: str | None = None,
    method: str | None = None,
    measure: int = 5,
    num_scenarios: int | None = None,
    nodes: int = 1,
    cores: int = 16,
    price: float = 0.04,
) -> int:
    """Check this machine: versions, threads, GPU, SUMO, environments, disk, the embedded scenarios.

    Prints what to do about each problem. With --plan: measure how long work would take, how much memory, and on many
    machines what it would cost. The exit status is 1 if a check failed.

    Args:
        plan: Forecast this work instead: finetune or pretrain on these data and this machine, the others for the Waymo
            Open Motion Dataset, from their cost on this machine.
        model: Run, model folder or registered name to measure; left out, demo-base, or fresh weights to pretrain.
        data: Data set to measure on, with --plan; for convert, files to convert (all of them are).
        recipe: Recipe of the training, with --plan finetune or pretrain.
        vocabulary: Vocabulary of the training, with --plan pretrain.
        config: File of settings of the training, with --plan finetune or pretrain.
        method: Method of fine-tuning, such as rlft, with --plan finetune; left out, the recipe's.
        measure: Number of scenarios to measure, of all sizes; with --plan finetune or pretrain of updates.
        num_scenarios: Scenarios of the whole work, with --plan. Left out: 576000 to convert, 44100 to evaluate, 44920
            to submit.
        nodes: Number of machines that share the work, with --plan.
        cores: Number of cores of each machine, with --plan.
        price: Price of a core for an hour, in dollars, with --plan.
    """
    options = {name: value for name, value in locals().items() if name != "plan"}
    if plan == "finetune" or plan == "pretrain":
        if recipe is None:
            raise ConfigError(f"--plan {plan} needs the recipe of the training: add --recipe, such as smart-demo.")
        model = model or ("demo-base" if plan == "finetune" else None)
        training = TrainingCommand(plan, recipe, model, data, vocabulary, config, method)
        print_wide(training_table(training, forecast_training(training, measure)))
        return 0
    if plan is not None:
        cost = measure_cost(plan, model or "demo-base", data, measure)
        print_wide(plan_table(plan, cost, num_scenarios=num_scenarios, nodes=nodes, cores=cores, price=price))
        return 0
    for name, value in options.items():
        if value != inspect.signature(doctor).parameters[name].default:
            flag = f"--{name.replace('_', '-')}"
            raise ConfigError(f"{flag} has no effect: add --plan evaluate, convert, submit, finetune or pretrain.")
    diagnoses = [*_versions(), _threads(), _gpu(), _sumo(), _environments(), _disk(), _pack()]
    table = Table(show_header=False)
    color = {GOOD: "green", WARNING: "yellow", BAD: "red"}
    for subject, state, finding in diagnoses:
        table.add_row(subject, Text(state, style=color[state]), finding)
    print_wide(table)
    return int(any(state == BAD for _, state, _ in diagnoses))


def _versions() -> Iterator[Diagnosis]:
    """Python and torch, each with the oldest version that will do."""
    checks = (("Python", platform.python_version(), (3, 11)), ("torch", torch.__version__, (2, 10)))
    for software, text, oldest in checks:
        is_new = tuple(int(digits) for digits in text.split("+")[0].split(".")[:2]) >= oldest
        finding = text if is_new else f"{text}: needs {oldest[0]}.{oldest[1]} or newer"
        yield software, GOOD if is_new else BAD, finding


def _threads() -> Diagnosis:
    """Compare two threads with one. Where two are slower, cores are shared and waiting threads spin."""
    # torch keeps the number of threads for the process, so it is put back.
    num_threads = torch.get_num_threads()
    seconds = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        seconds.append(measure_work())
    torch.set_num_threads(num_threads)
    finding = f"{os.cpu_count()} cores, 2 threads take {seconds[1] / seconds[0]:.1f} times as long as 1"
    if seconds[1] <= 1.5 * seconds[0]:
        return "threads", GOOD, finding
    is_passive = os.environ.get("OMP_WAIT_POLICY", "").upper() == "PASSIVE"
    way_out = "set OMP_NUM_THREADS=1" if is_passive else "set OMP_WAIT_POLICY=PASSIVE, or OMP_NUM_THREADS=1"
    return "threads", WARNING, f"{finding}: {way_out}"


def measure_work() -> float:
    """Seconds of some matrix products in as many threads as torch has."""
    # The first product is not timed: it starts the threads.
    x, w = torch.rand(4096, 64), torch.rand(64, 64)
    torch.relu(x @ w)
    start = time.perf_counter()
    for _ in range(200):
        torch.relu(x @ w).sum()
    return time.perf_counter() - start


def _gpu() -> Diagnosis:
    if not torch.cuda.is_available():
        return "GPU", WARNING, "none: the demo runs on the CPU, training on WOMD wants one"
    return "GPU", GOOD, torch.cuda.get_device_name()


def _sumo() -> Diagnosis:
    try:
        return "SUMO", GOOD, version("eclipse-sumo")
    except PackageNotFoundError:
        hint = 'not installed: `rlftsim synthesize` and traffic by SUMO need it (pip install "rlftsim[synthetic]")'
        return "SUMO", WARNING, hint


def _environments() -> Diagnosis:
    missing = [package for package in ("gymnasium", "pettingzoo") if find_spec(package) is None]
    if missing:
        hint = f"{' and '.join(missing)} not installed: `rlftsim drive`, `failures` and `rlftsim.envs` need them"
        return "environments", WARNING, f'{hint} (pip install "rlftsim[env]")'
    return "environments", GOOD, f"gymnasium {version('gymnasium')}, pettingzoo {version('pettingzoo')}"


def _disk() -> Diagnosis:
    folders = (Path.cwd(), Path(tempfile.gettempdir()))
    for folder in folders:
        if not os.access(folder, os.W_OK):
            return "disk", WARNING, f"{folder} cannot be written to: work in another folder"
    free = {str(folder): shutil.disk_usage(folder).free / 1e9 for folder in folders}
    finding = ", ".join(f"{gigabytes:.1f} GB free in {folder}" for folder, gigabytes in free.items())
    return "disk", GOOD if min(free.values()) >= MIN_FREE_GB else WARNING, finding


def _pack() -> Diagnosis:
    damaged = [finding for finding in verify_dataset(pack_path()) if finding.problem.is_damage]
    if damaged:
        return "synthetic scenarios", BAD, f"{damaged[0]}: install rlftsim again"
    return "synthetic scenarios", GOOD, "whole"
