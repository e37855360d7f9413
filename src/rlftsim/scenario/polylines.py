"""Points along polylines, and heights of the ground from the map points around a position."""

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree

NEAREST_POINTS = 3
"""Map points whose mean height is taken for the ground."""


def arc_length(points: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n"]:
    """Distance of each point from the first in the plane, along the polyline."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)))


def resample_to(points: Float[np.ndarray, "n k"], count: int) -> Float[np.ndarray, "m k"]:
    """Points at equal distances along a polyline, first and last kept.

    Args:
        points: Polyline with n points, in the plane (k = 2) or in space (k = 3), m.
        count: Number of points m of the result; a count below 2 gives both ends.
    """
    distance = arc_length(points)
    at = np.linspace(0.0, distance[-1], max(2, count))
    return np.stack([np.interp(at, distance, points[:, k]) for k in range(points.shape[1])], axis=1)


def sample_line(line: Float[np.ndarray, "n k"], spacing_m: float) -> Float[np.ndarray, "m k"]:
    """Points along a polyline from the start on.

    Args:
        line: Points of the polyline, at least two, m; columns after x and y are interpolated.
        spacing_m: Distance from point to point along the line in the plane, m.
    """
    lengths = arc_length(line)
    at = np.arange(0.0, lengths[-1] + 1e-6, spacing_m)
    return np.stack([np.interp(at, lengths, column) for column in line.T], axis=1)


def densify(points: Float[np.ndarray, "n 2"], spacing_m: float) -> Float[np.ndarray, "m 2"]:
    """Polyline of the same shape with further points between the given ones.

    Args:
        points: Polyline with n points in the plane, m; the result has all points.
        spacing_m: Largest distance between two points of the result, m.
    """
    distance = arc_length(points)
    num_steps = np.maximum(1, np.ceil(np.diff(distance) / spacing_m)).astype(int)  # [n-1] of each segment
    # number of the segment and the fraction of it, so that the given points come back exactly
    fractions = [k + np.arange(count) / count for k, count in enumerate(num_steps)]
    index = np.append(np.concatenate(fractions), len(num_steps))
    return np.stack([np.interp(index, np.arange(len(points)), points[:, k]) for k in range(2)], axis=1)


def find_runs(mask: Bool[np.ndarray, "n"]) -> Int64[np.ndarray, "runs 2"]:
    """First index of each run of True values, and the index after the last."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)


class Heights:
    """Height of the ground at any position: the mean of the nearest map points.

    Args:
        points: Map points [n, 3], world frame, m; without points the ground is at height 0.
    """

    def __init__(self, points: Float[np.ndarray, "n 3"]) -> None:
        self._z = points[:, 2]
        self._tree = KDTree(points[:, :2]) if len(points) else None

    def at(self, positions: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m"]:
        """Height at some positions, world frame, m."""
        if self._tree is None or not len(positions):
            return np.zeros(len(positions))
        _, nearest = self._tree.query(positions, k=min(NEAREST_POINTS, len(self._z)))
        return self._z[nearest.reshape(len(positions), -1)].mean(1)
