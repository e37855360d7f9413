"""Scores of several scenarios: features are computed once, then scored by any number of metrics.

A CPU measures one scenario after the other, which stay in its cache. A device measures all of them side by side, so
that what the host asks of it does not grow with their number.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch

from rlftsim.errors import DataError
from rlftsim.realism.agents import SimulatedStates
from rlftsim.realism.config import METRIC_2025, MetricConfig
from rlftsim.realism.features import (
    DEFAULT_COMPUTE,
    AnyLog,
    ComputeConfig,
    Features,
    JoinedLogs,
    MissingMap,
    ScenarioLog,
    compute_features,
    compute_joined_features,
    scenario_log,
)
from rlftsim.realism.meta_metric import RealismResult, score_features
from rlftsim.scenario.types import Scenario


@dataclass(frozen=True, eq=False)
class ScenarioFeatures:
    """The own part of a scenario, or of several side by side, and the features of their rollouts."""

    log: AnyLog
    features: Features


def compute_batch_features(
    scenarios: Sequence[Scenario | ScenarioLog],
    states: Sequence[SimulatedStates],
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> tuple[ScenarioFeatures, ...]:
    """Features of B scenarios with N rollouts each, on the rollouts' device: one entry each, or one of all.

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
    logs = [
        scenario_log(scenario, item.device, missing_map=missing_map, compute=compute)
        if isinstance(scenario, Scenario)
        else scenario
        for scenario, item in zip(scenarios, states)
    ]
    # Side by side all have the same number of distinct rollouts.
    can_join = len({item.repeat for item in states}) == 1
    if can_join and states[0].device.type != "cpu":
        joined = JoinedLogs.of(logs)
        return (ScenarioFeatures(joined, compute_joined_features(joined, states, compute=compute)),)
    return tuple(ScenarioFeatures(log, compute_features(log, item, compute=compute)) for log, item in zip(logs, states))


def score_batch_features(features: Sequence[ScenarioFeatures], config: MetricConfig = METRIC_2025) -> RealismResult:
    """Scores of B scenarios whose features are known, stacked: [B], [B, F] and [B, N].

    Args:
        features: as `compute_batch_features` returns them.
        config: the metric's year.
    """
    results = [score_features(item.log, item.features, config) for item in features]
    if isinstance(features[0].log, JoinedLogs):
        return results[0]
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
