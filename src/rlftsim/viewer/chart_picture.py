"""Charts as one still picture, for places that show no page."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rlftsim.viewer.chart import Chart
from rlftsim.viewer.figure import COLORS, INK, save_figure

CHART_INCHES = (4.6, 3.4)


def charts_to_png(path: Path, charts: Sequence[Chart], *, dots_per_inch: int = 120) -> None:
    """Draw charts side by side.

    Args:
        path: File to write (.png, .svg or .pdf); no half-written file is left.
        charts: Charts from left to right, at least one.
        dots_per_inch: Resolution of a PNG; 120 makes a chart 552 pixels wide.
    """
    width, height = CHART_INCHES
    figure = Figure(figsize=(width * len(charts), height), layout="constrained")
    for axis, chart in zip(figure.subplots(1, len(charts), squeeze=False)[0], charts):
        axis.set_title(chart.title, fontsize=11, loc="left", fontweight="bold")
        axis.set(xlabel=chart.x_label, ylabel=chart.y_label, yscale="log" if chart.log_y else "linear")
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
    save_figure(path, figure, dots_per_inch=dots_per_inch)
