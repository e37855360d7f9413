"""Line charts as inline SVG: axes, labels, lines; a page needs no plotting library."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float

from rlftsim.errors import DataError

WIDTH, HEIGHT = 460, 270
LEFT, RIGHT, TOP, BOTTOM = 72, 14, 12, 44
"""Room around the plotted area, in units of the SVG."""
MAX_DRAWN_POINTS = 200
MAX_DOTS = 11
NUM_SERIES_COLORS = 4
DRAWN_MAGNITUDE = 1e30
"""Values farther from zero count as not finite."""


@dataclass(frozen=True)
class Curve:
    """Values over updates (or steps, or epochs). Points that are not finite leave a gap."""

    name: str
    x: Sequence[float] | Sequence[int] | np.ndarray
    y: Sequence[float] | Sequence[int] | np.ndarray

    def __post_init__(self) -> None:
        if len(self.x) != len(self.y):
            raise DataError(f"curve {self.name}: {len(self.x)} x values but {len(self.y)} y values.")


@dataclass(frozen=True)
class Chart:
    """Curves that share both axes."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    reference: tuple[str, float] | None = None
    """Name and height of a dashed horizontal line, such as the KL target."""


@dataclass(frozen=True)
class Axes:
    """Limits of both axes, and positions of values in between."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float

    def horizontal(self, x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """SVG coordinate of x."""
        return np.asarray(
            LEFT + (np.asarray(x, float) - self.x_low) / (self.x_high - self.x_low) * (WIDTH - LEFT - RIGHT)
        )

    def vertical(self, y: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """SVG coordinate of y."""
        fraction = (np.asarray(y, float) - self.y_low) / (self.y_high - self.y_low)
        # SVG counts from the top.
        return np.asarray(HEIGHT - BOTTOM - fraction * (HEIGHT - TOP - BOTTOM))


def chart_html(chart: Chart) -> str:
    """A `<figure>` with title, legend (for more than one curve) and SVG."""
    curves = [(curve.name, *_select_points(curve)) for curve in chart.curves]  # name, x [n], y [n]
    title = f'<figcaption class="chart-title">{escape(chart.title)}</figcaption>'
    if not any(len(x) for _, x, _ in curves):
        return f'<figure class="chart">{title}<p class="note">No data.</p></figure>'
    axes = _compute_axes(curves, chart)
    shapes = [_frame_svg(axes, chart)]
    shapes += [_curve_svg(axes, x, y, css_color(index)) for index, (_, x, y) in enumerate(curves)]
    if chart.reference:
        name, height = chart.reference
        y = float(axes.vertical(np.array(height)))
        shapes.append(f'<path class="reference" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        label = f'<text class="halo" x="{WIDTH - RIGHT - 4}" y="{y - 5:.1f}" text-anchor="end">{escape(name)}</text>'
        shapes.append(label)
    legend = ""
    if len(chart.curves) > 1:
        line = '<svg viewBox="0 0 24 16" aria-hidden="true"><path d="M2 8H22" stroke="{}" stroke-width="3"/></svg>'
        items = "".join(f"<li>{line.format(css_color(i))}{escape(c.name)}</li>" for i, c in enumerate(chart.curves))
        legend = f'<ul class="legend chart-legend">{items}</ul>'
    return (
        f'<figure class="chart">{title}{legend}'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(chart.title)}">{"".join(shapes)}</svg>'
        "</figure>"
    )


def css_color(index: int) -> str:
    """CSS color of the curve with this number."""
    return f"var(--series-{index % NUM_SERIES_COLORS + 1})"


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers in [low, high].

    Args:
        low: Lower limit of the axis.
        high: Upper limit, above the lower limit.
        count: Number of ticks to aim at; the result may have a few more or fewer.
    """
    raw = (high - low) / max(count, 1)
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = min((m * magnitude for m in (1, 2, 2.5, 5, 10)), key=lambda s: abs(s - raw))
    # 1e-9 keeps a limit that is itself round but for float arithmetic.
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def label_ticks(low: float, high: float, count: int) -> list[tuple[float, str]]:
    """Round numbers in [low, high] with their labels.

    Args:
        low: Lower limit of the axis.
        high: Upper limit, above the lower limit.
        count: Number of ticks to aim at.
    """
    ticks = nice_ticks(low, high, count)
    step = ticks[1] - ticks[0] if len(ticks) > 1 else 1.0
    return [(tick, format_tick(tick, step)) for tick in ticks]


def format_tick(value: float, step: float) -> str:
    """Number with as many digits as the distance between ticks needs, in powers of ten where there would be too many.

    Args:
        value: Number to write at the tick.
        step: Distance between ticks, which sets the number of digits.
    """
    largest = max(abs(value), step)
    if largest >= 1e5 or step < 1e-5:
        return f"{value:.3g}".replace("-", "−")
    digits = next((d for d in range(8) if abs(round(step, d) - step) < 1e-6 * step), 8)
    return f"{value:,.{digits}f}".replace("-", "−").replace(",", "\u202f")


def _select_points(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Points that can be drawn, x and y [n], averaged over neighbors where there are very many."""
    x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
    # Comparisons with NaN are False, so y needs no separate isfinite.
    is_drawable = np.isfinite(x) & (np.abs(y) < DRAWN_MAGNITUDE)
    x, y = x[is_drawable], y[is_drawable]
    if len(x) <= MAX_DRAWN_POINTS:
        return x, y
    groups = np.array_split(np.arange(len(x)), MAX_DRAWN_POINTS)
    return np.array([x[g].mean() for g in groups]), np.array([y[g].mean() for g in groups])


def _compute_axes(curves: list[tuple[str, np.ndarray, np.ndarray]], chart: Chart) -> Axes:
    """Limits around all points and the reference."""
    x = np.concatenate([x for _, x, _ in curves])
    y = np.concatenate([y for _, _, y in curves] + ([np.array([chart.reference[1]])] if chart.reference else []))
    # A constant curve gets a margin of its own, or the axis would have no extent.
    margin = 0.06 * (y.max() - y.min()) or max(0.05 * abs(float(y[0])), 1e-3)
    wide = float(x.max()) if x.max() > x.min() else float(x.min()) + 1
    low = float(y.min() - margin)
    # The margin must not suggest that a rate or a loss can be negative.
    if low < 0 <= y.min():
        low = 0.0
    return Axes(float(x.min()), wide, low, float(y.max() + margin))


def _frame_svg(axes: Axes, chart: Chart) -> str:
    """Grid, tick labels, axis labels."""
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    shapes = []
    # 1. Horizontal grid lines with their values.
    for value, label in label_ticks(axes.y_low, axes.y_high, 5):
        y = float(axes.vertical(np.array(value)))
        shapes.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{right}"/>')
        shapes.append(f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    # 2. Ticks below the horizontal axis.
    for value, label in label_ticks(axes.x_low, axes.x_high, 5):
        x = float(axes.horizontal(np.array(value)))
        shapes.append(f'<path class="tick" d="M{x:.1f} {bottom}v5"/>')
        shapes.append(f'<text x="{x:.1f}" y="{bottom + 18}" text-anchor="middle">{label}</text>')
    shapes.append(f'<path class="axis" d="M{LEFT} {bottom}H{right}"/>')
    # 3. Names of both axes, the vertical one turned.
    middle = (LEFT + right) / 2
    shapes.append(
        f'<text class="label" x="{middle}" y="{HEIGHT - 6}" text-anchor="middle">{escape(chart.x_label)}</text>'
    )
    turn = f"translate(13 {(TOP + bottom) / 2}) rotate(-90)"
    shapes.append(f'<text class="label" transform="{turn}" text-anchor="middle">{escape(chart.y_label)}</text>')
    return "".join(shapes)


def _curve_svg(axes: Axes, x: np.ndarray, y: np.ndarray, color: str) -> str:
    """Line, with dots where points are few."""
    points = [f"{a:.1f} {b:.1f}" for a, b in zip(axes.horizontal(x), axes.vertical(y))]
    dots = "".join('<circle cx="{}" cy="{}" r="3" fill="{}"/>'.format(*point.split(), color) for point in points)
    line = f'<path class="curve" d="M{"L".join(points)}" stroke="{color}"/>' if points else ""
    return line + (dots if len(points) <= MAX_DOTS else "")
