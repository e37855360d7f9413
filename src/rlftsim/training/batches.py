"""Scenarios of an update, spread over processes and cut into pieces that fit into memory.

Losses are sums that are divided by global counts, so this module never changes a gradient, only time and memory.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int64

from rlftsim.errors import DataError
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.shards import AGENT_COLUMNS, compute_index_row
from rlftsim.scenario.types import TOTAL_STEPS, Scenarios

MAP_POINTS_PER_AGENT = 200
"""Map points that need about as much memory as an agent; measured 170 (SMART-nano) and 410 (the demo's model) on real
scenarios."""


def scenario_costs(scenarios: Scenarios) -> Float[np.ndarray, "n"]:
    """Thousands of map points of each scenario, an agent counted as 200: about proportional to memory and time.

    The index of a data set has the counts without a scenario being read; the scenarios of a list are counted here.
    """
    counts = count_columns(scenarios, (*AGENT_COLUMNS, "num_map_points"))
    # Thousands, so that budgets are numbers a person can write.
    return (counts[-1] + MAP_POINTS_PER_AGENT * counts[:-1].sum(0)) / 1000.0


def count_columns(scenarios: Scenarios, columns: Sequence[str]) -> Int64[np.ndarray, "columns n"]:
    """Counts of each scenario by columns of the index, from the index of a data set without a scenario being read.

    Args:
        scenarios: a data set, or scenarios of other types, which are counted here.
        columns: Names in `INDEX_FIELDS` of columns with numbers.
    """
    if isinstance(scenarios, ScenarioDataset):
        return np.array([scenarios.index[name].to_pylist() for name in columns], dtype=np.int64)
    rows = [compute_index_row(scenarios[i], "") for i in range(len(scenarios))]
    return np.array([[row[name] for row in rows] for name in columns], dtype=np.int64)


def check_scored(scenarios: Scenarios) -> None:
    """Check before a run begins that the metric, and so a reward, is defined for each scenario.

    Args:
        scenarios: Training scenarios that a method scores rollouts of.

    Raises:
        DataError: some have no logged future or no evaluated agent; the first is named.
    """
    num_steps, num_evaluated = count_columns(scenarios, ("num_steps", "num_evaluated"))
    unscored = np.flatnonzero((num_steps < TOTAL_STEPS) | (num_evaluated == 0))
    if len(unscored):
        first = scenarios[int(unscored[0])]
        cause = "no evaluated agent" if first.has_future else f"{first.num_steps} logged steps, its future is withheld"
        raise DataError(
            f"scenario {first.scenario_id} has {cause}: no reward is defined for it and {len(unscored) - 1} others of "
            f"{len(scenarios)}: leave them out, or train on the training split."
        )


def balance_by_cost(costs: Sequence[float] | Float[np.ndarray, "n"], num_groups: int) -> list[list[int]]:
    """Greedy load balancing: places of a list, in parts of about equal cost, so that no process waits long.

    The most expensive place goes first, each to the part that is cheapest so far; equal costs are dealt out in turn.

    Args:
        costs: Cost of each item, in any unit.
        num_groups: Number of groups; some stay empty where items are fewer.
    """
    groups: list[list[int]] = [[] for _ in range(num_groups)]
    spent = np.zeros(num_groups)
    # Stable, so that all processes deal alike.
    for index in np.argsort(-np.asarray(costs, float), kind="stable"):
        cheapest = int(spent.argmin())
        groups[cheapest].append(int(index))
        spent[cheapest] += costs[index]
    return [sorted(group) for group in groups]


def micro_batches(
    items: Sequence[int], costs: Float[np.ndarray, "n"], *, max_count: int, max_cost: float | None
) -> list[list[int]]:
    """Scenarios cut into pieces of similar size, the most expensive first, so that running out of memory shows at once.

    Args:
        items: Indices of the scenarios in the data set.
        costs: Costs [n] of all scenarios of the data set, thousands of map points.
        max_count: Scenarios of a batch at most.
        max_cost: Summed cost of a batch at most; a scenario that costs more is a batch alone. None = no limit.
    """
    budget = np.inf if max_cost is None else max_cost
    batches: list[list[int]] = []
    # Sorted by cost, neighbors in this order are alike, and little memory goes to padding.
    for item in sorted(items, key=lambda i: -costs[i]):
        if batches and len(batches[-1]) < max_count and costs[[*batches[-1], item]].sum() <= budget:
            batches[-1].append(item)
        else:
            batches.append([item])
    return batches
