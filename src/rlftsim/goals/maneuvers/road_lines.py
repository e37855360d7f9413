"""Road lines that must not be crossed. Frame: world, m."""

import numpy as np
from jaxtyping import Float

from rlftsim.scenario.types import MapFeatureType, Scenario, cached_on_scenario

FORBIDDEN = (
    MapFeatureType.LINE_SOLID_DOUBLE_WHITE,
    MapFeatureType.LINE_SOLID_SINGLE_YELLOW,
    MapFeatureType.LINE_SOLID_DOUBLE_YELLOW,
)
"""A single solid white line may be crossed where WOMD was logged; it only discourages."""
GAP_M = 3.0
"""Points of a line farther apart than this are not joined: clipped maps have holes."""


def crosses_forbidden_line(scenario: Scenario, points: Float[np.ndarray, "S 3"]) -> bool:
    """True if a path crosses a line that must not be crossed.

    Args:
        scenario: Scenario with the lines in the map.
        points: Points of the path in order, world frame, m.
    """
    start, end = _segments(scenario)  # [n, 2] each
    if not len(start) or len(points) < 2:
        return False
    # Only lines whose bounding box meets that of the path can cross it.
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    may_cross = (np.maximum(start, end) >= low).all(1) & (np.minimum(start, end) <= high).all(1)
    a, b = points[:-1, None, :2], points[1:, None, :2]  # [S - 1, 1, 2]
    c, d = start[may_cross], end[may_cross]
    # Two segments cross if each has its ends on both sides of the other.
    parts_line = _side(a, b, c) * _side(a, b, d) < 0
    parts_path = _side(c, d, a) * _side(c, d, b) < 0
    return bool((parts_line & parts_path).any())


@cached_on_scenario
def _segments(scenario: Scenario) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Both ends of every segment of a forbidden line."""
    features = scenario.map_features
    lines = [features.polyline(i)[:, :2].astype(np.float64) for i in features.find_indices(FORBIDDEN)]
    start = np.concatenate([np.zeros((0, 2)), *(line[:-1] for line in lines)])
    end = np.concatenate([np.zeros((0, 2)), *(line[1:] for line in lines)])
    is_joined = np.linalg.norm(end - start, axis=1) <= GAP_M
    return start[is_joined], end[is_joined]


def _side(
    start: Float[np.ndarray, "... 2"], end: Float[np.ndarray, "... 2"], point: Float[np.ndarray, "... 2"]
) -> Float[np.ndarray, "..."]:
    """Cross product of a segment and the offset to a point: positive to the left, negative to the right."""
    direction, offset = end - start, point - start
    return direction[..., 0] * offset[..., 1] - direction[..., 1] * offset[..., 0]
