"""Levels: roads above each other, as at a bridge, and the level that an agent is on.

Heights count only in scenes that have levels. Elsewhere the ground has a single height at each position, so that boxes
which meet in the plane meet in space, on slopes too. M agents, n things; frame: map, z as logged, meters.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from rlftsim.realism.map_based import HEIGHT_STRETCH

LEVEL_M = 1.5
"""Ground heights that differ by more than the height of a car are levels, where roads as steep as `STEEPEST` do not
explain it."""
REACH_M, STEEPEST = 8.0, 0.3
"""Centers of cars that touch are within this distance; on steeper roads the heights of such cars may be disjoint."""
STEP_UP_M = 1.5
"""Largest step of the ground that an agent follows; beyond it the agent keeps its height."""
GRADE, FLAT_M = 0.15, 2.0
"""Height per meter that a slope beside a route may gain, farther from it than its points are apart."""


@dataclass(frozen=True, eq=False)
class Levels:
    """Ground of a scene with levels: points of lanes, and undersides of logged boxes."""

    tree: KDTree
    """x, y, and z stretched as in the metric's search for road edges."""

    def follow(self, points: Float[np.ndarray, "n 2"], ground: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Height of the ground under agents after a step.

        Args:
            points: Positions after the step.
            ground: Heights of the ground before the step.
        """
        _, nearest = self.tree.query(np.column_stack([points, HEIGHT_STRETCH * ground]))
        height = self.tree.data[nearest, 2] / HEIGHT_STRETCH
        return np.where(np.abs(height - ground) <= STEP_UP_M, height, ground)

    def follow_lines(
        self, lines: Float[np.ndarray, "n p 2"], ground: Float[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n p"]:
        """Height of the ground along lines with points a few meters apart.

        Args:
            lines: Points of the lines, map frame, m.
            ground: Height of the ground at the start of each line.
        """
        heights = [ground]
        for points in np.moveaxis(lines, 1, 0):
            heights.append(self.follow(points, heights[-1]))
        return np.stack(heights[1:], 1)


def build_levels(ground: Float[np.ndarray, "p 3"]) -> Levels | None:
    """Levels of a scene; None where the ground has a single height at each position.

    Args:
        ground: Points on the ground.
    """
    if not len(ground) or np.ptp(ground[:, 2]) <= LEVEL_M:
        return None
    # one point in each cube of a meter: parked agents stay, lanes lie side by side
    _, first = np.unique(np.round(ground), axis=0, return_index=True)
    points = ground[first]
    pairs = KDTree(points[:, :2]).query_pairs(REACH_M, output_type="ndarray")
    x, y, rise = (points[pairs[:, 0]] - points[pairs[:, 1]]).T
    if np.any(np.abs(rise) > np.maximum(LEVEL_M, STEEPEST * np.hypot(x, y))):
        return Levels(KDTree(ground * [1.0, 1.0, HEIGHT_STRETCH]))
    return None


@dataclass(frozen=True, eq=False)
class RouteHeights:
    """Heights of things compared with the routes of agents."""

    z: Float[np.ndarray, "M n"]
    above_route: Float[np.ndarray, "M n"]
    """Height above the nearest point of the route, in the plane."""
    distance: Float[np.ndarray, "M n"]
    """Distance to that point in the plane."""

    @classmethod
    def measure(
        cls,
        points: Float[np.ndarray, "M n 2"],
        z: Float[np.ndarray, "M n"],
        route: Float[np.ndarray, "M r 2"],
        route_z: Float[np.ndarray, "M r"],
    ) -> "RouteHeights":
        """Heights of things over routes.

        Args:
            points: Positions of the things.
            z: Heights of the things, m.
            route: Points of the routes; those beyond the end are far away.
            route_z: Heights of the ground there.
        """
        above, distance = np.empty_like(z), np.empty_like(z)
        for row, line in enumerate(route):
            squared = ((points[row][:, None] - line) ** 2).sum(-1)  # [n, r]
            nearest = squared.argmin(1)
            above[row] = z[row] - route_z[row, nearest]
            distance[row] = np.sqrt(squared[np.arange(len(nearest)), nearest])
        return cls(z, above, distance)

    def differences(
        self, distances: Float[np.ndarray, "M n"], ground: Float[np.ndarray, "M"], above_route: Float[np.ndarray, "M"]
    ) -> Float[np.ndarray, "M n"]:
        """Height differences between things and the road that leads there, less the part that slopes explain.

        Args:
            distances: Distance from each agent to each thing.
            ground: Height of the ground under the agents.
            above_route: The same above the nearest point of the route.
        """
        is_near_route = self.distance < distances
        rise = np.where(is_near_route, self.above_route - above_route[:, None], self.z - ground[:, None])
        beside = np.maximum(np.minimum(self.distance, distances) - FLAT_M, 0.0)
        return np.maximum(np.abs(rise) - GRADE * beside, 0.0)


def is_on_level(difference: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """True where the ground at a height difference is that of the same level."""
    return np.abs(difference) <= LEVEL_M
