"""Exporters: further files of simulated rollouts, for `rlftsim simulate --export NAME`. A package of your own adds one:

[project.entry-points."rlftsim.exporters"]
csv = "my_package:write_csv"
"""

import inspect
from collections.abc import Callable
from pathlib import Path

from rlftsim.errors import ConfigError
from rlftsim.evaluation.explain import motion_of
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
    """The exporter of a name, this package's or another's.

    Raises:
        ConfigError: unknown, with the nearest known name, or not a function of three arguments.
    """
    found = EXPORTERS.get(name)
    try:
        inspect.signature(found).bind(None, None, None)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"exporter {name!r} cannot be called ({error}): make it a function of scenario, rollouts and folder."
        ) from None
    return found


def write_player(scenario: Scenario, states: SimulatedStates, folder: Path) -> Path:
    """Write FOLDER/SCENARIO.html, which plays the first rollouts beside the log in any browser.

    Args:
        scenario: map and log.
        states: its rollouts, world frame.
        folder: of the page.

    Raises:
        DataError: the file cannot be written.
    """
    path, animation = folder / f"{scenario.scenario_id}.html", _animation(scenario, states)
    write_page(path, animation.title, [animation])
    return path


def write_film(scenario: Scenario, states: SimulatedStates, folder: Path) -> Path:
    """Write FOLDER/SCENARIO.mp4: the log beside the first rollouts, in real time.

    Args:
        scenario: map and log.
        states: its rollouts, world frame.
        folder: of the film.

    Raises:
        DataError: the file cannot be written.
    """
    path = folder / f"{scenario.scenario_id}.mp4"
    to_film(path, _animation(scenario, states))
    return path


def _animation(scenario: Scenario, states: SimulatedStates) -> Animation:
    """The log, and the first rollouts."""
    scene = build_scene(scenario)
    panels = [
        Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents)),
        Panel("rollouts", motion_of(scenario, states).first(MAX_ROLLOUTS).with_overlaps(scene.agents)),
    ]
    return Animation(f"Scenario {scenario.scenario_id}", scene, panels)
