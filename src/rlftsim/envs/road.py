"""Road edges of scenarios, and points beside the edges.

The official distance to the road edge searches long; where the nearest edge tells enough, `nearest_edges` is quick.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float

from rlftsim.realism.map_based import RoadEdges, build_road_edges
from rlftsim.scenario.types import Scenario, cached_on_scenario

MAX_PAIRS = 1 << 22
"""Bounds the memory of the search for road edges."""


@cached_on_scenario
def road_edges(scenario: Scenario) -> RoadEdges | None:
    """Road edges of a scenario; None without any."""
    return build_road_edges(scenario.map_features, torch.device("cpu"))


def nearest_edges(
    points: Float[np.ndarray, "n p 2"], edges: Float[np.ndarray, "#n e 4"]
) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, "n p"], Bool[np.ndarray, "n p"]]:
    """Distance of each point to the nearest edge, side of that edge, and True for points beside the edge.

    Args:
        points: Points to measure, map frame, m.
        edges: Segments x0, y0, x1, y1, at least one, m; the drivable side is on the left.

    Returns:
        Distances, m; a positive number for points on the left, a negative number on the right; False for points beyond
        the end of the edge, where the side has no meaning.
    """
    edges = edges[:, None]  # [n, 1, e, 4]
    dx, dy = edges[..., 2] - edges[..., 0], edges[..., 3] - edges[..., 1]
    to_x, to_y = points[..., :1] - edges[..., 0], points[..., 1:] - edges[..., 1]  # [n, p, e]
    position = to_x * dx
    position += to_y * dy
    position /= np.maximum(dx * dx + dy * dy, 1e-9)
    clipped_position = position.clip(0.0, 1.0)
    squared = measure_square(to_x - clipped_position * dx, to_y - clipped_position * dy)
    nearest = squared.argmin(-1)[..., None]
    values = (squared, dx, dy, to_x, to_y, position)
    squared, dx, dy, to_x, to_y, position = (
        np.take_along_axis(np.broadcast_to(value, to_x.shape), nearest, -1)[..., 0] for value in values
    )
    return np.sqrt(squared), dx * to_y - dy * to_x, (position >= 0.0) & (position <= 1.0)


def measure_square(x: Float[np.ndarray, "*m"], y: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
    """Squared lengths of vectors, which take the place of `x`; `y` is changed, too."""
    x *= x
    y *= y
    x += y
    return x
