"""Work after a simulation: outcomes of goals, pictures, and further files of `rlftsim simulate --export NAME`.

A package of your own adds an exporter:

[project.entry-points."rlftsim.exporters"]
csv = "my_package:write_csv"
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from rich.table import Table

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.explain import to_scene_motion
from rlftsim.evaluation.rollout_files import RolloutEntry, read_states
from rlftsim.goals.attainment import Outcome, measure_outcome
from rlftsim.goals.goals_file import GoalEntry, GoalsFile
from rlftsim.jobs.progress import print_line, print_wide
from rlftsim.plugins import ExtensionPoint
from rlftsim.realism import SimulatedStates
from rlftsim.rollout.open_world import add_visitors
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.film import to_film
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel, draw_goals
from rlftsim.viewer.page import Animation, animate, write_page

Exporter = Callable[[Scenario, SimulatedStates, Path], Path]
"""Called with a scenario, its rollouts and the folder of the rollouts; writes a file there and returns its path."""

EXPORTERS: ExtensionPoint[Exporter] = ExtensionPoint(
    "exporter",
    "rlftsim.exporters",
    {
        "page": "rlftsim.evaluation.exporters:write_player",
        "film": "rlftsim.evaluation.exporters:write_film",
        "gpudrive": "rlftsim.evaluation.gpudrive_files:write_gpudrive",
        "rerun": "rlftsim.evaluation.rerun_files:write_rerun",
    },
    use=lambda name: exporter_by_name(name),
)
"""Name -> function."""
MAX_ROLLOUTS = 8
"""Rollouts that play on a page; each adds about 50 kB."""
PICTURE_INCHES = 7.0


def exporter_by_name(name: str) -> Exporter:
    """The exporter of a name, from this or any installed package.

    Raises:
        ConfigError: An unknown name, with the nearest known name, or not a function of three arguments.
    """
    exporter = EXPORTERS.get(name)
    try:
        inspect.signature(exporter).bind(None, None, None)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"exporter {name!r} cannot be called ({error}): make it a function of scenario, rollouts and folder."
        ) from None
    return exporter


def write_player(scenario: Scenario, states: SimulatedStates, folder: Path) -> Path:
    """Write FOLDER/SCENARIO.html, which plays the first rollouts beside the log in any browser.

    Args:
        scenario: Scenario with the map and log that are drawn.
        states: Rollouts of the scenario, world frame.
        folder: Folder in which the page is written.

    Raises:
        DataError: A file that cannot be written.
    """
    path, animation = folder / f"{scenario.scenario_id}.html", animate_states(scenario, {"rollouts": states})
    write_page(path, animation.title, [animation])
    return path


def write_film(scenario: Scenario, states: SimulatedStates, folder: Path) -> Path:
    """Write FOLDER/SCENARIO.mp4: the log beside the first rollouts, in real time.

    Args:
        scenario: Scenario with the map and log that are drawn.
        states: Rollouts of the scenario, world frame.
        folder: Folder in which the film is written.

    Raises:
        DataError: A file that cannot be written.
    """
    path = folder / f"{scenario.scenario_id}.mp4"
    to_film(path, animate_states(scenario, {"rollouts": states}))
    return path


def animate_states(
    scenario: Scenario, states: Mapping[str, SimulatedStates], *, max_rollouts: int = MAX_ROLLOUTS, caption: str = ""
) -> Animation:
    """The log, and the first rollouts beside it.

    Args:
        scenario: Scenario with the map and log that are drawn.
        states: Rollouts of the scenario, world frame, by the title of a panel.
        max_rollouts: Rollouts that can be played; each adds about 50 kB to a page.
        caption: Text below the title.
    """
    motions = ((title, to_scene_motion(scenario, simulated).first(max_rollouts)) for title, simulated in states.items())
    return animate(scenario, motions, caption=caption)


def report_rollouts(
    folder: Path,
    dataset: ScenarioDataset,
    scenario_ids: Sequence[str],
    goals: GoalsFile,
    *,
    picture: bool,
    exporters: Sequence[Exporter],
) -> None:
    """Print a table of goals and outcomes, draw scenarios, and export scenarios.

    Args:
        folder: Folder of rollouts of `rlftsim simulate`.
        dataset: Data set of the simulated scenarios.
        scenario_ids: Ids of the simulated scenarios.
        goals: Goals of the simulated agents; may be empty.
        picture: True draws FOLDER/SCENARIO.png.
        exporters: Functions that write further files of each scenario.

    Raises:
        DataError: Damaged rollouts.
    """
    outcomes, pictures = [], []
    for scenario_id in scenario_ids:
        entries = goals.of_scenario(scenario_id)
        if not (entries or picture):
            continue
        scenario = dataset.by_id(scenario_id)
        states = read_rollouts(_entry(folder, scenario_id), scenario)
        outcomes += [(e, measure_outcome(states.simulated_path(e.agent_id), (e.x, e.y))) for e in entries]
        if picture:
            pictures.append(folder / f"{scenario_id}.png")
            draw_outcomes(pictures[-1], states, scenario, entries)
    if outcomes:
        print_wide(build_outcome_table(outcomes))
    for path in pictures:
        print_line(path)
    for scenario in map(dataset.by_id, scenario_ids if exporters else ()):
        states = read_rollouts(_entry(folder, scenario.scenario_id), scenario)
        for write in exporters:
            print_line(write(with_entrants(scenario, states), states, folder))


def _entry(folder: Path, scenario_id: str) -> RolloutEntry:
    """Rollouts of a scenario in a folder that `rlftsim simulate` wrote."""
    return RolloutEntry(scenario_id, folder / f"{scenario_id}.npz", "npz")


def read_rollouts(entry: RolloutEntry, scenario: Scenario) -> SimulatedStates:
    """Rollouts of a scenario, with all agents of the scenario.

    Args:
        entry: Location of the rollouts.
        scenario: Scenario that was simulated.

    Raises:
        DataError: Damaged file, or one without the agents of the scenario.
    """
    # Files of an earlier call may be damaged or of an older data set.
    way_out = "remove it, then run the same command again."
    try:
        states = read_states(entry, None)
    except DataError as error:
        raise DataError(f"{str(error).rstrip('.')}: {way_out}") from None
    if not np.isin(scenario.tracks.object_id[scenario.simulated_indices], states.object_id).all():
        raise DataError(f"{entry}: lacks agents of the scenario: {way_out}")
    return states


def with_entrants(scenario: Scenario, states: SimulatedStates) -> Scenario:
    """The scenario with the agents that may have entered, if there are such agents among the rollouts'."""
    return add_visitors(scenario) if states.valid is not None else scenario


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
