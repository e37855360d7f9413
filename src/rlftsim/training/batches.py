"""How an update's scenarios are spread over processes and cut into pieces that fit into memory.

Losses are sums that are divided by global counts, so nothing here changes a gradient: only how long it takes and what it needs.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.index_row import IndexRow, compute_index_row
from rlftsim.scenario.types import Scenarios

MAP_POINTS_PER_AGENT = 200
"""Map points that need about as much memory as an agent does; measured 170 (SMART-nano) and 410 (the demo's model) on real scenarios."""
COUNTED = ("num_vehicles", "num_pedestrians", "num_cyclists", "num_others")
"""Columns of a data set's index that add up to its simulated agents."""


def scenario_costs(scenarios: Scenarios) -> Float[np.ndarray, "n"]:
    """Thousands of map points of each scenario, an agent counted as 200: memory and time of an update are about proportional to it.

    A data set's index knows them without a scenario being read; the scenarios of a list are looked at.
    """
    columns = (*COUNTED, "num_map_points")
    if isinstance(scenarios, ScenarioDataset):
        counts = np.array([scenarios.index[name].to_pylist() for name in columns])
    else:
        rows: list[IndexRow] = [compute_index_row(scenarios[i], "") for i in range(len(scenarios))]
        counts = np.array([[getattr(row, name) for row in rows] for name in columns])
    return (counts[-1] + MAP_POINTS_PER_AGENT * counts[:-1].sum(0)) / 1000.0


def share_out(costs: Sequence[float] | Float[np.ndarray, "n"], num_shares: int) -> list[list[int]]:
    """Places of a list, shared so that every share costs about the same and none waits long for another.

    The dearest goes first, each to the share that has cost least so far; at equal costs this deals them out in turn.

    Args:
        costs: of each place.
        num_shares: how many shares; some stay empty if there are fewer places.
    """
    shares: list[list[int]] = [[] for _ in range(num_shares)]
    spent = np.zeros(num_shares)
    for place in np.argsort(-np.asarray(costs, float), kind="stable"):
        least = int(spent.argmin())
        shares[least].append(int(place))
        spent[least] += costs[place]
    return [sorted(share) for share in shares]


def micro_batches(
    items: Sequence[int], costs: Float[np.ndarray, "n"], *, max_count: int, max_cost: float | None
) -> list[list[int]]:
    """Scenarios cut into pieces, alike in size and the dearest first, so that what does not fit shows at once.

    Args:
        items: scenario indices.
        costs: of all scenarios.
        max_count: scenarios of a piece at most.
        max_cost: of a piece's scenarios together, at most; one that costs more by itself is a piece of its own. None = any.
    """
    budget = np.inf if max_cost is None else max_cost
    pieces: list[list[int]] = []
    for item in sorted(items, key=lambda i: -costs[i]):
        if pieces and len(pieces[-1]) < max_count and costs[[*pieces[-1], item]].sum() <= budget:
            pieces[-1].append(item)
        else:
            pieces.append([item])
    return pieces
