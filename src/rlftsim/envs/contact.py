"""Collisions of a planner's agent, their type and their fault, after nuPlan's definition; lanes that a box is in.

Boxes have sharp corners, as nuPlan's. Motion: x, y, heading, vx, vy; map frame, meters, seconds.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree

from rlftsim.envs.levels import is_on_level
from rlftsim.envs.scene import PIECE_POINTS, Scene, build_env_scene
from rlftsim.geometry import boxes_overlap, clockwise_corners
from rlftsim.scenario.derived import cached_on_scenario
from rlftsim.scenario.types import Scenario

STANDS_MPS = 0.05
"""At most this fast an agent counts as stopped."""
BEHIND_RAD = np.radians(150.0)
"""A track at a greater bearing is behind."""
HALF_LANE_M = 1.85
"""Half of the width that is assumed for every lane, as logs have center lines and few boundaries."""
DENSE = 3
"""Points that lanes are searched by, between two points of a piece."""


class CollisionType(StrEnum):
    """Types of collisions, in the order in which they are tested."""

    STOPPED_EGO = "stopped_ego"
    STOPPED_TRACK = "stopped_track"
    ACTIVE_REAR = "active_rear"
    """The track is behind."""
    ACTIVE_FRONT = "active_front"
    """The ego's front bumper meets the track."""
    ACTIVE_LATERAL = "active_lateral"


@dataclass(frozen=True)
class Collision:
    """The first contact with one track."""

    step: int
    """Of the episode, 1 = after the first action."""
    agent: int
    """Row of the track."""
    kind: CollisionType
    at_fault: bool
    """Of the planner's agent: a stopped track, its own front, or a track beside it while it is not in one lane."""
    speed_change_mps: float
    """Length of the difference of both velocities."""


def collision_of(
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
        scene: the map.
        step: of the contact.
        agent: row of the track.
        ego: motion of the planner's agent.
        ego_size: its length and width.
        ego_ground: Height of the ground under it.
        track: motion of the other one.
        track_size: its length and width.
    """
    bearing = np.arctan2(track[1] - ego[1], track[0] - ego[0]) - ego[2]
    ahead = np.array([np.cos(ego[2]), np.sin(ego[2])])
    from_bumper = track[:2] - (ego[:2] + ego_size[0] / 2 * ahead)
    if np.hypot(*ego[3:]) <= STANDS_MPS:
        kind = CollisionType.STOPPED_EGO
    elif np.hypot(*track[3:]) <= STANDS_MPS:
        kind = CollisionType.STOPPED_TRACK
    elif np.cos(bearing) < np.cos(BEHIND_RAD):
        kind = CollisionType.ACTIVE_REAR
    elif boxes_overlap(from_bumper[None], ego[2:3], track[2:3], np.array([0.0, ego_size[1]]), track_size)[0]:
        kind = CollisionType.ACTIVE_FRONT
    else:
        kind = CollisionType.ACTIVE_LATERAL
    at_fault = kind in (CollisionType.STOPPED_TRACK, CollisionType.ACTIVE_FRONT) or (
        kind == CollisionType.ACTIVE_LATERAL and not bool(in_one_lane(scene, ego[None], ego_size, ego_ground)[0])
    )
    return Collision(step, agent, kind, at_fault, float(np.hypot(*(ego[3:] - track[3:]))))


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

    def find_near(
        self, positions: Float[np.ndarray, "m 2"], distance_m: float, ground: Float[np.ndarray, "m"]
    ) -> list[list[int]]:
        """For each position the list of points of lanes near it, on its level.

        Args:
            positions: Where to search.
            distance_m: Largest distance in the plane.
            ground: Heights of the ground there.
        """
        near = list(self.tree.query_ball_point(positions, distance_m))
        if self.z is None:
            return near
        rows = [np.array(points, np.int64) for points in near]
        return [points[is_on_level(self.z[points] - height)].tolist() for points, height in zip(rows, ground)]


@cached_on_scenario
def lane_search(scenario: Scenario) -> LaneSearch | None:
    """The lanes of a scenario to be searched by place; None without lanes."""
    scene = build_env_scene(scenario)
    graph, pieces = scene.graph, scene.lanes
    if not len(graph):
        return None
    # points between those of the pieces, about every 0.4 m
    part = np.arange(DENSE * (PIECE_POINTS - 1)) / DENSE
    low, rest = part.astype(int), (part % 1)[:, None]
    points = (1 - rest) * pieces.points[:, low] + rest * pieces.points[:, low + 1]
    along = np.diff(pieces.points, axis=1)[:, low]
    joined: list[set[int]] = [{lane, *graph.successors[lane]} for lane in range(len(graph))]
    for lane, successors in enumerate(graph.successors):
        for successor in successors:
            joined[successor].add(lane)
    topology = scenario.map_features.topology
    inside = topology.interpolating
    ids = scenario.map_features.feature_id[inside] if inside is not None else np.zeros(0, np.int64)
    return LaneSearch(
        tree=KDTree(points.reshape(-1, 2)),
        lane=np.repeat(pieces.lane, len(part)),
        heading=np.arctan2(along[..., 1], along[..., 0]).ravel(),
        z=None if scene.levels is None else pieces.z[:, low].ravel(),
        joined=tuple(frozenset(lanes) for lanes in joined),
        is_junction=np.isin(graph.lane_id, ids),
    )


def in_one_lane(
    scene: Scene, motion: Float[np.ndarray, "n c"], size: Float[np.ndarray, "_"], ground: Float[np.ndarray, "n"]
) -> Bool[np.ndarray, "n"]:
    """True where all corners of a box are within the half width of one lane, or of lanes that merge or follow.

    Without lanes a box is in none.

    Args:
        scene: the map.
        motion: x, y, heading of a box over time.
        size: its length and width.
        ground: Height of the ground under it.
    """
    search = lane_search(scene.scenario)
    if search is None:
        return np.zeros(len(motion), bool)
    corners = clockwise_corners(motion[:, :2], motion[:, 2], size)
    near = search.find_near(corners.reshape(-1, 2), HALF_LANE_M, np.repeat(ground, 4))
    lanes = [frozenset(search.lane[rows].tolist()) for rows in near]
    inside = np.zeros(len(motion), bool)
    for step in range(len(motion)):
        of_corners = lanes[4 * step : 4 * step + 4]
        candidates = frozenset().union(*(search.joined[lane] for lane in of_corners[0]))
        inside[step] = any(all(search.joined[lane] & own for own in of_corners) for lane in candidates)
    return inside
