"""Who got where it was asked to go, read off the rollouts that `rlftsim simulate` wrote."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from rlftsim.errors import DataError
from rlftsim.experiments.rollout_files import RolloutEntry, read_states
from rlftsim.goals.attainment import Outcome, outcome_of
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.realism import SimulatedStates
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel


def read_rollouts(folder: Path, scenario: Scenario) -> SimulatedStates:
    """What a folder of `rlftsim simulate` holds of a scenario.

    Raises:
        DataError: a damaged file, or one without the agents of the scenario.
    """
    entry = RolloutEntry(scenario.scenario_id, folder / f"{scenario.scenario_id}.npz", "npz")
    way_out = "remove it, then run the same command again."
    try:
        states = read_states(entry)
    except DataError as error:
        raise DataError(f"{str(error).rstrip('.')}: {way_out}") from None
    if not np.isin(scenario.tracks.object_id[scenario.simulated_indices], states.object_id).all():
        raise DataError(f"{entry}: has not all agents of the scenario: {way_out}")
    return states


def outcomes_of(states: SimulatedStates, entries: Sequence[GoalEntry]) -> list[tuple[GoalEntry, Outcome]]:
    """What became of a scenario's goals."""
    return [(entry, outcome_of(states.way_of(entry.agent_id), (entry.x, entry.y))) for entry in entries]


def outcome_table(outcomes: Sequence[tuple[GoalEntry, Outcome]]) -> Table:
    """For `print_wide`."""
    table = Table(
        title="goals: within 2 m in the end (reached), at any time (passed)",
        caption="closest: least distance to the goal, in the best rollout and in the median one",
        title_justify="left",
        caption_justify="left",
    )
    for heading in ("scenario", "agent", "label", "reached", "passed", "closest [m]: best", "median"):
        table.add_column(heading, overflow="fold")
    for entry, o in outcomes:
        numbers = (f"{o.reached:.0%}", f"{o.passed:.0%}", f"{o.best_m:.1f}", f"{o.median_m:.1f}")
        table.add_row(entry.scenario_id, str(entry.agent_id), entry.label, *numbers)
    return table


def picture_of(states: SimulatedStates, scenario: Scenario, entries: Sequence[GoalEntry]) -> GoalPanel:
    """Goals and where their agents went; without goals where the evaluated agents went."""
    asked = [(e.agent_id, np.array([e.x, e.y]), e.label) for e in entries]
    free = [(agent, None, "") for agent in scenario.tracks.object_id[scenario.evaluated_indices].tolist()]
    marks = tuple(DrawnGoal(*one, driven=states.way_of(one[0]).numpy().astype(np.float64)) for one in asked or free)
    return GoalPanel(scenario.scenario_id, scenario, marks)
