"""Scores of several scenarios: features are computed once, then scored by any number of metrics."""

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
class ScenarioFeatures:
    """The scenario's own part of the metric and the features of its rollouts."""

    log: ScenarioLog
    features: Features


def compute_batch_features(
    scenarios: Sequence[Scenario | ScenarioLog],
    states: Sequence[SimulatedStates],
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> tuple[ScenarioFeatures, ...]:
    """Features of B scenarios with N rollouts each, on the rollouts' device.

    Args:
        scenarios: logged scenarios, or their `scenario_log`.
        states: rollouts of each scenario, N the same for all.
        missing_map: without road edges raise ("error"), or count every agent as on the road ("neutral").
        compute: memory bound.

    Raises:
        DataError: a scenario cannot be scored, or the rollouts' agents are not its simulated agents; there is no
            scenario, or the numbers of scenarios or rollouts differ.
    """
    if len(scenarios) != len(states) or not scenarios:
        raise DataError(f"Scoring needs one set of rollouts per scenario, got {len(states)} for {len(scenarios)}.")
    sizes = sorted({item.num_rollouts for item in states})
    if len(sizes) > 1:
        raise DataError(f"Scenarios scored together need equally many rollouts, got {sizes}: score them one by one.")
    found = []
    for scenario, item in zip(scenarios, states):
        log = scenario
        if isinstance(log, Scenario):
            log = scenario_log(log, item.device, missing_map=missing_map, compute=compute)
        found.append(ScenarioFeatures(log, compute_features(log, item, compute=compute)))
    return tuple(found)


def score_batch_features(features: Sequence[ScenarioFeatures], config: MetricConfig = METRIC_2025) -> RealismResult:
    """Scores of B scenarios whose features are known, stacked: [B], [B, F] and [B, N].

    Args:
        features: as `compute_batch_features` returns them.
        config: the metric's year.
    """
    results = [score_features(item.log, item.features, config) for item in features]
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
    """Scores of B scenarios with N rollouts each, stacked: [B], [B, F] and [B, N].

    Args:
        scenarios: logged scenarios, or their `scenario_log`.
        states: rollouts of each scenario, N the same for all.
        config: the metric's year.
        missing_map: without road edges raise ("error"), or count every agent as on the road ("neutral").
        compute: memory bound.

    Raises:
        DataError: as `compute_batch_features`.
    """
    features = compute_batch_features(scenarios, states, missing_map=missing_map, compute=compute)
    return score_batch_features(features, config)
