"""Conditions a window must meet to become a scenario: plausible acceleration, turning, and distance between bodies."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

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
    """True for a path within the limits of acceleration, and for vehicles within those of slip and turning per step.

    Args:
        position: centers at consecutive steps, without label noise, m.
        heading: directions of the body, rad.
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


def clockwise_corners(
    position: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, "n"], size: Size | np.ndarray
) -> Float[np.ndarray, "n 4 2"]:
    """Corners of the boxes of one body in the order of `geometry.box_corners`: clockwise from the front left.

    Args:
        position: centers at some steps, m.
        heading: direction of the front, rad.
        size: the body's length and width, m; a height is ignored.
    """
    forward = np.stack([np.cos(heading), np.sin(heading)], axis=1) * size[0] / 2
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=1) * size[1] / 2
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return np.stack([position + a * forward + b * left for a, b in signs], axis=1)


def boxes_overlap(
    position: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, "n"],
    size: Size,
    other_position: Float[np.ndarray, "n 2"],
    other_heading: Float[np.ndarray, "n"],
    other_size: Size,
) -> Bool[np.ndarray, "n"]:
    """Steps at which the boxes of two bodies share area, by the separating axis theorem.

    Args:
        position: centers of the first body, m.
        heading: its headings, rad.
        size: its length and width, m.
        other_position: centers of the second body at the same steps.
        other_heading: its headings.
        other_size: its length and width.
    """
    first = clockwise_corners(position, heading, size)
    second = clockwise_corners(other_position, other_heading, other_size)
    overlap = np.ones(len(heading), bool)
    # two boxes are apart exactly where one of their four sides' directions separates the projections
    for angle in (heading, other_heading):
        for turn in (0.0, np.pi / 2):
            axis = np.stack([np.cos(angle + turn), np.sin(angle + turn)], axis=1)  # [n, 2]
            a = np.einsum("nkd,nd->nk", first, axis)
            b = np.einsum("nkd,nd->nk", second, axis)
            overlap &= (a.max(1) > b.min(1)) & (b.max(1) > a.min(1))
    return overlap


def compute_overlap_s(
    position: Float[np.ndarray, "v n 2"],
    heading: Float[np.ndarray, "v n"],
    sizes: list[Size],
    valid: Bool[np.ndarray, "v n"],
) -> float:
    """Longest time in seconds that any two vehicles share area while both are valid.

    Args:
        position: centers of the vehicles, m.
        heading: their headings, rad.
        sizes: one per vehicle.
        valid: steps at which a vehicle is seen.
    """
    longest = 0
    reach = np.array([np.hypot(size[0], size[1]) / 2 for size in sizes])
    for i in range(len(sizes) - 1):
        # circles around the boxes first: few pairs come near each other at all
        gap = np.linalg.norm(position[i + 1 :] - position[i], axis=-1) - reach[i] - reach[i + 1 :, None]
        for j in np.flatnonzero(((gap < 0) & valid[i + 1 :] & valid[i]).any(axis=1)) + i + 1:
            steps = np.flatnonzero(valid[i] & valid[j])
            hits = boxes_overlap(
                position[i, steps], heading[i, steps], sizes[i], position[j, steps], heading[j, steps], sizes[j]
            )
            longest = max(longest, int(hits.sum()))
    return longest * STEP_S


def compute_off_road_m(
    drivable: Any, position: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, "n"], size: Size
) -> float:
    """Largest distance of a corner from the drivable area in meters, at every third step; 0 if all are inside.

    Args:
        drivable: area as a shapely geometry.
        position: centers of one body, m.
        heading: its headings, rad.
        size: its length and width, m.
    """
    import shapely

    corners = clockwise_corners(position[::3], heading[::3], size).reshape(-1, 2)
    return float(shapely.distance(shapely.points(corners), drivable).max(initial=0.0))
