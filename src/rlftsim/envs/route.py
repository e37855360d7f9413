"""Routes: the middle of the lanes that a planner is to follow. Frame: map, m.

A log has no route, so the default is the lanes that the logged agent drove, without the timing. Such a route tells a
planner *where* the logged driver went. `Route.source` says where a route comes from.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from rlftsim.envs.levels import is_on_level
from rlftsim.envs.scene import Scene, build_env_scene
from rlftsim.errors import ConfigError
from rlftsim.geometry import wrapped
from rlftsim.goals.lane_paths import (
    MAX_LANE_DISTANCE_M,
    LanePath,
    Pose,
    ease_m,
    lane_change_paths,
    lanes_for,
    own_lanes,
    paths_from,
)
from rlftsim.goals.proposals import CurrentAgent, propose_from_lanes
from rlftsim.scenario.lane_graph import LaneGraph
from rlftsim.scenario.polylines import arc_length, sample_line
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, ObjectType, Scenario, cached_on_scenario

SPACING_M = 2.0
BEYOND_M = 50.0
"""Length of a route beyond the end of the logged way."""
LEAST_M = 100.0
"""Least length of a route, where the lanes go on so far."""
ON_M = 240.0
"""Least length of each later 8 s of a route, 30 m/s."""
NEAR_LANE_M, ALONG_RAD = 4.0, np.radians(60.0)
"""A point of a route is on the nearest lane within this distance that runs its way."""
TURN_PENALTY = 0.02
"""Meters of misfit that a radian of turning counts as, so that an agent that stands gets the straightest path."""

RouteChoice = str | tuple[int, ...]
"""Either "logged", "none", the name of a maneuver ("left"), or lane ids."""


@dataclass(frozen=True, eq=False)
class Route:
    """A line to follow, a point every 2 m; R = 0 where there is none."""

    points: Float[np.ndarray, "R 2"]
    heading: Float[np.ndarray, "R"]
    ground: Float[np.ndarray, "R"]
    """Height of the ground; zeros in scenes without levels."""
    limit_mps: Float[np.ndarray, "R"]
    """Speed limit; 0 = unknown."""
    lanes: Int64[np.ndarray, "l"]
    """Lanes along it, as indices of the scene's `graph`."""
    source: str
    """One of "logged lanes", "logged way" (no lane there), "maneuver", "lanes" and "none"."""

    def __len__(self) -> int:
        return len(self.points)

    def progress(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Distance along the route to the place nearest to each point, m; beyond the ends straight on."""
        if not len(self):
            return np.zeros(len(points))
        dx, dy = (points[:, k, None] - self.points[:, k] for k in range(2))
        nearest = (dx * dx + dy * dy).argmin(1)
        direction = np.stack([np.cos(self.heading[nearest]), np.sin(self.heading[nearest])], -1)
        return SPACING_M * nearest + ((points - self.points[nearest]) * direction).sum(-1)


NO_ROUTE = Route(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, np.int64), "none")


@cached_on_scenario
def find_route(scenario: Scenario, agent: int, choice: RouteChoice, num_steps: int) -> Route:
    """Route of an agent; empty without lanes.

    Args:
        scenario: Scenario with lanes and log for the route.
        agent: Row of the agent among the simulated agents.
        choice: Kind of route: "logged" for the lanes of the log, "none", a maneuver that the lanes allow, or lane ids.
        num_steps: Number of steps of the log's time, beyond the 91 of the metric for an episode that goes on.

    Raises:
        ConfigError: no such lane or maneuver.
    """
    scene = build_env_scene(scenario, num_steps)
    if choice == "none" or not len(scene.graph):
        return NO_ROUTE
    if isinstance(choice, tuple):
        return _of_points(scene, agent, _along_lanes(scene, agent, choice), "lanes")
    if choice == "logged":
        return _logged_route(scene, agent)
    proposals = propose_from_lanes(scenario, int(scenario.simulated_indices[agent]))
    for proposal in proposals:
        if proposal.maneuver.value == choice:
            return _of_points(scene, agent, proposal.path[:, :2] - scenario.origin, "maneuver")
    maneuvers = ", ".join(proposal.maneuver.value for proposal in proposals) or "no maneuver"
    raise ConfigError(
        f"route {choice!r}: in scenario {scenario.scenario_id} the lanes of agent {scene.object_id[agent]} allow "
        f"{maneuvers}; routes are also 'logged', 'none' and lane ids."
    )


def _logged_route(scene: Scene, agent: int) -> Route:
    line = trace_lanes(scene, agent)
    if len(line):
        return _of_points(scene, agent, line, "logged lanes")
    logged = scene.logged[agent, CURRENT_STEP:, :3][scene.valid[agent, CURRENT_STEP:]]
    beyond = np.arange(1.0, LEAST_M)[:, None] * [np.cos(logged[-1, 2]), np.sin(logged[-1, 2])]
    return _of_points(scene, agent, np.concatenate([logged[:, :2], logged[-1, :2] + beyond]), "logged way")


def trace_lanes(scene: Scene, agent: int) -> Float[np.ndarray, "n 2"]:
    """Points 1 m apart along the lanes that fit the logged way best, up to their end; none where no lane is.

    Args:
        scene: Scene with lanes and log. A scene of more than 8 s is traced 8 s after 8 s.
        agent: Row of the agent.
    """
    driver = CurrentAgent.from_track(scene.scenario, int(scene.scenario.simulated_indices[agent]))
    path = _find_path(scene, agent, driver.pose, driver.speed_mps, CURRENT_STEP)
    if path is None:
        return np.zeros((0, 2))
    pieces = []
    for start in range(CURRENT_STEP + FUTURE_STEPS, scene.num_steps - 1, FUTURE_STEPS):
        join = len(path.points) - 1
        if scene.valid[agent, start:].any():
            position = scene.logged[agent, start, :2] + scene.scenario.origin
            join = int(np.linalg.norm(path.points[:, :2] - position, axis=1).argmin())
        speed = float(np.linalg.norm(scene.logged[agent, start, 3:]))
        following = _find_path(scene, agent, path.pose(join), speed, start)
        if following is None:
            break
        pieces.append(path.points[:join])
        path = following
    return np.concatenate([*pieces, path.points])[:, :2] - scene.scenario.origin


def _find_path(scene: Scene, agent: int, pose: Pose, speed_mps: float, start: int) -> LanePath | None:
    """The path along the lanes that fits 8 s of the logged way best; None where no lane is.

    Args:
        scene: Scene with lanes and log.
        agent: Row of the agent.
        pose: Pose where the path begins, world frame.
        speed_mps: Speed there.
        start: Step of the log at the pose. Beyond the log's end the longest path is taken.
    """
    steps = slice(start, start + FUTURE_STEPS + 1)
    logged_path = scene.logged[agent, steps, :2][scene.valid[agent, steps]]
    travelled = float(arc_length(logged_path)[-1]) if len(logged_path) else 0.0
    least_m = LEAST_M if start == CURRENT_STEP else ON_M
    paths = _find_paths(scene, agent, pose, speed_mps, max(travelled + BEYOND_M, least_m))
    if not len(logged_path):
        longest = max((path.length_m for path in paths), default=0.0)
        paths = [path for path in paths if path.length_m > longest - SPACING_M]
    world = logged_path + scene.scenario.origin
    misfit = [
        (float(np.linalg.norm(world[:, None] - path.points[:, :2], axis=-1).min(1).mean()) if len(world) else 0.0)
        + TURN_PENALTY * abs(float(path.turn[-1]))
        for path in paths
    ]
    return paths[int(np.argmin(misfit))] if paths else None


def _find_paths(scene: Scene, agent: int, pose: Pose, speed_mps: float, length_m: float) -> list[LanePath]:
    """Paths along the lanes from a pose, with a lane change and without.

    Args:
        scene: Scene with lanes.
        agent: Row of the agent, whose type decides on the lanes.
        pose: Pose where the paths begin, world frame.
        speed_mps: Speed there.
        length_m: Greatest length of a path, m.
    """
    lanes = lanes_for(scene.graph, ObjectType(int(scene.object_type[agent])))
    if scene.levels is not None:
        lanes.usable[_lanes_of_other_levels(scene.graph, pose.position)] = False
    lane_paths = paths_from(lanes, pose, own_lanes(lanes, pose), length_m=length_m, ease_m=ease_m(speed_mps))
    speed = max(speed_mps, 5.0)
    changing = [
        path
        for start in lane_paths
        for side in (1, -1)
        for path, _ in lane_change_paths(lanes, start, side=side, speed_mps=speed, length_m=length_m)
    ]
    return lane_paths + changing


def _lanes_of_other_levels(graph: LaneGraph, position: Float[np.ndarray, "3"]) -> Int64[np.ndarray, "l"]:
    """Indices of the lanes that are near an agent in the plane alone."""
    offset = graph.points - position
    is_in_reach = np.linalg.norm(offset[:, :2], axis=1) <= MAX_LANE_DISTANCE_M
    is_same_level = is_on_level(offset[:, 2])
    return np.setdiff1d(graph.owner[is_in_reach & ~is_same_level], graph.owner[is_in_reach & is_same_level])


def _along_lanes(scene: Scene, agent: int, lane_ids: tuple[int, ...]) -> Float[np.ndarray, "n 2"]:
    """The middle of successive lanes, from the point nearest to an agent on."""
    row_of_id = {int(lane_id): row for row, lane_id in enumerate(scene.graph.lane_id)}
    unknown_ids = [lane_id for lane_id in lane_ids if lane_id not in row_of_id]
    if unknown_ids or not lane_ids:
        missing = unknown_ids[0] if unknown_ids else "here"
        raise ConfigError(
            f"route {lane_ids}: scenario {scene.scenario.scenario_id} has no lane {missing}: "
            f"its lanes are {', '.join(map(str, list(row_of_id)[:12]))}, ..."
        )
    line = np.concatenate([scene.graph.lines[row_of_id[i]][:, :2] for i in lane_ids]) - scene.scenario.origin
    nearest = int(((line - scene.logged[agent, CURRENT_STEP, :2]) ** 2).sum(-1).argmin())
    return line[nearest:]


def _of_points(scene: Scene, agent: int, line: Float[np.ndarray, "n 2"], source: str) -> Route:
    """Route along a polyline, with the lanes and limits there."""
    if float(arc_length(line)[-1]) < SPACING_M:
        return NO_ROUTE
    points = sample_line(line, SPACING_M)
    heading = compute_headings(points)
    # lanes and limits: of the nearest lane point that runs the same way; farther ones do not count
    graph = scene.graph
    graph_points = graph.points[:, :2] - scene.scenario.origin
    is_close = (graph_points >= points.min(0) - NEAR_LANE_M) & (graph_points <= points.max(0) + NEAR_LANE_M)
    candidates = np.append(np.flatnonzero(is_close.all(1)), 0)  # at least one
    offset = np.linalg.norm(points[:, None] - graph_points[candidates], axis=-1)  # [R, P]
    offset[np.abs(wrapped(graph.heading[candidates] - heading[:, None])) > ALONG_RAD] = np.inf
    ground = np.zeros(len(points))
    if scene.levels is not None:
        ground = scene.levels.follow_lines(points[None], np.array([scene.z[agent] - scene.size[agent, 2] / 2]))[0]
        offset[~is_on_level(graph.points[candidates, 2] - ground[:, None])] = np.inf
    nearest = offset.argmin(1)
    on_lane = offset[np.arange(len(points)), nearest] <= NEAR_LANE_M
    owner = graph.owner[candidates[nearest]]
    limit = np.where(on_lane, graph.speed_limit_mps[owner], 0.0)
    return Route(points, heading, ground, limit, np.unique(owner[on_lane]), source)


def compute_headings(lines: Float[np.ndarray, "*lines n 2"]) -> Float[np.ndarray, "*lines n"]:
    """Direction of polylines from each point to the next, rad; at the last point the direction of the last segment."""
    steps = np.diff(lines, axis=-2, append=2 * lines[..., -1:, :] - lines[..., -2:-1, :])
    return np.arctan2(steps[..., 1], steps[..., 0])
