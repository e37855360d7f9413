"""Scenarios that play in a browser: a page, or figures of a page, that need no network."""

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from rlftsim.errors import DataError
from rlftsim.jobs.files import write_text
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.scene import SceneMotion, SceneView, build_scene, logged_trajectories


@dataclass(frozen=True, eq=False)
class Panel:
    """Picture of a scene: a title and the motion of the agents."""

    title: str
    trajectories: SceneMotion
    notes: Sequence[str] = ()
    """Text in the corner of films, for each step of the motion."""


@dataclass(frozen=True, eq=False)
class Animation:
    """A scene with panels side by side, which share time, view and the number of the rollout."""

    title: str
    scene: SceneView
    panels: Sequence[Panel]
    caption: str = ""
    first_step: int | None = None
    """Step that the player begins with, also after the end; None = the present, and after the end the history."""

    def __post_init__(self) -> None:
        if not self.panels:
            raise DataError(f"{self.title}: an animation needs at least one panel.")
        # Agents have no ids in the panels: the same number means the same agent in all of them.
        for panel in self.panels:
            num_agents, expected = panel.trajectories.position.shape[1], len(self.scene.agents)
            if num_agents != expected:
                raise DataError(
                    f"{self.title}, {panel.title}: {num_agents} agents, but scene {self.scene.scenario_id} has "
                    f"{expected}: build both from the same scenario."
                )

    def to_payload(self) -> dict[str, Any]:
        """Lists, numbers and text only, in the layout that `player.js` reads."""
        panels = []
        for motion in (panel.trajectories for panel in self.panels):
            marks = [motion.collides is not None, motion.offroad is not None]
            panels.append({**motion.to_payload(), "marks": marks})
        return {"scene": self.scene.to_payload(), "panels": panels}


def animate(scenario: Scenario, motions: Iterable[tuple[str, SceneMotion]], *, caption: str = "") -> Animation:
    """The log, and motions of the same agents beside it; agents that overlap are marked.

    Args:
        scenario: Scenario with the map and log that are drawn.
        motions: Title and motion of each further panel.
        caption: Text below the title.
    """
    scene = build_scene(scenario)
    all_motions = [("logged", logged_trajectories(scenario)), *motions]
    panels = [Panel(title, motion.with_overlaps(scene.agents)) for title, motion in all_motions]
    return Animation(f"Scenario {scenario.scenario_id}", scene, panels, caption)


def animation_html(animation: Animation) -> str:
    """A `<figure>` that plays the animation on a page made by `page_html`."""
    titles = [escape(panel.title) for panel in animation.panels]
    panels = "".join(
        f'<div class="panel"><div class="panel-head"><span class="panel-title">{title}</span>'
        f'<span class="panel-status"></span></div><canvas role="img" aria-label="{title}"></canvas>'
        '<div class="panel-tip" hidden></div></div>'
        for title in titles
    )
    caption = f'<p class="player-caption">{escape(animation.caption)}</p>' if animation.caption else ""
    note = f'<p class="player-caption">{escape(animation.scene.note)}</p>' if animation.scene.note else ""
    first = "" if animation.first_step is None else f' data-first="{animation.first_step}"'
    return (
        f'<figure class="player" tabindex="0" aria-label="{escape(animation.title)}"{first}>'
        f'<figcaption><div class="player-title">{escape(animation.title)}</div>{caption}</figcaption>'
        f'<div class="panels">{panels}</div>'
        # player.js reads `data-part` and hides the class `several` for a single rollout
        f"{read_asset('controls.html').replace(chr(10), '')}{_legend_html(animation)}"
        '<p class="hint"><kbd>space</kbd> play or pause · <kbd>←</kbd> <kbd>→</kbd> one step · drag to move, wheel to '
        "zoom (after a click into the picture) · point at an agent to follow it in all panels</p>"
        f"{note}"
        f'<script type="application/json">{embed_json(animation.to_payload())}</script></figure>'
    )


def page_html(title: str, body: str, *, extra_css: str = "") -> str:
    """A whole self-contained page.

    Args:
        title: Title of the page, plain text.
        body: HTML inside of `<main>`, with texts that are already escaped.
        extra_css: Style rules after those of the player.
    """
    # player and drawing module in one function: a page that stands alone cannot import
    drawing = read_asset("drawing.js").partition("\nexport {")[0]
    script = f'(() => {{\n"use strict";\n{drawing}\n{read_asset("player.js")}}})();\n'
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>\n{read_asset('palette.css')}{read_asset('page.css')}{extra_css}</style>"
        f"</head>\n<body><main>\n{body}\n</main>\n<script>\n{script}</script></body></html>\n"
    )


def table_html(headings: Iterable[str], rows: Iterable[str], *, is_long: bool = False) -> str:
    """A table of results that scrolls sideways.

    Args:
        headings: HTML of the headings of the columns.
        rows: Elements `<tr>` of the body.
        is_long: True limits the height, for tables of many rows.
    """
    head = "".join(f'<th scope="col">{heading}</th>' for heading in headings)
    table = f'<table class="results"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    return f'<div class="card scroll{" long" if is_long else ""}" tabindex="0">{table}</div>'


def tile_html(title: str, value: str, note: str = "", tone: str = "") -> str:
    """A card with a large number.

    Args:
        title: Text above the number.
        value: Number, plain text.
        note: Text below the number, such as its interval; empty = none.
        tone: "good" or "bad" for a color; empty = none.
    """
    below = f'<div class="interval">{note}</div>' if note else ""
    return (
        f'<div class="card tile {tone}"><div class="what">{escape(title)}</div>'
        f'<div class="value">{value}</div>{below}</div>'
    )


def write_page(path: str | os.PathLike[str], title: str, animations: Sequence[Animation], *, caption: str = "") -> None:
    """Write a page of animations.

    Args:
        path: File to write; no half-written file is left.
        title: Heading above the animations, plain text.
        animations: Scenes from top to bottom, a figure each.
        caption: Paragraph below the heading, plain text; empty = none.

    Raises:
        DataError: The file cannot be written.
    """
    intro = f'<p class="lead">{escape(caption)}</p>' if caption else ""
    figures = "\n".join(animation_html(animation) for animation in animations)
    write_text(Path(path), page_html(title, f"<h1>{escape(title)}</h1>{intro}\n{figures}"))


def embed_json(payload: Any) -> str:
    """Compact JSON that cannot end the `<script>` around it."""
    # "</script>" inside a text would end the element; an escaped "<" means the same in JSON.
    return json.dumps(payload, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


@cache
def read_asset(name: str) -> str:
    """A text file of this package."""
    return (resources.files("rlftsim.viewer") / name).read_text(encoding="utf-8")


def _legend_html(animation: Animation) -> str:
    """Legend of shapes and colors; marks that no panel has are left out."""
    trajectories = [panel.trajectories for panel in animation.panels]
    # Pairs of SVG shapes and names.
    entries = [
        (_box_svg("agent-ego"), "ego"),
        (_box_svg("agent-evaluated"), "evaluated"),
        (_box_svg("agent-other"), "other"),
        ('<ellipse cx="12" cy="8" rx="8" ry="3" fill="var(--agent-other)"/>', "cyclist"),
        (
            '<circle cx="10" cy="8" r="4.5" fill="var(--agent-other)"/>'
            '<path d="M14 5l6 3-6 3z" fill="var(--agent-other)"/>',
            "pedestrian",
        ),
    ]
    if animation.scene.lights:
        dots = zip((5, 12, 19), ("stop", "caution", "go"))
        entries.append(
            ("".join(f'<circle cx="{x}" cy="8" r="3.5" fill="var(--{c})"/>' for x, c in dots), "traffic light")
        )
    if any(line.style == "stop_sign" for line in animation.scene.lines):
        octagon = '<path d="M18 5.5v5L14.5 14h-5L6 10.5v-5L9.5 2h5z" fill="var(--stop)"/>'
        octagon += '<path d="M8.5 7h7v2h-7z" fill="var(--surface)"/>'
        entries.append((octagon, "stop sign"))
    if any(t.collides is not None for t in trajectories):
        entries.append((f"{_ring_svg('collision')}{_box_svg('agent-other', 7.0)}", "collides"))
    if any(t.offroad is not None for t in trajectories):
        entries.append((f"{_ring_svg('offroad', '3 2')}{_box_svg('agent-other', 7.0)}", "off road"))
    items = "".join(f'<li><svg viewBox="0 0 24 16" aria-hidden="true">{svg}</svg>{name}</li>' for svg, name in entries)
    return f'<ul class="legend">{items}</ul>'


def _box_svg(color: str, half: float = 10.0) -> str:
    """A vehicle from above, heading right."""
    box = f'x="{12 - half}" y="{8 - half * 0.42}" width="{2 * half}" height="{half * 0.84}"'
    shape = f'<rect {box} rx="1.5" fill="var(--{color})"/>'
    tip, root = 12 + half * 0.85, 12 + half * 0.3
    return f'{shape}<path d="M{tip} 8L{root} {8 - half * 0.28}V{8 + half * 0.28}z" fill="var(--heading-mark)"/>'


def _ring_svg(color: str, dashes: str = "") -> str:
    """The frame around a marked vehicle."""
    return (
        f'<rect x="1" y="1" width="22" height="14" rx="3" fill="var(--{color})" fill-opacity=".3" '
        f'stroke="var(--{color})" stroke-width="2" stroke-dasharray="{dashes}"/>'
    )
