"""Where a scenario's score went: which feature, which agent, which steps cost how much against the ceiling.

The ceiling is the oracle: the record itself, as often as there are rollouts. What is lost is the meta-metric of the ceiling minus that of
the rollouts; it is split over features, evaluated agents and future steps without remainder, by the rule of `realism.credit`.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.realism import (
    FEATURE_NAMES,
    METRIC_2025,
    Features,
    MetricConfig,
    RealismResult,
    ScenarioLog,
    SimulatedStates,
    build_scenario_log,
    compute_features,
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
from rlftsim.scenario.types import HISTORY_STEPS, ObjectType, Scenario
from rlftsim.viewer.scene import Trajectories, logged_trajectories

WHOLE_FUTURE = -1
"""Last column of the step axis of costs: what belongs to an agent's whole future (collision, off-road, light), not to a step."""


@dataclass(frozen=True, eq=False)
class FeatureHistogram:
    """One histogram feature of log and rollouts over the official bins, evaluated agents together."""

    feature: str
    edges: Float[np.ndarray, "K1"]
    log_share: Float[np.ndarray, "K"]
    """Of the scored logged steps."""
    rollout_share: Float[np.ndarray, "K"]
    """Of all steps of all rollouts, as the metric counts: steps without a value lie in the last bin."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """A scenario's score, its ceiling and what lies between them."""

    scenario: Scenario
    config: MetricConfig
    result: RealismResult
    ceiling: RealismResult
    """Of the oracle."""
    cost: Float[np.ndarray, "F E T1"]
    """Share of ceiling minus score of a feature, evaluated agent and future step; the last column is the whole future. Negative
    where the rollouts do better than the record."""
    event_share: Float[np.ndarray, "J E T"]
    """Share of rollouts with a collision, off the road, passing a red light at a step, in the order of `BERNOULLI_FEATURES`."""
    histograms: tuple[FeatureHistogram, ...]
    rollouts: Trajectories

    @property
    def lost(self) -> float:
        """Ceiling minus score; the sum of `cost`."""
        return float(self.ceiling.meta_metric - self.result.meta_metric)

    @property
    def agent_names(self) -> list[str]:
        """Object id and kind of the evaluated agents."""
        tracks, chosen = self.scenario.tracks, self.scenario.evaluated_indices
        kinds = [ObjectType(int(kind)).name.lower() for kind in tracks.object_type[chosen]]
        ego = self.scenario.ego_index
        return [
            f"{tracks.object_id[index]} {'ego' if index == ego else kind}"
            for index, kind in zip(chosen.tolist(), kinds)
        ]


def explain(scenario: Scenario, states: SimulatedStates, config: MetricConfig = METRIC_2025) -> Explanation:
    """Explain the score of one scenario's rollouts.

    Raises:
        DataError: the scenario cannot be scored, or the agents are not its simulated ones.
    """
    log = build_scenario_log(scenario)
    features = compute_features(log, states)
    oracle = compute_features(log, logged_states(scenario, num_rollouts=states.num_rollouts))
    cost = split_difference(_mean_terms(log, oracle, config), _mean_terms(log, features, config), config)
    return Explanation(
        scenario=scenario,
        config=config,
        result=score_features(log, features, config),
        ceiling=score_features(log, oracle, config),
        cost=cost.unflatten(-1, (len(log.agents.evaluated), -1)).numpy(),
        event_share=_event_share(log, features),
        histograms=_histograms(log, features, config),
        rollouts=_trajectories(scenario, states).with_evaluated_flags(
            scenario, collision=features.collision, offroad=features.offroad
        ),
    )


def _mean_terms(log: ScenarioLog, features: Features, config: MetricConfig) -> Float[Tensor, "F ET1"]:
    """What every agent and step adds to the mean log-probability of a feature, agents and steps in one axis."""
    target, table = log_target(log, config), histogram_table(config, torch.device("cpu"))
    sets, size = form_sets(count_rollouts(features, log, config), features.repeat)
    whole = type(sets)(sets.bins[:1].double(), sets.agreement[:1].double(), sets.num_steps)
    log_probability = compute_log_probabilities(whole.bins, size[:1].double() * whole.num_steps, table)[0]
    logged = stack_histogram_features(log.features)[:, 0]  # [H, E, T]
    steps = log_probability.gather(-1, find_bins(logged.flatten(1), table).view(logged.shape))
    steps = torch.where(stack_scored_steps(log, config), steps, 0.0)
    by_agent = compute_agent_log_likelihoods(whole, size[:1].double(), target, table)[0, len(steps) :]  # [J, E]
    num_features, num_steps = len(FEATURE_NAMES), steps.shape[-1]
    terms = steps.new_zeros(num_features, steps.shape[1], num_steps + 1)
    terms[: len(steps), :, :num_steps] = steps
    terms[len(steps) :, :, WHOLE_FUTURE] = by_agent
    return (terms / count_terms(target).double()[:, None, None]).flatten(1)


def _event_share(log: ScenarioLog, features: Features) -> Float[np.ndarray, "J E T"]:
    events = torch.stack([features.collision, features.offroad, features.traffic_light_violation])
    return (events & log.agents.future_valid).double().mean(1).numpy()


def _histograms(log: ScenarioLog, features: Features, config: MetricConfig) -> tuple[FeatureHistogram, ...]:
    table, target = histogram_table(config, torch.device("cpu")), log_target(log, config)
    counts = count_rollouts(features, log, config).bins.sum((0, 2))  # [H, K]
    logged = target.steps_in_bin.sum(1)
    found = []
    for row, (name, histogram) in enumerate(zip(HISTOGRAM_FEATURES, config.histograms)):
        kept = slice(0, histogram.num_bins)
        shares = [values[row, kept] / values[row].sum().clamp(min=1) for values in (logged, counts)]
        edges = table.edges[row, : histogram.num_bins + 1]
        found.append(FeatureHistogram(name, edges.numpy(), *(share.numpy() for share in shares)))
    return tuple(found)


def _trajectories(scenario: Scenario, states: SimulatedStates) -> Trajectories:
    """The rollouts after the logged history, in the map frame of the viewer."""
    chosen = scenario.simulated_indices
    order = torch.from_numpy(
        match_agents(scenario.tracks.object_id[chosen].astype(np.int64), states.object_id, scenario.scenario_id)
    )
    future = torch.stack([states.x, states.y], -1)[:, order].double() - torch.from_numpy(scenario.origin)
    log = logged_trajectories(scenario)

    def after_history(past: np.ndarray, values: Tensor) -> np.ndarray:
        repeated = np.repeat(past[:, :, :HISTORY_STEPS], len(values), axis=0)
        return np.concatenate([repeated, values.float().numpy()], axis=2)

    valid = np.repeat(log.valid[:, :, :HISTORY_STEPS], len(future), axis=0)
    return Trajectories(
        position=after_history(log.position, future),
        heading=after_history(log.heading, states.heading[:, order]),
        valid=np.concatenate([valid, np.ones(future.shape[:3], bool)], axis=2),
    )
