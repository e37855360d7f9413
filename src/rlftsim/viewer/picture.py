"""Still picture of a scene: panels side by side, with the paths of all rollouts as thin lines."""

import os
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rlftsim.scenario.types import CURRENT_STEP, ObjectType
from rlftsim.viewer.figure import DOTS_PER_INCH, save_figure
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.scene import AgentBoxes, SceneView

PANEL_INCHES = 4.0
POINTS_PER_INCH = 72.0
LANE_WIDTH_M = {"lane": 4.4, "bike_lane": 2.0}
COLORS = {
    "ground": "#eef0ec",
    "road": "#d7dbe0",
    "crosswalk": "#f7f8fa",
    "edge": "#79828f",
    "white": "#ffffff",
    "yellow": "#d9a514",
    "ego": "#1d63d8",
    "evaluated": "#e07b00",
    "other": "#8b94a1",
    "collides": "#c4161c",
    "offroad": "#a21caf",
}
ROLES = ("other", "evaluated", "ego")
MIN_PEDESTRIAN_RADIUS_M = 0.5
LIGHT_COLORS = {**dict.fromkeys("147", "#c4161c"), **dict.fromkeys("258", "#d9a514"), **dict.fromkeys("36", "#11754b")}
"""Colors of stop, caution and go, by WOMD's numbers of a light's states."""
MARK_STYLES = {"collides": "-", "offroad": "--"}
"""Line styles of the frames around agents, by the field of `SceneMotion` that marks them."""
FRAME_SCALE = {"collides": 1.25, "offroad": 1.6}
MARK_WIDTH = 1.8
NOTE_CHARACTERS = 75
"""Of a line of small print across one panel."""


def to_png(path: str | os.PathLike[str], animation: Animation, *, dots_per_inch: int = DOTS_PER_INCH) -> None:
    """Draw the panels of an animation side by side at the current step, with the later paths of evaluated agents.

    Boxes are those of each panel's first rollout.

    Args:
        path: File to write, .png, .svg or .pdf; no half-written file is left.
        animation: Scene and panels; the caption is left out.
        dots_per_inch: Resolution of a PNG; 160 makes a panel 640 pixels wide.

    Raises:
        ConfigError: An ending that is no picture's.
        DataError: The file cannot be written.
    """
    figure, axes = draw_scene(animation)
    for axis, panel in zip(axes, animation.panels):
        draw_paths(axis, animation.scene.agents, panel)
        light_dots(axis, animation.scene, CURRENT_STEP)
        draw_agents(axis, animation.scene.agents, panel, CURRENT_STEP)
    save_figure(Path(path), figure, dots_per_inch=dots_per_inch)


def draw_scene(animation: Animation) -> tuple[Figure, Sequence[Axes]]:
    """Figure with the still part of an animation: a map for each panel, and a legend."""
    panels = animation.panels
    figure = Figure(figsize=(PANEL_INCHES * len(panels), PANEL_INCHES + 0.7), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, panel in zip(axes, panels):
        axis.set_title(panel.title, fontsize=12, loc="left", fontweight="bold")
        axis.spines[:].set_visible(False)
        draw_map(axis, animation.scene, animation.scene.focus, inches=PANEL_INCHES)
    names = {"ego": "ego", "evaluated": "evaluated agents", "other": "other agents"}
    handles = [Line2D([], [], color=COLORS[role], lw=5, label=label) for role, label in names.items()]
    marks = {"collides": "collides", "offroad": "off road"}
    handles += [
        Line2D([], [], color=COLORS[mark], lw=MARK_WIDTH, ls=MARK_STYLES[mark], label=label)
        for mark, label in marks.items()
        if any(getattr(panel.trajectories, mark) is not None for panel in panels)
    ]
    # A single panel is too narrow for all of them in a row.
    columns = min(len(handles), 3 * len(panels))
    spacing = {"handlelength": 1.5, "columnspacing": 1.2}
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=9, **spacing)
    write_notes(figure, [animation.scene], panels_across=len(panels))
    return figure, list(axes)


def write_notes(figure: Figure, scenes: Sequence[SceneView], *, panels_across: int) -> None:
    """Write the notes of the scenes in small print on top of a figure, each once.

    Args:
        figure: Figure with a constrained layout, which makes room for the notes.
        scenes: Scenes in the figure; equal notes are written once.
        panels_across: Number of panels side by side, for the length of a line.
    """
    notes = " ".join(dict.fromkeys(scene.note for scene in scenes if scene.note))
    if notes:
        lines = "\n".join(wrap(notes, NOTE_CHARACTERS * panels_across))
        figure.suptitle(lines, fontsize=7, color=COLORS["edge"], x=0.01, ha="left")


def draw_map(axis: Axes, scene: SceneView, focus: tuple[float, float, float], *, inches: float) -> None:
    """Draw a square of a scene's map: road, on it crosswalks, lines, and edges on top.

    Args:
        axis: Axes that show the square, in the map frame, meters.
        scene: Still part of a scenario, with the map features as styled lines.
        focus: Center x, y and half of the width of the square, meters.
        inches: Width of the axes on paper, so that lanes have the width of the real road.
    """
    x, y, radius = focus
    axis.set(xlim=(x - radius, x + radius), ylim=(y - radius, y + radius), xticks=[], yticks=[], aspect="equal")
    axis.set_facecolor(COLORS["ground"])
    points_per_m = inches * POINTS_PER_INCH / (2 * radius)
    # Autoscaling is off for every collection: the limits show the focus of the scene, not the whole map.
    by_style: dict[str, list[np.ndarray]] = {}
    for line in scene.lines:
        by_style.setdefault(line.style, []).append(line.points)

    def add(collection: type[PolyCollection] | type[LineCollection], style: str, **properties: Any) -> None:
        axis.add_collection(collection(by_style.get(style, []), **properties), autolim=False)

    add(PolyCollection, "driveway", facecolor=COLORS["road"], zorder=1)
    # Lanes are logged as center lines; wide strokes with round ends make them a road surface without gaps.
    for style, width in LANE_WIDTH_M.items():
        add(LineCollection, style, colors=COLORS["road"], lw=width * points_per_m, capstyle="round", zorder=1)
    for style in ("crosswalk", "speed_bump"):
        add(PolyCollection, style, facecolor=COLORS["crosswalk"], edgecolor=COLORS["edge"], lw=0.4, zorder=1)
    for color in ("white", "yellow"):
        add(LineCollection, color, colors=COLORS[color], lw=0.9, linestyles=["-"])
        add(LineCollection, f"{color}_broken", colors=COLORS[color], lw=0.9, linestyles=[(0, (4, 6))])
    add(LineCollection, "edge", colors=COLORS["edge"], lw=1.1)


def draw_paths(axis: Axes, agents: AgentBoxes, panel: Panel) -> None:
    """Draw the paths of the evaluated agents from the current step on as thin lines, paler the more rollouts there are.

    Args:
        axis: Axes in the map frame, meters.
        agents: Boxes of the scene, which say which agents are evaluated.
        panel: Motion of the agents in all rollouts.
    """
    trajectories = panel.trajectories
    position, valid = trajectories.position[:, :, CURRENT_STEP:], trajectories.valid[:, :, CURRENT_STEP:]
    alpha = max(0.12, 0.9 / np.sqrt(trajectories.num_rollouts))
    for agent in np.flatnonzero(agents.evaluated_mask):
        # [N, steps, 2]; NaN interrupts a line where the agent is not valid.
        points = np.where(valid[:, agent, :, None], position[:, agent], np.nan)
        color = COLORS[ROLES[2 if agents.is_ego[agent] else 1]]
        width = 2.0 if trajectories.num_rollouts == 1 else 1.0
        axis.add_collection(LineCollection(list(points), colors=color, lw=width, alpha=alpha), autolim=False)


def draw_agents(axis: Axes, agents: AgentBoxes, panel: Panel, step: int) -> list[PolyCollection]:
    """Draw the agents of a panel's first rollout; returns the shapes, which a film removes again.

    Boxes have a wedge that points ahead, pedestrians are discs; agents that collide or are off the road get a frame.

    Args:
        axis: Axes in the map frame, meters.
        agents: Boxes of the scene, sizes in meters.
        panel: Motion of the agents; the first rollout counts.
        step: Step 0..90; beyond the end of the motion there are no shapes.
    """
    trajectories = panel.trajectories
    if step >= trajectories.num_steps:
        return []
    present_agents = np.flatnonzero(trajectories.valid[0, :, step])  # [k]
    roles = np.where(agents.is_ego, 2, agents.evaluated_mask.astype(int))
    colors = [COLORS[ROLES[roles[agent]]] for agent in present_agents]
    outlines, wedges = [], []
    for agent in present_agents:
        cos, sin = np.cos(trajectories.heading[0, agent, step]), np.sin(trajectories.heading[0, agent, step])
        # Rows are points, so they are multiplied from the left with the transposed rotation.
        rotation, center = np.array([[cos, sin], [-sin, cos]]), trajectories.position[0, agent, step]
        outline, wedge = (shape @ rotation + center for shape in _outline(agents, int(agent)))
        outlines.append(outline)
        wedges.append(wedge)
    shapes = [
        PolyCollection(outlines, facecolors=colors, edgecolor="white", lw=0.5, zorder=3),
        PolyCollection(wedges, facecolor="white", edgecolor="none", zorder=3),
    ]
    # Frames are enlarged outlines, so that both kinds can be seen around one agent.
    for mark, style in MARK_STYLES.items():
        flags = getattr(trajectories, mark)
        marked = [] if flags is None else [outlines[row] for row in np.flatnonzero(flags[0, present_agents, step])]
        frames = [shape.mean(0) + FRAME_SCALE[mark] * (shape - shape.mean(0)) for shape in marked]
        shapes.append(
            PolyCollection(frames, facecolor="none", edgecolor=COLORS[mark], lw=MARK_WIDTH, ls=style, zorder=4)
        )
    for shape in shapes:
        axis.add_collection(shape, autolim=False)
    return shapes


def light_dots(axis: Axes, scene: SceneView, step: int) -> PathCollection:
    """Add the traffic lights to axes in the map frame; lights that were not observed at the step are left out.

    Args:
        axis: Axes in the map frame, meters.
        scene: Still part of a scenario, with the states of all lights.
        step: Step 0..90 of the states.

    Returns:
        Dots, which a film removes again.
    """
    colors = [(light.stop_point, LIGHT_COLORS.get(light.states[step : step + 1])) for light in scene.lights]
    observed = [(point, color) for point, color in colors if color]
    points = np.array([point for point, _ in observed]).reshape(-1, 2)
    shown_colors = [color for _, color in observed]
    return axis.scatter(*points.T, s=26, c=shown_colors, edgecolors="white", linewidths=0.6, zorder=5)


def _outline(agents: AgentBoxes, agent: int) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "3 2"]]:
    """Outline and wedge in the agent's frame, meters."""
    half = np.array([agents.length[agent], agents.width[agent]]) / 2
    wedge = np.array([[0.9, 0], [0.3, 0.65], [0.3, -0.65]])
    if agents.object_type[agent] != ObjectType.PEDESTRIAN:
        return half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]), half * wedge
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    radius = max(half.max(), MIN_PEDESTRIAN_RADIUS_M)
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1), radius * wedge
