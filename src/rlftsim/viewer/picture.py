"""One still picture of a scene: panels side by side, with the paths of all rollouts as thin lines."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rlftsim.scenario.types import CURRENT_STEP, ObjectType
from rlftsim.viewer.figure import DOTS_PER_INCH, save_figure
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.scene import AgentBoxes, SceneView

PANEL_INCHES = 4.0
POINTS_PER_INCH = 72.0
LANE_WIDTH_M = {"lane": 4.4, "bike_lane": 2.0}
COLOURS = {
    "ground": "#eef0ec",
    "road": "#d7dbe0",
    "crosswalk": "#f7f8fa",
    "edge": "#79828f",
    "white": "#ffffff",
    "yellow": "#d9a514",
    "ego": "#1d63d8",
    "evaluated": "#e07b00",
    "other": "#8b94a1",
}
ROLES = ("other", "evaluated", "ego")
MIN_PEDESTRIAN_RADIUS_M = 0.5


def to_png(
    path: str | os.PathLike[str], animation: Animation, *, step: int = CURRENT_STEP, dots_per_inch: int = DOTS_PER_INCH
) -> None:
    """Draw the panels of an animation side by side, boxes at `step`, paths of evaluated agents from there on.

    Args:
        path: file to write; nothing half-written is left there.
        animation: what to draw; its caption is left out.
        step: 0..90; the boxes are those of each panel's first rollout.
        dots_per_inch: 160 makes a panel 640 pixels wide.
    """
    panels = animation.panels
    figure = Figure(figsize=(PANEL_INCHES * len(panels), PANEL_INCHES + 0.7), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, panel in zip(axes, panels):
        _draw_panel(axis, animation.scene, panel, step)
    names = {"ego": "ego", "evaluated": "evaluated agents", "other": "other agents"}
    handles = [Line2D([], [], color=COLOURS[role], lw=5, label=label) for role, label in names.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=10)
    save_figure(Path(path), figure, dots_per_inch=dots_per_inch)


def _draw_panel(axis: Axes, scene: SceneView, panel: Panel, step: int) -> None:
    x, y, radius = scene.focus
    axis.set(xlim=(x - radius, x + radius), ylim=(y - radius, y + radius), xticks=[], yticks=[], aspect="equal")
    axis.set_facecolor(COLOURS["ground"])
    axis.set_title(panel.title, fontsize=12, loc="left", fontweight="bold")
    for side in axis.spines.values():
        side.set_visible(False)
    _draw_map(axis, scene, points_per_m=PANEL_INCHES * POINTS_PER_INCH / (2 * radius))
    _draw_paths(axis, scene.agents, panel, step)
    trajectories = panel.trajectories
    if step < trajectories.num_steps:
        shown = trajectories.valid[0, :, step]
        _draw_boxes(axis, scene.agents, shown, trajectories.position[0, :, step], trajectories.heading[0, :, step])


def _draw_map(axis: Axes, scene: SceneView, *, points_per_m: float) -> None:
    """Road under crosswalks under lines under edges."""
    by_kind: dict[str, list[np.ndarray]] = {}
    for line in scene.lines:
        by_kind.setdefault(line.kind, []).append(line.points)
    axis.add_collection(PolyCollection(by_kind.get("driveway", []), facecolor=COLOURS["road"], zorder=1), autolim=False)
    for kind, width in LANE_WIDTH_M.items():
        lanes = LineCollection(
            by_kind.get(kind, []), colors=COLOURS["road"], lw=width * points_per_m, capstyle="round", zorder=1
        )
        axis.add_collection(lanes, autolim=False)
    for kind in ("crosswalk", "speed_bump"):
        areas = PolyCollection(
            by_kind.get(kind, []), facecolor=COLOURS["crosswalk"], edgecolor=COLOURS["edge"], lw=0.4, zorder=1
        )
        axis.add_collection(areas, autolim=False)
    for kind, dashes in (
        ("white", "-"),
        ("white_broken", (0, (4, 6))),
        ("yellow", "-"),
        ("yellow_broken", (0, (4, 6))),
    ):
        colour = COLOURS[kind.removesuffix("_broken")]
        axis.add_collection(
            LineCollection(by_kind.get(kind, []), colors=colour, lw=0.9, linestyles=[dashes]), autolim=False
        )
    axis.add_collection(LineCollection(by_kind.get("edge", []), colors=COLOURS["edge"], lw=1.1), autolim=False)


def _draw_paths(axis: Axes, agents: AgentBoxes, panel: Panel, step: int) -> None:
    """Thin lines of the evaluated agents, paler the more rollouts there are."""
    trajectories = panel.trajectories
    alpha = max(0.12, 0.9 / np.sqrt(trajectories.num_rollouts))
    for agent in np.flatnonzero(agents.evaluated_mask):
        where = np.where(trajectories.valid[:, agent, step:, None], trajectories.position[:, agent, step:], np.nan)
        colour = COLOURS[ROLES[2 if agents.is_ego[agent] else 1]]
        width = 2.0 if trajectories.num_rollouts == 1 else 1.0
        axis.add_collection(LineCollection(list(where), colors=colour, lw=width, alpha=alpha), autolim=False)


def _draw_boxes(axis: Axes, agents: AgentBoxes, shown: np.ndarray, position: np.ndarray, heading: np.ndarray) -> None:
    """Oriented boxes with a wedge that points ahead; pedestrians are discs."""
    for agent in np.flatnonzero(shown):
        colour = COLOURS[ROLES[2 if agents.is_ego[agent] else int(agents.evaluated_mask[agent])]]
        half = np.array([agents.length[agent], agents.width[agent]]) / 2
        turn = np.array(
            [[np.cos(heading[agent]), np.sin(heading[agent])], [-np.sin(heading[agent]), np.cos(heading[agent])]]
        )
        outline = half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        wedge = half * np.array([[0.9, 0], [0.3, 0.65], [0.3, -0.65]])
        if agents.object_type[agent] == ObjectType.PEDESTRIAN:
            angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
            radius = max(half.max(), MIN_PEDESTRIAN_RADIUS_M)
            outline, wedge = radius * np.stack([np.cos(angle), np.sin(angle)], -1), radius * wedge / half.clip(1e-3)
        for shape, fill in ((outline, colour), (wedge, "white")):
            edge = "white" if shape is outline else "none"
            polygon = PolyCollection([shape @ turn + position[agent]], facecolor=fill, edgecolor=edge, lw=0.5, zorder=3)
            axis.add_collection(polygon, autolim=False)
