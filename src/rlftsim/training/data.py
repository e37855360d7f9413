"""Which scenarios an update sees: a function of the seed and the update alone, so that resuming needs nothing else."""

from collections.abc import Sequence

import numpy as np

from rlftsim.errors import DataError
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import Scenarios


def batch_with_futures(scenarios: Scenarios, indices: Sequence[int]) -> ScenarioBatch:
    """Batch of some scenarios.

    Raises:
        DataError: one of them withholds its future, so nothing can be learned from it.
    """
    chosen = [scenarios[i] for i in indices]
    for scenario in chosen:
        if not scenario.has_future:
            raise DataError(
                f"scenario {scenario.scenario_id} records {scenario.num_steps} steps, its future is withheld: "
                "train on the training split."
            )
    return collate(chosen)


def scenarios_of_update(update: int, batch_size: int, num_scenarios: int, seed: int) -> list[int]:
    """Indices of the scenarios of an update: the data set is passed over in a new random order every epoch, nothing is left out.

    Args:
        update: counted from 0.
        batch_size: scenarios per update over all processes.
        num_scenarios: in the data set.
        seed: of the run.
    """
    places = range(update * batch_size, (update + 1) * batch_size)
    orders = {epoch: _order(epoch, num_scenarios, seed) for epoch in {p // num_scenarios for p in places}}
    return [int(orders[p // num_scenarios][p % num_scenarios]) for p in places]


def _order(epoch: int, num_scenarios: int, seed: int) -> np.ndarray:
    return np.random.default_rng(derive_seed(seed, "order", epoch)).permutation(num_scenarios)
