"""Scores of several scenarios: features are computed once, then scored by any number of metrics.

A CPU measures scenarios in turn, which stay in the CPU's cache. A device measures all scenarios side by side, so that
the host's requests do not grow with the number of scenarios.
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
    scenario_log,
)
from rlftsim.realism.meta_metric import RealismResult, score_features
from rlftsim.scenario.types import Scenario


@dataclass(frozen=True, eq=False)
class ScenarioFeatures:
    """Logged side of a scenario, or of several side by side, and the features of the rollouts."""

    log: AnyLog
    features: Features


def compute_batch_features(
    scenarios: Sequence[Scenario | ScenarioLog],
    states: Sequence[SimulatedStates],
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> tuple[ScenarioFeatures, ...]:
    """Features of B scenarios with N rollouts each, on the rollouts' device: an entry per scenario, or a joint entry.

    Args:
        scenarios: B logged scenarios, or the `scenario_log` of each.
        states: Rollouts of each scenario, in the order of the scenarios; N is the same for all.
        missing_map: Answer to a scenario without road edges: "error" raises, "neutral" counts all agents as on-road.
        compute: Bound on the memory of the computation; changes no result.

    Raises:
        DataError: A scenario cannot be scored, or the agents of the rollouts are not the scenario's simulated agents;
            there is no scenario, or the numbers of scenarios or rollouts differ.
    """
    if len(scenarios) != len(states) or not scenarios:
        raise DataError(f"Scoring needs one set of rollouts per scenario, got {len(states)} for {len(scenarios)}.")
    sizes = sorted({rollouts.num_rollouts for rollouts in states})
    if len(sizes) > 1:
        raise DataError(f"Scenarios scored together need equally many rollouts, got {sizes}: score them one by one.")
    logs = [
        scenario_log(scenario, rollouts.device, missing_map=missing_map, compute=compute)
        for scenario, rollouts in zip(scenarios, states)
    ]
    # Side by side all have the same number of distinct rollouts.
    can_join = len({rollouts.repeat for rollouts in states}) == 1
    if can_join and states[0].device.type != "cpu":
        joined_logs = JoinedLogs.from_logs(logs)
        return (ScenarioFeatures(joined_logs, compute_features(joined_logs, states, compute=compute)),)
    return tuple(
        ScenarioFeatures(log, compute_features(log, rollouts, compute=compute)) for log, rollouts in zip(logs, states)
    )


def score_batch_features(features: Sequence[ScenarioFeatures], config: MetricConfig = METRIC_2025) -> RealismResult:
    """Scores of B scenarios from features, stacked: [B], [B, F] and [B, N].

    Args:
        features: Features of all scenarios, from `compute_batch_features`.
        config: Year of the metric: bins, weights and rules.
    """
    results = [score_features(scene.log, scene.features, config) for scene in features]
    if isinstance(features[0].log, JoinedLogs):
        return results[0]
    columns = {
        field.name: torch.stack([getattr(result, field.name) for result in results])
        for field in fields(RealismResult)
        if field.name not in ("scenario_ids", "config")
    }
    return RealismResult(scenario_ids=tuple(r.scenario_ids[0] for r in results), config=config, **columns)


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
        scenarios: B logged scenarios, or the `scenario_log` of each.
        states: Rollouts of each scenario, in the order of the scenarios; N is the same for all.
        config: Year of the metric: bins, weights and rules.
        missing_map: Answer to a scenario without road edges: "error" raises, "neutral" counts all agents as on-road.
        compute: Bound on the memory of the computation; changes no result.

    Raises:
        DataError: The same causes as in `compute_batch_features`.
    """
    features = compute_batch_features(scenarios, states, missing_map=missing_map, compute=compute)
    return score_batch_features(features, config)
