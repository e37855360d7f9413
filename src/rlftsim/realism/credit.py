"""Whom a score is owed to: what a rollout adds to the meta-metric, split over features and agents without remainder.

A likelihood is the exponential of a mean over agents, so a difference of two likelihoods x and y is

    x - y = L(x, y) (ln x - ln y),        L(x, y) = (x - y) / (ln x - ln y)   (the logarithmic mean; L(x, x) = x)

and ln x - ln y is a sum over agents (and steps): each is owed L times its own term. Weighted and summed over features these shares
add up to the difference of the meta-metrics exactly. Computed in float64 from the counts that the metric has anyway.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.realism.config import METRIC_2025, MetricConfig
from rlftsim.realism.features import Features, ScenarioLog
from rlftsim.realism.likelihood import (
    RolloutCounts,
    compute_agent_log_likelihoods,
    count_rollouts,
    count_terms,
    histogram_table,
    log_target,
)
from rlftsim.realism.meta_metric import form_sets


@dataclass(frozen=True, eq=False)
class Credit:
    """What each rollout adds to the meta-metric: RMM of all N rollouts minus RMM of the N - 1 others, split."""

    added: Float64[Tensor, "N E F"]
    """Share of an evaluated agent (by ascending object id) and feature (`FEATURE_NAMES`); positive where the rollout helps. A
    feature of no weight has 0, one without a scored step NaN."""
    repeat: int = 1
    """Each of the N rollouts stands for this many identical ones, all with the same shares."""

    @property
    def by_feature(self) -> Float64[Tensor, "N F"]:
        """Weight times the feature's likelihood with all rollouts minus that without this one."""
        return self.added.sum(1)

    @property
    def by_agent(self) -> Float64[Tensor, "N E"]:
        """All features of an agent together."""
        return self.added.sum(-1)

    @property
    def mloo(self) -> Float64[Tensor, "N E F"]:
        """The leave-one-out reward of a rollout, split: sums to zero over rollouts for every agent and feature."""
        return self.added - self.added.mean(0)


def log_mean_of_exp(log_x: Float[Tensor, "..."], log_y: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Logarithmic mean of e^log_x and e^log_y; e^log_x where both are equal."""
    gap = log_x - log_y
    ratio = torch.where(gap == 0, 1.0, torch.expm1(gap) / torch.where(gap == 0, 1.0, gap))
    return log_y.exp() * ratio


def compute_credit(log: ScenarioLog, features: Features, config: MetricConfig = METRIC_2025) -> Credit:
    """Shares of agents and features in what each rollout adds to the meta-metric.

    Raises:
        DataError: fewer than two rollouts, so that none can be left out.
    """
    distinct = _require_two(features)
    terms = _log_likelihood_terms(log, features, config, slice(0, 1 + distinct))  # of all, and of all but each
    return Credit(split_difference(terms[:1], terms[1:], config).transpose(1, 2), features.repeat)


def compute_single_credit(
    log: ScenarioLog, features: Features, config: MetricConfig = METRIC_2025
) -> Float64[Tensor, "N E F"]:
    """Shares of agents and features in how far a rollout's own RMM lies above the mean of the others' own.

    Summed over agents and features: RMM_i - mean_{j != i} RMM_j, the reward `rloo`. Each difference RMM_i - RMM_j is split for itself.

    Raises:
        DataError: fewer than two rollouts, so that there are no others.
    """
    distinct = _require_two(features)
    terms = _log_likelihood_terms(log, features, config, slice(1 + distinct, None))  # of each alone
    between = split_difference(terms[:, None], terms[None], config)  # [N, N, F, E]
    return (between.sum(1) * (features.repeat / (distinct * features.repeat - 1))).transpose(1, 2)


def _require_two(features: Features) -> int:
    """The number of distinct rollouts, if there are two rollouts at all."""
    distinct = len(features.linear_speed)
    if distinct * features.repeat < 2:
        raise DataError("Credit needs at least 2 rollouts, got 1: without it there is nothing to score.")
    return distinct


def _log_likelihood_terms(
    log: ScenarioLog, features: Features, config: MetricConfig, sets: slice
) -> Float64[Tensor, "S F E"]:
    """What each agent adds to the mean log-probability of each feature under some of the sets of `form_sets`, nats."""
    target, table = log_target(log, config), histogram_table(config, features.linear_speed.device)
    counts, size = form_sets(count_rollouts(features, log, config), features.repeat)
    chosen = RolloutCounts(counts.bins[sets].double(), counts.agreement[sets].double(), counts.num_steps)
    by_agent = compute_agent_log_likelihoods(chosen, size[sets].double(), target, table)
    return by_agent / count_terms(target).double()[:, None]


def split_difference(
    x: Float64[Tensor, "*S F E"], y: Float64[Tensor, "*S2 F E"], config: MetricConfig
) -> Float64[Tensor, "*S3 F E"]:
    """Meta-metric of x minus that of y, split over features and agents.

    Args:
        x: What each agent (or agent and step, in one axis) adds to the mean log-probability of each feature, nats.
        y: The same of other rollouts; broadcast against x.
        config: The weights.
    """
    weight = torch.tensor(config.weights, dtype=x.dtype, device=x.device)[:, None]
    mean = log_mean_of_exp(x.sum(-1, keepdim=True), y.sum(-1, keepdim=True))
    return torch.where(weight > 0, weight * mean * (x - y), 0.0)
