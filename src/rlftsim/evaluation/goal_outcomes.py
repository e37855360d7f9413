"""Outcomes of goals after a simulation: a table, and pictures of the simulated paths."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from rich.table import Table

from rlftsim.goals.attainment import Outcome, measure_outcome
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.realism import SimulatedStates
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel, draw_goals

PICTURE_INCHES = 7.0


def measure_outcomes(states: SimulatedStates, entries: Sequence[GoalEntry]) -> list[tuple[GoalEntry, Outcome]]:
    """Outcome of each goal over the rollouts of a scenario.

    Args:
        states: Rollouts of the scenario, world frame.
        entries: Goals of its agents.
    """
    return [(entry, measure_outcome(states.simulated_path(entry.agent_id), (entry.x, entry.y))) for entry in entries]


def build_outcome_table(outcomes: Sequence[tuple[GoalEntry, Outcome]]) -> Table:
    """Table of goals and outcomes, for `print_wide`.

    Args:
        outcomes: Goals of any scenarios, each with its outcome.
    """
    headings = ("scenario", "agent", "label", "reached", "passed", "closest [m]: best", "median")
    table = Table(
        *headings,
        title="goals: within 2 m in the end (reached), at any time (passed)",
        caption="closest: smallest distance to the goal, in the best rollout and in the median one",
        title_justify="left",
        caption_justify="left",
    )
    for entry, o in outcomes:
        numbers = (f"{o.reached:.0%}", f"{o.passed:.0%}", f"{o.best_m:.1f}", f"{o.median_m:.1f}")
        table.add_row(entry.scenario_id, str(entry.agent_id), entry.label, *numbers)
    return table


def _find_path(states: SimulatedStates, agent_id: int) -> Float64[np.ndarray, "N T 2"]:
    """Simulated path of an agent, NaN where the agent is absent."""
    presence = states.presence[:, states.find_rows(np.array([agent_id]))[0], :, None]
    return torch.where(presence, states.simulated_path(agent_id), torch.nan).numpy().astype(np.float64)


def draw_outcomes(path: Path, states: SimulatedStates, scenario: Scenario, entries: Sequence[GoalEntry]) -> None:
    """Draw goals and the simulated paths of their agents; without goals the paths of the evaluated agents.

    Args:
        path: Picture to write.
        states: Rollouts of the scenario, world frame.
        scenario: Scenario with the map that is drawn.
        entries: Goals of its agents; may be empty.
    """
    targeted = [(e.agent_id, np.array([e.x, e.y]), e.label) for e in entries]
    # Without goals the picture shows the agents that the metric evaluates.
    free = [(agent, None, "") for agent in scenario.tracks.object_id[scenario.evaluated_indices].tolist()]
    marks = tuple(
        DrawnGoal(agent_id, position, label, driven=_find_path(states, agent_id))
        for agent_id, position, label in targeted or free
    )
    draw_goals(path, [GoalPanel(scenario.scenario_id, scenario, marks)], panel_inches=PICTURE_INCHES)
