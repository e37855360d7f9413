"""Closed-loop realism of a model in training, and the use of the map, on scenarios held out of training.

Validation draws from no random generator that the training uses, so a run ends with the same bits with and without.
"""

import copy
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from rlftsim.errors import ConfigError, check_not_negative, check_positive, check_types, given
from rlftsim.realism import metric_by_name, score_batch
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.policy import Policy, Sampling
from rlftsim.rollout.simulate import check_sampling, simulate
from rlftsim.scenario.types import Scenarios
from rlftsim.training.data import batch_with_futures
from rlftsim.training.map_use import MapUse, measure_map_use, predicts_tokens
from rlftsim.training.parallel import Fabric, all_reduce_sum

WATCHED = {
    "validation_rmm": "meta_metric",
    "validation_kinematic": "kinematic",
    "validation_interactive": "interactive",
    "validation_map_based": "map_based",
    "validation_min_ade_m": "min_average_displacement_error",
    "validation_unlogged_offroad_rate": "unlogged_offroad_rate",
}
"""Logged metric -> field of `RealismResult`."""


@dataclass(frozen=True)
class ValidationConfig:
    """Validation of a model in training."""

    every: int = 0
    """Updates between two validations; there is one at the end, too. 0 = never."""
    num_scenarios: int = 64
    """A fixed random choice of the held-out scenarios; all if there are fewer."""
    num_rollouts: int = 8
    """Of each scenario. Fewer rollouts score lower: compare with an evaluation of the same number only."""
    scenarios_per_pass: int = 4
    """Simulated at once; fewer need less memory, the result is the same."""
    top_k: int | None = None
    """Sample among so many of the most likely decisions, as models trained with label smoothing need it; None = all."""
    metric: str = "2025"
    """Configuration of the meta-metric."""
    seed: int = 0
    """Of the choice and of the rollouts, the same at every validation."""
    keep_best: bool = False
    """The model of the run is that of the best validation: of the highest lower bound (95 %, one-sided) of its gain in
    RMM over the start, scenario by scenario. False = the model of the last update."""

    def __post_init__(self) -> None:
        check_types(self)
        if self.every < 0:
            raise ConfigError(f"validation.every must be 0 (never) or more updates, got {self.every}.")
        check_positive(self, ("num_scenarios", "num_rollouts", "scenarios_per_pass", *given(self, ("top_k",))))
        check_not_negative(self, ("seed",))
        metric_by_name(self.metric)

    def is_due(self, update: int, total: int) -> bool:
        """True where a validation follows an update.

        Args:
            update: Number of updates done.
            total: Number of updates of the run.
        """
        return self.every > 0 and (update % self.every == 0 or update == total)

    def choose(self, num_scenarios: int) -> list[int]:
        """Positions of the scenarios to validate on."""
        order = np.random.default_rng(self.seed).permutation(num_scenarios)
        return sorted(order[: self.num_scenarios].tolist())


def check_validation(model: object, scenarios: Scenarios, config: ValidationConfig) -> None:
    """Refuse before a run any cause that would end the run at the first validation.

    Args:
        model: Model in training, of which a copy simulates.
        scenarios: Held-out scenarios, at least one.
        config: Settings of the validation, of which sampling is tried.

    Raises:
        ConfigError: the model cannot simulate, or not with this sampling, or there is no scenario.
    """
    if not isinstance(model, Policy):
        raise ConfigError(f"{type(model).__name__} cannot simulate, so it cannot be validated: set validation.every=0.")
    if not len(scenarios):
        raise ConfigError("no scenario to validate on: name another split, or set validation.every=0.")
    if config.top_k is not None:
        frozen: Any = copy.deepcopy(model).eval() if isinstance(model, nn.Module) else model
        check_sampling(frozen, scenarios, Sampling(top_k=config.top_k))


class Validator:
    """Validations of a run, each on the same scenarios with the same dice.

    Args:
        scenarios: Held-out scenarios to select from, with futures.
        config: Number and choice of scenarios and rollouts.
        fabric: Processes of the run, which divide the scenarios.
        start: Policy at the start of the run, to which gains refer; None = no gains are logged.

    Raises:
        DataError: A scenario withholds its future.
    """

    def __init__(self, scenarios: Scenarios, config: ValidationConfig, fabric: Fabric, start: nn.Module | None = None):
        self._scenarios, self.config, self._fabric = scenarios, config, fabric
        clusters = getattr(scenarios, "clusters", np.arange(len(scenarios)))  # lists of scenarios name none
        self._clusters = np.array(clusters)[config.choose(len(scenarios))]
        self._start = None if start is None else validate(start, scenarios, config, fabric)[1]

    def validate(self, model: nn.Module) -> dict[str, float]:
        """Metrics of a model, see `validate`; with the gain in RMM over the start, and the lower bound of the gain.

        Args:
            model: Policy in training; left unchanged.
        """
        from rlftsim.statistics import cluster_bootstrap, mean_interval  # as in `validate`

        values, rmm = validate(model, self._scenarios, self.config, self._fabric)
        if self._start is not None:
            gains = rmm - self._start
            gain = mean_interval(gains, alpha=0.1)
            if 1 < len(set(self._clusters)) < len(gains):
                gain = cluster_bootstrap(gains, self._clusters, level=0.9)
            values |= {"validation_gain": gain.mean, "validation_gain_low": gain.interval[0]}
        return values


@torch.no_grad()
def validate(
    model: nn.Module, scenarios: Scenarios, config: ValidationConfig, fabric: Fabric
) -> tuple[dict[str, float], Float[np.ndarray, "n"]]:
    """Mean realism of a model's rollouts, and the use of the map; each process takes a part of the scenarios.

    Args:
        model: Policy; left unchanged, training mode included.
        scenarios: Held-out scenarios to select from, with futures.
        config: Number and choice of scenarios and rollouts.
        fabric: Processes of the run, over which sums are added.

    Returns:
        1. Means over scenarios (`WATCHED`), the 95 % interval of the meta-metric's mean (Student's t), for a model that
           predicts tokens the loss and map use on vehicles (`training.map_use`), and the seconds taken.
        2. Meta-metric of each selected scenario; NaN where undefined.

    Raises:
        DataError: A scenario withholds the future.
    """
    from rlftsim.statistics import interval_around  # scipy.stats: half a second that configurations need not pay

    start = time.perf_counter()
    # A copy, so that neither the mode nor a cache of the model in training changes.
    frozen: Any = copy.deepcopy(model).eval().requires_grad_(False)
    # Dealt out in turn: the same scenarios in total for any number of processes.
    choice = config.choose(len(scenarios))
    selected = choice[fabric.global_rank :: fabric.world_size]
    rmm = torch.zeros(len(choice), dtype=torch.float64, device=fabric.device)
    positions = torch.arange(len(choice), device=fabric.device)[fabric.global_rank :: fabric.world_size]
    sums = torch.zeros(3, len(WATCHED), dtype=torch.float64, device=fabric.device)  # count, sum, sum of squares
    map_use = MapUse.zero(fabric.device) if predicts_tokens(frozen) else None
    for first in range(0, len(selected), config.scenarios_per_pass):
        batch = batch_with_futures(scenarios, selected[first : first + config.scenarios_per_pass]).to(fabric.device)
        with fabric.autocast():
            rollouts = simulate(
                frozen, batch, num_rollouts=config.num_rollouts, seed=config.seed, sampling=Sampling(top_k=config.top_k)
            )
            if map_use is not None:
                map_use += measure_map_use(frozen, batch)
        states = states_of_rollouts(batch, rollouts)
        realism = score_batch(batch.scenarios, states, metric_by_name(config.metric), missing_map="neutral")
        values = torch.stack([getattr(realism, name).double() for name in WATCHED.values()], -1)  # [B, metrics]
        rmm[positions[first : first + config.scenarios_per_pass]] = values[:, 0]
        # A scenario may have no finite value of a metric: it is left out of that mean.
        finite = values.isfinite()
        values = torch.where(finite, values, 0.0)
        sums += torch.stack([finite.double(), values, values.square()]).sum(1)
    count, total, squares = all_reduce_sum(sums, fabric)  # [metrics] each
    mean = total / count
    # Standard error of the mean from sums, which can be added over processes; rounding may make it negative.
    error = ((squares - count * mean.square()).clamp(min=0) / (count - 1) / count).sqrt()
    low, high = interval_around(float(mean[0]), float(error[0]), int(count[0])).interval
    logged = dict(zip(WATCHED, mean.tolist())) | {"validation_rmm_low": low, "validation_rmm_high": high}
    if map_use is not None:
        logged |= MapUse(all_reduce_sum(map_use.sums, fabric)).to_metrics("validation_")
    rmm = all_reduce_sum(rmm, fabric).cpu().numpy()
    return {**logged, "seconds_validation": time.perf_counter() - start}, rmm
