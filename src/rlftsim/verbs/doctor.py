"""`rlftsim doctor`: checks of the machine, and forecasts of long work on many machines, from its cost on this one."""

import inspect
import math
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from rich.table import Column, Table
from rich.text import Text

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.evaluate import EvaluateConfig, simulate_states
from rlftsim.evaluation.resumable import ScenarioRows
from rlftsim.jobs.progress import print_wide, progress_bar
from rlftsim.jobs.threads import one_thread
from rlftsim.policies.registry import load_policy
from rlftsim.realism import scenario_log, score
from rlftsim.rollout.policy import frozen_copy, get_device
from rlftsim.scenario.batch import collate
from rlftsim.scenario.convert import convert
from rlftsim.scenario.inspect import verify_dataset
from rlftsim.scenario.open import open_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.submission.messages import encode_rollouts

Plan = Literal["convert", "evaluate", "submit"]
WOMD_SCENARIOS: dict[Plan, int] = {"convert": 576_000, "evaluate": 44_100, "submit": 44_920}
"""All records of the Waymo Open Motion Dataset, its validation split and its test split."""
WOMD_PIECES: dict[Plan, int] = {"convert": 1_300, "evaluate": 44_100 // ScenarioRows.items_per_file, "submit": 150}
"""Pieces of the work, each done by one core: source files, groups of scenarios, shards."""
GOOD, WARNING, BAD = "good", "warning", "bad"
MIN_FREE_GB = 2.0


@dataclass(frozen=True)
class Diagnosis:
    """Result of one check."""

    subject: str
    state: str
    finding: str


def doctor(
    plan: Plan | None = None,
    model: str = "demo-base",
    data: str = "synthetic",
    measure: int = 5,
    num_scenarios: int | None = None,
    nodes: int = 1,
    cores: int = 16,
    price: float = 0.04,
) -> int:
    """Check this machine: versions, threads, GPU, disk, the embedded scenarios.

    Prints what to do about each problem. With --plan: measure how long work on many machines would take, and what it
    would cost. The exit status is 1 if a check failed.

    Args:
        plan: Forecast this work for the Waymo Open Motion Dataset instead, from its cost on this machine.
        model: Run, model folder or registered name to measure, with --plan evaluate or submit.
        data: Data set to measure on, with --plan; for convert, files to convert (all of them are).
        measure: Number of scenarios to measure, of all sizes, with --plan evaluate or submit.
        num_scenarios: Scenarios of the whole work, with --plan. Left out: 576000 to convert, 44100 to evaluate, 44920
            to submit.
        nodes: Number of machines that share the work, with --plan.
        cores: Number of cores of each machine, with --plan.
        price: Price of a core for an hour, in dollars, with --plan.
    """
    options = {name: value for name, value in locals().items() if name != "plan"}
    if plan is not None:
        cost = measure_cost(plan, model, data, measure)
        print_wide(plan_table(plan, cost, num_scenarios=num_scenarios, nodes=nodes, cores=cores, price=price))
        return 0
    for name, value in options.items():
        if value != inspect.signature(doctor).parameters[name].default:
            flag = f"--{name.replace('_', '-')}"
            raise ConfigError(f"{flag} has no effect: add --plan evaluate, convert or submit.")
    diagnoses = [*_versions(), _threads(), _gpu(), _sumo(), _disk(), _pack()]
    table = Table(show_header=False)
    color = {GOOD: "green", WARNING: "yellow", BAD: "red"}
    for diagnosis in diagnoses:
        table.add_row(diagnosis.subject, Text(diagnosis.state, style=color[diagnosis.state]), diagnosis.finding)
    print_wide(table)
    return int(any(diagnosis.state == BAD for diagnosis in diagnoses))


def _versions() -> Iterator[Diagnosis]:
    """Python and torch, each with the oldest version that will do."""
    for software, version_text, oldest in (
        ("Python", platform.python_version(), (3, 11)),
        ("torch", torch.__version__, (2, 10)),
    ):
        number = tuple(int(digits) for digits in version_text.split("+")[0].split(".")[:2])
        if number >= oldest:
            yield Diagnosis(software, GOOD, version_text)
        else:
            yield Diagnosis(software, BAD, f"{version_text}: needs {oldest[0]}.{oldest[1]} or newer")


def _threads() -> Diagnosis:
    """Compare two threads with one. Where two are slower, cores are shared and waiting threads spin."""
    # torch keeps the number of threads for the process, so it is put back.
    num_threads = torch.get_num_threads()
    seconds = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        seconds.append(_seconds_of_work())
    torch.set_num_threads(num_threads)
    finding = f"{os.cpu_count()} cores, 2 threads take {seconds[1] / seconds[0]:.1f} times as long as 1"
    if seconds[1] > 1.5 * seconds[0]:
        policy = os.environ.get("OMP_WAIT_POLICY", "not set")
        return Diagnosis(
            "threads", WARNING, f"{finding}: OMP_WAIT_POLICY is {policy}, set it to PASSIVE or use 1 thread"
        )
    return Diagnosis("threads", GOOD, finding)


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
    damaged = [finding for finding in verify_dataset(pack_path()) if finding.problem.is_damage]
    if damaged:
        return Diagnosis("synthetic scenarios", BAD, f"{damaged[0]}: install rlftsim again")
    return Diagnosis("synthetic scenarios", GOOD, "whole")


@dataclass(frozen=True)
class UnitCost:
    """Processor time of one scenario on one core of this machine."""

    seconds: float
    num_measured: int
    mean_agents: float = math.nan
    """In the scenarios of the data set; not known of files that are to be converted."""


def measure_cost(plan: Plan, model: str, data: str, num_measured: int) -> UnitCost:
    """Do the work on a few scenarios and measure the processor time.

    The scenarios are those in the middle of bins of equal size by number of agents, so their mean cost is near that of
    the whole data set.

    Args:
        plan: Kind of work.
        model: Model as the command line names it; for "evaluate" and "submit" alone.
        data: Data set; for "convert" the tfrecord files or other sources, of which everything is converted.
        num_measured: Number of scenarios to measure.
    """
    if plan == "convert":
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            report = convert(data, Path(folder) / "data", jobs=1)
            if not report.converted:
                raise DataError(f"{data}: no scenario could be converted, so there is no cost to plan with.")
            return UnitCost((time.process_time() - start) / report.converted, report.converted)
    dataset = open_dataset(data, cache_size=2)
    agents = dataset.num_agents
    bins = np.array_split(np.argsort(agents, kind="stable"), min(num_measured, len(dataset)))
    positions = [int(members[len(members) // 2]) for members in bins]
    policy, config = frozen_copy(load_policy(model, "cpu")), EvaluateConfig()
    seconds = []
    with progress_bar("measure", len(positions) + 1) as advance, one_thread():
        for position in [positions[0], *positions]:
            start = time.process_time()
            scenario = dataset[position]
            states = simulate_states(policy, collate([scenario]).to(get_device(policy)), config)
            if plan == "submit":
                encode_rollouts(scenario.scenario_id, states)
            else:
                score(scenario_log(scenario), states)
            seconds.append(time.process_time() - start)
            advance(1)
    # The first one is done twice: it imports and fills caches, which later ones find.
    return UnitCost(float(np.mean(seconds[1:])), len(positions), float(agents.mean()))


def forecast_s(seconds: float, num_scenarios: int, num_items: int, num_cores: int) -> float:
    """Time until the last core is done, where each takes one piece of the work after another.

    Args:
        seconds: Processor time of one scenario on one core.
        num_scenarios: Number of scenarios in all.
        num_items: Number of pieces of the work; the scenarios are spread evenly over them.
        num_cores: Cores at work at the same time.
    """
    rounds = math.ceil(num_items / num_cores)
    return seconds * num_scenarios / num_items * rounds


def plan_table(plan: Plan, cost: UnitCost, *, num_scenarios: int | None, nodes: int, cores: int, price: float) -> Table:
    """Time and price on one core, one machine and all machines.

    Args:
        plan: Kind of work.
        cost: Cost of a scenario.
        num_scenarios: Number of scenarios in all; None = those of the Waymo Open Motion Dataset.
        nodes: Number of machines.
        cores: Cores of a machine.
        price: Price of a core for an hour, in dollars.
    """
    total = num_scenarios or WOMD_SCENARIOS[plan]
    num_items = max(round(WOMD_PIECES[plan] * total / WOMD_SCENARIOS[plan]), 1)
    agents = "" if math.isnan(cost.mean_agents) else f", {cost.mean_agents:.0f} agents on average"
    table = Table(
        *(Column(heading, justify="right") for heading in ("machines", "cores", "time", "price")),
        title=f"{plan}: {total} scenarios of {cost.seconds:.3g} s ({cost.num_measured} measured here{agents})",
        caption=f"at ${price:g} for a core and hour; without reading over a network and starting machines",
        title_justify="left", caption_justify="left",
    )  # fmt: skip
    for machines, num_cores in dict.fromkeys([(1, 1), (1, cores), (nodes, cores)]):
        seconds = forecast_s(cost.seconds, total, num_items, machines * num_cores)
        dollars = cost.seconds * total / 3600 * price
        table.add_row(f"{machines}", f"{machines * num_cores}", _duration(seconds), f"${dollars:.2f}")
    return table


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 2 * 3600 else f"{seconds / 3600:.1f} h"
