"""Loss of a scenario's score against its ceiling, split over features, evaluated agents and future steps.

The ceiling is the oracle: the log, repeated as often as there are rollouts. The loss, meta-metric of the ceiling minus
meta-metric of the rollouts, is split without remainder, by the rule of `realism.credit`.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.realism import (
    FEATURE_NAMES,
    METRIC_2025,
    Features,
    MetricConfig,
    RealismResult,
    ScenarioLog,
    SimulatedStates,
    compute_features,
    scenario_log,
    score_features,
)
from rlftsim.realism.agents import match_agents
from rlftsim.realism.config import HISTOGRAM_FEATURES
from rlftsim.realism.credit import split_difference
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.realism.likelihood import (
    compute_agent_log_likelihoods,
    compute_log_probabilities,
    count_rollouts,
    count_terms,
    find_bins,
    histogram_table,
    log_target,
    stack_histogram_features,
    stack_scored_steps,
)
from rlftsim.realism.meta_metric import form_sets
from rlftsim.scenario.types import ObjectType, Scenario
from rlftsim.viewer.scene import SceneMotion, continue_log

WHOLE_FUTURE = -1
"""Last column of the step axis of costs: an agent's whole future, to which collision, off-road and light belong."""


@dataclass(frozen=True, eq=False)
class FeatureHistogram:
    """A histogram feature of log and rollouts over the official bins, evaluated agents together."""

    feature: str
    edges: Float[np.ndarray, "K1"]
    log_fraction: Float[np.ndarray, "K"]
    """Fraction of the scored logged steps."""
    rollout_fraction: Float[np.ndarray, "K"]
    """Fraction of all steps of all rollouts, as the metric counts: steps without a value lie in the last bin."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """A scenario's score, the ceiling and the costs between both."""

    scenario: Scenario
    config: MetricConfig
    result: RealismResult
    ceiling: RealismResult
    """Scores of the oracle."""
    cost: Float[np.ndarray, "F E T1"]
    """Part of ceiling minus score that belongs to a feature, evaluated agent and future step; the last column is the
    whole future. Negative where the rollouts do better than the log."""
    events: Bool[np.ndarray, "J N E T"]
    """True = a collision, off the road, passing a red light (`BERNOULLI_FEATURES`) at a step where the log is valid."""
    histograms: tuple[FeatureHistogram, ...]
    rollouts: SceneMotion

    @property
    def lost(self) -> float:
        """Ceiling minus score; the sum of `cost`."""
        return float(self.ceiling.meta_metric - self.result.meta_metric)

    @property
    def agent_names(self) -> list[str]:
        """Object id and type of the evaluated agents."""
        tracks, ego = self.scenario.tracks, self.scenario.ego_index
        types = {
            i: ObjectType(int(tracks.object_type[i])).name.lower() for i in self.scenario.evaluated_indices.tolist()
        }
        return [f"{tracks.object_id[i]} {'ego' if i == ego else name}" for i, name in types.items()]


def explain(scenario: Scenario, states: SimulatedStates, config: MetricConfig = METRIC_2025) -> Explanation:
    """Explanation of the score of a scenario's rollouts.

    Args:
        scenario: Scenario with the logged future.
        states: Rollouts of the scenario, world frame.
        config: Metric of a year; features without a weight have no cost.

    Raises:
        DataError: A scenario that cannot be scored, or agents that are not the simulated agents of the scenario.
    """
    # 1. Features of log, rollouts and oracle; the oracle has as many rollouts, as the metric depends on their number.
    log = scenario_log(scenario)
    features = compute_features(log, states)
    oracle = compute_features(log, logged_states(scenario, num_rollouts=states.num_rollouts))
    # 2. Each score is a weighted sum of exponentials of sums over agents and steps; split the difference of the two.
    cost = split_difference(_mean_terms(log, oracle, config), _mean_terms(log, features, config), config)
    # 3. Events and histograms behind the costs.
    events = torch.stack([features.collision, features.offroad, features.traffic_light_violation])  # [J, N, E, T]
    return Explanation(
        scenario=scenario,
        config=config,
        result=score_features(log, features, config),
        ceiling=score_features(log, oracle, config),
        cost=cost.unflatten(-1, (len(log.agents.evaluated), -1)).numpy(),
        events=(events & log.agents.future_valid).numpy(),
        histograms=_histograms(log, features, config),
        rollouts=to_scene_motion(scenario, states).with_evaluated_flags(
            scenario, collision=features.collision, offroad=features.offroad
        ),
    )


def _mean_terms(log: ScenarioLog, features: Features, config: MetricConfig) -> Float[Tensor, "F ET1"]:
    """Contribution of each agent and step to the mean log-probability of a feature, agents and steps in one axis."""
    target, table = log_target(log, config), histogram_table(config, torch.device("cpu"))
    # Row 0 of the sets is that of all rollouts; in float64, so that the parts add up.
    sets, size = form_sets(count_rollouts(features, log, config), features.repeat)
    all_rollouts = replace(sets, bins=sets.bins[:1].double(), agreement=sets.agreement[:1].double())
    num_samples = size[:1].double() * all_rollouts.num_steps
    log_probability = compute_log_probabilities(all_rollouts.bins, num_samples, table)[0]  # [H, E, K]
    logged = stack_histogram_features(log.features)[:, 0]  # [H, E, T]
    steps = log_probability.gather(-1, find_bins(logged.flatten(1), table).view(logged.shape))  # [H, E, T]
    steps = torch.where(stack_scored_steps(log, config), steps, 0.0)
    by_agent = compute_agent_log_likelihoods(all_rollouts, size[:1].double(), target, table)[0, len(steps) :]  # [J, E]
    # Histogram features fill the steps, Bernoulli features the last column: they have one value per future.
    terms = steps.new_zeros(len(FEATURE_NAMES), steps.shape[1], steps.shape[-1] + 1)  # [F, E, T + 1]
    terms[: len(steps), :, : steps.shape[-1]] = steps
    terms[len(steps) :, :, WHOLE_FUTURE] = by_agent
    return (terms / count_terms(target).double()[:, None, None]).flatten(1)


def _histograms(log: ScenarioLog, features: Features, config: MetricConfig) -> tuple[FeatureHistogram, ...]:
    table, target = histogram_table(config, torch.device("cpu")), log_target(log, config)
    simulated = count_rollouts(features, log, config).bins.sum((0, 2))  # [H, K]
    logged = target.steps_in_bin.sum(1)  # [H, K]
    histograms = []
    for row, (name, histogram) in enumerate(zip(HISTOGRAM_FEATURES, config.histograms)):
        # features have different numbers of bins: the rest of a row is padding
        num_bins = histogram.num_bins
        fractions = [counts[row, :num_bins] / counts[row].sum().clamp(min=1) for counts in (logged, simulated)]
        edges = table.edges[row, : num_bins + 1]
        histograms.append(FeatureHistogram(name, edges.numpy(), *(fraction.numpy() for fraction in fractions)))
    return tuple(histograms)


def to_scene_motion(scenario: Scenario, states: SimulatedStates) -> SceneMotion:
    """The rollouts after the logged history, in the map frame of the viewer."""
    ids = scenario.tracks.object_id[scenario.simulated_indices].astype(np.int64)
    order = torch.from_numpy(match_agents(ids, states.object_id, scenario.scenario_id))
    # float64: world coordinates may be large, the map frame is near the origin
    future = torch.stack([states.x, states.y], -1)[:, order].double() - torch.from_numpy(scenario.origin)
    heading, presence = states.heading[:, order].float().numpy(), states.presence[:, order].cpu().numpy()
    return continue_log(scenario, future.float().numpy(), heading, presence)
