"""The region around the ego, and the gates where lanes cross its border. Map frame, meters.

G gates, P points of lanes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.polylines import arc_length, resample_to
from rlftsim.scenario.types import CURRENT_STEP, Scenario

DECISION_STEPS = 5
"""Agents enter and leave every half second."""
SPACING_M = 2.0
NARROWEST_M, WIDEST_M = 60.0, 120.0
STANDING_MPS = 0.3
"""Slower agents stand."""
UNKNOWN_LIMIT_MPS, CRUISE = 10.0, 0.7
"""Speed limit where none is known, and the fraction of the limit that traffic drives."""


@dataclass(frozen=True, eq=False)
class Gates:
    """Places where lanes cross the border of the region."""

    point: Int64[np.ndarray, "G"]
    """Point of the lane, for `GateFinder.follow`."""
    position: Float[np.ndarray, "G 2"]
    heading: Float[np.ndarray, "G"]
    """Direction of the lane."""
    inward: Float[np.ndarray, "G 2"]
    """Unit vector towards the ego."""
    lane_mps: Float[np.ndarray, "G"]
    """Usual speed on the lane."""
    lane_closing_mps: Float[np.ndarray, "G"]
    """Speed at which traffic on the lane comes nearer to the ego; negative = goes away."""
    standing_closing_mps: Float[np.ndarray, "G"]
    """Speed at which what stands there comes nearer."""
    moving_per_km: Float[np.ndarray, "G"]
    """Agents that move at the current step of the scenario, in the region around the ego and per km of its lanes."""
    standing_per_km: Float[np.ndarray, "G"]
    """Agents that stand at the current step."""

    def __len__(self) -> int:
        return len(self.heading)

    def select(self, index: np.ndarray) -> "Gates":
        """Some of the gates."""
        return Gates(*(values[index] for values in vars(self).values()))


class GateFinder:
    """Finds the gates of a scenario's map.

    Args:
        scenario: Scenario with the map; without lanes there are no gates.
    """

    def __init__(self, scenario: Scenario):
        graph = lane_graph(scenario)
        parts = [(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, bool), np.zeros(0))]
        for line, limit in zip(graph.lines, graph.speed_limit_mps):
            count = max(int(np.ceil(arc_length(line)[-1] / SPACING_M)), 1) + 1
            sampled = resample_to(line[:, :2] - scenario.origin, count)
            direction = np.diff(sampled, axis=0, append=2 * sampled[-1:] - sampled[-2:-1])
            heading, speed = np.arctan2(direction[:, 1], direction[:, 0]), CRUISE * (limit or UNKNOWN_LIMIT_MPS)
            is_followed = np.arange(count) < count - 1
            parts.append((sampled, heading, np.full(count, speed), is_followed, arc_length(sampled)))
        self.points, self.heading, self.speed, self.is_followed, self._along_m = map(np.concatenate, zip(*parts))
        self._first, self._successors = np.cumsum([len(part[0]) for part in parts]), graph.successors  # of each lane
        ends = [
            line[-1, :2] - scenario.origin for line, successors in zip(graph.lines, graph.successors) if not successors
        ]
        self.ends = np.array(ends).reshape(-1, 2)
        self.moving_per_km, self.standing_per_km = self._count_agents(scenario)

    def _count_agents(self, scenario: Scenario) -> tuple[float, float]:
        """Moving and standing agents per km of lanes, with one more of each, so that no density is zero."""
        tracks, region_m = scenario.tracks, find_region_m(scenario)
        position = tracks.position[:, CURRENT_STEP, :2] - scenario.origin
        ego = position[scenario.ego_index]
        is_near = tracks.valid[:, CURRENT_STEP] & (np.linalg.norm(position - ego, axis=-1) < region_m)
        is_near[scenario.ego_index] = False
        moves = np.linalg.norm(tracks.velocity[:, CURRENT_STEP], axis=-1) >= STANDING_MPS
        is_inside = np.linalg.norm(self.points - ego, axis=-1) < region_m
        lanes_km = max(SPACING_M * is_inside.sum() / 1000, 0.1)
        return (1 + (is_near & moves).sum()) / lanes_km, (1 + (is_near & ~moves).sum()) / lanes_km

    def find(self, ego: Float[np.ndarray, "2"], ego_velocity: Float[np.ndarray, "2"], region_m: float) -> Gates:
        """Gates of a region.

        Args:
            ego: Position of the ego, the center of the region.
            ego_velocity: Velocity of the ego, m/s.
            region_m: Radius of the region.
        """
        offset = self.points - ego
        is_inside = (offset * offset).sum(-1) < region_m**2
        index = np.flatnonzero(self.is_followed[:-1] & (is_inside[1:] != is_inside[:-1]))
        inward = -offset[index] / np.linalg.norm(offset[index], axis=-1, keepdims=True)
        heading, speed = self.heading[index], self.speed[index]
        velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
        standing = -(ego_velocity * inward).sum(-1)
        moving_per_km, standing_per_km = (np.full(len(index), d) for d in (self.moving_per_km, self.standing_per_km))
        return Gates(
            index, self.points[index], heading, inward, speed, (velocity * inward).sum(-1) + standing, standing,
            moving_per_km, standing_per_km,
        )  # fmt: skip

    def follow(self, point: int, distance_m: float) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
        """Points of the lanes ahead on every branch, and distances driven to them.

        Args:
            point: Point of a lane.
            distance_m: Length of the way.
        """
        pending, points, distances, visited = [(point, 0.0)], [], [], set()
        while pending:
            start, driven_m = pending.pop()
            if start in visited:
                continue
            visited.add(start)
            lane = int(np.searchsorted(self._first, start, "right")) - 1
            ahead = slice(start, int(self._first[lane + 1]))
            along_m = driven_m + self._along_m[ahead] - self._along_m[start]
            points.append(self.points[ahead][along_m <= distance_m])
            distances.append(along_m[along_m <= distance_m])
            if along_m[-1] < distance_m:
                pending += [(int(self._first[lane]), float(along_m[-1])) for lane in self._successors[lane]]
        return np.concatenate(points), np.concatenate(distances)


def find_region_m(scenario: Scenario) -> float:
    """Radius of the region in which agents are seen: up to the farthest one within 120 m now, 60 m at least."""
    tracks = scenario.tracks
    now = tracks.position[tracks.valid[:, CURRENT_STEP], CURRENT_STEP, :2]
    distance = np.linalg.norm(now - tracks.position[scenario.ego_index, CURRENT_STEP, :2], axis=-1)
    return float(distance[distance < WIDEST_M].max(initial=NARROWEST_M))
