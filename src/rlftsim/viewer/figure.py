"""Figures as PNG or SVG: curves with bands, intervals beside each other, charts of pages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator

from rlftsim.errors import ConfigError
from rlftsim.jobs.files import write_atomically
from rlftsim.viewer.chart import Chart

COLORS = ("#1d63d8", "#e07b00", "#11754b", "#a21caf", "#79828f", "#24292f")
"""Colors of curves; the first four are those of `palette.css`, in the same order."""
INK, PALE = "#24292f", "#c9cfd6"
DOTS_PER_INCH = 160
PICTURES = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class Band:
    """A curve with a band around it."""

    name: str
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]
    low: Float[np.ndarray, "n"] | None = None
    high: Float[np.ndarray, "n"] | None = None
    style: Literal["measured", "theory"] = "measured"
    """Measurements are dots on a line, a theory is a dashed line."""
    color: int = 0
    """Index into `COLORS`."""


@dataclass(frozen=True)
class Interval:
    """A named number with an interval."""

    name: str
    mean: float
    low: float
    high: float
    color: int = 0


def draw_bands(
    bands: Sequence[Band], *, title: str, x_label: str, y_label: str, log: bool = False, ticks: Sequence[int] = ()
) -> Figure:
    """Figure of curves that share both axes.

    Args:
        bands: Curves in the order of the legend, in data units of the axes.
        title: Title above the curves.
        x_label: Quantity and unit of the horizontal axis.
        y_label: Quantity and unit of the vertical axis.
        log: True makes both axes logarithmic.
        ticks: Values marked on the horizontal axis; empty = matplotlib chooses.
    """
    figure, axis = _axis(6.4, 4.4, title)
    for band in bands:
        color = COLORS[band.color % len(COLORS)]
        if band.low is not None and band.high is not None:
            axis.fill_between(band.x, band.low, band.high, color=color, alpha=0.16, lw=0)
        style, width = ("--", 1.4) if band.style == "theory" else ("o-", 2)
        axis.plot(band.x, band.y, style, color=color, lw=width, ms=5, label=band.name)
    if log:
        axis.set(xscale="log", yscale="log")
    if len(ticks):
        axis.set_xticks(list(ticks), [f"{t:g}" for t in ticks])
        # A logarithmic axis labels its minor ticks too, which would stand between the given ones.
        axis.xaxis.set_minor_locator(NullLocator())
        axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set(xlabel=x_label, ylabel=y_label)
    axis.grid(color=PALE, lw=0.6, alpha=0.7)
    axis.legend(frameon=False, fontsize=9)
    return figure


def draw_subplots(
    panels: Mapping[str, Sequence[Band]],
    *,
    title: str,
    x_label: str,
    y_label: str,
    ticks: Sequence[str],
    is_joined: bool = True,
) -> Figure:
    """Figure of panels with percentages that share both axes and a legend, two in a row.

    Args:
        panels: Curves by title, with the same names in each panel; the horizontal axis counts ticks from 0.
        title: Title above all panels.
        x_label: Quantity and unit of the horizontal axes.
        y_label: Quantity and unit of the vertical axes, 0 to 100 %.
        ticks: Names of the positions 0, 1, ... on the horizontal axis.
        is_joined: True joins the dots of a curve, where the ticks have an order.
    """
    columns, rows = 2, -(-len(panels) // 2)  # rounded up
    figure = Figure(figsize=(4.4 * columns, 3.4 * rows + 0.8), layout="constrained")
    figure.suptitle(title, fontsize=12, fontweight="bold", color=INK, x=0.01, ha="left")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axis, (heading, bands) in zip(axes, panels.items()):
        axis.set_title(heading, fontsize=10, loc="left", color=INK)
        for band in bands:
            color, is_theory = COLORS[band.color % len(COLORS)], band.style == "theory"
            line = ("--" if is_theory else "-") if is_joined else ""
            face = "white" if is_theory else color  # open dots for a theory
            axis.plot(band.x, band.y, f"o{line}", color=color, lw=1.2, ms=4, mfc=face, label=band.name, zorder=3)
            if band.low is not None and band.high is not None:
                axis.vlines(band.x, band.low, band.high, color=color, lw=2, alpha=0.4)
        axis.set_xticks(range(len(ticks)), list(ticks), fontsize=8)
        axis.set(ylim=(-3, 103))
        axis.grid(color=PALE, lw=0.6, alpha=0.7)
        axis.spines[["top", "right"]].set_visible(False)
    # Inner axes share ticks with the outer ones, so only the last row and the first column are labeled.
    for axis in axes[-columns:]:
        axis.set_xlabel(x_label)
    for axis in axes[::columns]:
        axis.set_ylabel(y_label)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 3), frameon=False, fontsize=9)
    return figure


def draw_intervals(intervals: Sequence[Interval], *, title: str, x_label: str, zero: bool) -> Figure:
    """Figure with a row for each number and interval, the first on top.

    Args:
        intervals: Numbers with intervals, from top to bottom.
        title: Title above the numbers.
        x_label: Quantity and unit of the numbers.
        zero: True marks zero by a line, for differences.
    """
    figure, axis = _axis(6.4, 1.3 + 0.42 * len(intervals), title)
    for row, item in enumerate(intervals):
        color = COLORS[item.color % len(COLORS)]
        axis.plot([item.low, item.high], [row, row], color=color, lw=3, alpha=0.45, solid_capstyle="round")
        axis.plot([item.mean], [row], "o", color=color, ms=6)
    if zero:
        axis.axvline(0.0, color=INK, lw=1, ls=(0, (4, 3)))
    axis.set_yticks(range(len(intervals)), [item.name for item in intervals])
    # The vertical axis points down, so that the first row is on top.
    axis.set(xlabel=x_label, ylim=(len(intervals) - 0.4, -0.6))
    axis.grid(axis="x", color=PALE, lw=0.6, alpha=0.7)
    axis.tick_params(axis="y", length=0)
    axis.spines["left"].set_visible(False)
    return figure


def check_picture_path(path: Path) -> None:
    """Check that a file name has the ending of a picture.

    Raises:
        ConfigError: The ending is no picture's.
    """
    if path.suffix not in PICTURES:
        raise ConfigError(f"{path}: pictures are written as {', '.join(PICTURES)}: name the file so.")


def save_figure(path: Path, figure: Figure, *, dots_per_inch: int = DOTS_PER_INCH) -> None:
    """Write a figure as PNG, SVG or PDF; no half-written file is left behind.

    Args:
        path: File to write; the ending .png, .svg or .pdf chooses the format.
        figure: Figure to write; equal figures give equal bytes.
        dots_per_inch: Resolution of a PNG; 160 makes an inch 160 pixels.

    Raises:
        ConfigError: An ending that is no picture's.
        DataError: The file cannot be written.
    """
    check_picture_path(path)
    picture_format = path.suffix.removeprefix(".")
    FigureCanvasAgg(figure)
    # No dates and a fixed salt for ids: the same figure gives the same bytes.
    metadata = {"png": None, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[picture_format]
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "rlftsim"}):
        options = {"format": picture_format, "dpi": dots_per_inch, "facecolor": "white", "metadata": metadata}
        write_atomically(path, lambda temporary: figure.savefig(temporary, **options))


def _axis(width: float, height: float, title: str) -> tuple[Figure, Axes]:
    """Figure of a size in inches with an empty axis."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, fontsize=12, fontweight="bold", color=INK, x=0.01, ha="left")
    axis = figure.subplots()
    axis.spines[["top", "right"]].set_visible(False)
    return figure, axis


CHART_INCHES = (4.6, 3.4)


def charts_to_png(path: Path, charts: Sequence[Chart]) -> None:
    """Draw charts side by side.

    Args:
        path: File to write (.png, .svg or .pdf); no half-written file is left.
        charts: Charts from left to right, at least one.
    """
    width, height = CHART_INCHES
    figure = Figure(figsize=(width * len(charts), height), layout="constrained")
    for axis, chart in zip(figure.subplots(1, len(charts), squeeze=False)[0], charts):
        axis.set_title(chart.title, fontsize=11, loc="left", fontweight="bold")
        axis.set(xlabel=chart.x_label, ylabel=chart.y_label)
        axis.grid(alpha=0.3)
        for index, curve in enumerate(chart.curves):
            # A short curve may be a single point, which a line alone would not show.
            marker = "o" if len(curve.x) < 20 else ""
            color = COLORS[index % len(COLORS)]
            x, y = np.asarray(curve.x), np.asarray(curve.y)
            axis.plot(x, y, color=color, lw=1.2, marker=marker, ms=3, label=curve.name)
        if chart.reference:
            axis.axhline(chart.reference[1], color=INK, ls="--", lw=1, label=chart.reference[0])
        # One curve needs no legend: its name is the title of the chart or of its axis.
        if len(axis.get_legend_handles_labels()[1]) > 1:
            axis.legend(frameon=False, fontsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    save_figure(path, figure, dots_per_inch=120)
