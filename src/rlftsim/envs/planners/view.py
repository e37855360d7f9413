"""View of planners that follow a route: the route as a line, boxes and stopping places on the line.

M agents in as many scenes; lines of P points, K boxes, E edges, padded.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64

from rlftsim.envs.idm import LOOKAHEAD_M, ON_LINE_M
from rlftsim.envs.observations import FAR_M
from rlftsim.scenario.polylines import sample_line

STRAIGHT_M = 80.0
"""Without a route a planner drives straight on."""


@dataclass(frozen=True, eq=False)
class View:
    """Frame: each agent's own, x ahead; meters, seconds."""

    speed: Float[np.ndarray, "M"]
    size: Float[np.ndarray, "M 2"]
    line: Float[np.ndarray, "M P 2"]
    """The route, a point every meter from the nearest place on; the last point is repeated."""
    heading: Float[np.ndarray, "M P"]
    limit_mps: Float[np.ndarray, "M"]
    """Speed limit here; 0 = unknown."""
    boxes: Float[np.ndarray, "M K 5"]
    """x, y, heading, vx, vy."""
    box_size: Float[np.ndarray, "M K 2"]
    is_box: Bool[np.ndarray, "M K"]
    """False = padding."""
    stop_m: Float[np.ndarray, "M"]
    """Distance along the line to the nearest red or yellow light on it; infinite without one."""
    edges: Float[np.ndarray, "M E 4"]
    """Padding is far away."""


def read_view(observation: Mapping[str, np.ndarray]) -> View:
    """View of observations in the agents' frames, of kind "dict" with a leading axis M."""
    ego, route = observation["ego"].astype(float), observation["route"].astype(float)
    is_box = observation["neighbors_mask"].astype(bool)
    is_box = is_box[:, : np.flatnonzero(is_box.any(0)).max(initial=-1) + 1]
    neighbors = observation["neighbors"][:, : is_box.shape[1]].astype(float)
    num_points = np.count_nonzero(observation["route_mask"], axis=1)
    line, heading = _extend_routes(route[..., :2], num_points)
    turn = np.arctan2(neighbors[..., 3], neighbors[..., 2])[..., None]
    return View(
        speed=ego[:, 0],
        size=ego[:, 4:6],
        line=line,
        heading=heading,
        limit_mps=np.where(num_points > 0, route[:, 0, 2], 0.0),
        boxes=np.concatenate([neighbors[..., :2], turn, neighbors[..., 4:6]], -1),
        box_size=neighbors[..., 6:8],
        is_box=is_box,
        stop_m=_find_stops(observation, line, ego[:, 4]),
        edges=np.where(observation["edges_mask"][..., None] > 0, observation["edges"].astype(float), FAR_M),
    )


def _extend_routes(
    route: Float[np.ndarray, "M R 2"], num_points: Int64[np.ndarray, "M"]
) -> tuple[Float[np.ndarray, "M P 2"], Float[np.ndarray, "M P"]]:
    """Points a meter apart along routes, and the directions there.

    Beyond its end a route goes straight on, so that a planner never stops for want of a line.
    """
    row, end = np.arange(len(route)), np.maximum(num_points, 2)
    points = np.concatenate([route, np.zeros_like(route[:, :1])], 1)
    points[num_points < 2, :2] = [[0.0, 0.0], [STRAIGHT_M, 0.0]]
    last = points[row, end - 1] - points[row, end - 2]
    last /= np.maximum(np.linalg.norm(last, axis=-1, keepdims=True), 1e-6)
    beyond = points[row, end - 1] + LOOKAHEAD_M * last
    points = np.where((np.arange(points.shape[1]) < end[:, None])[..., None], points, beyond[:, None])
    # 1. points every meter, the last one repeated
    lines = [sample_line(points[m, : end[m] + 1], 1.0) for m in row]
    final = np.array(list(map(len, lines)))[:, None] - 1
    along = np.arange(final.max() + 1)
    line = np.stack([points[np.minimum(along, len(points) - 1)] for points in lines])
    # 2. directions to the next point
    turn = np.diff(line, axis=1)
    turn = np.arctan2(turn[..., 1], turn[..., 0])[row[:, None], np.minimum(along, final - 1)]
    return line, np.unwrap(turn)


def _find_stops(
    observation: Mapping[str, np.ndarray], line: Float[np.ndarray, "M P 2"], length: Float[np.ndarray, "M"]
) -> Float[np.ndarray, "M"]:
    """Distances along the lines to the nearest red or yellow lights that the fronts have not passed."""
    lights = observation["lights"].astype(float)
    waits = (observation["lights_mask"] > 0) & lights[..., 2:4].any(-1)
    waits &= lights[..., 0] >= length[:, None] / 2 - 1.0
    if not waits.any():
        return np.full(len(line), np.inf)
    agent, light = np.nonzero(waits)
    x, y = (line[agent, :, axis] - lights[agent, light, axis, None] for axis in range(2))  # [n, P]
    distance = np.sqrt(x * x + y * y)
    stop = np.full(waits.shape, np.inf)
    stop[agent, light] = np.where(distance.min(1) <= ON_LINE_M, distance.argmin(1), np.inf)
    return stop.min(1)
