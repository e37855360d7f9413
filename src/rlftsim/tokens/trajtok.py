"""TrajTok: a vocabulary by rule and data, with a token for every cell of a grid of end positions that the data use.

After TrajTok (first place of the 2025 sim-agents challenge), with three defects fixed: grids and tokens are
symmetric, a token made by rule ends with the heading of the cell, and such a token neither starts nor ends at rest.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from scipy.ndimage import distance_transform_edt, uniform_filter

from rlftsim.errors import ConfigError, check_finiteness, check_not_negative, check_positive
from rlftsim.tokens.motions import mirror_poses
from rlftsim.tokens.vocabulary import STEPS_PER_TOKEN

MAX_MEAN_STEP_TURN_RAD = np.deg2rad(10.0)
"""A mean motion that turns by more within 0.1 s blends unlike motions: a token by rule replaces it."""


@dataclass(frozen=True)
class Grid:
    """End positions of a class: x from `x_min_m` to `x_max_m`, y from `-y_max_m` to `y_max_m`, both ends included."""

    x_min_m: float
    x_max_m: float
    x_bins: int
    y_max_m: float
    y_bins: int
    """Bins from end to end; even, so that y = 0 is a grid line."""
    min_motions: int
    """A cell with fewer is empty."""

    def __post_init__(self) -> None:
        check_positive(self, ("min_motions",))
        check_finiteness(self, ("x_min_m", "x_max_m", "y_max_m"))
        if not (self.x_min_m < 0 < self.x_max_m and self.y_max_m > 0 and self.x_bins > 1 and self.y_bins > 1):
            raise ConfigError(f"a grid needs x_min_m < 0 < x_max_m, y_max_m > 0 and at least 2 bins, got {self}.")
        zero = -self.x_min_m / self.spacing_m[0]
        if abs(zero - round(zero)) > 1e-6 or self.y_bins % 2:
            raise ConfigError(f"x = 0 and y = 0 must be lines of the grid (y_bins even), got {self}.")

    @property
    def spacing_m(self) -> tuple[float, float]:
        """Spacing of the grid lines in x and y."""
        return (self.x_max_m - self.x_min_m) / self.x_bins, 2 * self.y_max_m / self.y_bins

    @property
    def shape(self) -> tuple[int, int]:
        """Cells in x and y."""
        return self.x_bins + 1, self.y_bins + 1

    @property
    def origin(self) -> tuple[int, int]:
        """Index of the cell of standing still."""
        return round(-self.x_min_m / self.spacing_m[0]), self.y_bins // 2


@dataclass(frozen=True)
class TrajTokConfig:
    """Grids and thresholds. The defaults are the published numbers, the vehicle's y made symmetric."""

    vehicle: Grid = field(default_factory=lambda: Grid(-5.0, 20.0, 250, 2.5, 80, 3))
    pedestrian: Grid = field(default_factory=lambda: Grid(-1.5, 4.5, 120, 2.0, 80, 1))
    cyclist: Grid = field(default_factory=lambda: Grid(-1.0, 8.0, 180, 1.0, 40, 1))
    neighborhood: int = 9
    """Side of the square around a cell whose used cells are counted, in cells."""
    num_neighbors: int = 20
    """A used cell with fewer used ones around it is dropped; an unused one with more is added."""

    def __post_init__(self) -> None:
        if self.neighborhood < 3 or not self.neighborhood % 2:
            raise ConfigError(f"neighborhood must be odd and at least 3, got {self.neighborhood}.")
        check_not_negative(self, ("num_neighbors",))

    @property
    def grids(self) -> tuple[Grid, Grid, Grid]:
        """In the order of the classes."""
        return self.vehicle, self.pedestrian, self.cyclist


class GridMotions:
    """Counts and sums of motions by the cell at the end, mirror images included, in constant memory."""

    def __init__(self, grid: Grid):
        self.grid = grid
        self._count = np.zeros(grid.shape, np.int64)
        self._sum = np.zeros((*grid.shape, STEPS_PER_TOKEN + 1, 3))

    def add(self, motions: Float32[np.ndarray, "n 6 3"]) -> None:
        """Add motions; motions that end outside the grid are ignored."""
        cell = np.round(motions[:, -1, :2] / np.array(self.grid.spacing_m)).astype(np.int64) + np.array(
            self.grid.origin
        )
        is_inside = ((cell >= 0) & (cell < np.array(self.grid.shape))).all(1)
        index = tuple(cell[is_inside].T)
        np.add.at(self._count, index, 1)
        np.add.at(self._sum, index, motions[is_inside].astype(np.float64))

    @property
    def count(self) -> Int64[np.ndarray, "X Y"]:
        """Number of motions and mirror images in each cell."""
        # Mirroring flips the y axis of the grid, whose middle line is y = 0.
        return self._count + self._count[:, ::-1]

    @property
    def mean(self) -> Float[np.ndarray, "X Y 6 3"]:
        """Mean motion of each cell, zero without a motion."""
        total = self._sum + mirror_poses(self._sum[:, ::-1])
        return total / self.count.clip(min=1)[..., None, None]


def rule_tokens(cells: GridMotions, config: TrajTokConfig) -> Float32[np.ndarray, "V 6 3"]:
    """Tokens of a class, symmetric, the first exactly still: a token for each cell that is used after smoothing.

    Args:
        cells: Motions of the class, by cell of the grid.
        config: Thresholds of the smoothing.
    """
    # 1. Cells that get a token [X, Y].
    grid = cells.grid
    has_motions = cells.count >= grid.min_motions
    has_token = smooth_cells(has_motions, config)
    has_token[grid.origin] = True
    # 2. The cell's mean motion, moved to the cell's center, or a curve where the data lack a good mean.
    mean = cells.mean  # [X, Y, 6, 3]
    is_sharp = np.abs(np.diff(mean[..., 2], axis=2)).max(2) > MAX_MEAN_STEP_TURN_RAD
    axes = ((np.arange(size) - zero) * gap for size, zero, gap in zip(grid.shape, grid.origin, grid.spacing_m))
    ends = np.stack(np.meshgrid(*axes, indexing="ij"), -1)  # [X, Y, 2], centers of the cells
    heading = _fill_end_headings(mean[..., -1, 2], has_token & has_motions, grid)
    progress = np.linspace(0, 1, STEPS_PER_TOKEN + 1)
    centered_motions = mean.copy()
    centered_motions[..., :2] += progress[:, None] * (ends - mean[..., -1, :2])[:, :, None]
    is_by_rule = ~has_motions | is_sharp
    tokens = np.where(is_by_rule[..., None, None], _build_curves(ends, heading), centered_motions)
    # 3. Exactly symmetric: the middle line is straight, the right half mirrors the left one.
    half = grid.origin[1]
    tokens[:, half, :, 1:] = 0.0
    tokens[:, :half] = mirror_poses(tokens[:, :half:-1])
    tokens[grid.origin] = 0.0
    has_token[grid.origin] = False
    return np.concatenate([tokens[grid.origin][None], tokens[has_token]]).astype(np.float32)


def smooth_cells(is_used: Bool[np.ndarray, "X Y"], config: TrajTokConfig) -> Bool[np.ndarray, "X Y"]:
    """Used cells without isolated cells, plus unused cells that are surrounded by used cells.

    Args:
        is_used: True = the data use the cell.
        config: Size of the square, and number of used cells inside.
    """
    # The mean over the square times its size is the number of used cells, minus the cell itself.
    side = config.neighborhood
    num_used = (
        np.rint(uniform_filter(is_used.astype(np.float64), side, mode="constant") * side**2).astype(int) - is_used
    )
    return np.where(is_used, num_used >= config.num_neighbors, num_used > config.num_neighbors)


def _fill_end_headings(
    heading: Float[np.ndarray, "X Y"], has_heading: Bool[np.ndarray, "X Y"], grid: Grid
) -> Float[np.ndarray, "X Y"]:
    """Heading of the nearest cell that has a heading; 0 if no cell has."""
    if not has_heading.any():
        return np.zeros_like(heading)
    nearest = distance_transform_edt(~has_heading, sampling=grid.spacing_m, return_distances=False, return_indices=True)
    return heading[tuple(nearest)]  # type: ignore[arg-type]


def _build_curves(ends: Float[np.ndarray, "X Y 2"], heading: Float[np.ndarray, "X Y"]) -> Float[np.ndarray, "X Y 6 3"]:
    """Cubic Hermite curves from the origin to end points, with headings that change evenly.

    The tangents are as long as the straight distance and point along the headings at the start (0) and at the end, or
    backwards where the end lies behind the start.
    """
    t = np.linspace(0, 1, STEPS_PER_TOKEN + 1)[:, None]
    length = np.hypot(ends[..., 0], ends[..., 1]) * np.where(ends[..., 0] < 0, -1.0, 1.0)
    start_tangent = np.stack([length, np.zeros_like(length)], -1)
    end_tangent = length[..., None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    position = (
        (t**3 - 2 * t**2 + t) * start_tangent[:, :, None]
        + (3 * t**2 - 2 * t**3) * ends[:, :, None]
        + (t**3 - t**2) * end_tangent[:, :, None]
    )
    return np.concatenate([position, t * heading[..., None, None]], -1)
