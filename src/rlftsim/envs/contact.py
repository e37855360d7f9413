"""Collisions of a planner's agent, with type and fault, after nuPlan's definition; lanes that a box is in.

Boxes have sharp corners, as nuPlan's. Motion: x, y, heading, vx, vy; map frame, meters, seconds.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree

from rlftsim.envs.levels import is_on_level
from rlftsim.envs.scene import SEGMENT_POINTS, Scene, build_env_scene
from rlftsim.geometry import boxes_overlap, clockwise_corners
from rlftsim.scenario.types import TOTAL_STEPS, Scenario, cached_on_scenario

STOPPED_MPS = 0.05
"""At most this fast an agent counts as stopped."""
BEHIND_RAD = np.radians(150.0)
"""A track at a greater bearing is behind."""
HALF_LANE_M = 1.85
"""Half of the width that is assumed for every lane, as logs have center lines and few boundaries."""
SUBDIVISIONS = 3
"""Points that lanes are searched by, between two points of a segment."""


class CollisionType(StrEnum):
    """Types of collisions, in the order of the tests."""

    STOPPED_EGO = "stopped_ego"
    STOPPED_TRACK = "stopped_track"
    ACTIVE_REAR = "active_rear"
    """The track is behind."""
    ACTIVE_FRONT = "active_front"
    """The ego's front bumper meets the track."""
    ACTIVE_LATERAL = "active_lateral"


@dataclass(frozen=True)
class Collision:
    """The first contact with a track."""

    step: int
    """Step of the episode, 1 = after the first action."""
    agent: int
    """Row of the track."""
    collision_type: CollisionType
    at_fault: bool
    """True = the planner's agent is to blame: a stopped track, a front bumper that meets the track, or a track beside
    an agent that is not in one lane."""
    speed_change_mps: float
    """Length of the difference of both velocities."""


def classify_collision(
    scene: Scene,
    step: int,
    agent: int,
    ego: Float[np.ndarray, "5"],
    ego_size: Float[np.ndarray, "2"],
    ego_ground: Float[np.ndarray, "1"],
    track: Float[np.ndarray, "5"],
    track_size: Float[np.ndarray, "2"],
) -> Collision:
    """Type and fault of a contact.

    Args:
        scene: Scene with the lanes that decide whether the ego is in a single lane.
        step: Step of the episode at which the boxes first overlap.
        agent: Row of the track in the scene's agent axis.
        ego: Motion of the planner's agent at the step.
        ego_size: Length and width of the planner's agent, m.
        ego_ground: Height of the ground under the planner's agent, m; tells levels apart.
        track: Motion of the track at the step.
        track_size: Length and width of the track, m.
    """
    bearing = np.arctan2(track[1] - ego[1], track[0] - ego[0]) - ego[2]
    direction = np.array([np.cos(ego[2]), np.sin(ego[2])])
    from_bumper = track[:2] - (ego[:2] + ego_size[0] / 2 * direction)
    at_fault = False
    if np.hypot(*ego[3:]) <= STOPPED_MPS:
        collision_type = CollisionType.STOPPED_EGO
    elif np.hypot(*track[3:]) <= STOPPED_MPS:
        collision_type, at_fault = CollisionType.STOPPED_TRACK, True
    elif np.cos(bearing) < np.cos(BEHIND_RAD):
        collision_type = CollisionType.ACTIVE_REAR
    elif boxes_overlap(from_bumper[None], ego[2:3], track[2:3], np.array([0.0, ego_size[1]]), track_size)[0]:
        collision_type, at_fault = CollisionType.ACTIVE_FRONT, True
    else:
        collision_type = CollisionType.ACTIVE_LATERAL
        at_fault = not in_one_lane(scene, ego[None], ego_size, ego_ground)[0]
    return Collision(step, agent, collision_type, bool(at_fault), float(np.hypot(*(ego[3:] - track[3:]))))


@dataclass(frozen=True, eq=False)
class LaneSearch:
    """The lanes of a scenario as a search tree; without lanes there is none."""

    tree: KDTree
    lane: Int64[np.ndarray, "p"]
    """Lane of each point, as an index of the scene's `graph`."""
    heading: Float[np.ndarray, "p"]
    z: Float[np.ndarray, "p"] | None
    """Heights; None where they do not count."""
    joined: tuple[frozenset[int], ...]
    """Each lane with its predecessors and successors."""
    is_junction: Bool[np.ndarray, "n"]
    """True = the lane joins two others inside a junction."""

    def find_points(
        self, positions: Float[np.ndarray, "m 2"], distance_m: float, ground: Float[np.ndarray, "m"]
    ) -> list[list[int]]:
        """Indices of the lane points near each position and on the same level, a list per position.

        Args:
            positions: Centers of the search, map frame, m.
            distance_m: Largest distance of a lane point in the plane, m.
            ground: Heights of the ground at the positions, m; lanes of other levels are left out.
        """
        neighbors = list(self.tree.query_ball_point(positions, distance_m))
        if self.z is None:
            return neighbors
        rows = [np.array(points, np.int64) for points in neighbors]
        return [points[is_on_level(self.z[points] - height)].tolist() for points, height in zip(rows, ground)]


@cached_on_scenario
def lane_search(scenario: Scenario) -> LaneSearch | None:
    """The lanes of a scenario to be searched by position; None without lanes."""
    scene = build_env_scene(scenario, TOTAL_STEPS)
    graph, segments = scene.graph, scene.lanes
    if not len(graph):
        return None
    # points between those of the segments, about every 0.4 m
    index = np.arange(SUBDIVISIONS * (SEGMENT_POINTS - 1)) / SUBDIVISIONS
    low, fraction = index.astype(int), (index % 1)[:, None]
    points = (1 - fraction) * segments.points[:, low] + fraction * segments.points[:, low + 1]
    step = np.diff(segments.points, axis=1)[:, low]
    joined: list[set[int]] = [{lane, *graph.successors[lane]} for lane in range(len(graph))]
    for lane, successors in enumerate(graph.successors):
        for successor in successors:
            joined[successor].add(lane)
    features = scenario.map_features
    interpolating = features.topology.interpolating
    junction_ids = features.feature_id[interpolating] if interpolating is not None else np.zeros(0, np.int64)
    return LaneSearch(
        tree=KDTree(points.reshape(-1, 2)),
        lane=np.repeat(segments.lane, len(index)),
        heading=np.arctan2(step[..., 1], step[..., 0]).ravel(),
        z=None if scene.levels is None else segments.z[:, low].ravel(),
        joined=tuple(frozenset(lanes) for lanes in joined),
        is_junction=np.isin(graph.lane_id, junction_ids),
    )


def in_one_lane(
    scene: Scene, motion: Float[np.ndarray, "n c"], size: Float[np.ndarray, "_"], ground: Float[np.ndarray, "n"]
) -> Bool[np.ndarray, "n"]:
    """True where all corners of a box are within the half width of a single lane, or of lanes that merge or follow.

    Without lanes the result is False.

    Args:
        scene: Scene with the lanes to search.
        motion: x, y, heading of a box at n steps, map frame; further columns are ignored.
        size: Length and width of the box, m.
        ground: Height of the ground under the box at each step, m.
    """
    search = lane_search(scene.scenario)
    if search is None:
        return np.zeros(len(motion), bool)
    corners = clockwise_corners(motion[:, :2], motion[:, 2], size)
    points = search.find_points(corners.reshape(-1, 2), HALF_LANE_M, np.repeat(ground, 4))
    lanes = [frozenset(search.lane[rows].tolist()) for rows in points]
    is_inside = np.zeros(len(motion), bool)
    for step in range(len(motion)):
        corner_lanes = lanes[4 * step : 4 * step + 4]
        candidates = frozenset().union(*(search.joined[lane] for lane in corner_lanes[0]))
        is_inside[step] = any(all(search.joined[lane] & corner for corner in corner_lanes) for lane in candidates)
    return is_inside
