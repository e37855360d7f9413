"""The realism meta-metric of N rollouts, of N - 1 rollouts without each in turn, and of each rollout alone.

Source: Waymo Open Sim Agents Challenge; RLFTSim, equation 1. The rewards of RLFTSim (equation 2) are made of the
leave-one-out and single-rollout values, which cost a single reduction over per-rollout counts.

Of several scenarios features are computed once, then scored by any number of metrics. A CPU measures scenarios one by
one, which stay in the CPU's cache. A device measures all scenarios side by side, so that the host's requests do not
grow with the number of scenarios.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError, DataError
from rlftsim.realism.agents import SimulatedStates, mean_over_agents, sum_over_agents
from rlftsim.realism.config import (
    FEATURE_NAMES,
    METRIC_2025,
    SUB_SCORES,
    MetricConfig,
    official_buckets,
    official_fields,
)
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
from rlftsim.realism.likelihood import RolloutCounts, compute_likelihoods, count_rollouts, histogram_table, log_target
from rlftsim.scenario.types import Scenario


@dataclass(frozen=True, eq=False)
class RealismResult:
    """Scores of a single scenario (no leading axis) or of several (leading axis B).

    Likelihoods and meta-metrics: higher is better. N counts repeated rollouts too.
    """

    scenario_ids: tuple[str, ...]
    config: MetricConfig
    likelihoods: Float[Tensor, "*B F"]
    """In the order of `FEATURE_NAMES`."""
    meta_metric: Float[Tensor, "*B"]
    kinematic: Float[Tensor, "*B"]
    interactive: Float[Tensor, "*B"]
    map_based: Float[Tensor, "*B"]
    average_displacement_error: Float[Tensor, "*B"]
    """Mean over rollouts and evaluated agents, m."""
    min_average_displacement_error: Float[Tensor, "*B"]
    """minADE, m: of the best rollout as a whole; the mean over agents is taken before the minimum."""
    collision_rate: Float[Tensor, "*B"]
    """Fraction of (rollout, evaluated agent) pairs that ever collide in simulation while the log is valid."""
    offroad_rate: Float[Tensor, "*B"]
    unlogged_offroad_rate: Float[Tensor, "*B"]
    """As `offroad_rate`, over the evaluated agents whose log never leaves the road; NaN if there is none."""
    traffic_light_violation_rate: Float[Tensor, "*B"]
    """Over all evaluated agents, while the likelihood counts vehicles only (as officially)."""
    leave_one_out_meta_metric: Float[Tensor, "*B N"]
    """Meta-metric of the other N - 1 rollouts; NaN for N = 1."""
    single_meta_metric: Float[Tensor, "*B N"]
    """Meta-metric of each rollout alone."""
    rollout_displacement_error: Float[Tensor, "*B N"]
    """Mean over evaluated agents, m."""
    rollout_collision_rate: Float[Tensor, "*B N"]
    rollout_offroad_rate: Float[Tensor, "*B N"]
    rollout_traffic_light_violation_rate: Float[Tensor, "*B N"]

    def likelihood(self, feature: str) -> Float[Tensor, "*B"]:
        """Likelihood of a feature of `FEATURE_NAMES`."""
        return self.likelihoods[..., FEATURE_NAMES.index(feature)]

    def find_score(self, name: str) -> Float[Tensor, "*B"]:
        """Field of a name, or the likelihood of a feature for `FEATURE_likelihood`."""
        feature = name.removesuffix("_likelihood")
        return self.likelihood(feature) if feature in FEATURE_NAMES else getattr(self, name)

    def to_official_fields(self) -> list[dict[str, object]]:
        """Plain numbers under the official messages' names, an entry per scenario; sub-scores under `buckets`."""
        fields, buckets = (
            {official_name: self.find_score(name).reshape(-1).tolist() for name, official_name in names.items()}
            for names in (official_fields(self.config), official_buckets(self.config))
        )
        return [
            {
                "scenario_id": scenario_id,
                **{name: column[row] for name, column in fields.items()},
                "buckets": {name: column[row] for name, column in buckets.items()},
            }
            for row, scenario_id in enumerate(self.scenario_ids)
        ]

    def __repr__(self) -> str:
        names = {"RMM": "meta_metric", "kinematic": "kinematic", "interactive": "interactive", "map-based": "map_based"}
        means = " | ".join(f"{label} {float(getattr(self, name).mean()):.3f}" for label, name in names.items())
        count = len(self.scenario_ids)
        return means if count == 1 else f"{means} (mean of {count} scenarios)"


@lru_cache(maxsize=32)
def _score_weights(config: MetricConfig, device: torch.device) -> Float[Tensor, "4 F"]:
    """Weights of the meta-metric and of the three sub-scores. Cached, because a copy to a device takes time."""
    rows = [config.weights, *(config.sub_score_weights(name) for name in SUB_SCORES)]
    return torch.tensor(rows, dtype=torch.float32, device=device)


def _weigh(likelihoods: Float[Tensor, "... F"], weights: Float[Tensor, "... F"]) -> Float[Tensor, "..."]:
    # A feature without weight stays out even where it is NaN (time to collision without any evaluated vehicle).
    return torch.where(weights > 0, likelihoods * weights, 0.0).sum(-1)


def form_sets(counts: RolloutCounts, repeat: int) -> tuple[RolloutCounts, Float[Tensor, "S"]]:
    """Counts and sizes of S = 1 + N + N sets of rollouts: all, all without each rollout in turn, each rollout alone.

    Args:
        counts: Counts of N distinct rollouts.
        repeat: Number of identical rollouts behind each of the N.
    """

    def form(values: Tensor) -> Tensor:
        # Counts are whole numbers below 2^24: sums and differences are exact in float32.
        total = values.sum(0, keepdim=True) * repeat
        return torch.cat([total, total - values, values])

    sets = replace(counts, bins=form(counts.bins), agreement=form(counts.agreement))
    size = counts.bins.new_ones(len(sets.bins))
    size[0] = len(counts.bins) * repeat
    size[1 : len(counts.bins) + 1] = len(counts.bins) * repeat - 1
    return sets, size


def _mean_per_rollout(values: Float[Tensor, "N E"], log: AnyLog, repeat: int) -> Float[Tensor, "*B N_repeat"]:
    """Means over a scenario's evaluated agents."""
    return mean_over_agents(values, log.agents.layout).movedim(0, -1).repeat_interleave(repeat, dim=-1)


def _compute_rate(event: Bool[Tensor, "N E T"], log: AnyLog, repeat: int) -> Float[Tensor, "*B N_repeat"]:
    """Fraction of a rollout's evaluated agents with an event at any step where the log is valid."""
    return _mean_per_rollout((event & log.agents.future_valid).any(-1).to(torch.float32), log, repeat)


def score_features(log: AnyLog, features: Features, config: MetricConfig = METRIC_2025) -> RealismResult:
    """Scores of rollouts from features, which several metrics of the same rollouts share.

    Args:
        log: Logged side of the scenario, or of B scenarios; the scores of several have an axis B.
        features: Features of the N distinct rollouts, from `compute_features`.
        config: Year of the metric: bins, weights and rules.
    """
    if config.challenge != log.agents.challenge:
        raise ConfigError(
            f"metric {config.name} scores {config.challenge.title}: take a metric of {log.agents.challenge.title}, or "
            "`rlftsim evaluate`, which makes the rollouts that its metric wants."
        )
    num_distinct, repeat = len(features.linear_speed), features.repeat
    # 1. Likelihoods of all sets of rollouts at once.
    sets, size = form_sets(count_rollouts(features, log, config), repeat)
    table = histogram_table(config, features.linear_speed.device)
    likelihoods = compute_likelihoods(sets, size, log_target(log, config), table).movedim(1, -1)  # [S, *B, F]
    # 2. Meta-metric of each set; without a rollout there is no score, so leave-one-out values need two.
    weights = _score_weights(config, likelihoods.device)
    rmm = _weigh(likelihoods, weights[0]).movedim(0, -1)  # [*B, S]
    leave_one_out, single = (scores.repeat_interleave(repeat, -1) for scores in rmm[..., 1:].split(num_distinct, -1))
    if num_distinct * repeat == 1:
        leave_one_out = torch.full_like(leave_one_out, torch.nan)
    # 3. Reported beside the metric, for each rollout [*B, N].
    displacement = _mean_per_rollout(features.displacement_error, log, repeat)
    events = ("collision", "offroad", "traffic_light_violation")
    rates = {name: _compute_rate(getattr(features, name), log, repeat) for name in events}
    stays_on_road = ~log.leaves_road  # [E]
    leaves_road = (features.offroad & log.agents.future_valid).any(-1) & stays_on_road  # [N, E]
    num_leaving = sum_over_agents(leaves_road.to(torch.float32), log.agents.layout).sum(0)  # [*B]
    num_staying = sum_over_agents(stays_on_road.to(torch.float32), log.agents.layout)
    return RealismResult(
        tuple(scene.scenario_id for scene in log.logs),
        config,
        likelihoods[0],
        *(_weigh(likelihoods[0], row) for row in weights),  # the meta-metric, then the sub-scores
        average_displacement_error=displacement.mean(-1),
        min_average_displacement_error=displacement.amin(-1),
        **{f"{name}_rate": rate.mean(-1) for name, rate in rates.items()},
        unlogged_offroad_rate=num_leaving / (num_distinct * num_staying),
        leave_one_out_meta_metric=leave_one_out,
        single_meta_metric=single,
        rollout_displacement_error=displacement,
        **{f"rollout_{name}_rate": rate for name, rate in rates.items()},
    )


def score(
    scenario: Scenario | ScenarioLog,
    states: SimulatedStates,
    config: MetricConfig = METRIC_2025,
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> RealismResult:
    """Scores of a scenario's rollouts, on the rollouts' device.

    Args:
        scenario: Scenario with its logged future, or the `scenario_log` of it.
        states: N rollouts of exactly the simulated agents, in any order.
        config: Year of the metric: bins, weights and rules.
        missing_map: Answer to a scenario without road edges: "error" raises, "neutral" counts all agents as on-road.
        compute: Bound on the memory of the computation; changes no result.

    Raises:
        DataError: The scenario cannot be scored, or the agents of the rollouts are not the simulated agents.
    """
    log = scenario_log(scenario, states.device, missing_map=missing_map, compute=compute, challenge=config.challenge)
    return score_features(log, compute_features(log, states, compute=compute), config)


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
    return tuple(ScenarioFeatures(log, compute_features(log, s, compute=compute)) for log, s in zip(logs, states))


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
