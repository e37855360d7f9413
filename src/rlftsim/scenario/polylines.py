"""Points along polylines, and heights of the ground from the map points around a place."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

NEAREST_POINTS = 3
"""Map points whose mean height is taken for the ground."""


def arc_length(points: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n"]:
    """Distance of each point from the first in the plane, along the polyline."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)))


def resample_to(points: Float[np.ndarray, "n k"], count: int) -> Float[np.ndarray, "m k"]:
    """Points at equal distances along a polyline, first and last kept.

    Args:
        points: the polyline, in the plane or in space.
        count: number of points of the result; fewer than two make two.
    """
    along = arc_length(points)
    at = np.linspace(0.0, along[-1], max(2, count))
    return np.stack([np.interp(at, along, points[:, k]) for k in range(points.shape[1])], axis=1)


def densify(points: Float[np.ndarray, "n 2"], spacing_m: float) -> Float[np.ndarray, "m 2"]:
    """Polyline of the same shape with further points between its own.

    Args:
        points: the polyline.
        spacing_m: largest distance between two points of the result.
    """
    along = arc_length(points)
    parts = np.maximum(1, np.ceil(np.diff(along) / spacing_m)).astype(int)  # [n-1] pieces of each segment
    # number of the segment and the fraction of it, so that the own points come back exactly
    place = np.append(np.concatenate([k + np.arange(count) / count for k, count in enumerate(parts)]), len(parts))
    return np.stack([np.interp(place, np.arange(len(points)), points[:, k]) for k in range(2)], axis=1)


class Heights:
    """Height of the ground at any place: the mean of the nearest map points.

    Args:
        points: map points, world frame; without any the ground is at height 0.
    """

    def __init__(self, points: Float[np.ndarray, "n 3"]) -> None:
        self._z = points[:, 2]
        self._tree = KDTree(points[:, :2]) if len(points) else None

    def at(self, places: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m"]:
        """Height at some places, world frame."""
        if self._tree is None or not len(places):
            return np.zeros(len(places))
        _, nearest = self._tree.query(places, k=min(NEAREST_POINTS, len(self._z)))
        return self._z[nearest.reshape(len(places), -1)].mean(1)
