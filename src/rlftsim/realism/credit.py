"""Credit assignment: the contribution of a rollout to the meta-metric, split exactly over features and agents.

A likelihood is the exponential of a mean over agents, so a difference of two likelihoods x and y is

    x - y = L(x, y) (ln x - ln y),        L(x, y) = (x - y) / (ln x - ln y)   (the logarithmic mean; L(x, x) = x)

and ln x - ln y is a sum over agents (and steps): each agent gets L times the agent's term. Weighted and summed over
features, these shares add up to the difference of the meta-metrics exactly. Computed in float64 from the counts that
the metric has anyway.

`AgentScores` has scores split over agents in a batch's order of agents, for rewards with credit per agent. Agents that
are not evaluated, and padding, have 0 there.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.realism import likelihood
from rlftsim.realism.agents import Layout, sum_over_agents, to_agents
from rlftsim.realism.config import FEATURE_NAMES, METRIC_2025, SUB_SCORES, MetricConfig
from rlftsim.realism.features import AnyLog, Features
from rlftsim.realism.meta_metric import ScenarioFeatures, form_sets


@dataclass(frozen=True, eq=False)
class Credit:
    """Contribution of each rollout, RMM of all N minus RMM without the rollout, split over agents and features."""

    added: Float64[Tensor, "N E F"]
    """Share of an evaluated agent (by ascending object id) and feature (`FEATURE_NAMES`); positive = the rollout helps.
    A feature without weight has 0, a feature without a scored step NaN."""
    repeat: int = 1
    """Number of identical rollouts behind each of the N, all with the same shares."""

    @property
    def by_agent(self) -> Float64[Tensor, "N E"]:
        """Sum over features, for each agent."""
        return self.added.sum(-1)

    @property
    def mloo(self) -> Float64[Tensor, "N E F"]:
        """The reward `mloo` (RLFTSim, equation 2), split; sums to zero over rollouts for every agent and feature."""
        # mloo_i = mean_j RMM(-j) - RMM(-i) = (RMM - RMM(-i)) - mean_j (RMM - RMM(-j))
        return self.added - self.added.mean(0)


def compute_logarithmic_mean(log_x: Float[Tensor, "..."], log_y: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Logarithmic mean of e^log_x and e^log_y; e^log_x where both are equal.

    Args:
        log_x: Logarithm of the first number, nats.
        log_y: Logarithm of the second number, nats; broadcast against the first.
    """
    gap = log_x - log_y
    # L(x, y) = y (x / y - 1) / ln(x / y); expm1 is exact for nearly equal numbers, the inner `where` avoids 0 / 0.
    ratio = torch.where(gap == 0, 1.0, torch.expm1(gap) / torch.where(gap == 0, 1.0, gap))
    return log_y.exp() * ratio


def compute_credit(log: AnyLog, features: Features, config: MetricConfig = METRIC_2025) -> Credit:
    """Shares of agents and features in the contribution of each rollout to the meta-metric.

    Args:
        log: Logged side of the scenario, or of several.
        features: Features of the scenario's rollouts, N distinct ones.
        config: Year of the metric: bins, weights and rules.

    Raises:
        DataError: Fewer than two rollouts, so that none can be left out.
    """
    num_distinct = _validate_num_distinct(features)
    # [1 + N, F, E]: of all rollouts, and of all but each
    terms = _compute_terms(log, features, config, slice(0, 1 + num_distinct))
    added = split_difference(terms[:1], terms[1:], config, log.agents.layout)  # [N, F, E]
    return Credit(added.transpose(1, 2), features.repeat)


def compute_single_credit(
    log: AnyLog, features: Features, config: MetricConfig = METRIC_2025
) -> Float64[Tensor, "N E F"]:
    """Shares of agents and features in RMM_i - mean_{j != i} RMM_j, the reward `rloo`.

    RMM_i is the meta-metric of rollout i alone. Each difference RMM_i - RMM_j is split separately.

    Args:
        log: Logged side of the scenario, or of several.
        features: Features of the scenario's rollouts, N distinct ones.
        config: Year of the metric: bins, weights and rules.

    Raises:
        DataError: Fewer than two rollouts, so that a baseline is missing.
    """
    num_distinct = _validate_num_distinct(features)
    # [N, F, E]: of each rollout alone
    terms = _compute_terms(log, features, config, slice(1 + num_distinct, None))
    differences = split_difference(terms[:, None], terms[None], config, log.agents.layout)  # [N, N, F, E]
    # Pairs of equal rollouts add nothing, so the mean over all others is the sum over distinct ones times their repeat.
    return (differences.sum(1) * (features.repeat / (num_distinct * features.repeat - 1))).transpose(1, 2)


def _validate_num_distinct(features: Features) -> int:
    """Number of distinct rollouts, of at least two rollouts in all."""
    num_distinct = len(features.linear_speed)
    if num_distinct * features.repeat < 2:
        raise DataError("Credit needs at least 2 rollouts, got 1: without it there is nothing to score.")
    return num_distinct


def _compute_terms(log: AnyLog, features: Features, config: MetricConfig, sets: slice) -> Float64[Tensor, "S F E"]:
    """Terms of the agents in each feature's mean log-probability, under the selected sets of `form_sets`, nats."""
    target, table = likelihood.log_target(log, config), likelihood.histogram_table(config, features.linear_speed.device)
    counts, size = form_sets(likelihood.count_rollouts(features, log, config), features.repeat)
    counts = replace(counts, bins=counts.bins[sets].double(), agreement=counts.agreement[sets].double())
    by_agent = likelihood.compute_agent_log_likelihoods(counts, size[sets].double(), target, table)
    return by_agent / to_agents(likelihood.count_terms(target).double(), target.layout)


def split_difference(
    x: Float64[Tensor, "*S F E"], y: Float64[Tensor, "*S2 F E"], config: MetricConfig, layout: Layout | None = None
) -> Float64[Tensor, "*S3 F E"]:
    """Meta-metric of x minus that of y, split over features and agents.

    Args:
        x: Term of each agent (or agent and step, in one axis) in the mean log-probability of each feature, nats.
        y: Terms under the rollouts to compare with, nats; broadcast against `x`.
        config: Year of the metric; only the weights count here.
        layout: Arrangement of the agents of several scenarios, to split the meta-metric of each; None = a single one.
    """
    weight = torch.tensor(config.weights, dtype=x.dtype, device=x.device)[:, None]  # [F, 1]
    mean = compute_logarithmic_mean(sum_over_agents(x, layout), sum_over_agents(y, layout))
    return torch.where(weight > 0, weight * to_agents(mean, layout) * (x - y), 0.0)


@dataclass(frozen=True, eq=False)
class AgentScores:
    """Shares of A agents in the scores of N distinct rollouts of B scenarios; the shares sum to the rollout's score."""

    features: tuple[ScenarioFeatures, ...]
    config: MetricConfig
    num_agents: int
    """A, padding included."""

    @cached_property
    def leave_one_out(self) -> Float64[Tensor, "B N A"]:
        """Shares of mean_j RMM(-j) - RMM(-i), the reward `mloo`; see `Credit.mloo`. The sum over rollouts is zero."""
        return self._scatter(lambda scene: compute_credit(scene.log, scene.features, self.config).mloo.sum(-1))

    @cached_property
    def sub_scores(self) -> dict[str, Float64[Tensor, "B N A"]]:
        """`leave_one_out` in its parts of each sub-score, by name."""
        credits = {id(scene): compute_credit(scene.log, scene.features, self.config).mloo for scene in self.features}
        columns = {name: [FEATURE_NAMES.index(feature) for feature in names] for name, names in SUB_SCORES.items()}
        return {
            name: self._scatter(lambda scene, index=index: credits[id(scene)][..., index].nan_to_num().sum(-1))
            for name, index in columns.items()
        }

    @cached_property
    def single(self) -> Float64[Tensor, "B N A"]:
        """Shares of RMM_i - mean_{j != i} RMM_j, the reward `rloo`; see `compute_single_credit`."""
        return self._scatter(lambda scene: compute_single_credit(scene.log, scene.features, self.config).sum(-1))

    @cached_property
    def displacement_error(self) -> Float[Tensor, "B N A"]:
        """Shares of `RealismResult.rollout_displacement_error`, m: an agent's error over the number of agents E."""
        return self._scatter_mean(lambda scene: scene.features.displacement_error)

    @cached_property
    def collision(self) -> Float[Tensor, "B N A"]:
        """Shares of `RealismResult.rollout_collision_rate`: 1 / E for each evaluated agent that collides."""
        return self._scatter_mean(lambda scene: likelihood.compute_outcomes(scene.features, scene.log)[:, 0].float())

    @cached_property
    def offroad(self) -> Float[Tensor, "B N A"]:
        """Shares of `RealismResult.rollout_offroad_rate`: 1 / E for each evaluated agent that leaves the road."""
        return self._scatter_mean(lambda scene: likelihood.compute_outcomes(scene.features, scene.log)[:, 1].float())

    def _scatter_mean(self, compute: Callable[[ScenarioFeatures], Tensor]) -> Tensor:
        """Values [N, E] over the number of evaluated agents in each scenario, scattered as by `_scatter`."""

        def divide(scene: ScenarioFeatures) -> Tensor:
            values, layout = compute(scene), scene.log.agents.layout
            return values / to_agents(sum_over_agents(torch.ones_like(values[0]), layout), layout)

        return self._scatter(divide)

    def _scatter(self, compute: Callable[[ScenarioFeatures], Tensor]) -> Tensor:
        """Values [N, E] of each scenario's evaluated agents, scattered to the agent axis of the batch: [B, N, A]."""
        rows = []
        for scene in self.features:
            values, layout, index = compute(scene), scene.log.agents.layout, scene.log.agents.evaluated
            if layout is not None:
                # From the index among the agents of all scenarios to that in the padded batch.
                index = index - layout.first_agent[layout.scenario] + layout.scenario * self.num_agents
            row = values.new_zeros(len(values), len(scene.log.logs) * self.num_agents)
            rows.append(row.index_copy(1, index, values).view(len(values), -1, self.num_agents))
        return torch.cat(rows, 1).transpose(0, 1)
