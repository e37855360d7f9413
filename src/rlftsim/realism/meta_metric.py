"""The realism meta-metric of rollouts, of all but one of them, and of each alone.

Source: Waymo Open Sim Agents Challenge; RLFTSim, equation 1. The rewards of RLFTSim (equation 2) are made of the
leave-one-out and single-rollout values, which cost one reduction over per-rollout counts.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.realism.agents import SimulatedStates, mean_over_agents, sum_over_agents
from rlftsim.realism.config import FEATURE_NAMES, METRIC_2025, SUB_SCORES, MetricConfig
from rlftsim.realism.features import (
    DEFAULT_COMPUTE,
    AnyLog,
    ComputeConfig,
    Features,
    MissingMap,
    ScenarioLog,
    compute_features,
    scenario_log,
)
from rlftsim.realism.likelihood import RolloutCounts, compute_likelihoods, count_rollouts, histogram_table, log_target
from rlftsim.realism.official_names import official_buckets, official_fields
from rlftsim.scenario.types import Scenario


@dataclass(frozen=True, eq=False)
class RealismResult:
    """Scores of one scenario (no leading axis) or of several (leading axis B).

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
        """Likelihood of one feature of `FEATURE_NAMES`."""
        return self.likelihoods[..., FEATURE_NAMES.index(feature)]

    def score_of(self, name: str) -> Float[Tensor, "*B"]:
        """A field by its name, or a feature's likelihood by `FEATURE_likelihood`."""
        feature = name.removesuffix("_likelihood")
        return self.likelihood(feature) if feature in FEATURE_NAMES else getattr(self, name)

    def to_official_fields(self) -> list[dict[str, object]]:
        """Plain numbers under the official messages' names, an entry per scenario; sub-scores under `buckets`."""
        fields, buckets = (
            {official: self.score_of(ours).reshape(-1).tolist() for ours, official in names.items()}
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
        means = " | ".join(f"{shown} {float(getattr(self, name).mean()):.3f}" for shown, name in names.items())
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
    """Counts and sizes of S = 1 + N + N sets of rollouts: all, all but each one, each one alone.

    Args:
        counts: of N distinct rollouts.
        repeat: number of identical rollouts that each represents.
    """
    num_rollouts = len(counts.bins) * repeat
    # Counts are whole numbers below 2^24: sums and differences are exact in float32.
    all_bins = counts.bins.sum(0, keepdim=True) * repeat
    all_agreement = counts.agreement.sum(0, keepdim=True) * repeat
    sets = RolloutCounts(
        bins=torch.cat([all_bins, all_bins - counts.bins, counts.bins]),
        agreement=torch.cat([all_agreement, all_agreement - counts.agreement, counts.agreement]),
        num_steps=counts.num_steps,
    )
    size = counts.bins.new_ones(len(sets.bins))
    size[:1] = num_rollouts
    size[1 : len(counts.bins) + 1] = num_rollouts - 1
    return sets, size


def _mean_per_rollout(values: Float[Tensor, "N E"], log: AnyLog, repeat: int) -> Float[Tensor, "*B N_repeat"]:
    """Means over a scenario's evaluated agents."""
    return mean_over_agents(values, log.agents.layout).movedim(0, -1).repeat_interleave(repeat, dim=-1)


def _any_rate(event: Bool[Tensor, "N E T"], log: AnyLog, repeat: int) -> Float[Tensor, "*B N_repeat"]:
    """Fraction of a rollout's evaluated agents with an event at any step where the log is valid."""
    return _mean_per_rollout((event & log.agents.future_valid).any(-1).to(torch.float32), log, repeat)


def score_features(log: AnyLog, features: Features, config: MetricConfig = METRIC_2025) -> RealismResult:
    """Scores of rollouts from their features, which several metrics of the same rollouts share.

    Args:
        log: the scenario's own part, or those of B scenarios; their scores have an axis B.
        features: of its rollouts.
        config: the metric's year.
    """
    distinct, repeat = len(features.linear_speed), features.repeat
    # 1. Likelihoods of all sets of rollouts at once.
    sets, size = form_sets(count_rollouts(features, log, config), repeat)
    table = histogram_table(config, features.linear_speed.device)
    likelihoods = compute_likelihoods(sets, size, log_target(log, config), table).movedim(1, -1)  # [S, *B, F]
    # 2. Meta-metric of each set; without a rollout there is no score, so leave-one-out values need two.
    weights = _score_weights(config, likelihoods.device)
    rmm = _weigh(likelihoods, weights[0]).movedim(0, -1)  # [*B, S]
    without_each, alone = (part.repeat_interleave(repeat, dim=-1) for part in rmm[..., 1:].split(distinct, -1))
    if distinct * repeat == 1:
        without_each = torch.full_like(without_each, torch.nan)
    meta_metric, kinematic, interactive, map_based = (_weigh(likelihoods[0], row) for row in weights)
    # 3. Reported beside the metric, for each rollout [*B, N].
    displacement = _mean_per_rollout(features.displacement_error, log, repeat)
    collision = _any_rate(features.collision, log, repeat)
    offroad = _any_rate(features.offroad, log, repeat)
    stays = ~log.leaves_road  # [E]
    left = ((features.offroad & log.agents.future_valid).any(-1) & stays).to(torch.float32)  # [N, E]
    left = sum_over_agents(left, log.agents.layout)  # [N, *B]
    light = _any_rate(features.traffic_light_violation, log, repeat)
    return RealismResult(
        scenario_ids=log.scenario_ids,
        config=config,
        likelihoods=likelihoods[0],
        meta_metric=meta_metric,
        kinematic=kinematic,
        interactive=interactive,
        map_based=map_based,
        average_displacement_error=displacement.mean(-1),
        min_average_displacement_error=displacement.amin(-1),
        collision_rate=collision.mean(-1),
        offroad_rate=offroad.mean(-1),
        unlogged_offroad_rate=left.sum(0) / (distinct * sum_over_agents(stays.to(torch.float32), log.agents.layout)),
        traffic_light_violation_rate=light.mean(-1),
        leave_one_out_meta_metric=without_each,
        single_meta_metric=alone,
        rollout_displacement_error=displacement,
        rollout_collision_rate=collision,
        rollout_offroad_rate=offroad,
        rollout_traffic_light_violation_rate=light,
    )


def score(
    scenario: Scenario | ScenarioLog,
    states: SimulatedStates,
    config: MetricConfig = METRIC_2025,
    *,
    missing_map: MissingMap = "error",
    compute: ComputeConfig = DEFAULT_COMPUTE,
) -> RealismResult:
    """Scores of one scenario's rollouts, on the rollouts' device.

    Args:
        scenario: the logged scenario, or its `scenario_log`.
        states: its rollouts.
        config: the metric's year.
        missing_map: without road edges raise ("error"), or count every agent as on the road ("neutral").
        compute: memory bound.

    Raises:
        DataError: the scenario cannot be scored, or the rollouts' agents are not its simulated agents.
    """
    log = scenario
    if isinstance(log, Scenario):
        log = scenario_log(log, states.device, missing_map=missing_map, compute=compute)
    return score_features(log, compute_features(log, states, compute=compute), config)
