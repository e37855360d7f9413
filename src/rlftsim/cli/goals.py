"""The verb that proposes and checks goals: goals. Also reads the goals of a command line, for verbs that simulate."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.table import Table
from tyro.conf import Positional

from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.goal_proposals import format_label, propose, to_goal_entry
from rlftsim.goals.goals_file import GoalEntry, GoalsFile, check_single_goals, parse_goal, read_goals, write_goals
from rlftsim.goals.maneuvers.proposals import Proposal, no_proposal_reason
from rlftsim.goals.placement import distance_m, goal_warnings
from rlftsim.jobs.folder import check_file
from rlftsim.jobs.progress import log, print_wide
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.open import check_splits, dataset_folder
from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario
from rlftsim.viewer.figure import check_picture_path
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel, draw_goals

Choice = Literal[
    "alternative", "logged", "straight", "left", "right", "left_uturn", "lane_change_left", "lane_change_right"
]
"""The last six are those of `Maneuver`, spelled out for the command line."""


@dataclass(frozen=True)
class Propose:
    """Propose maneuvers for agents from the lane graph, and write them to a goals file.

    Lists every maneuver that can be completed in 8 seconds at plausible speeds and without leaving the road:
    straight, left, right, left U-turn, lane changes. The logged maneuver is marked. The file has one of them as
    the goal of each agent and keeps the others as alternatives.
    """

    data: Annotated[Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    scenario: list[str]
    """Scenario ids."""
    agent: list[int] | None = None
    """Object ids of agents. Left out: the evaluated agents."""
    choose: Choice = "alternative"
    """Goals in the file: the first maneuver that differs from the log, the logged one, or a maneuver by name.
    Agents that cannot do it get no goal."""
    out: Path | None = None
    """Goals file to write. Left out: the proposals are only printed."""
    picture: Path | None = None
    """PNG, SVG or PDF of the proposals, a panel for each agent."""

    def run(self) -> int:
        """Propose goals; print, draw and write them."""
        # 1. mistakes that need no scenario to be seen
        for file in filter(None, (self.out, self.picture)):
            check_file(file)
        if self.picture is not None:
            check_picture_path(self.picture)
        # 2. a table for each scenario, and its goals and pictures for later
        scenarios = ScenarioDataset(dataset_folder(self.data))
        goals, alternatives, panels = [], [], []
        for scenario_id in dict.fromkeys(self.scenario):
            check_splits(scenarios, scenario_id, self.data, "--scenario")
            scenario = scenarios.by_id(scenario_id)
            table = Table(title=f"scenario {scenario.scenario_id}", title_justify="left")
            for heading in ("agent", "kind", "m/s", "maneuver", "goal (x, y)", "away [m]"):
                table.add_column(heading)
            for track in self._tracks(scenario):
                proposals = propose(scenario, track)
                chosen = next((proposal for proposal in proposals if self._is_chosen(proposal)), None)
                for proposal in proposals:
                    (goals if proposal is chosen else alternatives).append(to_goal_entry(scenario, proposal))
                _add_rows(table, scenario, track, proposals, chosen)
                agent = int(scenario.tracks.object_id[track])
                marks = [
                    DrawnGoal(agent, p.position, format_label(p), p.path[:, :2], is_logged=p.is_logged)
                    for p in proposals
                ]
                title = f"{scenario.scenario_id}, agent {agent}"
                panels.append(GoalPanel(title, scenario, tuple(marks) or (DrawnGoal(agent),)))
            print_wide(table)
            warn_of_doubts([entry for entry in goals if entry.scenario_id == scenario_id], scenario)
        # 3. files
        if self.picture is not None:
            draw_goals(self.picture, panels, columns=min(len(panels), 4))
            print(self.picture)
        if self.out is not None:
            self._refuse_no_goals(goals, alternatives)
            write_goals(self.out, GoalsFile(tuple(goals), tuple(alternatives)))
            print(f"{self.out}: {len(goals)} goals, {len(alternatives)} alternatives.")
        return 0

    def _is_chosen(self, proposal: Proposal) -> bool:
        match self.choose:
            case "alternative":
                return not proposal.is_logged
            case "logged":
                return proposal.is_logged
            case maneuver:
                return proposal.maneuver.value == maneuver

    def _refuse_no_goals(self, chosen: list[GoalEntry], alternatives: list[GoalEntry]) -> None:
        """Refuse to write a file without goals.

        Raises:
            DataError: no agent can do the chosen maneuver; the message lists the possible ones.
        """
        if chosen:
            return
        labels = dict.fromkeys(entry.label for entry in alternatives)
        can = f"they can do {', '.join(labels)} (--choose)" if labels else "there is no proposal for them"
        raise DataError(
            f"{self.out} not written, none of these agents can do {self.choose}: {can}; or name others with --agent."
        )

    def _tracks(self, scenario: Scenario) -> list[int]:
        """Track indices of the agents to propose goals for.

        Raises:
            ConfigError: an agent that is not simulated.
        """
        if self.agent is None:
            return scenario.evaluated_indices.tolist()
        by_id = {int(scenario.tracks.object_id[i]): int(i) for i in scenario.simulated_indices}
        unknown = [str(agent) for agent in self.agent if agent not in by_id]
        if unknown:
            raise ConfigError(
                f"no agent {', '.join(unknown)} in scenario {scenario.scenario_id}: there are "
                f"{', '.join(map(str, sorted(by_id)))}."
            )
        return [by_id[agent] for agent in dict.fromkeys(self.agent)]


@dataclass(frozen=True)
class Check:
    """Check a goals file, its alternatives included, against its scenarios, and list doubtful goals."""

    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")]
    """A goals file."""
    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""

    def run(self) -> int:
        """List doubtful goals; an impossible one ends with status 2."""
        scenarios, file = ScenarioDataset(dataset_folder(self.data)), read_goals(self.file)
        lines = []
        for entry in (*file.goals, *file.alternatives):
            check_splits(scenarios, entry.scenario_id, self.data, entry)
            lines += goal_warnings(entry, scenarios.by_id(entry.scenario_id))
        for line in lines:
            print(line)
        counts = f"{len(file.goals)} goals in {len(file.scenario_ids)} scenarios, {len(file.alternatives)} alternatives"
        print(f"{self.file}: {counts}, {len(lines)} doubts.")
        return 0


@dataclass(frozen=True)
class GoalsVerb:
    """Propose goals for agents, or check a file of them."""

    action: Annotated[Propose, tyro.conf.subcommand("propose")] | Annotated[Check, tyro.conf.subcommand("check")]

    def run(self) -> int:
        """Run the action."""
        return self.action.run()


def given_goals(file: Path | None, written: list[str], scenario_ids: list[str] | None) -> GoalsFile:
    """The goals of a command line: those of a file, and those written AGENT=X,Y.

    Args:
        file: goals file of `--goals`.
        written: values of `--goal`.
        scenario_ids: values of `--scenario`; None = not given.

    Raises:
        DataError: a file or a goal that makes no sense, or a file without goals in the simulated scenarios.
        ConfigError: goals are written out, but it is unclear for which scenario.
    """
    found = GoalsFile(()) if file is None else read_goals(file)
    # A file whose goals would all be ignored is a mistake.
    if file is not None and not found.goals:
        kept = f'move one of its {len(found.alternatives)} alternatives to "goals"' if found.alternatives else "add one"
        raise DataError(f'{file}: has no entry in "goals": {kept}, or leave --goals out.')
    if file is not None and scenario_ids and not any(found.of_scenario(scenario_id) for scenario_id in scenario_ids):
        raise DataError(
            f"{file}: has goals in {len(found.scenario_ids)} scenarios, such as {found.scenario_ids[0]}, none in "
            f"{', '.join(scenario_ids)}: name another --scenario, or leave --goals or --scenario out."
        )
    if not written:
        return found
    if scenario_ids is None or len(scenario_ids) != 1:
        raise ConfigError("--goal AGENT=X,Y needs one scenario: name it with --scenario, or write a file for --goals.")
    entries = (*found.goals, *(parse_goal(text, scenario_ids[0]) for text in written))
    check_single_goals(entries)
    return GoalsFile(entries, found.alternatives)


def warn_of_doubts(entries: Sequence[GoalEntry], scenario: Scenario) -> None:
    """Log goals that will most likely be missed.

    Args:
        entries: goals of agents in the scenario.
        scenario: map and log.

    Raises:
        DataError: an impossible goal.
    """
    for entry in entries:
        for line in goal_warnings(entry, scenario):
            log.info(f"  {line}")


def _add_rows(
    table: Table, scenario: Scenario, track: int, proposals: tuple[Proposal, ...], chosen: Proposal | None
) -> None:
    tracks = scenario.tracks
    speed = float(np.linalg.norm(tracks.velocity[track, CURRENT_STEP]))
    agent = (str(tracks.object_id[track]), ObjectType(int(tracks.object_type[track])).name.lower(), f"{speed:.1f}")
    if not proposals:
        table.add_row(
            *agent, f"nothing: {no_proposal_reason(scenario, track) or 'no maneuver can be completed in time'}", "", ""
        )
    for row, proposal in enumerate(proposals):
        entry = to_goal_entry(scenario, proposal)
        mark = " ← goal" if proposal is chosen else ""
        point = f"{entry.x:.2f},{entry.y:.2f}"
        away = f"{distance_m(entry, scenario, track):.0f}"
        table.add_row(*(agent if row == 0 else ("", "", "")), f"{format_label(proposal)}{mark}", point, away)
