"""Goals on a map: where agents are asked to go, the ways there, and where simulations took them. Handed over in the world frame, drawn in the map's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from rlftsim.goals.attainment import NEAR_M
from rlftsim.scenario.types import CURRENT_STEP, Scenario
from rlftsim.viewer.figure import DOTS_PER_INCH, INK, save_figure
from rlftsim.viewer.page import Panel
from rlftsim.viewer.picture import POINTS_PER_INCH, agent_shapes, draw_map, light_dots
from rlftsim.viewer.scene import SceneView, build_scene, logged_trajectories

PANEL_INCHES = 4.2
GOAL_COLOURS = ("#a21caf", "#1d63d8", "#11754b", "#e07b00", "#b42318", "#0e7490")
MARGIN_M = 14.0
MIN_RADIUS_M = 30.0


@dataclass(frozen=True, eq=False)
class DrawnGoal:
    """A goal of an agent, world frame, metres."""

    object_id: int
    position: Float[np.ndarray, "2"] | None = None
    """None = the agent has none and only its ways are drawn."""
    label: str = ""
    way: Float[np.ndarray, "S 2"] | None = None
    """How to get there."""
    driven: Float[np.ndarray, "N T 2"] | None = None
    """Where simulations took the agent."""
    is_recorded: bool = False
    """Drawn as a square, not as a star."""


@dataclass(frozen=True, eq=False)
class GoalPanel:
    """A scenario and goals in it, world frame."""

    title: str
    scenario: Scenario
    marks: tuple[DrawnGoal, ...]


def draw_goals(
    path: Path, panels: Sequence[GoalPanel], *, columns: int = 1, dots_per_inch: int = DOTS_PER_INCH
) -> None:
    """Write a picture with a panel for each scenario. Raises as `write_whole`."""
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(PANEL_INCHES * columns, (PANEL_INCHES + 0.3) * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, panel in zip(axes, panels):
        _draw_panel(axis, panel)
    save_figure(path, figure, dots_per_inch=dots_per_inch)


def _draw_panel(axis: Axes, panel: GoalPanel) -> None:
    scene, log = build_scene(panel.scenario), logged_trajectories(panel.scenario)
    x, y, radius = _focus(panel, scene)
    axis.set_axis_on()
    axis.set(xlim=(x - radius, x + radius), ylim=(y - radius, y + radius), xticks=[], yticks=[], aspect="equal")
    axis.set_facecolor("#eef0ec")
    axis.set_title(panel.title, fontsize=8, loc="left", color=INK)
    draw_map(axis, scene, points_per_m=PANEL_INCHES * POINTS_PER_INCH / (2 * radius))
    for shape in agent_shapes(scene.agents, Panel(panel.title, log), CURRENT_STEP):
        axis.add_collection(shape, autolim=False)
    light_dots(axis, scene, CURRENT_STEP)
    for number, mark in enumerate(panel.marks):
        _draw_mark(axis, mark, panel.scenario.origin, GOAL_COLOURS[number % len(GOAL_COLOURS)])


def _draw_mark(axis: Axes, mark: DrawnGoal, origin: Float[np.ndarray, "2"], colour: str) -> None:
    if mark.driven is not None:
        alpha = max(0.15, 1 / np.sqrt(len(mark.driven)))
        axis.add_collection(LineCollection(list(mark.driven - origin), colors=colour, lw=1, alpha=alpha), autolim=False)
    if mark.way is not None:
        axis.plot(*(mark.way - origin).T, color=colour, lw=1.4, zorder=4)
    if mark.position is None:
        return
    x, y = mark.position - origin
    angle = np.linspace(0, 2 * np.pi, 40)
    axis.plot(x + NEAR_M * np.cos(angle), y + NEAR_M * np.sin(angle), color=colour, lw=0.8, zorder=4)
    axis.plot([x], [y], "s" if mark.is_recorded else "*", color=colour, ms=5 if mark.is_recorded else 9, zorder=5)
    outline = [patheffects.withStroke(linewidth=2, foreground="white")]
    axis.annotate(
        mark.label.replace("_", " "), (x, y), (4, 4), textcoords="offset points", fontsize=7, color=colour, zorder=6,
        path_effects=outline, annotation_clip=True,
    )  # fmt: skip


def _focus(panel: GoalPanel, scene: SceneView) -> tuple[float, float, float]:
    """A square around the goals and the agents that have them; the scenario's own where there are none."""
    ids = [mark.object_id for mark in panel.marks]
    tracks = panel.scenario.tracks
    places = [tracks.position[np.isin(tracks.object_id, ids), CURRENT_STEP, :2] - panel.scenario.origin]
    for mark in panel.marks:
        ways = (None if mark.position is None else mark.position[None], mark.way, mark.driven)
        places += [way.reshape(-1, 2) - panel.scenario.origin for way in ways if way is not None]
    points = np.concatenate(places)
    if not len(points):
        return scene.focus
    low, high = points.min(0), points.max(0)
    radius = max(float((high - low).max()) / 2 + MARGIN_M, MIN_RADIUS_M)
    return float((low + high)[0] / 2), float((low + high)[1] / 2), radius
