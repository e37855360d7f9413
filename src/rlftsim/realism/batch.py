"""Scenarios side by side: measured once, scored by any number of metrics."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch

from rlftsim.errors import DataError
from rlftsim.realism.agents import SimulatedStates
from rlftsim.realism.config import METRIC_2025, MetricConfig
from rlftsim.realism.features import (
    DEFAULT_COMPUTE,
    ComputeConfig,
    Features,
    MissingMap,
    ScenarioLog,
    compute_features,
    scenario_log,
)
from rlftsim.realism.meta_metric import RealismResult, score_features
from rlftsim.scenario.types import Scenario


@dataclass(frozen=True, eq=False)
class Measured:
    """A scenario's own part of the metric, and the features of its rollouts."""

    log: ScenarioLog
    features: Features


def measure_batch(
    scenarios: Sequence[Scenario | ScenarioLog],
    states: Sequence[SimulatedStates],
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> tuple[Measured, ...]:
    """Features of B scenarios with N rollouts each, on the rollouts' device.

    Args:
        scenarios: The recorded scenarios, whose own parts are computed once and remembered, or those parts.
        states: Rollouts of each.
        missing_map: What to do without road edges: "error" or "neutral" (everybody counts as on the road).
        compute: Memory bound.

    Raises:
        DataError: a scenario cannot be scored, or the rollouts' agents are not its simulated agents; there is no scenario, or the
            numbers of scenarios or rollouts differ.
    """
    if len(scenarios) != len(states) or not scenarios:
        raise DataError(f"Scoring needs one set of rollouts per scenario, got {len(states)} for {len(scenarios)}.")
    sizes = sorted({item.num_rollouts for item in states})
    if len(sizes) > 1:
        raise DataError(f"Scenarios scored together need equally many rollouts, got {sizes}: score them one by one.")
    measured = []
    for scenario, item in zip(scenarios, states):
        log = scenario
        if isinstance(log, Scenario):
            log = scenario_log(log, item.device, missing_map=missing_map, compute=compute)
        measured.append(Measured(log, compute_features(log, item, compute=compute)))
    return tuple(measured)


def score_measured(measured: Sequence[Measured], config: MetricConfig = METRIC_2025) -> RealismResult:
    """Scores of B scenarios whose rollouts are measured, stacked: [B], [B, F] and [B, N]."""
    results = [score_features(item.log, item.features, config) for item in measured]
    stacked = {
        field.name: torch.stack([getattr(result, field.name) for result in results])
        for field in fields(RealismResult)
        if field.name not in ("scenario_ids", "config")
    }
    return RealismResult(scenario_ids=tuple(r.scenario_ids[0] for r in results), config=config, **stacked)


def score_batch(
    scenarios: Sequence[Scenario | ScenarioLog],
    states: Sequence[SimulatedStates],
    config: MetricConfig = METRIC_2025,
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> RealismResult:
    """Scores of B scenarios with N rollouts each, stacked: [B], [B, F] and [B, N]. Arguments and errors as `measure_batch`."""
    return score_measured(measure_batch(scenarios, states, missing_map=missing_map, compute=compute), config)
