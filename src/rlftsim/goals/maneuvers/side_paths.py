"""Paths that leave the own lane: into the neighboring lane, and back in the opposite direction. Frame: world, m."""

import numpy as np
from jaxtyping import Float

from rlftsim.geometry import wrapped
from rlftsim.goals.maneuvers.lane_paths import (
    EASE_M,
    SPACING_M,
    LanePath,
    Lanes,
    Pose,
    nearest_of_each_lane,
    neighbor_lanes,
    path_through,
    paths_from,
    to_pose_frame,
)

CHANGE_STARTS_M = (0, 10, 20, 30)
"""Where a lane change may begin; the first place with a neighboring lane is used."""
CHANGE_S = 3.5
CHANGE_M = (18.0, 100.0)
"""A lane change is as long as the drive of so many seconds, within these bounds."""
UTURN_RADIUS_M = (5.0, 15.0)
"""Radii of the U-turns of cars, at the center of the box."""
UTURN_STARTS_M = tuple(range(0, 15, 2))
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
    lanes: Lanes, own_path: LanePath, *, side: int, speed_mps: float, length_m: float
) -> list[tuple[LanePath, int]]:
    """Paths into the lane beside a path, each with the index at which the change is complete.

    Args:
        lanes: Lanes that the agent may use.
        own_path: Path along the own lane, from the agent on.
        side: Side of the neighboring lane: 1 left, -1 right.
        speed_mps: Speed during the change, m/s; faster changes are longer.
        length_m: Greatest length of a path, m.
    """
    change_m = change_length_m(speed_mps)
    for start in CHANGE_STARTS_M:
        if start + change_m > min(length_m, own_path.length_m + change_m):
            break
        pose = own_path.pose(start)
        entries = neighbor_lanes(lanes, pose, side=side)
        if entries:
            paths = paths_from(lanes, pose, entries, length_m=length_m - start, ease_m=change_m)
            return [(path.prepend(own_path, start), start + int(change_m / SPACING_M)) for path in paths]
    return []


def uturn_paths(lanes: Lanes, left_turn: LanePath, *, length_m: float) -> list[LanePath]:
    """U-turns to the left, by a half circle where a path turns left, into lanes of the opposite direction.

    Args:
        lanes: Lanes that the agent may use.
        left_turn: Path that turns left, from the agent on.
        length_m: Greatest length of a path, m.
    """
    # 1. The entry: a little before the path begins to turn, in the leftmost lane.
    bends = np.flatnonzero(np.abs(left_turn.turn - left_turn.turn[0]) >= TURNING_RAD)
    first = max(int(bends[0]) - BEFORE_TURN_M, 0) if len(bends) else len(left_turn.turn) - 1
    entry = left_turn.pose(first)
    if neighbor_lanes(lanes, entry, side=1):
        return []
    forward = np.array([np.cos(entry.heading), np.sin(entry.heading), 0.0])
    paths = []
    for depth in UTURN_STARTS_M:
        # 2. Straight on into the junction, then a half circle to each opposite lane within reach.
        pose = Pose(entry.position + depth * forward, entry.heading)
        straight = entry.position + SPACING_M * np.arange(depth)[:, None] * forward  # [depth, 3], last point left out
        for point, radius in _find_opposite_lanes(lanes, pose):
            half_circle = _half_circle(pose, radius)
            head = np.concatenate([left_turn.points[:first], straight, half_circle])
            limits = np.full(len(head), left_turn.speed_limit_mps[first])
            # 3. On along the opposite lane.
            end = Pose(half_circle[-1], pose.heading + np.pi)
            for tail in paths_from(lanes, end, [point], length_m=length_m - len(head) * SPACING_M, ease_m=EASE_M):
                points = np.concatenate([head, tail.points[1:]])
                limits_mps = np.append(limits, tail.speed_limit_mps[1:])
                paths.append(path_through(points, left_turn.start_heading, limits_mps))
    return paths


def _find_opposite_lanes(lanes: Lanes, pose: Pose) -> list[tuple[int, float]]:
    """Points on opposite lanes to the left, with the radius of the half circle there, nearest first."""
    graph = lanes.graph
    x, y = to_pose_frame(pose, graph.points)
    low, high = UTURN_RADIUS_M
    is_opposite = (np.abs(x) <= SPACING_M) & (y >= 2 * low) & (y <= 2 * high) & lanes.usable[graph.owner]
    is_opposite &= np.abs(wrapped(graph.heading - pose.heading - np.pi)) <= OPPOSITE_RAD
    return [(point, float(y[point]) / 2) for point in nearest_of_each_lane(graph, np.flatnonzero(is_opposite), y)]


def _half_circle(pose: Pose, radius: float) -> Float[np.ndarray, "n 3"]:
    """Points of a half circle to the left of a pose, beginning there."""
    angle = np.linspace(0.0, np.pi, int(np.ceil(np.pi * radius / SPACING_M)) + 1)
    # In the frame of the pose, then rotated and moved into the world.
    x, y = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    cos, sin = np.cos(pose.heading), np.sin(pose.heading)
    offset = np.stack([x * cos - y * sin, x * sin + y * cos, np.zeros_like(angle)], -1)
    return pose.position + offset
