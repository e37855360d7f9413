"""Exporters: further files of simulated rollouts, for `rlftsim simulate --export NAME`. A package of your own adds one:

[project.entry-points."rlftsim.exporters"]
csv = "my_package:write_csv"
"""

import inspect
from collections.abc import Callable
from pathlib import Path

from rlftsim.errors import ConfigError
from rlftsim.evaluation.explain import to_scene_motion
from rlftsim.plugins import ExtensionPoint
from rlftsim.realism import SimulatedStates
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.film import to_film
from rlftsim.viewer.page import Animation, Panel, write_page
from rlftsim.viewer.scene import build_scene, logged_trajectories

Exporter = Callable[[Scenario, SimulatedStates, Path], Path]
"""Called with a scenario, its rollouts and the folder of the rollouts; writes a file there and returns its path."""

EXPORTERS: ExtensionPoint[Exporter] = ExtensionPoint(
    "exporter",
    "rlftsim.exporters",
    {"page": "rlftsim.evaluation.exporters:write_player", "film": "rlftsim.evaluation.exporters:write_film"},
    use=lambda name: exporter_by_name(name),
)
"""Name -> function."""
MAX_ROLLOUTS = 8
"""Rollouts that play on a page; each adds about 50 kB."""


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
    path, animation = folder / f"{scenario.scenario_id}.html", _animation(scenario, states)
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
    to_film(path, _animation(scenario, states))
    return path


def _animation(scenario: Scenario, states: SimulatedStates) -> Animation:
    """The log, and the first rollouts."""
    scene = build_scene(scenario)
    panels = [
        Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents)),
        Panel("rollouts", to_scene_motion(scenario, states).first(MAX_ROLLOUTS).with_overlaps(scene.agents)),
    ]
    return Animation(f"Scenario {scenario.scenario_id}", scene, panels)
