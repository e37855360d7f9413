"""Attainment of goals that are given one at a time: the fraction of a policy's rollouts that come to each goal.

A file per scenario is kept, with the policy's fingerprint: an interrupted measurement is resumed, and another policy is
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
from rlftsim.evaluation.evaluate import check_jobs, frozen_copy, identity_of, simulate_encoded
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.evaluation.resumable import JsonParts, map_scenarios
from rlftsim.evaluation.scenario_source import open_held_out
from rlftsim.goals.attainment import measure_outcome
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.placement import goals_of_batch
from rlftsim.jobs.runner import on_this_machine
from rlftsim.rollout.policy import Policy, get_device, is_goal_conditioned
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset


@dataclass(frozen=True)
class Attained:
    """Attainment of one goal: fractions of the rollouts."""

    entry: GoalEntry
    reached: float
    """Within 2 m at the end."""
    passed: float
    """Within 2 m at some step."""

    @property
    def reached_once(self) -> float:
        """1 if some rollout reaches it, else 0."""
        return float(self.reached > 0)

    @property
    def passed_once(self) -> float:
        """1 if some rollout passes it, else 0."""
        return float(self.passed > 0)


def attain_goals(
    policy: Policy,
    data: str | PathLike[str] | ScenarioDataset,
    out: str | PathLike[str],
    config: EvaluateConfig,
    goals: Sequence[GoalEntry],
    *,
    title: str = "goals",
    show_progress: bool = True,
) -> tuple[Attained, ...]:
    """Attainment of each goal by a policy, in the order of the goals.

    Args:
        policy: any policy; one that is not goal-conditioned is simulated once for all goals of a scenario.
        data: data set's folder, or "synthetic", or an opened data set.
        out: folder of the results, a JSON file per scenario, made if missing.
        config: rollouts, seed, sampling, split, processes.
        goals: each is given alone, whatever other goals its scenario has.
        title: beside the progress bar.
        show_progress: False = no progress bar.

    Raises:
        DataError: no such data set, scenario or agent.
        ConfigError: several processes for a policy on a GPU.
    """
    dataset, config = open_held_out(data, config)
    check_jobs(config, get_device(policy))
    by_scenario: dict[str, list[GoalEntry]] = {}
    for goal in goals:
        by_scenario.setdefault(goal.scenario_id, []).append(goal)
    # The goals' labels are not compared: renaming one measures nothing anew.
    common = identity_of(policy, dataset, config)
    points = {i: [[goal.agent_id, goal.x, goal.y] for goal in own] for i, own in by_scenario.items()}
    identity = {scenario_id: common | {"goals": own} for scenario_id, own in points.items()}
    ids, information = tuple(by_scenario), {"package_version": __version__}
    files = JsonParts(Path(out), ids, identity, information, partial(_attained, by_scenario))
    work = partial(_simulate_goals, _Job(frozen_copy(policy), dataset, config, by_scenario))
    runner = on_this_machine(config.jobs, len(ids))
    parts = map_scenarios(work, len(ids), files, runner=runner, title=title, show_progress=show_progress)
    # Files are by scenario, goals may come in any order.
    found = {_key(one.entry): one for part in parts for one in part}
    return tuple(found[_key(goal)] for goal in goals)


@dataclass(frozen=True, eq=False)
class _Job:
    """Input of the work on a scenario; is handed to other processes."""

    policy: Policy
    dataset: ScenarioDataset
    config: EvaluateConfig
    goals: Mapping[str, Sequence[GoalEntry]]
    """By scenario id, in the order of positions."""


def _key(entry: GoalEntry) -> tuple[str, int, float, float, str]:
    return entry.scenario_id, entry.agent_id, entry.x, entry.y, entry.label


def _attained(
    goals: Mapping[str, Sequence[GoalEntry]], scenario_id: str, values: Mapping[str, Any]
) -> tuple[Attained, ...]:
    fractions = zip(goals[scenario_id], values["reached"], values["passed"], strict=True)
    return tuple(Attained(goal, reached, passed) for goal, reached, passed in fractions)


def _simulate_goals(job: _Job, position: int) -> dict[str, object]:
    """Fractions of the rollouts for each goal of a scenario."""
    scenario_id = tuple(job.goals)[position]
    batch = collate([job.dataset.by_id(scenario_id)]).to(get_device(job.policy))
    with torch.no_grad():
        context = job.policy.encode(batch)
    simulated = partial(simulate_encoded, job.policy, batch, context, job.config)
    # Without goal conditioning the rollouts are the same for every goal.
    goal_free = None if is_goal_conditioned(job.policy) else simulated()
    outcomes = []
    for goal in job.goals[scenario_id]:
        states = goal_free or simulated(goals=goals_of_batch([goal], batch))
        outcomes.append(measure_outcome(states.simulated_path(goal.agent_id), (goal.x, goal.y)))
    return {"reached": [one.reached for one in outcomes], "passed": [one.passed for one in outcomes]}
