"""Attainment of single goals: the fraction of a policy's rollouts that come to each goal.

A file per scenario is stored, with the policy's fingerprint: an interrupted measurement is resumed, and a new policy is
measured anew. A policy that is not goal-conditioned is measured against the same goals, as a baseline.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import torch

from rlftsim import __version__
from rlftsim.evaluation.evaluate import describe_measurement
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.evaluation.resumable import ScenarioValues, measure_scenarios
from rlftsim.evaluation.rollout_states import simulate_states
from rlftsim.evaluation.scenario_source import open_held_out
from rlftsim.goals.attainment import measure_outcome
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.placement import goals_of_batch
from rlftsim.jobs.runner import check_jobs, choose_runner
from rlftsim.rollout.policy import Policy, frozen_copy, get_device, is_goal_conditioned
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset


@dataclass(frozen=True)
class Attained:
    """Attainment of a goal: fractions of the rollouts."""

    entry: GoalEntry
    reached: float
    """Within 2 m at the end."""
    passed: float
    """Within 2 m at some step."""

    @property
    def reached_once(self) -> float:
        """1 if any rollout reaches the goal, else 0."""
        return float(self.reached > 0)

    @property
    def passed_once(self) -> float:
        """1 if any rollout passes the goal, else 0."""
        return float(self.passed > 0)


def attain_goals(
    policy: Policy,
    data: str | PathLike[str] | ScenarioDataset,
    out: str | PathLike[str],
    config: EvaluateConfig,
    goals: Sequence[GoalEntry],
    *,
    title: str = "goals",
) -> tuple[Attained, ...]:
    """Attainment of each goal by a policy, in the order of the goals.

    Args:
        policy: Any policy; without goal conditioning, a scenario is simulated once for all goals.
        data: Folder of a data set, "synthetic", or an opened data set.
        out: Folder of the results, a JSON file per scenario, made if missing.
        config: Rollouts, seed, sampling, split, processes.
        goals: Goals; each is pursued alone, whatever goals the scenario has besides.
        title: Name of the work, in front of the progress bar.

    Raises:
        DataError: No such data set, scenario or agent, or a second process at work in the folder.
        ConfigError: Several processes for a policy on a GPU.
    """
    dataset, config = open_held_out(data, config)
    check_jobs(config.jobs, get_device(policy))
    by_scenario: dict[str, list[GoalEntry]] = {}
    for goal in goals:
        by_scenario.setdefault(goal.scenario_id, []).append(goal)
    # The goals' labels are not compared: renaming one measures nothing anew.
    measurement = describe_measurement(policy, dataset, config)
    identity = {
        scenario_id: measurement | {"goals": [[goal.agent_id, goal.x, goal.y] for goal in scenario_goals]}
        for scenario_id, scenario_goals in by_scenario.items()
    }
    files = ScenarioValues(Path(out), tuple(by_scenario), identity, partial(_parse_attained, by_scenario))
    work = partial(_simulate_goals, frozen_copy(policy), dataset, config, by_scenario)
    stored = measure_scenarios(title, work, files, runner=choose_runner(config.jobs, len(by_scenario)))
    # Files are by scenario, goals may come in any order.
    by_goal = {attained.entry: attained for scenario_goals in stored for attained in scenario_goals}
    return tuple(by_goal[goal] for goal in goals)


def _parse_attained(
    goals: Mapping[str, Sequence[GoalEntry]], scenario_id: str, values: Mapping[str, Any]
) -> tuple[Attained, ...]:
    fractions = zip(goals[scenario_id], values["reached"], values["passed"], strict=True)
    return tuple(Attained(goal, reached, passed) for goal, reached, passed in fractions)


def _simulate_goals(
    policy: Policy,
    dataset: ScenarioDataset,
    config: EvaluateConfig,
    goals: Mapping[str, Sequence[GoalEntry]],
    position: int,
) -> dict[str, object]:
    """Fractions of the rollouts for each goal of a scenario, with goals by scenario id in the order of positions."""
    scenario_id = tuple(goals)[position]
    batch = collate([dataset.by_id(scenario_id)]).to(get_device(policy))
    with torch.no_grad():
        context = policy.encode(batch)
    simulate = partial(simulate_states, policy, batch, config, context=context)
    # Without goal conditioning the rollouts are the same for every goal.
    goal_free = None if is_goal_conditioned(policy) else simulate()
    outcomes = []
    for goal in goals[scenario_id]:
        states = goal_free or simulate(goals=goals_of_batch([goal], batch))
        outcomes.append(measure_outcome(states.simulated_path(goal.agent_id), (goal.x, goal.y)))
    reached, passed = [outcome.reached for outcome in outcomes], [outcome.passed for outcome in outcomes]
    return {"reached": reached, "passed": passed, "package_version": __version__}
