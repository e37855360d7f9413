"""View of planners that follow a route: the route as a line, boxes and stopping places on the line."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rlftsim.envs.idm import LOOKAHEAD_M, ON_LINE_M
from rlftsim.envs.route import compute_headings, sample_line

STRAIGHT_M = 80.0
"""Without a route a planner drives straight on."""


@dataclass(frozen=True, eq=False)
class View:
    """Frame: the agent's own, x ahead; meters, seconds."""

    speed: float
    size: Float[np.ndarray, "2"]
    line: Float[np.ndarray, "P 2"]
    """The route, a point every meter from the nearest place on."""
    heading: Float[np.ndarray, "P"]
    limit_mps: float
    """Speed limit here; 0 = unknown."""
    boxes: Float[np.ndarray, "K 5"]
    """x, y, heading, vx, vy."""
    box_size: Float[np.ndarray, "K 2"]
    stop_m: float
    """Distance along the line to the nearest red or yellow light on it; infinite without one."""
    edges: Float[np.ndarray, "E 4"]


def read_view(observation: dict[str, Any]) -> View:
    """View of an observation in the agent's frame, of kind "dict"."""
    ego, is_neighbor = observation["ego"].astype(float), observation["neighbors_mask"].astype(bool)
    route = observation["route"][observation["route_mask"].astype(bool)].astype(float)
    neighbors = observation["neighbors"][is_neighbor].astype(float)
    line = route[:, :2] if len(route) > 1 else np.array([[0.0, 0.0], [STRAIGHT_M, 0.0]])
    # beyond its end the route goes straight on, so that a planner never stops for want of a line
    last = line[-1] - line[-2]
    last /= max(float(np.linalg.norm(last)), 1e-6)
    line = sample_line(np.vstack([line, line[-1] + LOOKAHEAD_M * last]), 1.0)
    return View(
        speed=float(ego[0]),
        size=ego[4:6],
        line=line,
        heading=np.unwrap(compute_headings(line)),
        limit_mps=float(route[0, 2]) if len(route) else 0.0,
        boxes=np.concatenate(
            [neighbors[:, :2], np.arctan2(neighbors[:, 3], neighbors[:, 2])[:, None], neighbors[:, 4:6]], 1
        ),
        box_size=neighbors[:, 6:8],
        stop_m=_stop(observation, line, float(ego[4])),
        edges=observation["edges"][observation["edges_mask"].astype(bool)].astype(float),
    )


def _stop(observation: dict[str, Any], line: Float[np.ndarray, "P 2"], length: float) -> float:
    lights = observation["lights"][observation["lights_mask"].astype(bool)].astype(float)
    waits = lights[:, 2:4].any(1)
    points = lights[waits, :2]
    if not len(points):
        return np.inf
    distance = np.linalg.norm(line[:, None] - points, axis=-1)  # [P, T]
    # a stop point that the front has passed is behind
    on_line = (distance.min(0) <= ON_LINE_M) & (points[:, 0] >= length / 2 - 1.0)
    return float(distance.argmin(0)[on_line].min()) if on_line.any() else np.inf
