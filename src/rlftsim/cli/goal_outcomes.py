"""Who got where it was asked to go, read off the rollouts that `rlftsim simulate` wrote."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from rich.table import Table

from rlftsim.goals.attainment import Outcome, outcome_of
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel


def outcomes_of(folder: Path, scenario: Scenario, entries: Sequence[GoalEntry]) -> list[tuple[GoalEntry, Outcome]]:
    """What became of a scenario's goals."""
    ways = [torch.from_numpy(driven(folder, scenario, entry.agent_id)) for entry in entries]
    return [(entry, outcome_of(way, (entry.x, entry.y))) for entry, way in zip(entries, ways)]


def outcome_table(outcomes: Sequence[tuple[GoalEntry, Outcome]]) -> Table:
    """For `print_wide`."""
    table = Table(title="goals: within 2 m in the end (reached), at any time (passed)", title_justify="left")
    for heading in ("scenario", "agent", "label", "reached", "passed", "closest [m]"):
        table.add_column(heading)
    for entry, o in outcomes:
        shares = (f"{o.reached:.0%}", f"{o.passed:.0%}", f"{o.closest_m:.1f}")
        table.add_row(entry.scenario_id, str(entry.agent_id), entry.label, *shares)
    return table


def picture_of(folder: Path, scenario: Scenario, entries: Sequence[GoalEntry]) -> GoalPanel:
    """Goals and where their agents went; without goals where the evaluated agents went."""
    marks = [
        DrawnGoal(e.agent_id, np.array([e.x, e.y]), e.label, driven=driven(folder, scenario, e.agent_id))
        for e in entries
    ]
    if not entries:
        for agent in scenario.tracks.object_id[scenario.evaluated_indices].tolist():
            marks.append(DrawnGoal(agent, driven=driven(folder, scenario, agent)))
    return GoalPanel(scenario.scenario_id, scenario, tuple(marks))


def driven(folder: Path, scenario: Scenario, agent_id: int) -> Float[np.ndarray, "N T 2"]:
    """Where the rollouts of a scenario took an agent, world frame."""
    with np.load(folder / f"{scenario.scenario_id}.npz") as rollouts:
        row = int(np.flatnonzero(rollouts["object_ids"] == agent_id)[0])
        return np.stack([rollouts["x"][:, row], rollouts["y"][:, row]], -1).astype(np.float64)
