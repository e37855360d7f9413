"""Score, outcome of goals and events of a variant's rollouts, in the layout of the page."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rlftsim.errors import DataError
from rlftsim.evaluation.explain import Explanation, explain
from rlftsim.goals.attainment import Outcome, measure_outcome
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.jobs.documents import to_finite
from rlftsim.realism import FEATURE_NAMES, SimulatedStates, metric_by_name
from rlftsim.realism.config import BERNOULLI_FEATURES
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import Scenario

EVENT_NAMES = ("collision", "offroad", "light")
"""Names of `BERNOULLI_FEATURES` on the page."""
assert len(EVENT_NAMES) == len(BERNOULLI_FEATURES)


@dataclass(frozen=True, eq=False)
class Scored:
    """Score, outcomes and explanation of a variant with complete rollouts."""

    num_rollouts: int
    outcomes: tuple[tuple[GoalEntry, Outcome], ...]
    explanation: Explanation | None
    reason: str = ""
    """Reason for a missing score; empty with a score."""

    def to_payload(self, free: "Scored | None" = None) -> dict[str, Any]:
        """Plain numbers for the page.

        Args:
            free: Scores of the same model on the same seeds without goals, for the change of realism.
        """
        return {
            "num_rollouts": self.num_rollouts,
            "outcomes": [
                {
                    "agent": entry.agent_id,
                    "label": entry.label,
                    "passed": round(outcome.passed * self.num_rollouts),
                    "reached": round(outcome.reached * self.num_rollouts),
                    "best_m": outcome.best_m,
                    "median_m": outcome.median_m,
                }
                for entry, outcome in self.outcomes
            ],
            "reason": self.reason,
            "score": None if self.explanation is None else self._score,
            "events": [] if self.explanation is None else self._events,
            "change": None if free is None else compute_change(self, free),
        }

    @cached_property
    def _score(self) -> dict[str, Any]:
        explanation = self.explanation
        assert explanation is not None
        result, top_result = explanation.result, explanation.ceiling
        (official,), (ceiling,) = result.to_official_fields(), top_result.to_official_fields()
        weights, costs = explanation.config.weights, explanation.cost.sum((1, 2))
        features = zip(FEATURE_NAMES, weights, result.likelihoods, top_result.likelihoods, costs)
        return to_finite(
            {
                "metric": explanation.config.name,
                "official": official,
                "ceiling": ceiling,
                "lost": explanation.lost,
                "features": [
                    {"name": name, "weight": weight, "value": float(value), "ceiling": float(top), "lost": float(cost)}
                    for name, weight, value, top, cost in features
                ],
            }
        )

    @cached_property
    def _events(self) -> list[list[Any]]:
        """Kind, rollout, object id, first and last simulated step of every event."""
        assert self.explanation is not None
        scenario = self.explanation.scenario
        ids = scenario.tracks.object_id[scenario.evaluated_indices].tolist()
        edges = np.diff(self.explanation.events.astype(np.int8), axis=-1, prepend=0, append=0)  # [J, N, E, T + 1]
        # Rows of both are in the same order, so that starts and stops of one event stand side by side.
        starts, stops = np.argwhere(edges == 1).tolist(), np.argwhere(edges == -1).tolist()
        return [[EVENT_NAMES[j], n, ids[e], start, stop[3]] for (j, n, e, start), stop in zip(starts, stops)]

    def explained(self) -> dict[str, Any]:
        """Costs by feature, agent and step for the page."""
        if self.explanation is None:
            return {"reason": self.reason}
        scenario = self.explanation.scenario
        return {
            "reason": "",
            "features": list(FEATURE_NAMES),
            "agents": scenario.tracks.object_id[scenario.evaluated_indices].tolist(),
            "names": self.explanation.agent_names,
            "cost": np.round(self.explanation.cost, 6).tolist(),
        }


def score_variant(scenario: Scenario, rollouts: Rollouts, goals: tuple[GoalEntry, ...], metric: str) -> Scored:
    """Score and outcomes of all rollouts of a scenario, from the numbers that `rlftsim simulate` writes.

    Args:
        scenario: Scenario that was simulated, with its logged future where there is one.
        rollouts: Rollouts of this scenario alone (B = 1), on the CPU.
        goals: Goals of the scenario's agents, to be measured.
        metric: Year of the meta-metric, "2025" or "2024".
    """
    (states,) = states_of_rollouts(collate([scenario]), rollouts)
    return score_states(scenario, states, goals, metric)


def score_states(scenario: Scenario, states: SimulatedStates, goals: tuple[GoalEntry, ...], metric: str) -> Scored:
    """Score and outcomes of simulated states.

    Args:
        scenario: Scenario that was simulated; without a logged future there is a reason in place of a score.
        states: Simulated states [N, A, 80] of the scenario in the world frame.
        goals: Goals of the scenario's agents, to be measured.
        metric: Year of the meta-metric, "2025" or "2024".
    """
    outcomes = tuple((goal, measure_outcome(states.simulated_path(goal.agent_id), (goal.x, goal.y))) for goal in goals)
    explanation, reason = None, ""
    if not scenario.has_future:
        reason = "this split withholds the logged future, which realism is measured against: no score."
    else:
        try:
            explanation = explain(scenario, states, metric_by_name(metric))
        except DataError as error:  # such as a map without road edges
            reason = str(error)
    return Scored(states.num_rollouts, outcomes, explanation, reason)


def compute_change(scored: Scored, free: Scored) -> dict[str, float] | None:
    """Change of the meta-metric by goals with its standard error, by the jackknife over pairs of rollouts.

    Args:
        scored: Scores of a variant with goals.
        free: Scores of the same model without goals, on the same seeds, so that rollouts are pairs.

    Returns:
        None without a score.
    """
    # Not at the top: scipy takes half a second, for which the page would wait.
    from rlftsim.statistics import interval_around

    if scored.explanation is None or free.explanation is None:
        return None
    result, free_result = scored.explanation.result, free.explanation.result
    mean = float(result.meta_metric - free_result.meta_metric)
    count = scored.num_rollouts
    if count < 2:
        return {"mean": mean, "margin": 0.0}
    changes = (result.leave_one_out_meta_metric - free_result.leave_one_out_meta_metric).double()  # [N]
    variance = (count - 1) / count * (changes - changes.mean()).square().sum()
    low, high = interval_around(mean, math.sqrt(float(variance)), count).interval
    return {"mean": mean, "margin": (high - low) / 2}
