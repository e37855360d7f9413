"""Realism in closed loop of a model in training, on scenarios that it is not trained on. Changes nothing that the training sees."""

import copy
import time
from dataclasses import dataclass

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import nn

from rlftsim.errors import ConfigError, given, require_not_negative, require_positive
from rlftsim.intervals import interval_around
from rlftsim.realism import RealismResult, metric_by_name, score_batch
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.policy import Policy, Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.types import Scenarios
from rlftsim.training.data import batch_with_futures
from rlftsim.training.parallel import add_up

WATCHED = {
    "validation_rmm": "meta_metric",
    "validation_kinematic": "kinematic",
    "validation_interactive": "interactive",
    "validation_map_based": "map_based",
    "validation_min_ade_m": "min_average_displacement_error",
}
"""What is logged, by its field of `RealismResult`."""


@dataclass(frozen=True)
class ValidationConfig:
    """When and how a model in training is validated."""

    every: int = 0
    """Updates; also at the end. 0 = never."""
    num_scenarios: int = 64
    """A fixed random choice; all if there are fewer."""
    num_rollouts: int = 8
    """Of each scenario. Fewer rollouts score lower: compare with an evaluation of the same number only."""
    scenarios_per_pass: int = 4
    """Simulated at once; fewer need less memory, the result is the same."""
    top_k: int | None = None
    """Sample among so many of the most likely decisions only, as models trained with label smoothing want it; None = among all."""
    metric: str = "2025"
    """Configuration of the meta-metric."""
    seed: int = 0
    """Of the choice and of the rollouts: the same at every validation."""

    def __post_init__(self) -> None:
        if self.every < 0:
            raise ConfigError(f"validation.every must be 0 (never) or more updates, got {self.every}.")
        require_positive(self, ("num_scenarios", "num_rollouts", "scenarios_per_pass", *given(self, ("top_k",))))
        require_not_negative(self, ("seed",))
        metric_by_name(self.metric)

    def is_due(self, update: int, total: int) -> bool:
        """Whether to validate after this many of all updates."""
        return self.every > 0 and (update % self.every == 0 or update == total)

    def choose(self, num_scenarios: int) -> list[int]:
        """Positions of the scenarios to validate on."""
        order = np.random.default_rng(self.seed).permutation(num_scenarios)
        return sorted(order[: self.num_scenarios].tolist())


def refuse_to_validate(model: object, scenarios: Scenarios) -> None:
    """Say before a run what would end it at its first validation.

    Raises:
        ConfigError: the model cannot simulate, or there is no scenario.
    """
    if not isinstance(model, Policy):
        raise ConfigError(f"{type(model).__name__} cannot simulate, so it cannot be validated: set validation.every=0.")
    if not len(scenarios):
        raise ConfigError("no scenario to validate on: name another split, or set validation.every=0.")


@torch.no_grad()
def validate(model: nn.Module, scenarios: Scenarios, config: ValidationConfig, fabric: Fabric) -> dict[str, float]:
    """Scores of a model's rollouts, each process simulating its part of the scenarios.

    Args:
        model: a policy; it is left as it is, in training mode and all.
        scenarios: to choose from, with their futures.
        config: how many, and which.
        fabric: the processes.

    Returns:
        Means over scenarios (`WATCHED`), the 95 % interval of the meta-metric's mean (Student's t), and the seconds it took.

    Raises:
        DataError: a scenario withholds its future.
    """
    start = time.perf_counter()
    frozen = copy.deepcopy(model).eval().requires_grad_(False)
    own = config.choose(len(scenarios))[fabric.global_rank :: fabric.world_size]
    sums = torch.zeros(3, len(WATCHED), dtype=torch.float64, device=fabric.device)  # count, sum, sum of squares
    for first in range(0, len(own), config.scenarios_per_pass):
        result = _score(frozen, scenarios, own[first : first + config.scenarios_per_pass], config, fabric)
        values = torch.stack([getattr(result, name).double() for name in WATCHED.values()], -1)
        finite = values.isfinite()
        values = torch.where(finite, values, 0.0)
        sums += torch.stack([finite.double(), values, values.square()]).sum(1)
    count, total, squares = add_up(sums, fabric)
    mean = total / count
    error = ((squares - count * mean.square()).clamp(min=0) / (count - 1) / count).sqrt()
    low, high = interval_around(float(mean[0]), float(error[0]), int(count[0])).interval
    logged = dict(zip(WATCHED, mean.tolist())) | {"validation_rmm_low": low, "validation_rmm_high": high}
    return {**logged, "seconds_validation": time.perf_counter() - start}


def _score(
    policy: nn.Module, scenarios: Scenarios, chosen: list[int], config: ValidationConfig, fabric: Fabric
) -> RealismResult:
    """Scores of some scenarios' rollouts. One without a map counts as on the road."""
    batch = batch_with_futures(scenarios, chosen).to(fabric.device)
    with fabric.autocast():
        rollouts = simulate(
            policy,  # type: ignore[arg-type]
            batch,
            num_rollouts=config.num_rollouts,
            seed=config.seed,
            sampling=Sampling(top_k=config.top_k),
        )
    states = states_of_rollouts(batch, rollouts)
    return score_batch(batch.scenarios, states, metric_by_name(config.metric), missing_map="neutral")
