"""Agents that reached their goals, read off the rollouts that `rlftsim simulate` wrote."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from rlftsim.errors import DataError
from rlftsim.evaluation.rollout_files import RolloutEntry, read_states
from rlftsim.goals.attainment import Outcome, measure_outcome
from rlftsim.goals.goals_file import GoalEntry, GoalsFile
from rlftsim.jobs.progress import print_line, print_wide
from rlftsim.realism import SimulatedStates
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel, draw_goals

PICTURE_INCHES = 7.0


def report_outcomes(folder: Path, scenarios: Sequence[Scenario], goals: GoalsFile, *, picture: bool) -> None:
    """Print a table of goals and their outcomes, and draw scenarios.

    Args:
        folder: Folder of rollouts of `rlftsim simulate`.
        scenarios: Scenarios to report on.
        goals: Goals of their agents; may be empty.
        picture: True = draw FOLDER/SCENARIO.png, too.

    Raises:
        DataError: Damaged rollouts.
    """
    outcomes, pictures = [], []
    for scenario in scenarios:
        states, entries = read_rollouts(folder, scenario), goals.of_scenario(scenario.scenario_id)
        outcomes += [
            (entry, measure_outcome(states.simulated_path(entry.agent_id), (entry.x, entry.y))) for entry in entries
        ]
        if picture:
            pictures.append(folder / f"{scenario.scenario_id}.png")
            draw_goals(pictures[-1], [draw_outcome(states, scenario, entries)], panel_inches=PICTURE_INCHES)
    if outcomes:
        print_wide(outcome_table(outcomes))
    for path in pictures:
        print_line(path)


def read_rollouts(folder: Path, scenario: Scenario) -> SimulatedStates:
    """Rollouts of a scenario in a folder that `rlftsim simulate` wrote.

    Args:
        folder: Folder with a file SCENARIO.npz.
        scenario: Simulated scenario.

    Raises:
        DataError: Damaged file, or one without the agents of the scenario.
    """
    # Files of an earlier call may be damaged or of an older data set.
    entry = RolloutEntry(scenario.scenario_id, folder / f"{scenario.scenario_id}.npz", "npz")
    way_out = "remove it, then run the same command again."
    try:
        states = read_states(entry)
    except DataError as error:
        raise DataError(f"{str(error).rstrip('.')}: {way_out}") from None
    if not np.isin(scenario.tracks.object_id[scenario.simulated_indices], states.object_id).all():
        raise DataError(f"{entry}: lacks agents of the scenario: {way_out}")
    return states


def outcome_table(outcomes: Sequence[tuple[GoalEntry, Outcome]]) -> Table:
    """Table of goals and outcomes, for `print_wide`."""
    table = Table(
        title="goals: within 2 m in the end (reached), at any time (passed)",
        caption="closest: smallest distance to the goal, in the best rollout and in the median one",
        title_justify="left",
        caption_justify="left",
    )
    for heading in ("scenario", "agent", "label", "reached", "passed", "closest [m]: best", "median"):
        table.add_column(heading, overflow="fold")
    for entry, o in outcomes:
        numbers = (f"{o.reached:.0%}", f"{o.passed:.0%}", f"{o.best_m:.1f}", f"{o.median_m:.1f}")
        table.add_row(entry.scenario_id, str(entry.agent_id), entry.label, *numbers)
    return table


def draw_outcome(states: SimulatedStates, scenario: Scenario, entries: Sequence[GoalEntry]) -> GoalPanel:
    """Goals and the simulated paths of their agents; without goals the paths of the evaluated agents.

    Args:
        states: Rollouts of the scenario.
        scenario: Map and log.
        entries: Goals of its agents; may be empty.
    """
    targeted = [(e.agent_id, np.array([e.x, e.y]), e.label) for e in entries]
    # Without goals the picture shows the agents that the metric evaluates.
    free = [(agent, None, "") for agent in scenario.tracks.object_id[scenario.evaluated_indices].tolist()]
    marks = tuple(
        DrawnGoal(agent_id, position, label, driven=states.simulated_path(agent_id).numpy().astype(np.float64))
        for agent_id, position, label in targeted or free
    )
    return GoalPanel(scenario.scenario_id, scenario, marks)
