"""One still picture of a scene: panels side by side, with the paths of all rollouts as thin lines."""

import os
from collections.abc import Sequence
from pathlib import Path

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
    "collides": "#c4161c",
    "offroad": "#a21caf",
}
ROLES = ("other", "evaluated", "ego")
MIN_PEDESTRIAN_RADIUS_M = 0.5
LIGHT_COLOURS = {
    **dict.fromkeys("147", "#c4161c"),
    **dict.fromkeys("258", "#d9a514"),
    **dict.fromkeys("36", "#11754b"),
}
"""By WOMD's number of a light's state: stop, caution, go."""
MARK_STYLES = {"collides": "-", "offroad": "--"}
"""How agents are framed, by the field of `Trajectories` that says so."""
FRAME_SCALE = {"collides": 1.25, "offroad": 1.6}
MARK_WIDTH = 1.8


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
    figure, axes = draw_scene(animation)
    for axis, panel in zip(axes, animation.panels):
        draw_paths(axis, animation.scene.agents, panel, step)
        light_dots(axis, animation.scene, step)
        for shape in agent_shapes(animation.scene.agents, panel, step):
            axis.add_collection(shape, autolim=False)
    save_figure(Path(path), figure, dots_per_inch=dots_per_inch)


def draw_scene(animation: Animation) -> tuple[Figure, Sequence[Axes]]:
    """What stands still in an animation: a panel of map for each of its own, and a legend."""
    panels = animation.panels
    figure = Figure(figsize=(PANEL_INCHES * len(panels), PANEL_INCHES + 0.7), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, panel in zip(axes, panels):
        _draw_ground(axis, animation.scene, panel.title)
    names = {"ego": "ego", "evaluated": "evaluated agents", "other": "other agents"}
    handles = [Line2D([], [], color=COLOURS[role], lw=5, label=label) for role, label in names.items()]
    marks = {"collides": "collides", "offroad": "off road"}
    handles += [
        Line2D([], [], color=COLOURS[mark], lw=MARK_WIDTH, ls=MARK_STYLES[mark], label=label)
        for mark, label in marks.items()
        if any(getattr(panel.trajectories, mark) is not None for panel in panels)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=10)
    return figure, list(axes)


def _draw_ground(axis: Axes, scene: SceneView, title: str) -> None:
    x, y, radius = scene.focus
    axis.set(xlim=(x - radius, x + radius), ylim=(y - radius, y + radius), xticks=[], yticks=[], aspect="equal")
    axis.set_facecolor(COLOURS["ground"])
    axis.set_title(title, fontsize=12, loc="left", fontweight="bold")
    for side in axis.spines.values():
        side.set_visible(False)
    draw_map(axis, scene, points_per_m=PANEL_INCHES * POINTS_PER_INCH / (2 * radius))


def draw_map(axis: Axes, scene: SceneView, *, points_per_m: float) -> None:
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


def draw_paths(axis: Axes, agents: AgentBoxes, panel: Panel, step: int) -> None:
    """Thin lines of the evaluated agents from a step on, paler the more rollouts there are."""
    trajectories = panel.trajectories
    alpha = max(0.12, 0.9 / np.sqrt(trajectories.num_rollouts))
    for agent in np.flatnonzero(agents.evaluated_mask):
        where = np.where(trajectories.valid[:, agent, step:, None], trajectories.position[:, agent, step:], np.nan)
        colour = COLOURS[ROLES[2 if agents.is_ego[agent] else 1]]
        width = 2.0 if trajectories.num_rollouts == 1 else 1.0
        axis.add_collection(LineCollection(list(where), colors=colour, lw=width, alpha=alpha), autolim=False)


def agent_shapes(agents: AgentBoxes, panel: Panel, step: int) -> list[PolyCollection]:
    """The agents of a panel's first rollout at a step: oriented boxes with a wedge that points ahead, pedestrians as discs; who
    collides or is off the road is framed. To be added to a panel's axes."""
    trajectories = panel.trajectories
    if step >= trajectories.num_steps:
        return []
    chosen = np.flatnonzero(trajectories.valid[0, :, step])
    roles = np.where(agents.is_ego, 2, agents.evaluated_mask.astype(int))
    colours = [COLOURS[ROLES[roles[agent]]] for agent in chosen]
    outlines, wedges = [], []
    for agent in chosen:
        cos, sin = np.cos(trajectories.heading[0, agent, step]), np.sin(trajectories.heading[0, agent, step])
        turn, place = np.array([[cos, sin], [-sin, cos]]), trajectories.position[0, agent, step]
        outline, wedge = (shape @ turn + place for shape in _outline(agents, int(agent)))
        outlines.append(outline)
        wedges.append(wedge)
    shapes = [
        PolyCollection(outlines, facecolors=colours, edgecolor="white", lw=0.5, zorder=3),
        PolyCollection(wedges, facecolor="white", edgecolor="none", zorder=3),
    ]
    for mark, style in MARK_STYLES.items():
        flags = getattr(trajectories, mark)
        marked = [] if flags is None else [outlines[row] for row in np.flatnonzero(flags[0, chosen, step])]
        frames = [shape.mean(0) + FRAME_SCALE[mark] * (shape - shape.mean(0)) for shape in marked]
        shapes.append(
            PolyCollection(frames, facecolor="none", edgecolor=COLOURS[mark], lw=MARK_WIDTH, ls=style, zorder=4)
        )
    return shapes


def light_dots(axis: Axes, scene: SceneView, step: int) -> PathCollection:
    """The traffic lights at a step, added to the axes; those that are not seen are left out."""
    colours = [(light.stop_point, LIGHT_COLOURS.get(light.states[step : step + 1])) for light in scene.lights]
    seen = [(point, colour) for point, colour in colours if colour]
    points = np.array([point for point, _ in seen]).reshape(-1, 2)
    return axis.scatter(
        points[:, 0], points[:, 1], s=26, c=[colour for _, colour in seen], edgecolors="white", linewidths=0.6, zorder=5
    )


def _outline(agents: AgentBoxes, agent: int) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "3 2"]]:
    """Outline and wedge in the agent's own frame, metres."""
    half = np.array([agents.length[agent], agents.width[agent]]) / 2
    wedge = np.array([[0.9, 0], [0.3, 0.65], [0.3, -0.65]])
    if agents.object_type[agent] != ObjectType.PEDESTRIAN:
        return half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]), half * wedge
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    radius = max(half.max(), MIN_PEDESTRIAN_RADIUS_M)
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1), radius * wedge
