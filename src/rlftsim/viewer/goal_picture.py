"""Goals on a map: the goals of agents, the paths there, and the trajectories of simulations.

Arguments are in the world frame; pictures are in the map frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from rlftsim.goals.attainment import NEAR_M
from rlftsim.scenario.types import CURRENT_STEP, Scenario
from rlftsim.viewer.figure import DOTS_PER_INCH, INK, save_figure
from rlftsim.viewer.page import Panel
from rlftsim.viewer.picture import draw_agents, draw_map, light_dots, write_notes
from rlftsim.viewer.scene import SceneView, build_scene, logged_trajectories

PANEL_INCHES = 4.2
GOAL_COLORS = ("#a21caf", "#0f766e", "#7c2d12", "#4d7c0f", "#111827", "#be185d")
"""Colors of goals, none of which is that of an agent (`viewer.picture.COLORS`)."""
LONGEST_LABEL = 30
MARGIN_M = 14.0
MIN_RADIUS_M = 30.0


@dataclass(frozen=True, eq=False)
class DrawnGoal:
    """A goal of an agent, world frame, meters."""

    object_id: int
    position: Float[np.ndarray, "2"] | None = None
    """None = the agent has no goal; only the paths are drawn."""
    label: str = ""
    path: Float[np.ndarray, "S 2"] | None = None
    """Path to the goal."""
    driven: Float[np.ndarray, "N T 2"] | None = None
    """Simulated paths of the agent."""
    is_logged: bool = False
    """Marked by an x, other goals by a cross."""

    @property
    def name(self) -> str:
        """Text beside the goal: object id and label, shortened if long."""
        label = self.label.replace("_", " ")
        cut = label if len(label) <= LONGEST_LABEL else f"{label[: LONGEST_LABEL - 1]}…"
        return f"{self.object_id}: {cut}" if label else str(self.object_id)


@dataclass(frozen=True, eq=False)
class GoalPanel:
    """A scenario with goals in the world frame."""

    title: str
    scenario: Scenario
    marks: tuple[DrawnGoal, ...]


def draw_goals(
    path: Path,
    panels: Sequence[GoalPanel],
    *,
    columns: int = 1,
    panel_inches: float = PANEL_INCHES,
    dots_per_inch: int = DOTS_PER_INCH,
) -> None:
    """Write a picture with a panel for each scenario.

    Args:
        path: File to write, .png, .svg or .pdf.
        panels: Scenarios with goals, row by row, at least one.
        columns: Number of panels in a row.
        panel_inches: Width of a panel in inches; the height is 0.3 inches more, for the title.
        dots_per_inch: Resolution of a PNG.

    Raises:
        ConfigError: An ending that is no picture's.
        DataError: The file cannot be written.
    """
    rows = -(-len(panels) // columns)  # rounded up
    figure = Figure(figsize=(panel_inches * columns, (panel_inches + 0.3) * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:  # those that get no panel stay empty
        axis.set_axis_off()
    scenes = [build_scene(panel.scenario) for panel in panels]
    for axis, panel, scene in zip(axes, panels, scenes):
        log = logged_trajectories(panel.scenario)
        # 1. The map around the goals, with the agents at the current step.
        axis.set_axis_on()
        axis.set_title(panel.title, fontsize=8, loc="left", color=INK)
        draw_map(axis, scene, _focus(panel, scene), inches=panel_inches)
        draw_agents(axis, scene.agents, Panel(panel.title, log), CURRENT_STEP)
        light_dots(axis, scene, CURRENT_STEP)
        # 2. Object ids of all agents, as goals files name them.
        for agent in np.flatnonzero(log.valid[0, :, CURRENT_STEP]):
            _write(axis, str(scene.agents.object_id[agent]), log.position[0, agent, CURRENT_STEP], INK, size=5.5)
        # 3. Goals with their paths, a color each, on top of everything else.
        for number, mark in enumerate(panel.marks):
            _draw_mark(axis, mark, panel.scenario.origin, GOAL_COLORS[number % len(GOAL_COLORS)])
    write_notes(figure, scenes, panels_across=columns)
    save_figure(path, figure, dots_per_inch=dots_per_inch)


def _draw_mark(axis: Axes, mark: DrawnGoal, origin: Float[np.ndarray, "2"], color: str) -> None:
    if mark.driven is not None:
        # Paler the more rollouts there are, so that where most of them went stands out.
        alpha = max(0.15, 1 / np.sqrt(len(mark.driven)))
        driven = mark.driven - origin  # [N, T, 2], map frame
        axis.add_collection(LineCollection(list(driven), colors=color, lw=1, alpha=alpha), autolim=False)
        axis.plot(*driven[:, -1].T, ".", color=color, ms=3, mec="none", alpha=max(alpha, 0.5), zorder=4)
    if mark.path is not None:
        axis.plot(*(mark.path - origin).T, color=color, lw=1.4, zorder=4)
    if mark.position is None:
        return
    point = mark.position - origin  # [2], map frame
    # The circle is as large as the distance at which a goal counts as passed.
    axis.add_patch(Circle(tuple(point), NEAR_M, fc="white", alpha=0.5, zorder=3.5))
    axis.add_patch(Circle(tuple(point), NEAR_M, fc="none", ec=color, lw=0.8, zorder=5))
    axis.plot(*point[:, None], "x" if mark.is_logged else "+", color=color, ms=8, mew=0.6, zorder=5)
    _write(axis, mark.name, point, color, size=7.0)


def _write(axis: Axes, text: str, point: Float[np.ndarray, "2"], color: str, *, size: float) -> None:
    """Write a text beside a point, on the side with more room; a dollar sign begins no formula."""
    is_right = point[0] > sum(axis.get_xlim()) / 2
    outline = [patheffects.withStroke(linewidth=2, foreground="white")]
    axis.annotate(
        text, tuple(point), (-4 if is_right else 4, 4), ha="right" if is_right else "left", textcoords="offset points",
        fontsize=size, color=color, zorder=6, path_effects=outline, annotation_clip=True, parse_math=False,
    ).set_in_layout(False)  # fmt: skip


def _focus(panel: GoalPanel, scene: SceneView) -> tuple[float, float, float]:
    """Square around goals and agents, as center x, y and half width; without goals the focus of the scene."""
    tracks = panel.scenario.tracks
    is_marked = np.isin(tracks.object_id, [mark.object_id for mark in panel.marks])
    # Current positions, goals, paths and simulated paths, each [n, 2].
    point_sets = [tracks.position[is_marked, CURRENT_STEP, :2]]
    for mark in panel.marks:
        point_sets += [p.reshape(-1, 2) for p in (mark.position, mark.path, mark.driven) if p is not None]
    points = np.concatenate(point_sets) - panel.scenario.origin  # map frame
    if not len(points):
        return scene.focus
    low, high = points.min(0), points.max(0)
    radius = max(float((high - low).max()) / 2 + MARGIN_M, MIN_RADIUS_M)
    return float((low + high)[0] / 2), float((low + high)[1] / 2), radius
