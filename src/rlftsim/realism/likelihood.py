"""Likelihoods of the log under the rollouts' histograms, by the rules of the official evaluator.

Rollouts enter a score only through counts, so counts are stored per rollout: the counts of any set of rollouts (all,
all but a single rollout, a rollout alone) are a sum, and scoring every leave-one-out set costs a single reduction.
Feature axes: H = 7 histogram features in the order of `HISTOGRAM_FEATURES`, J = 3 Bernoulli features in that of
`BERNOULLI_FEATURES`, F = H + J. K bins. Scores of several scenarios together have an axis B.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.realism.agents import Layout, sum_over_agents
from rlftsim.realism.config import HISTOGRAM_FEATURES, HistogramConfig, MetricConfig
from rlftsim.realism.features import CACHED_LOGS, AnyLog, Features, JoinedLogs, ScenarioLog


def compute_bin_edges(histogram: HistogramConfig) -> Float[np.ndarray, "K1"]:
    """Edges of equal-width bins, rounded like TensorFlow's float32 linspace: low + k * step, the last exactly high.

    A float64 linspace rounded to float32 differs by up to 8e-7, enough to move a value to the next bin.
    """
    low, high = np.float32(histogram.low), np.float32(histogram.high)
    edges = low + (high - low) / np.float32(histogram.num_bins) * np.arange(histogram.num_bins + 1, dtype=np.float32)
    edges[-1] = high
    return edges


@dataclass(frozen=True, eq=False)
class HistogramTable:
    """The histogram features of a metric side by side, padded to the largest number of bins K."""

    edges: Float[Tensor, "H K1"]
    """Infinite beyond a feature's own edges."""
    low: Float[Tensor, "H"]
    high: Float[Tensor, "H"]
    last_bin: Int64[Tensor, "H"]
    pseudocount: Float[Tensor, "H"]
    num_bins: Float[Tensor, "H"]
    bernoulli_pseudocount: Float[Tensor, "J"]


@lru_cache(maxsize=32)
def histogram_table(config: MetricConfig, device: torch.device) -> HistogramTable:
    """Bins of a metric on a device; cached.

    Args:
        config: Year of the metric, with the ranges and numbers of bins.
        device: Device of the tensors, that of the features to be counted.
    """
    histograms = config.histograms
    edges = np.full((len(histograms), max(h.num_bins for h in histograms) + 1), np.inf, np.float32)
    for row, histogram in enumerate(histograms):
        edges[row, : histogram.num_bins + 1] = compute_bin_edges(histogram)
    rows = [[h.low, h.high, h.pseudocount, h.num_bins] for h in histograms]  # [H, 4]
    low, high, pseudocount, num_bins = torch.tensor(rows, device=device).unbind(1)
    bernoulli = torch.tensor([b.pseudocount for b in config.bernoullis], device=device)
    edges = torch.from_numpy(edges).to(device)
    return HistogramTable(edges, low, high, num_bins.long() - 1, pseudocount, num_bins, bernoulli)


def find_bins(values: Float[Tensor, "H m"], table: HistogramTable) -> Int64[Tensor, "H m"]:
    """Bin of each value, after clipping into the range; closed on the left, the last bin on both sides.

    NaN falls into the last bin, as in the official evaluator: the last steps of a rollout, where no difference exists,
    are counted there.

    Args:
        values: Values of each histogram feature, m values in the feature's unit.
        table: Bins of the metric on the device of the values.
    """
    clipped = values.clamp(table.low[:, None], table.high[:, None])
    bins = torch.searchsorted(table.edges, clipped, right=True) - 1
    last_bin = table.last_bin[:, None]
    return torch.where(clipped.isnan(), last_bin, torch.minimum(bins, last_bin).clamp_(min=0))


def stack_histogram_features(features: Features) -> Float[Tensor, "H N E T"]:
    """The histogram features, stacked."""
    return torch.stack([getattr(features, name) for name in HISTOGRAM_FEATURES])


def count_bins(values: Float[Tensor, "H N E T"], table: HistogramTable) -> Float[Tensor, "N H E K"]:
    """Histogram of each rollout and agent over all T steps, valid or not.

    Args:
        values: Values of each histogram feature in N rollouts, in the feature's unit.
        table: Bins of the metric on the device of the values.
    """
    num_features, num_rollouts, num_agents, _ = values.shape
    bins = find_bins(values.flatten(1), table).view(values.shape).permute(1, 0, 2, 3)
    counts = values.new_zeros(num_rollouts, num_features, num_agents, table.edges.shape[1] - 1)
    return counts.scatter_add_(-1, bins, counts.new_ones(1).expand(bins.shape))


@dataclass(frozen=True, eq=False)
class LogTarget:
    """The log's side of the likelihoods: counts of logged bins, and logged outcomes."""

    steps_in_bin: Float[Tensor, "H E K"]
    """Number of scored steps whose logged value lies in the bin."""
    num_scored_steps: Float[Tensor, "H *B"]
    outcome: Bool[Tensor, "J E"]
    """True if the agent ever collides, leaves the road or runs a red light in the log."""
    layout: Layout | None = None
    """Of the agents of B scenarios; None = all are of one, and there is no axis B."""


def compute_outcomes(features: Features, log: AnyLog) -> Bool[Tensor, "N J E"]:
    """True for agents that ever collide, leave the road or run a red light at a step where the log is valid.

    Light violations of agents other than vehicles do not count.

    Args:
        features: Features of N rollouts, or of the log (N = 1).
        log: Logged side of the scenario, whose validity counts for rollouts, too.
    """
    # The log's validity masks the rollouts, too, as officially.
    log_valid = log.agents.future_valid
    lights = features.traffic_light_violation & log.agents.is_vehicle[:, None]
    return torch.stack([features.collision, features.offroad, lights], dim=1).logical_and_(log_valid).any(-1)


def stack_scored_steps(log: ScenarioLog, config: MetricConfig) -> Bool[Tensor, "H E T"]:
    """Mask of the logged steps at which each histogram feature counts.

    Args:
        log: Logged side of a single scenario.
        config: Year of the metric; years differ in the agents scored for time to collision.
    """
    features = log.features
    valid, speed, acceleration = features.valid[0], features.speed_valid[0], features.acceleration_valid[0]
    collision_time = valid & log.agents.is_vehicle[:, None] if config.time_to_collision_vehicles_only else valid
    return torch.stack([speed, acceleration, speed, acceleration, valid, collision_time, valid])


@lru_cache(maxsize=CACHED_LOGS)
def log_target(log: AnyLog, config: MetricConfig) -> LogTarget:
    """Bins and outcomes of the log, cached (logs are compared by identity).

    Args:
        log: Logged side of the scenario, or of several side by side.
        config: Year of the metric: bins and rules.
    """
    if isinstance(log, JoinedLogs):
        targets = [log_target(scenario_log, config) for scenario_log in log.logs]
        return LogTarget(
            torch.cat([target.steps_in_bin for target in targets], 1),
            torch.stack([target.num_scored_steps for target in targets], -1),
            torch.cat([target.outcome for target in targets], -1),
            log.agents.layout,
        )
    table = histogram_table(config, log.agents.valid.device)
    values = stack_histogram_features(log.features)[:, 0]  # [H, E, T]
    is_scored = stack_scored_steps(log, config).to(values.dtype)
    bins = find_bins(values.flatten(1), table).view(values.shape)
    steps_in_bin = values.new_zeros(*values.shape[:2], table.edges.shape[1] - 1).scatter_add_(-1, bins, is_scored)
    return LogTarget(steps_in_bin, is_scored.sum((1, 2)), compute_outcomes(log.features, log)[0])


@dataclass(frozen=True, eq=False)
class RolloutCounts:
    """Counts of each rollout; the counts of a set of rollouts are the sum over the members."""

    bins: Float[Tensor, "N H #E K"]
    """E is 1 where all agents share a histogram."""
    agreement: Float[Tensor, "N J E"]
    """1 where the rollout has the log's outcome; where all agents share a histogram, the number of agents that have."""
    num_steps: int
    """Values per rollout in a histogram: T steps of an agent, or of all agents."""
    num_outcomes: tuple[int, ...] = (1, 1, 1)
    """Outcomes per rollout of each Bernoulli feature: that of an agent, or those of all agents."""


def count_rollouts(features: Features, log: AnyLog, config: MetricConfig) -> RolloutCounts:
    """Counts of each distinct rollout.

    Args:
        features: Features of N distinct rollouts.
        log: Logged side of the same scenario, or scenarios.
        config: Year of the metric: bins and rules.
    """
    values = stack_histogram_features(features)
    table = histogram_table(config, values.device)
    bins, num_steps = count_bins(values, table), values.shape[-1]
    outcome, logged = compute_outcomes(features, log), log_target(log, config).outcome
    agreement = (outcome == logged).to(values.dtype)
    if not config.challenge.makes_scenes:
        return RolloutCounts(bins, agreement, num_steps)
    # Light violations, the last feature, are counted agent by agent all the same.
    num_agents = logged.shape[-1]
    num_agreeing = (outcome[:, :-1, None] == logged[:-1, :, None]).sum(-1)  # [N, J - 1, E]
    agreement = torch.cat([num_agreeing.to(values.dtype), agreement[:, -1:]], 1)
    return RolloutCounts(bins.sum(2, keepdim=True), agreement, num_steps * num_agents, (num_agents, num_agents, 1))


def compute_log_probabilities(
    counts: Float[Tensor, "S H E K"], num_values: Float[Tensor, "S"], table: HistogramTable
) -> Float[Tensor, "S H E K"]:
    """Log-probability of each bin for S sets of rollouts with additive smoothing, nats.

    ln P(k) = ln (count(k) + c) - ln (total + c K), with c the pseudocount and K the feature's own number of bins.

    Args:
        counts: Number of values in each bin, for each of S sets of rollouts.
        num_values: Number of values in each histogram: rollouts times steps, times agents that share the histogram.
        table: Bins of the metric, with the pseudocounts.
    """
    pseudocount = table.pseudocount[:, None, None]
    total = num_values[:, None] + table.pseudocount * table.num_bins  # [S, H]
    return (counts + pseudocount).log_() - total.log()[..., None, None]


def compute_agent_log_likelihoods(
    counts: RolloutCounts, num_rollouts: Float[Tensor, "S"], target: LogTarget, table: HistogramTable
) -> Float[Tensor, "S F E"]:
    """Log-likelihood of each agent's log under S sets of rollouts, nats.

    For histogram features the sum over the agent's scored steps, for Bernoulli features that of the agent's outcome.

    Args:
        counts: Counts summed over each set: `bins` [S, H, E, K], `agreement` [S, J, E].
        num_rollouts: Number of rollouts in each set.
        target: Logged bins and outcomes, from `log_target`.
        table: Bins of the metric, with the pseudocounts.
    """
    log_probability = compute_log_probabilities(counts.bins, num_rollouts * counts.num_steps, table)
    histogram = (log_probability * target.steps_in_bin).sum(-1)  # [S, H, E]
    pseudocount = table.bernoulli_pseudocount
    # Two outcomes: (number that agree + c) / (number of outcomes + 2 c).
    num_outcomes = torch.stack([num_rollouts * number for number in counts.num_outcomes], -1)  # [S, J]
    agreement = (counts.agreement + pseudocount[:, None]) / (num_outcomes + 2 * pseudocount)[..., None]
    return torch.cat([histogram, agreement.log_()], dim=1)


def count_terms(target: LogTarget) -> Float[Tensor, "F *B"]:
    """Number of terms in a feature's mean log-probability: scored (agent, step) pairs, or agents."""
    agent_counts = torch.ones_like(target.outcome, dtype=target.num_scored_steps.dtype)  # [J, E]
    return torch.cat([target.num_scored_steps, sum_over_agents(agent_counts, target.layout)])


def compute_likelihoods(
    counts: RolloutCounts, num_rollouts: Float[Tensor, "S"], target: LogTarget, table: HistogramTable
) -> Float[Tensor, "S F *B"]:
    """Likelihood of the log under S sets of rollouts, per feature: the exponential of the mean log-probability.

    Histogram features average over all scored (agent, step) pairs together (not over means of agents), Bernoulli
    features over all agents. A feature without a scored step is NaN, as in the official evaluator.

    Args:
        counts: Counts summed over each set: `bins` [S, H, E, K], `agreement` [S, J, E].
        num_rollouts: Number of rollouts in each set.
        target: Logged bins and outcomes, from `log_target`.
        table: Bins of the metric, with the pseudocounts.
    """
    by_agent = compute_agent_log_likelihoods(counts, num_rollouts, target, table)
    return (sum_over_agents(by_agent, target.layout) / count_terms(target)).exp_()
