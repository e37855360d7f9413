"""Conditions a window must meet to become a scenario: plausible acceleration, turning, and distance between bodies."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.geometry import boxes_overlap, clockwise_corners
from rlftsim.scenario.types import STEP_S

MAX_ACCELERATION_MPS2 = 15.0
MAX_SLIP_RAD = 0.4
MAX_HEADING_STEP_RAD = 0.3
MAX_OVERLAP_S = 0.3
MAX_OFF_ROAD_M = 0.5
MIN_MOVING_AGENTS = 4

Size = tuple[float, float, float]
"""Length, width and height in meters."""


def moves_plausibly(
    position: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, "n"], is_vehicle: bool = True
) -> bool:
    """True for a path within the limits of acceleration, for vehicles also within those of slip and turning per step.

    Args:
        position: Centers at consecutive steps, without label noise, m.
        heading: Directions of the body at the same steps, rad.
        is_vehicle: False = a pedestrian, which may step sideways and turn on the spot.
    """
    if len(position) < 3:
        return True
    acceleration = np.linalg.norm(np.diff(position, 2, axis=0), axis=1) / STEP_S**2  # [n-2]
    if acceleration.max() > MAX_ACCELERATION_MPS2:
        return False
    if not is_vehicle:
        return True
    if np.abs(np.diff(np.unwrap(heading))).max() > MAX_HEADING_STEP_RAD:
        return False
    # slip: angle between the direction of motion and the heading, which a slow body does not have
    velocity = np.gradient(position, STEP_S, axis=0)
    fast = np.linalg.norm(velocity, axis=1) > 1.0
    slip = np.arctan2(velocity[:, 1], velocity[:, 0]) - heading
    slip = np.abs(np.arctan2(np.sin(slip), np.cos(slip)))
    return not np.any(slip[fast] > MAX_SLIP_RAD)


def compute_overlap_s(
    position: Float[np.ndarray, "v n 2"],
    heading: Float[np.ndarray, "v n"],
    sizes: list[Size],
    valid: Bool[np.ndarray, "v n"],
) -> float:
    """Longest time in seconds that any two vehicles share area while both are valid.

    Args:
        position: Centers of v vehicles over n steps, m.
        heading: Directions of the vehicles, rad.
        sizes: Length, width and height of each vehicle, m.
        valid: True at the steps at which a vehicle is observed.
    """
    longest = 0
    reach = np.array([np.hypot(size[0], size[1]) / 2 for size in sizes])
    for i in range(len(sizes) - 1):
        # circles around the boxes first: few pairs come close
        gap_m = np.linalg.norm(position[i + 1 :] - position[i], axis=-1) - reach[i] - reach[i + 1 :, None]
        for j in np.flatnonzero(((gap_m < 0) & valid[i + 1 :] & valid[i]).any(axis=1)) + i + 1:
            steps = np.flatnonzero(valid[i] & valid[j])
            gap = position[j, steps] - position[i, steps]
            hits = boxes_overlap(gap, heading[i, steps], heading[j, steps], np.array(sizes[i]), np.array(sizes[j]))
            longest = max(longest, int(hits.sum()))
    return longest * STEP_S


def compute_off_road_m(
    drivable: Any, position: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, "n"], size: Size
) -> float:
    """Largest distance of a corner from the drivable area in meters, at every third step; 0 if all are inside.

    Args:
        drivable: Drivable area as a shapely geometry, plan coordinates, m.
        position: Centers of a body over n steps, m.
        heading: Directions of the body at the same steps, rad.
        size: Length, width and height of the body, m; the height is ignored.
    """
    import shapely

    corners = clockwise_corners(position[::3], heading[::3], np.array(size)).reshape(-1, 2)
    return float(shapely.distance(shapely.points(corners), drivable).max(initial=0.0))
