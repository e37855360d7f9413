"""Paths that leave the own lane: into the lane beside it, and back in the opposite direction. Frame: world, m."""

import numpy as np
from jaxtyping import Float

from rlftsim.geometry import wrapped
from rlftsim.goals.maneuvers.lane_paths import (
    EASE_M,
    SPACING_M,
    LanePath,
    Lanes,
    Pose,
    in_frame_of,
    nearest_of_each_lane,
    neighbor_lanes,
    path_through,
    paths_from,
)

CHANGE_AFTER_M = (0, 10, 20, 30)
"""Where a lane change may begin; the first place with a neighboring lane is used."""
CHANGE_S = 3.5
CHANGE_M = (18.0, 100.0)
"""A lane change is as long as the drive of so many seconds, within these bounds."""
UTURN_RADIUS_M = (5.0, 15.0)
"""Radii of the U-turns of cars, at the center of the box."""
UTURN_AFTER_M = tuple(range(0, 15, 2))
"""Distances into a junction at which a U-turn may begin."""
LONGEST_UTURN_M = 7.0
"""Longer vehicles make no U-turns."""
OPPOSITE_RAD = np.radians(20.0)
TURNING_RAD, BEFORE_TURN_M = np.radians(5.0), 3
"""A turn begins so many meters before the path has turned by so much."""


def change_length_m(speed_mps: float) -> float:
    """Distance that a lane change takes at a speed, m."""
    return float(np.clip(CHANGE_S * speed_mps, *CHANGE_M))


def lane_change_paths(
    lanes: Lanes, own: LanePath, *, side: int, speed_mps: float, length_m: float
) -> list[tuple[LanePath, int]]:
    """Paths into the lane beside a path, each with the index at which the change is complete.

    Args:
        lanes: the usable lanes.
        own: a path along the own lane.
        side: 1 left, -1 right.
        speed_mps: during the change.
        length_m: greatest length of a path.
    """
    change_m = change_length_m(speed_mps)
    for leave in CHANGE_AFTER_M:
        if leave + change_m > min(length_m, own.length_m + change_m):
            break
        pose = own.pose(leave)
        beside = neighbor_lanes(lanes, pose, side=side)
        if beside:
            rest = paths_from(lanes, pose, beside, length_m=length_m - leave, ease_m=change_m)
            return [(path.after(own, leave), leave + int(change_m / SPACING_M)) for path in rest]
    return []


def uturn_paths(lanes: Lanes, turning: LanePath, *, length_m: float) -> list[LanePath]:
    """U-turns to the left, by a half circle where a path turns left, into lanes of the opposite direction.

    Args:
        lanes: the usable lanes.
        turning: a path that turns left.
        length_m: greatest length of a path.
    """
    # 1. The entry: a little before the path begins to turn, in the leftmost lane.
    bent = np.flatnonzero(np.abs(turning.turn - turning.turn[0]) >= TURNING_RAD)
    begin = max(int(bent[0]) - BEFORE_TURN_M, 0) if len(bent) else len(turning.turn) - 1
    entry = turning.pose(begin)
    if neighbor_lanes(lanes, entry, side=1):
        return []
    forward = np.array([np.cos(entry.heading), np.sin(entry.heading), 0.0])
    paths = []
    for ahead in UTURN_AFTER_M:
        # 2. Straight on into the junction, then a half circle to each opposite lane within reach.
        pose = Pose(entry.position + ahead * forward, entry.heading)
        straight = (
            entry.position + SPACING_M * np.arange(ahead)[:, None] * forward
        )  # [ahead, 3], without the last point
        for point, radius in _opposite(lanes, pose):
            half_circle = _half_circle(pose, radius)
            head = np.concatenate([turning.points[:begin], straight, half_circle])
            limits = np.full(len(head), turning.speed_limit_mps[begin])
            # 3. On along the opposite lane.
            end = Pose(half_circle[-1], pose.heading + np.pi)
            for rest in paths_from(lanes, end, [point], length_m=length_m - len(head) * SPACING_M, ease_m=EASE_M):
                points = np.concatenate([head, rest.points[1:]])
                paths.append(path_through(points, turning.start_heading, np.append(limits, rest.speed_limit_mps[1:])))
    return paths


def _opposite(lanes: Lanes, pose: Pose) -> list[tuple[int, float]]:
    """Points on opposite lanes to the left, with the radius of the half circle there, nearest first."""
    graph = lanes.graph
    ahead, left = in_frame_of(pose, graph.points)
    low, high = UTURN_RADIUS_M
    near = (np.abs(ahead) <= SPACING_M) & (left >= 2 * low) & (left <= 2 * high) & lanes.usable[graph.owner]
    near &= np.abs(wrapped(graph.heading - pose.heading - np.pi)) <= OPPOSITE_RAD
    nearest = nearest_of_each_lane(graph, np.flatnonzero(near), left)
    return [(point, float(left[point]) / 2) for point in nearest]


def _half_circle(pose: Pose, radius: float) -> Float[np.ndarray, "n 3"]:
    """Points of a half circle from a pose to its left."""
    angle = np.linspace(0.0, np.pi, int(np.ceil(np.pi * radius / SPACING_M)) + 1)
    # In the frame of the pose, then rotated and moved into the world.
    ahead, left = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    cos, sin = np.cos(pose.heading), np.sin(pose.heading)
    step = np.stack([ahead * cos - left * sin, ahead * sin + left * cos, np.zeros_like(angle)], -1)
    return pose.position + step
