"""The verb that says what agents may be asked to do: goals. And the goals of a command line, for verbs that simulate."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.table import Table
from tyro.conf import Positional

from rlftsim.cli.data import data_folder, refuse_unknown
from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.goal_proposals import entry_of, label_of, propose
from rlftsim.goals.goals_file import GoalEntry, GoalsFile, parse_goal, read_goals, refuse_twice, write_goals
from rlftsim.goals.placing import distance_m, doubts
from rlftsim.goals.proposals import Proposal, why_nothing
from rlftsim.progress import print_wide, say
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario
from rlftsim.viewer.figure import refuse_no_picture
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel, draw_goals

Choice = Literal[
    "alternative", "recorded", "straight", "left", "right", "left_uturn", "lane_change_left", "lane_change_right"
]
"""The last six are those of `Manoeuvre`, spelt out for the command line."""


@dataclass(frozen=True)
class Propose:
    """Say what agents may do, read off the lanes, and write a goals file.

    Every manoeuvre that can be completed in 8 seconds at plausible speeds and without leaving the road: straight, left, right, left
    U-turn, lane changes; what the record shows is marked. The file asks each agent for one of them and keeps the others
    as alternatives.
    """

    data: Positional[str]
    """Folder of a data set, or "synthetic"."""
    scenario: list[str]
    """Scenario ids."""
    agent: list[int] | None = None
    """Object ids of agents; left out, the evaluated ones."""
    choose: Choice = "alternative"
    """What the file asks for: the first manoeuvre that the record does not show, the recorded one, or the one of a name. Agents that
    cannot do it get no goal."""
    out: Path | None = None
    """Goals file to write; left out, the proposals are only printed."""
    picture: Path | None = None
    """PNG, SVG or PDF to draw the proposals into, a panel for each agent."""

    def run(self) -> int:
        """Propose, print, draw, write."""
        self._refuse_nothing()
        scenarios = ScenarioDataset(data_folder(self.data))
        asked, alternatives, panels = [], [], []
        for scenario_id in dict.fromkeys(self.scenario):
            refuse_unknown(scenarios, scenario_id, self.data, "--scenario")
            scenario = scenarios.by_id(scenario_id)
            table = Table(title=f"scenario {scenario.scenario_id}", title_justify="left")
            for heading in ("agent", "kind", "m/s", "manoeuvre", "goal (x, y)", "away [m]"):
                table.add_column(heading)
            for track in self._tracks(scenario):
                proposals = propose(scenario, track)
                chosen = _choose(proposals, self.choose)
                for proposal in proposals:
                    (asked if proposal is chosen else alternatives).append(entry_of(scenario, proposal))
                _add_rows(table, scenario, track, proposals, chosen)
                panels.append(_panel(scenario, track, proposals))
            print_wide(table)
            warn_of_doubts([entry for entry in asked if entry.scenario_id == scenario_id], scenario)
        if self.picture is not None:
            draw_goals(self.picture, panels, columns=min(len(panels), 4))
            print(self.picture)
        if self.out is not None:
            self._refuse_unasked(asked, alternatives)
            write_goals(self.out, GoalsFile(tuple(asked), tuple(alternatives)))
            print(f"{self.out}: {len(asked)} goals, {len(alternatives)} alternatives.")
        return 0

    def _refuse_nothing(self) -> None:
        """Refuse flags without values, and a picture that cannot be one, before anything is looked at.

        Raises:
            ConfigError: there are.
        """
        if not self.scenario:
            raise ConfigError("--scenario names none: give the id of at least one.")
        if self.agent is not None and not self.agent:
            raise ConfigError("--agent names nobody: give object ids, or leave it out for the evaluated agents.")
        if self.picture is not None:
            refuse_no_picture(self.picture)

    def _refuse_unasked(self, asked: list[GoalEntry], alternatives: list[GoalEntry]) -> None:
        """Refuse to write a file that asks nobody.

        Raises:
            DataError: it would; says what could be asked.
        """
        if asked:
            return
        labels = dict.fromkeys(entry.label for entry in alternatives)
        can = f"they can do {', '.join(labels)} (--choose)" if labels else "nothing can be proposed for them"
        raise DataError(
            f"{self.out} not written, none of these agents can do {self.choose}: {can}; or name others with --agent."
        )

    def _tracks(self, scenario: Scenario) -> list[int]:
        """Whom to propose for.

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
    """Check a goals file, its alternatives included, against its scenarios: who is asked, and what is doubtful."""

    file: Positional[Path]
    """A goals file."""
    data: str
    """Folder of a data set, or "synthetic"."""

    def run(self) -> int:
        """Say what is doubtful; a mistake ends with status 2."""
        scenarios, file = ScenarioDataset(data_folder(self.data)), read_goals(self.file)
        lines = [
            line
            for entry in (*file.goals, *file.alternatives)
            for line in doubts(entry, _find(scenarios, entry, self.data))
        ]
        for line in lines:
            print(line)
        print(
            f"{self.file}: {len(file.goals)} goals in {len(file.scenario_ids)} scenarios, {len(file.alternatives)} alternatives, "
            f"{len(lines)} doubts."
        )
        return 0


@dataclass(frozen=True)
class Goals:
    """Propose goals for agents, or check a file of them."""

    action: Annotated[Propose, tyro.conf.subcommand("propose")] | Annotated[Check, tyro.conf.subcommand("check")]

    def run(self) -> int:
        """Run the action."""
        return self.action.run()


def goals_asked(file: Path | None, written: list[str], scenario_ids: list[str] | None) -> GoalsFile:
    """The goals of a command line: those of a file, and those written AGENT=X,Y.

    Raises:
        DataError: a file or a goal that makes no sense.
        ConfigError: goals written out need to know which scenario is meant.
    """
    found = GoalsFile(()) if file is None else read_goals(file)
    if file is not None:
        _refuse_unused(file, found, scenario_ids)
    if not written:
        return found
    if scenario_ids is None or len(scenario_ids) != 1:
        raise ConfigError(
            "--goal AGENT=X,Y needs to know the scenario: name one with --scenario, or write --goals FILE."
        )
    entries = (*found.goals, *(parse_goal(text, scenario_ids[0]) for text in written))
    refuse_twice(entries)
    return GoalsFile(entries, found.alternatives)


def _refuse_unused(file: Path, found: GoalsFile, scenario_ids: list[str] | None) -> None:
    """Refuse a file that asks for nothing in the scenarios that are simulated.

    Raises:
        DataError: it does.
    """
    if not found.goals:
        kept = f'move one of its {len(found.alternatives)} alternatives to "goals"' if found.alternatives else "add one"
        raise DataError(f'{file}: has no entry in "goals", so nobody is asked: {kept}, or leave --goals out.')
    if scenario_ids and not any(found.of_scenario(scenario_id) for scenario_id in scenario_ids):
        others = found.scenario_ids
        raise DataError(
            f"{file}: has goals in {len(others)} scenarios, such as {others[0]}, none in {', '.join(scenario_ids)}: name another "
            "--scenario, or leave --goals or --scenario out."
        )


def warn_of_doubts(entries: Sequence[GoalEntry], scenario: Scenario) -> None:
    """Say what will most likely happen otherwise than it was asked for.

    Raises:
        DataError: an impossible goal.
    """
    for entry in entries:
        for line in doubts(entry, scenario):
            say(f"  {line}")


def _find(scenarios: ScenarioDataset, entry: GoalEntry, name: str) -> Scenario:
    refuse_unknown(scenarios, entry.scenario_id, name, entry)
    return scenarios.by_id(entry.scenario_id)


def _choose(proposals: tuple[Proposal, ...], choice: Choice) -> Proposal | None:
    fitting = {"alternative": lambda p: not p.is_recorded, "recorded": lambda p: p.is_recorded}
    fits = fitting.get(choice, lambda p: p.manoeuvre.value == choice)
    return next((proposal for proposal in proposals if fits(proposal)), None)


def _add_rows(
    table: Table, scenario: Scenario, track: int, proposals: tuple[Proposal, ...], chosen: Proposal | None
) -> None:
    tracks = scenario.tracks
    speed = float(np.linalg.norm(tracks.velocity[track, CURRENT_STEP]))
    who = (str(tracks.object_id[track]), ObjectType(int(tracks.object_type[track])).name.lower(), f"{speed:.1f}")
    if not proposals:
        table.add_row(
            *who, f"nothing: {why_nothing(scenario, track) or 'no manoeuvre can be completed in time'}", "", ""
        )
    for row, proposal in enumerate(proposals):
        entry = entry_of(scenario, proposal)
        mark = " ← asked for" if proposal is chosen else ""
        point = f"{entry.x:.2f},{entry.y:.2f}"
        away = f"{distance_m(entry, scenario, track):.0f}"
        table.add_row(*(who if row == 0 else ("", "", "")), f"{label_of(proposal)}{mark}", point, away)


def _panel(scenario: Scenario, track: int, proposals: tuple[Proposal, ...]) -> GoalPanel:
    agent = int(scenario.tracks.object_id[track])
    marks = tuple(DrawnGoal(agent, p.position, label_of(p), p.way[:, :2], is_recorded=p.is_recorded) for p in proposals)
    return GoalPanel(f"{scenario.scenario_id}, agent {agent}", scenario, marks or (DrawnGoal(agent),))
