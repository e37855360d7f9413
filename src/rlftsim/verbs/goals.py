"""`rlftsim goals`: propose goals for agents, or check a file of goals. Reads the goals of a command line, too."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from rich.table import Table

from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.goal_proposals import format_label, propose, to_goal_entry
from rlftsim.goals.goals_file import GoalEntry, GoalsFile, check_single_goals, parse_goal, read_goals, write_goals
from rlftsim.goals.placement import distance_m, goal_warnings
from rlftsim.goals.proposals import Proposal, no_proposal_reason
from rlftsim.jobs.folder import check_file
from rlftsim.jobs.progress import log, print_line, print_wide
from rlftsim.rollout.policy import Policy, is_goal_conditioned
from rlftsim.scenario.dataset import ScenarioDataset, dataset_folder
from rlftsim.scenario.open import check_membership
from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario
from rlftsim.viewer.figure import check_picture_path
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel, draw_goals

Choice = Literal[
    "alternative", "logged", "straight", "left", "right", "left_uturn", "lane_change_left", "lane_change_right"
]
"""The last six are those of `Maneuver`, spelled out for the command line."""


def propose_goals(
    data: str,
    scenario: list[str],
    *,
    agent: list[int] | None = None,
    choose: Choice = "alternative",
    out: Path | None = None,
    picture: Path | None = None,
) -> None:
    """Propose maneuvers for agents from the lane graph, and write them to a goals file.

    Lists every maneuver that can be completed in 8 seconds at plausible speeds and without leaving the road:
    straight, left, right, left U-turn, lane changes. The logged maneuver is marked. The file has one of them as
    the goal of each agent and keeps the others as alternatives.

    Args:
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        scenario: Ids of the scenarios whose agents get proposals.
        agent: Object ids of agents. Left out: the evaluated agents.
        choose: Goals in the file: the first maneuver that differs from the log, the logged one, or a maneuver
            by name. Agents that cannot do it get no goal.
        out: Goals file to write. Left out: the proposals are only printed.
        picture: PNG, SVG or PDF of the proposals, a panel for each agent.
    """
    # 1. mistakes that need no scenario to be seen
    for file in filter(None, (out, picture)):
        check_file(file)
    if picture is not None:
        check_picture_path(picture)
    # 2. a table for each scenario, and its goals and pictures for later
    scenarios = ScenarioDataset(dataset_folder(data))
    goals, alternatives, panels = [], [], []
    for scenario_id in dict.fromkeys(scenario):
        check_membership(scenarios, scenario_id, data, "--scenario")
        logged = scenarios.by_id(scenario_id)
        headings = ("agent", "kind", "m/s", "maneuver", "goal (x, y)", "away [m]")
        table = Table(*headings, title=f"scenario {scenario_id}")
        for track in _find_tracks(logged, agent):
            proposals = propose(logged, track)
            goal = next((proposal for proposal in proposals if _is_choice(proposal, choose)), None)
            for proposal in proposals:
                (goals if proposal is goal else alternatives).append(to_goal_entry(logged, proposal))
            _add_rows(table, logged, track, proposals, goal)
            object_id = int(logged.tracks.object_id[track])
            marks = [
                DrawnGoal(object_id, p.position, format_label(p), p.path[:, :2], is_logged=p.is_logged)
                for p in proposals
            ]
            title = f"{scenario_id}, agent {object_id}"
            panels.append(GoalPanel(title, logged, tuple(marks) or (DrawnGoal(object_id),)))
        print_wide(table)
        warn_of_doubts([entry for entry in goals if entry.scenario_id == scenario_id], logged)
    # 3. files
    if picture is not None:
        draw_goals(picture, panels, columns=min(len(panels), 4))
        print_line(picture)
    if out is not None:
        if not goals:
            labels = dict.fromkeys(entry.label for entry in alternatives)
            reason = f"they can do {', '.join(labels)} (--choose)" if labels else "there is no proposal for them"
            raise DataError(
                f"{out} not written, none of these agents can do {choose}: {reason}; or name others with --agent."
            )
        write_goals(out, GoalsFile(tuple(goals), tuple(alternatives)))
        print_line(f"{out}: {len(goals)} goals, {len(alternatives)} alternatives.")


def _is_choice(proposal: Proposal, choice: Choice) -> bool:
    """True if a proposal may be the goal under a choice."""
    if choice in ("alternative", "logged"):
        return proposal.is_logged == (choice == "logged")
    return proposal.maneuver.value == choice


def _find_tracks(scenario: Scenario, object_ids: list[int] | None) -> list[int]:
    """Track indices of the agents to propose goals for: those with these ids, or the evaluated ones.

    Raises:
        ConfigError: An agent that is not simulated.
    """
    if object_ids is None:
        return scenario.evaluated_indices.tolist()
    track_by_id = {int(scenario.tracks.object_id[track]): int(track) for track in scenario.simulated_indices}
    unknown_ids = [str(object_id) for object_id in object_ids if object_id not in track_by_id]
    if unknown_ids:
        raise ConfigError(
            f"no agent {', '.join(unknown_ids)} in scenario {scenario.scenario_id}: there are "
            f"{', '.join(map(str, sorted(track_by_id)))}."
        )
    return [track_by_id[object_id] for object_id in dict.fromkeys(object_ids)]


def check_goals(file: Path, data: str) -> None:
    """Check a goals file, its alternatives included, against its scenarios, and list doubtful goals.

    An impossible goal ends with status 2.

    Args:
        file: Goals file, such as one that `rlftsim goals propose` wrote.
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
    """
    scenarios, goals = ScenarioDataset(dataset_folder(data)), read_goals(file)
    lines = []
    for entry in (*goals.goals, *goals.alternatives):
        check_membership(scenarios, entry.scenario_id, data, entry)
        lines += goal_warnings(entry, scenarios.by_id(entry.scenario_id))
    for line in lines:
        print_line(line)
    counts = f"{len(goals.goals)} goals in {len(goals.scenario_ids)} scenarios, {len(goals.alternatives)} alternatives"
    print_line(f"{file}: {counts}, {len(lines)} doubts.")


def read_given_goals(file: Path | None, written: list[str], scenario_ids: list[str] | None) -> GoalsFile:
    """The goals of a command line: those of a file, and those written AGENT=X,Y.

    Args:
        file: Goals file of `--goals`; None = not given.
        written: Values of `--goal`, each AGENT=X,Y in meters, world frame.
        scenario_ids: Values of `--scenario`; None = not given.

    Raises:
        DataError: A file or a goal that makes no sense, or a file without goals in the simulated scenarios.
        ConfigError: Goals are written out, but it is unclear for which scenario.
    """
    goals = GoalsFile(()) if file is None else read_goals(file)
    # A file whose goals would all be ignored is a mistake.
    if file is not None and not goals.goals:
        count = len(goals.alternatives)
        advice = f'move one of its {count} alternatives to "goals"' if count else "add one"
        raise DataError(f'{file}: has no entry in "goals": {advice}, or leave --goals out.')
    if file is not None and scenario_ids and not any(goals.of_scenario(scenario_id) for scenario_id in scenario_ids):
        raise DataError(
            f"{file}: has goals in {len(goals.scenario_ids)} scenarios, such as {goals.scenario_ids[0]}, none in "
            f"{', '.join(scenario_ids)}: name another --scenario, or leave --goals or --scenario out."
        )
    if not written:
        return goals
    if scenario_ids is None or len(scenario_ids) != 1:
        raise ConfigError("--goal AGENT=X,Y needs one scenario: name it with --scenario, or write a file for --goals.")
    entries = (*goals.goals, *(parse_goal(text, scenario_ids[0]) for text in written))
    check_single_goals(entries)
    return GoalsFile(entries, goals.alternatives)


def warn_of_doubts(entries: Sequence[GoalEntry], scenario: Scenario) -> None:
    """Log goals that will most likely be missed.

    Args:
        entries: Goals of agents in the scenario.
        scenario: Map and log of the agents.

    Raises:
        DataError: An impossible goal.
    """
    for entry in entries:
        for line in goal_warnings(entry, scenario):
            log.info(f"  {line}")


def check_goal_effects(goals: GoalsFile, policy: Policy, name: str, guidance_scale: float) -> None:
    """Check that goals and guidance have an effect.

    Args:
        goals: Goals of the simulated agents; may be empty.
        policy: Policy that decides for all agents.
        name: Name of the policy, for messages.
        guidance_scale: Factor on the goal-progress bias; 1 = as learned.

    Raises:
        ConfigError: Goals of a policy that is not goal-conditioned, or guidance without goals.
    """
    if goals.goals and not is_goal_conditioned(policy):
        raise ConfigError(
            f"{name} is not goal-conditioned, {len(goals.goals)} goals would have no effect: take a model "
            "that was fine-tuned with goals (docs/goals.md), or leave --goal and --goals out."
        )
    if guidance_scale != 1.0 and not goals.goals:
        raise ConfigError(f"--guidance-scale {guidance_scale:g} has no effect without goals: add --goal or --goals.")


def check_scenarios(
    scenario_ids: Sequence[str], goals: GoalsFile, dataset: ScenarioDataset, name: str, has_scenario_flag: bool
) -> None:
    """Check scenarios and goals that are to be simulated, and log doubts.

    Args:
        scenario_ids: Ids of the scenarios.
        goals: Goals of agents in the scenarios; may be empty.
        dataset: Data set that must have the scenarios.
        name: Name of the data set, for messages.
        has_scenario_flag: True where the ids are those of `--scenario`, else those of goals.

    Raises:
        DataError: An unknown scenario, or an impossible goal.
    """
    for scenario_id in scenario_ids:
        entries = goals.of_scenario(scenario_id)
        check_membership(dataset, scenario_id, name, "--scenario" if has_scenario_flag else next(iter(entries), ""))
        if entries:
            warn_of_doubts(entries, dataset.by_id(scenario_id))
        elif goals.goals:
            log.info(f"  scenario {scenario_id} has no goals: it is simulated without.")


def _add_rows(
    table: Table, scenario: Scenario, track: int, proposals: tuple[Proposal, ...], goal: Proposal | None
) -> None:
    tracks = scenario.tracks
    speed = float(np.linalg.norm(tracks.velocity[track, CURRENT_STEP]))
    agent = (str(tracks.object_id[track]), ObjectType(int(tracks.object_type[track])).name.lower(), f"{speed:.1f}")
    if not proposals:
        reason = no_proposal_reason(scenario, track) or "no maneuver can be completed in time"
        table.add_row(*agent, f"nothing: {reason}", "", "")
    for row, proposal in enumerate(proposals):
        entry = to_goal_entry(scenario, proposal)
        mark = " ← goal" if proposal is goal else ""
        point = f"{entry.x:.2f},{entry.y:.2f}"
        distance = f"{distance_m(entry, scenario, track):.0f}"
        table.add_row(*(agent if row == 0 else ("", "", "")), f"{format_label(proposal)}{mark}", point, distance)
