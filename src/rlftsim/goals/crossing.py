"""Lines painted on the road that nobody may drive across. Frame: world, metres."""

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.scenario.derived import derived
from rlftsim.scenario.types import MapFeatureType, Scenario

FORBIDDEN = (
    MapFeatureType.LINE_SOLID_DOUBLE_WHITE,
    MapFeatureType.LINE_SOLID_SINGLE_YELLOW,
    MapFeatureType.LINE_SOLID_DOUBLE_YELLOW,
)
"""A single solid white line may be crossed where WOMD was recorded; it only discourages."""
GAP_M = 3.0
"""Points of a line farther apart than this are not joined: clipped maps have holes."""


def crosses_forbidden_line(scenario: Scenario, points: Float[np.ndarray, "S 3"]) -> bool:
    """Whether a way leads across a line that may not be crossed."""
    start, end = _segments(scenario)
    if not len(start) or len(points) < 2:
        return False
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    near = (np.maximum(start, end) >= low).all(1) & (np.minimum(start, end) <= high).all(1)
    return bool(_cross(points[:-1, None, :2], points[1:, None, :2], start[near], end[near]).any())


@derived
def _segments(scenario: Scenario) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Both ends of every piece of a forbidden line."""
    features = scenario.map_features
    lines = [features.polyline(i)[:, :2].astype(np.float64) for i in features.indices_of(FORBIDDEN)]
    start = np.concatenate([np.zeros((0, 2)), *(line[:-1] for line in lines)])
    end = np.concatenate([np.zeros((0, 2)), *(line[1:] for line in lines)])
    short = np.linalg.norm(end - start, axis=1) <= GAP_M
    return start[short], end[short]


def _cross(
    a: Float[np.ndarray, "S 1 2"],
    b: Float[np.ndarray, "S 1 2"],
    c: Float[np.ndarray, "n 2"],
    d: Float[np.ndarray, "n 2"],
) -> Bool[np.ndarray, "S n"]:
    """Whether segments a-b and c-d intersect: each has its ends on both sides of the other."""
    one = _side(a, b, c) * _side(a, b, d) < 0
    return one & (_side(c, d, a) * _side(c, d, b) < 0)


def _side(start: Float[np.ndarray, "... 2"], end: Float[np.ndarray, "... 2"], point: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:  # fmt: skip
    along, to = end - start, point - start
    return along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0]
