"""Forecasts of long work on many machines, from its cost on this one."""

import math
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from rich.table import Column, Table

from rlftsim.errors import DataError
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.evaluation.resumable import ScenarioRows
from rlftsim.evaluation.rollout_states import simulate_states
from rlftsim.jobs.progress import progress_bar
from rlftsim.jobs.threads import one_thread
from rlftsim.policies.registry import load_policy
from rlftsim.realism import scenario_log, score
from rlftsim.rollout.policy import frozen_copy
from rlftsim.scenario.batch import collate
from rlftsim.scenario.convert import convert
from rlftsim.scenario.open import open_dataset
from rlftsim.submission.messages import encode_rollouts

Plan = Literal["convert", "evaluate", "submit"]
WOMD_SCENARIOS: dict[Plan, int] = {"convert": 576_000, "evaluate": 44_100, "submit": 44_920}
"""All records of the Waymo Open Motion Dataset, its validation split and its test split."""
WOMD_PIECES: dict[Plan, int] = {"convert": 1_300, "evaluate": 44_100 // ScenarioRows.items_per_file, "submit": 150}
"""Pieces of the work, each done by one core: source files, groups of scenarios, shards."""


@dataclass(frozen=True)
class UnitCost:
    """Processor time of one scenario on one core of this machine."""

    seconds: float
    num_measured: int
    mean_agents: float = math.nan
    """In the scenarios of the data set; not known of files that are to be converted."""
    peak_bytes: int = 0
    """Memory of this process, the largest scenario included; 0 = not measured."""


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
    with progress_bar("measure", len(positions) + 2) as advance, one_thread():
        for position in [positions[0], *positions, int(np.argmax(agents))]:
            start = time.process_time()
            scenario = dataset[position]
            states = simulate_states(policy, collate([scenario]), config)
            if plan == "submit":
                encode_rollouts(scenario.scenario_id, states)
            else:
                score(scenario_log(scenario), states)
            seconds.append(time.process_time() - start)
            advance(1)
    # The first one is done twice: it imports and fills caches, which later ones find. The last is the largest of all.
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return UnitCost(float(np.mean(seconds[1:-1])), len(positions), float(agents.mean()), peak_bytes)


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
    gigabytes = cost.peak_bytes / 1e9
    memory = f"; the largest scenario takes {gigabytes:.2f} GB a core, {cores * gigabytes:.1f} GB a machine"
    memory = memory if cost.peak_bytes else ""
    table = Table(
        *(Column(heading, justify="right") for heading in ("machines", "cores", "time", "price")),
        title=f"{plan}: {total} scenarios of {cost.seconds:.3g} s ({cost.num_measured} measured here{agents})",
        caption=f"at ${price:g} for a core and hour; without reading over a network and starting machines{memory}",
        min_width=76,  # title and caption wrap at the table's width
    )  # fmt: skip
    for machines, num_cores in dict.fromkeys([(1, 1), (1, cores), (nodes, cores)]):
        # until the last core is done, where each takes one piece of the work after another
        seconds = cost.seconds * total / num_items * math.ceil(num_items / (machines * num_cores))
        dollars = cost.seconds * total / 3600 * price
        table.add_row(f"{machines}", f"{machines * num_cores}", _duration(seconds), f"${dollars:.2f}")
    return table


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 2 * 3600 else f"{seconds / 3600:.1f} h"
