"""Who gets where it is asked to go: every goal given alone, to a policy that sees it or, as a baseline, to one that does not.

A file a scenario is kept, with the model's fingerprint, so an interrupted measurement goes on and another model is measured anew.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from rlftsim import __version__
from rlftsim.errors import DataError
from rlftsim.experiments.contestants import Contestant
from rlftsim.experiments.evaluate import EvaluateConfig, check_jobs, choose_scenarios, simulate_encoded
from rlftsim.experiments.workshop import Workshop
from rlftsim.files import write_text
from rlftsim.goals.attainment import outcome_of
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.placing import goals_of_batch
from rlftsim.processor import one_thread
from rlftsim.progress import progress_bar
from rlftsim.recipes.models import load_policy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, device_of, sees_goals
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.workers import run_tasks

FOLDER = "attainment"


@dataclass(frozen=True)
class Attained:
    """What became of one goal: shares of the rollouts."""

    entry: GoalEntry
    reached: float
    """Ends within 2 m."""
    passed: float
    """Comes within 2 m at some time."""

    @property
    def reached_once(self) -> float:
        """1 if some rollout reaches it, else 0."""
        return float(self.reached > 0)

    @property
    def passed_once(self) -> float:
        """1 if some rollout passes it, else 0."""
        return float(self.passed > 0)


def held_out(workshop: Workshop) -> tuple[ScenarioDataset, tuple[str, ...]]:
    """The scenarios that a workshop measures on, and their ids."""
    config = workshop.evaluation
    dataset = ScenarioDataset(workshop.data, config.split)
    return dataset, tuple(dataset.scenario_ids[i] for i in choose_scenarios(dataset, config))


def measure_attainment(
    workshop: Workshop, rows: Mapping[str, Contestant], goals: Sequence[GoalEntry], *, name: str
) -> dict[str, tuple[Attained, ...]]:
    """What becomes of every goal with each contestant, in the order of the goals; whoever is not trained yet is trained.

    Args:
        workshop: scenarios, settings, models.
        rows: contestants by the names of their rows.
        goals: each is given alone, whatever others its scenario has.
        name: of the folder of results.
    """
    models = workshop.models(list(rows.values()))
    asked: dict[str, list[GoalEntry]] = {}
    for goal in goals:
        asked.setdefault(goal.scenario_id, []).append(goal)
    found = {}
    for row, contestant in rows.items():
        folder = workshop.out / FOLDER / name / workshop.evaluation_name(contestant)
        policy = load_policy(models[contestant], workshop.device)
        job = _Job(policy, fingerprint_policy(policy), workshop.data, workshop.evaluation, asked, folder)
        check_jobs(job.config, device_of(policy))
        missing = [i for i in asked if _read(job, i) is None]
        with progress_bar(f"goals, {row}", len(asked), len(asked) - len(missing)) as advance, one_thread():
            run_tasks(partial(_measure_scenario, job), missing, jobs=job.config.jobs, advance=advance)
        attained = [one for i in asked for one in _read(job, i) or ()]
        if len(attained) < len(goals):
            raise DataError(f"{folder}: results vanished meanwhile (another process in the same folder?): run again.")
        by_goal = {_key(one.entry): one for one in attained}
        found[row] = tuple(by_goal[_key(goal)] for goal in goals)
    return found


# ---- one scenario -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Job:
    """Handed to other processes."""

    policy: Policy
    fingerprint: str
    data: Path
    config: EvaluateConfig
    goals: Mapping[str, Sequence[GoalEntry]]
    folder: Path

    def path_of(self, scenario_id: str) -> Path:
        return self.folder / f"{scenario_id}.json"

    def whose(self, scenario_id: str) -> dict[str, object]:
        """What a file of results must say to be those of this job."""
        goals = [[goal.agent_id, goal.x, goal.y] for goal in self.goals[scenario_id]]
        return {"rlftsim": __version__, "policy": self.fingerprint, "goals": goals}


def _key(entry: GoalEntry) -> tuple[str, int, float, float, str]:
    return entry.scenario_id, entry.agent_id, entry.x, entry.y, entry.label


def _read(job: _Job, scenario_id: str) -> tuple[Attained, ...] | None:
    """What was measured of a scenario's goals; None where it is missing, damaged, or of other goals or another model."""
    try:
        found, whose = json.loads(job.path_of(scenario_id).read_text()), job.whose(scenario_id)
        if {name: found[name] for name in whose} != whose:
            return None
        shares = zip(job.goals[scenario_id], found["reached"], found["passed"], strict=True)
        return tuple(Attained(goal, reached, passed) for goal, reached, passed in shares)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _measure_scenario(
    job: _Job, scenario_id: str, advance: Callable[[int], None], is_stopped: Callable[[], bool]
) -> None:
    """Simulate under each goal; once for all of them if the policy sees none."""
    scenario = ScenarioDataset(job.data, job.config.split, cache_size=1).by_id(scenario_id)
    batch = collate([scenario]).to(device_of(job.policy))
    with torch.no_grad():
        context = job.policy.encode(batch)
    simulated = partial(simulate_encoded, job.policy, batch, context, job.config)
    blind = None if sees_goals(job.policy) else simulated()
    outcomes = []
    for goal in job.goals[scenario_id]:
        if is_stopped():
            return
        states = blind or simulated(goals=goals_of_batch([goal], batch))
        outcomes.append(outcome_of(states.way_of(goal.agent_id), (goal.x, goal.y)))
    shares = {"reached": [one.reached for one in outcomes], "passed": [one.passed for one in outcomes]}
    write_text(job.path_of(scenario_id), json.dumps(job.whose(scenario_id) | shares) + "\n")
    advance(1)
