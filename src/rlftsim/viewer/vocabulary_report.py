"""Report on a vocabulary: a folder with a page and a picture.

For each class the picture shows the endpoints of the tokens and the size of the errors.
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure

from rlftsim.errors import DataError
from rlftsim.jobs.files import errors_name, new_folder, remove_folder, write_text
from rlftsim.tokens.coverage import ClassCoverage, Spread
from rlftsim.viewer.figure import COLORS, INK, save_figure

PAGE, PICTURE = "report.md", "picture.png"
FILES = (PAGE, PICTURE, "report.json")
"""Files of a report; the last is in those of earlier versions alone."""

USE_COLORS = LinearSegmentedColormap.from_list("use", ["#7cc4f0", "#1d63d8", "#0a1f4d"])
DEAD, SPARE = "#e5735c", "#8b94a1"
SINGLE, ROLLING = COLORS[:2]
TICK_INCHES = 0.085
SHOWN_FRACTION = 0.998
"""Fraction of the tokens inside the picture, in x and in y; a single token far out would squeeze all tokens."""
MANY_TOKENS = 3000
"""Above this, heading ticks are shorter, so that no tick hides a neighbor."""


def write_vocabulary_report(folder: Path, classes: tuple[ClassCoverage, ...], *, vocabulary: str, data: str) -> None:
    """Write `report.md` and `picture.png` into a folder, both or none; an earlier report is replaced.

    Args:
        folder: Folder of the report; only an earlier report may be in the folder.
        classes: Coverage of each class of agents, the result of `measure_coverage`.
        vocabulary: Description of the vocabulary, for titles.
        data: Description of the data that the vocabulary is compared with.

    Raises:
        DataError: The folder has files of no report, or cannot be written.
    """
    if folder.exists() and not (folder.is_dir() and {p.name for p in folder.iterdir()} <= set(FILES)):
        raise DataError(f"{folder} is not a report on a vocabulary: name another place with --report.")
    # Written beside the folder and renamed, so that an interruption leaves the earlier report as it was.
    with errors_name(folder), new_folder(folder) as partial:
        write_text(partial / PAGE, report_page(classes, vocabulary=vocabulary, data=data))
        coverage_picture(partial / PICTURE, classes, title=f"{vocabulary}, compared with {data}")
        remove_folder(folder, FILES)


ROWS = {
    "motions": lambda c: f"{c.single_m.count:,}",
    "tokens": lambda c: f"{c.num_tokens:,}",
    "radius of a disk [cm]": lambda c: "unknown" if c.radius_m is None else f"{100 * c.radius_m:.1f}",
    "error of single motions: mean · 95 % · max [cm]": lambda c: _centimeters(c.single_m),
    "error of whole tracks: mean · 95 % · max [cm]": lambda c: _centimeters(c.rolling_m),
    "heading of whole tracks: mean · 95 % [°]": lambda c: (
        f"{np.degrees(c.heading_rad.mean):.2f} · {np.degrees(c.heading_rad.p95):.2f}"
    ),
    "fastest token [m/s]": lambda c: f"{c.token_speed_mps.max():.1f}",
    "fastest motion [m/s]": lambda c: f"{c.speed_mps.max:.1f}",
    "left against right [cm]": lambda c: "the same" if c.asymmetry_m < 1e-5 else f"{100 * c.asymmetry_m:.1f}",
    "tokens no motion, nor its mirror image, falls on": lambda c: str(c.is_dead.sum()),
    "tokens for speeds the data lack": lambda c: str(c.is_spare.sum()),
    "implausible tokens": lambda c: str(c.is_implausible.sum()),
    "token 0 stands exactly still": lambda c: "yes" if c.stands_still else "no",
    "motions left out as glitches": lambda c: str(c.num_glitches),
}
"""Rows of the table: a name, and the text of a class."""

NOTES = """An error is the mean distance of the four corners of the class's box between log and token. *Single
motions*: each half second against the nearest token. *Whole tracks*: token after token, each from the end of the
last one, gaps and glitches of the log included. *Left against right*: error of the token whose mirror image is
worst represented. *Implausible*: a turn of more than 30° or a distance beyond the speed of the class within 0.1 s.
*For speeds the data lack*: exactly straight ahead, and no motion falls on it.
"""


def report_page(classes: tuple[ClassCoverage, ...], *, vocabulary: str, data: str) -> str:
    """Report as Markdown.

    Args:
        classes: Coverage of each class of agents, the result of `measure_coverage`.
        vocabulary: Description of the vocabulary, for titles.
        data: Description of the data that the vocabulary is compared with.
    """
    head = ["| | " + " | ".join(c.class_name for c in classes) + " |", "|---|" + "---:|" * len(classes)]
    body = [f"| {name} | " + " | ".join(format_cell(c) for c in classes) + " |" for name, format_cell in ROWS.items()]
    table = "\n".join(head + body)
    return f"# A vocabulary\n\n{vocabulary}, compared with {data}.\n\n{table}\n\n{NOTES}\n![picture]({PICTURE})\n"


def _centimeters(spread: Spread) -> str:
    return f"{100 * spread.mean:.2f} · {100 * spread.p95:.2f} · {100 * spread.max:.1f}"


def coverage_picture(path: Path, classes: tuple[ClassCoverage, ...], *, title: str) -> None:
    """Draw a row of two panels for each class, 13 inches wide.

    Args:
        path: PNG to write; no half-written file is left.
        classes: Coverage of each class of agents, the result of `measure_coverage`.
        title: Description of vocabulary and data above all panels.
    """
    figure = Figure(figsize=(13, 4.3 * len(classes) + 0.6), layout="constrained")
    figure.suptitle(title, fontsize=13, fontweight="bold", x=0.01, ha="left", color=INK)
    axes = figure.subplots(len(classes), 2, squeeze=False, gridspec_kw={"width_ratios": [2.3, 1]})
    for row, coverage in zip(axes, classes):
        _draw_tokens(figure, row[0], coverage)
        _draw_errors(row[1], coverage)
        for axis in row:
            axis.spines[["top", "right"]].set_visible(False)
            axis.tick_params(labelsize=9)
    save_figure(path, figure, dots_per_inch=110)


def _draw_tokens(figure: Figure, axis: Axes, coverage: ClassCoverage) -> None:
    """Draw endpoints of tokens with a tick along the heading on the screen, the most used tokens on top."""
    end, use = coverage.poses[:, -1], coverage.use  # [tokens, 3] and [tokens]
    # Unused tokens first, so that the used ones are drawn over them.
    size = TICK_INCHES * (1.0 if len(end) <= MANY_TOKENS else 0.6)
    norm = LogNorm(1, max(int(use.max()), 2))
    groups = (
        (coverage.is_spare, SPARE, f"{coverage.is_spare.sum()} for speeds the data lack"),
        (coverage.is_dead, DEAD, f"{coverage.is_dead.sum()} that no motion falls on"),
    )
    for is_member, color, label in groups:
        if is_member.any():
            _draw_ticks(axis, end[is_member], size, color=color)
            axis.plot([], [], color=color, lw=2, label=label)
    used = np.flatnonzero(~coverage.is_unused)
    used = used[np.argsort(use[used])]  # drawn in this order, the most used ones last
    if len(used):
        _draw_ticks(axis, end[used], size, values=use[used], norm=norm)
    # Limits around nearly all points, left and right alike.
    x, y = end[:, 0], end[:, 1]
    low, high = np.quantile(x, (1 - SHOWN_FRACTION, SHOWN_FRACTION))
    side = max(float(np.quantile(np.abs(y), SHOWN_FRACTION)), 0.05) * 1.15
    margin = max(0.04 * (high - low), 0.05)
    axis.set(xlim=(low - margin, high + margin), ylim=(-side, side))
    num_outside = int(((x < low - margin) | (x > high + margin) | (np.abs(y) > side)).sum())
    if num_outside:
        axis.plot([], [], " ", label=f"{num_outside} outside the picture")
    name = f"{coverage.class_name}: {coverage.num_tokens} tokens, {coverage.single_m.count:,} motions"
    axis.set_title(name, loc="left", fontsize=11, fontweight="bold", color=INK)
    axis.set_xlabel("end point after 0.5 s, ahead [m]", fontsize=9)
    axis.set_ylabel("to the left [m]", fontsize=9)
    bar = figure.colorbar(ScalarMappable(norm, USE_COLORS), ax=axis, pad=0.01, aspect=25)
    bar.set_label("motions and mirror images on a token", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    # Powers of ten only, as whole numbers: a motion cannot fall on half a token.
    bar.set_ticks([10**k for k in range(9) if 10**k <= norm.vmax])
    bar.ax.minorticks_off()
    bar.ax.yaxis.set_major_formatter("{x:,.0f}")
    if axis.get_legend_handles_labels()[1]:
        axis.legend(loc="upper right", fontsize=8, framealpha=0.9)


def _draw_ticks(axis: Axes, poses: np.ndarray, size: float, *, values=None, norm=None, color=None) -> None:
    x, y, heading = poses.T  # each [tokens]
    # angles="uv": headings are meant on the screen, because the axes are not to scale.
    axis.quiver(
        x, y, np.cos(heading), np.sin(heading), *(() if values is None else (values,)), norm=norm,
        color=color, cmap=None if values is None else USE_COLORS, angles="uv", units="inches", scale_units="inches",
        scale=1 / size, width=0.011, headwidth=1, headlength=0, headaxislength=0, pivot="tail",
    )  # fmt: skip


def _draw_errors(axis: Axes, coverage: ClassCoverage) -> None:
    """Draw cumulative distributions of errors, with mean, 95 % and maximum in the legend."""
    # Limits before any data: errors of zero, as where everything stands, leave a logarithmic axis nothing to go by.
    axis.set(xlim=(0.05, 1000), ylim=(0, 102), xscale="log")
    for spread, color, name in ((coverage.rolling_m, ROLLING, "tracks"), (coverage.single_m, SINGLE, "motions")):
        if not spread.count:
            continue
        values, fraction = spread.curve()
        # Below the first tick of the logarithmic axis there is nothing to see.
        is_visible = (values * 100 >= 0.05) & (values * 100 <= 1000)
        label = f"{name}: {100 * spread.mean:.1f} · {100 * spread.p95:.1f} · {100 * spread.max:.0f} cm"
        axis.plot(values[is_visible] * 100, fraction[is_visible] * 100, color=color, lw=1.8, label=label)
        axis.plot(spread.p95 * 100, 95, "o", color=color, ms=5)
        axis.plot(spread.mean * 100, np.interp(spread.mean, values, fraction) * 100, "D", color=color, ms=5)
    axis.set_xticks([0.1, 1, 10, 100, 1000], ["0.1", "1", "10", "100", "1000"])
    axis.grid(alpha=0.25)
    axis.set_title("error", loc="left", fontsize=11, color=INK)
    axis.set_xlabel("mean distance of corners [cm]   ◆ mean   ● 95 %", fontsize=9)
    axis.set_ylabel("fraction with at most this error [%]", fontsize=9)
    if axis.lines:
        axis.legend(loc="lower right", fontsize=8, framealpha=0.9, title="mean · 95 % · max", title_fontsize=8)
