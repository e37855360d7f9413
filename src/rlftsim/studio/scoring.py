"""Score, outcome of goals and events of one variant's rollouts, as the page shows them."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rlftsim.errors import DataError
from rlftsim.evaluation.explain import Explanation, explain
from rlftsim.goals.attainment import Outcome, measure_outcome
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.realism import FEATURE_NAMES, SimulatedStates, metric_by_name
from rlftsim.realism.config import BERNOULLI_FEATURES
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import Scenario

EVENT_KINDS = ("collision", "offroad", "light")
"""Names of `BERNOULLI_FEATURES` on the page."""
assert len(EVENT_KINDS) == len(BERNOULLI_FEATURES)


@dataclass(frozen=True, eq=False)
class Scored:
    """Everything that is known of a variant once its rollouts are complete."""

    num_rollouts: int
    outcomes: tuple[tuple[GoalEntry, Outcome], ...]
    explanation: Explanation | None
    reason: str = ""
    """Why there is no score; empty where there is one."""

    def to_payload(self, free: "Scored | None" = None) -> dict[str, Any]:
        """Plain numbers for the page.

        Args:
            free: the same model on the same seeds without goals, for the change of realism.
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
            "change": None if free is None else change_of(self, free),
        }

    @cached_property
    def _score(self) -> dict[str, Any]:
        found = self.explanation
        assert found is not None
        (official,), (ceiling,) = found.result.to_official_fields(), found.ceiling.to_official_fields()
        lost = found.cost.sum((1, 2))  # [F]
        return {
            "metric": found.config.name,
            "official": _plain(official),
            "ceiling": _plain(ceiling),
            "lost": found.lost,
            "features": [
                {"name": name, "weight": weight, "value": _number(value), "ceiling": _number(top), "lost": float(part)}
                for name, weight, value, top, part in zip(
                    FEATURE_NAMES, found.config.weights, found.result.likelihoods, found.ceiling.likelihoods, lost
                )
            ],
        }

    @cached_property
    def _events(self) -> list[list[Any]]:
        """Kind, rollout, object id, first and last simulated step of every event."""
        assert self.explanation is not None
        scenario = self.explanation.scenario
        ids = scenario.tracks.object_id[scenario.evaluated_indices].tolist()
        edges = np.diff(self.explanation.events.astype(np.int8), axis=-1, prepend=0, append=0)  # [J, N, E, T + 1]
        # Rows of both are in the same order, so that starts and stops of one event stand side by side.
        starts, stops = np.argwhere(edges == 1).tolist(), np.argwhere(edges == -1).tolist()
        return [[EVENT_KINDS[j], n, ids[e], start, stop[3]] for (j, n, e, start), stop in zip(starts, stops)]

    def explained(self) -> dict[str, Any]:
        """Costs by feature, agent and step for the page."""
        if self.explanation is None:
            return {"reason": self.reason}
        found, tracks = self.explanation, self.explanation.scenario.tracks
        return {
            "reason": "",
            "features": list(FEATURE_NAMES),
            "agents": tracks.object_id[found.scenario.evaluated_indices].tolist(),
            "names": found.agent_names,
            "cost": np.round(found.cost, 6).tolist(),
        }


def score_variant(scenario: Scenario, rollouts: Rollouts, goals: tuple[GoalEntry, ...], metric: str) -> Scored:
    """Score and outcomes of all rollouts of a scenario, from the numbers that `rlftsim simulate` writes.

    Args:
        scenario: that was simulated.
        rollouts: of this scenario alone, on the CPU.
        goals: of its agents.
        metric: year.
    """
    (states,) = states_of_rollouts(collate([scenario]), rollouts)
    return score_states(scenario, states, goals, metric)


def score_states(scenario: Scenario, states: SimulatedStates, goals: tuple[GoalEntry, ...], metric: str) -> Scored:
    """Score and outcomes of simulated states.

    Args:
        scenario: that was simulated.
        states: world frame.
        goals: of its agents.
        metric: year.
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


def change_of(scored: Scored, free: Scored) -> dict[str, float] | None:
    """Change of the meta-metric by goals with its standard error, by the jackknife over pairs of rollouts.

    Args:
        scored: with goals.
        free: without, on the same seeds, so that rollouts are pairs.

    Returns:
        None without a score.
    """
    # Not at the top: scipy takes half a second, for which the page would wait.
    from rlftsim.statistics import interval_around

    if scored.explanation is None or free.explanation is None:
        return None
    own, other = scored.explanation.result, free.explanation.result
    mean = float(own.meta_metric - other.meta_metric)
    count = scored.num_rollouts
    if count < 2:
        return {"mean": mean, "margin": 0.0}
    without_each = (own.leave_one_out_meta_metric - other.leave_one_out_meta_metric).double()  # [N]
    variance = (count - 1) / count * (without_each - without_each.mean()).square().sum()
    low, high = interval_around(mean, math.sqrt(float(variance)), count).interval
    return {"mean": mean, "margin": (high - low) / 2}


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    """Official fields with None for what is not a number."""
    return {
        name: _plain(value) if isinstance(value, dict) else value if isinstance(value, str) else _number(value)
        for name, value in fields.items()
    }


def _number(value: Any) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None
