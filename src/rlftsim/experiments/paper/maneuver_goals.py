"""Goals of the maneuver benchmark: logged and alternative maneuvers of egos that have both, in an editable file."""

from collections.abc import Sequence
from pathlib import Path

from rlftsim.errors import DataError
from rlftsim.experiments.goal_proposals import LOGGED, propose, split_label, to_goal_entry
from rlftsim.experiments.paper.controllability import open_held_out
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.goals.goals_file import GoalEntry, GoalsFile, read_goals, write_goals
from rlftsim.goals.placement import find_track
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS, Maneuver

NAME = "maneuver-controllability"


def goals_path(suite: ExperimentSuite) -> Path:
    """Path of a suite's goals file, which may be edited by hand."""
    return suite.out / f"{NAME}.goals.json"


def propose_goals(dataset: ScenarioDataset, scenario_ids: Sequence[str]) -> GoalsFile:
    """Logged and alternative maneuvers of every ego that has both. The logged maneuvers are the file's goals.

    Args:
        dataset: Scenarios with logged futures.
        scenario_ids: Ids of the scenarios to propose goals for, in the order of the file.
    """
    logged, alternatives = [], []
    for scenario_id in scenario_ids:
        scenario = dataset.by_id(scenario_id)
        proposals = propose(scenario, scenario.ego_index)
        # An ego without an alternative, or whose logged maneuver has no name, cannot be compared with itself.
        if {proposal.is_logged for proposal in proposals} == {True, False}:
            for proposal in proposals:
                (logged if proposal.is_logged else alternatives).append(to_goal_entry(scenario, proposal))
    return GoalsFile(tuple(logged), tuple(alternatives))


def find_goals(suite: ExperimentSuite) -> list[GoalEntry]:
    """Goals of the suite's held-out scenarios from the suite's goals file, which is written first if there is none.

    Raises:
        DataError: No ego has two maneuvers, or the file was edited and makes no sense.
    """
    dataset, ids = open_held_out(suite)
    path = goals_path(suite)
    # 1. Goals are proposed once: the file may have been edited since.
    if not path.exists():
        write_goals(path, propose_goals(dataset, ids))
    file = read_goals(path)
    goals = [goal for goal in (*file.goals, *file.alternatives) if goal.scenario_id in ids]
    # 2. All of them are checked, before anything is trained.
    for goal in goals:
        parse_maneuver(goal)
        scenario = dataset.by_id(goal.scenario_id)
        if find_track(goal, scenario) != scenario.ego_index:
            raise DataError(
                f"{goal}: agent {goal.agent_id} is not the ego of scenario {scenario.scenario_id}, and only the ego "
                f"may have a goal here: write agent {scenario.tracks.object_id[scenario.ego_index]}, or remove the "
                "entry."
            )
    if all(is_logged(goal) for goal in goals):
        raise DataError(
            f"{path}: not one ego of {len(ids)} scenarios has an alternative maneuver: take more scenarios."
        )
    return goals


def is_logged(goal: GoalEntry) -> bool:
    """True if the goal's maneuver is the logged maneuver."""
    return split_label(goal.label)[1]


def parse_maneuver(goal: GoalEntry) -> Maneuver:
    """Maneuver that a goal's label names.

    Raises:
        DataError: The label names no maneuver.
    """
    try:
        return Maneuver(split_label(goal.label)[0])
    except ValueError:
        maneuvers = ", ".join(m.value for m in BENCHMARK_MANEUVERS)
        raise DataError(
            f"{goal}: label {goal.label!r} names no maneuver: known are {maneuvers}, each with {LOGGED!r} if it is the "
            "logged one."
        ) from None
