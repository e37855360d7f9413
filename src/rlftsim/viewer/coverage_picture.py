"""One picture of a vocabulary: for each class where its tokens lead, how large its errors are, and which speeds it knows."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure

from rlftsim.tokens.coverage import MAX_SPEED_BIN_MPS, ClassCoverage, Spread
from rlftsim.viewer.figure import COLOURS, INK, save_figure

USE_COLOURS = LinearSegmentedColormap.from_list("use", ["#7cc4f0", "#1d63d8", "#0a1f4d"])
DEAD, SPARE, BARS = "#e5735c", "#8b94a1", "#c3ccd8"
SINGLE, ROLLING = COLOURS[:2]
TICK_INCHES = 0.085
SHOWN_SHARE = 0.998
"""Of the tokens, in x and in y; a single one far away would squeeze all others."""
MANY_TOKENS = 3000
"""Above this, heading ticks are shorter, so that they do not hide each other."""


def coverage_picture(path: Path, classes: tuple[ClassCoverage, ...], *, title: str, dots_per_inch: int = 110) -> None:
    """Draw a row of three panels for each class.

    Args:
        path: PNG to write; nothing half-written is left there.
        classes: what `measure_coverage` returned.
        title: which vocabulary, which data.
        dots_per_inch: of the PNG, 17 inches wide.
    """
    figure = Figure(figsize=(17, 4.3 * len(classes) + 0.6), layout="constrained")
    figure.suptitle(title, fontsize=13, fontweight="bold", x=0.01, ha="left", color=INK)
    axes = figure.subplots(len(classes), 3, squeeze=False, gridspec_kw={"width_ratios": [2.3, 1, 1]})
    for row, coverage in zip(axes, classes):
        _draw_tokens(figure, row[0], coverage)
        _draw_errors(row[1], coverage)
        _draw_speeds(row[2], coverage)
        for axis in row:
            axis.spines[["top", "right"]].set_visible(False)
            axis.tick_params(labelsize=9)
    save_figure(path, figure, dots_per_inch=dots_per_inch)


def _draw_tokens(figure: Figure, axis: Axes, coverage: ClassCoverage) -> None:
    """End points, with a tick along the heading on the screen (the axes are not to scale), the most used ones on top."""
    end, use = coverage.poses[:, -1], coverage.use
    size = TICK_INCHES * (1.0 if len(end) <= MANY_TOKENS else 0.6)
    norm = LogNorm(1, max(int(use.max()), 2))
    groups = (
        (coverage.is_spare, SPARE, f"{coverage.is_spare.sum()} for speeds the data lack"),
        (coverage.is_dead, DEAD, f"{coverage.is_dead.sum()} that no motion falls on"),
    )
    for where, colour, label in groups:
        if where.any():
            _draw_ticks(axis, end[where], size, color=colour)
            axis.plot([], [], color=colour, lw=2, label=label)
    used = np.flatnonzero(~coverage.is_unused)
    used = used[np.argsort(use[used])]
    if len(used):
        _draw_ticks(axis, end[used], size, values=use[used], norm=norm)
    num_outside = _frame(axis, end[:, :2])
    if num_outside:
        axis.plot([], [], " ", label=f"{num_outside} outside the picture")
    name = f"{coverage.class_name}: {coverage.num_tokens} tokens, {coverage.single_m.count:,} motions"
    axis.set_title(name, loc="left", fontsize=11, fontweight="bold", color=INK)
    axis.set_xlabel("end point after 0.5 s, ahead [m]", fontsize=9)
    axis.set_ylabel("to the left [m]", fontsize=9)
    bar = figure.colorbar(ScalarMappable(norm, USE_COLOURS), ax=axis, pad=0.01, aspect=25)
    bar.set_label("motions and mirror images on a token", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    bar.set_ticks([10**k for k in range(9) if 10**k <= norm.vmax])
    bar.ax.minorticks_off()
    bar.ax.yaxis.set_major_formatter("{x:,.0f}")
    if axis.get_legend_handles_labels()[1]:
        axis.legend(loc="upper right", fontsize=8, framealpha=0.9)


def _frame(axis: Axes, points: np.ndarray) -> int:
    """Show nearly all points, left and right alike; returns how many are outside."""
    low, high = np.quantile(points[:, 0], (1 - SHOWN_SHARE, SHOWN_SHARE))
    side = max(float(np.quantile(np.abs(points[:, 1]), SHOWN_SHARE)), 0.05) * 1.15
    margin = max(0.04 * (high - low), 0.05)
    axis.set(xlim=(low - margin, high + margin), ylim=(-side, side))
    inside = (points[:, 0] >= low - margin) & (points[:, 0] <= high + margin) & (np.abs(points[:, 1]) <= side)
    return int((~inside).sum())


def _draw_ticks(axis: Axes, poses: np.ndarray, size: float, *, values=None, norm=None, color=None) -> None:
    x, y, heading = poses.T
    axis.quiver(
        x, y, np.cos(heading), np.sin(heading), *(() if values is None else (values,)), norm=norm,
        color=color, cmap=None if values is None else USE_COLOURS, angles="uv", units="inches", scale_units="inches",
        scale=1 / size, width=0.011, headwidth=1, headlength=0, headaxislength=0, pivot="tail",
    )  # fmt: skip


def _draw_errors(axis: Axes, coverage: ClassCoverage) -> None:
    """Cumulative distributions, with mean, 95 % and maximum in the legend."""
    for spread, colour, name in ((coverage.rolling_m, ROLLING, "tracks"), (coverage.single_m, SINGLE, "motions")):
        if not spread.count:
            continue
        values, share = spread.curve()
        shown = (values * 100 >= 0.05) & (values * 100 <= 1000)
        axis.plot(values[shown] * 100, share[shown] * 100, color=colour, lw=1.8, label=_in_words(name, spread))
        axis.plot(spread.p95 * 100, 95, "o", color=colour, ms=5)
        axis.plot(spread.mean * 100, np.interp(spread.mean, values, share) * 100, "D", color=colour, ms=5)
    axis.set(xscale="log", xlim=(0.05, 1000), ylim=(0, 102))
    axis.set_xticks([0.1, 1, 10, 100, 1000], ["0.1", "1", "10", "100", "1000"])
    axis.grid(alpha=0.25)
    axis.set_title("error", loc="left", fontsize=11, color=INK)
    axis.set_xlabel("mean distance of corners [cm]   ◆ mean   ● 95 %", fontsize=9)
    axis.set_ylabel("share with at most this error [%]", fontsize=9)
    if axis.lines:
        axis.legend(loc="lower right", fontsize=8, framealpha=0.9, title="mean · 95 % · max", title_fontsize=8)


def _in_words(name: str, spread: Spread) -> str:
    return f"{name}: {100 * spread.mean:.1f} · {100 * spread.p95:.1f} · {100 * spread.max:.0f} cm"


def _draw_speeds(axis: Axes, coverage: ClassCoverage) -> None:
    """How often each speed occurs, and a mark below for each token's."""
    counts, speeds = coverage.speed_counts, coverage.token_speed_mps
    top = max(int(counts.max()), 10) * 3
    axis.bar(np.arange(len(counts)) + 0.5, np.maximum(counts, 0.1), width=0.94, color=BARS, label="motions")
    groups = (
        (coverage.is_dead, DEAD, "tokens without motions"),
        (coverage.is_spare, SPARE, "tokens for speeds the data lack"),
        (~coverage.is_unused, SINGLE, "used tokens"),
    )
    for where, colour, label in groups:
        if where.any():
            axis.vlines(speeds[where], 0.12, 0.55, color=colour, lw=0.7, label=label)
    fastest = max(float(np.quantile(speeds, SHOWN_SHARE)), coverage.speed_mps.max)
    axis.set(yscale="log", ylim=(0.1, top), xlim=(-0.01 * fastest, min(fastest * 1.05 + 1, MAX_SPEED_BIN_MPS + 2)))
    axis.set_title("speed", loc="left", fontsize=11, color=INK)
    name = f"speed [m/s]   tokens up to {speeds.max():.1f}, motions up to {coverage.speed_mps.max:.1f}"
    axis.set_xlabel(name, fontsize=9)
    axis.set_ylabel("motions per m/s", fontsize=9)
    axis.set_yticks([y for y in 10.0 ** np.arange(8) if y <= top])
    axis.legend(loc="upper right", fontsize=8, framealpha=0.9)
