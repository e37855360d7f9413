"""Observations of planner-driven agents: arrays of fixed size, rows nearest first.

M agents over B scenes; K neighbors, L pieces of lanes, E pieces of road edges, C crossings, T lights, R route points.
Frame: the observing agent's own at the present step (x ahead, y left), or the map frame; meters, seconds, radians.
Unused rows are zeros, and 0 in the mask. Things above or below the agent's road, as at a bridge, are left out.
"""

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int8, Int64

from rlftsim.envs.actions import WHEELBASE_PER_LENGTH, signed_speed, to_heading_frame
from rlftsim.envs.drivers import Driver
from rlftsim.envs.levels import RouteHeights, is_on_level
from rlftsim.envs.route import Route, compute_headings
from rlftsim.envs.scene import GREEN, RED, SEGMENT_POINTS, YELLOW
from rlftsim.envs.world import World, WorldState, find_lights, find_presence, padded
from rlftsim.geometry import heights_overlap, wrapped
from rlftsim.scenario.types import STEP_S, TOTAL_STEPS

Frame = Literal["ego", "world"]

NEIGHBORS, LANES, EDGES, CROSSINGS, LIGHTS, ROUTE = 32, 64, 64, 8, 16, 40
SEEN_M = 100.0
"""Rows farther than this are left out."""
BOUND = 1e4
"""No number is larger: spaces must be bounded. Maps reach a few hundred meters."""
HISTORY = 10
OWN_LANES = 12
"""Nearest pieces that an agent's own lane is searched among."""
_FAR_M = 1e7


@dataclass(frozen=True, eq=False)
class Observation:
    """Observations of M agents."""

    ego: Float32[np.ndarray, "M 12"]
    """Speed, acceleration, yaw rate, steering angle that explains it, length, width, cos and sin of the heading to the
    lane, lateral offset to it (left positive), speed limit (0 = unknown), time left, class."""
    ego_history: Float32[np.ndarray, "M 11 5"]
    """x, y, cos, sin, speed at steps -10 .. 0."""
    neighbors: Float32[np.ndarray, "M K 10"]
    """x, y, cos, sin, vx, vy, length, width, class, age of the last logged state."""
    neighbors_mask: Int8[np.ndarray, "M K"]
    neighbors_history: Float32[np.ndarray, "M K 40"]
    """x, y, cos, sin at the ten steps before, oldest first; zeros where the neighbor was not seen."""
    lanes: Float32[np.ndarray, "M L 25"]
    """Ten points of a piece, class, speed limit, light (0 none, 1 red, 2 yellow, 3 green), on the route, stop sign."""
    lanes_mask: Int8[np.ndarray, "M L"]
    edges: Float32[np.ndarray, "M E 4"]
    """x0, y0, x1, y1, the drivable side on the left."""
    edges_mask: Int8[np.ndarray, "M E"]
    crossings: Float32[np.ndarray, "M C 8"]
    """Four corners."""
    crossings_mask: Int8[np.ndarray, "M C"]
    lights: Float32[np.ndarray, "M T 6"]
    """x, y of the stop point, red, yellow, green, time since the state changed."""
    lights_mask: Int8[np.ndarray, "M T"]
    route: Float32[np.ndarray, "M R 3"]
    """x, y, speed limit (0 = unknown), a point every 2 m from the nearest place on."""
    route_mask: Int8[np.ndarray, "M R"]
    goal: Float32[np.ndarray, "M 3"]
    """x, y of the route's end, and 1; zeros without a route."""

    def of_agent(self, row: int) -> dict[str, np.ndarray]:
        """Arrays of an agent by name."""
        return {field.name: getattr(self, field.name)[row] for field in fields(self)}

    def by_name(self) -> dict[str, np.ndarray]:
        """Arrays of all agents by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def flat(self) -> Float32[np.ndarray, "M D"]:
        """All numbers of each agent in a row, in the order of the fields."""
        arrays = self.by_name().values()
        return np.concatenate([array.reshape(len(array), -1).astype(np.float32) for array in arrays], axis=1)


_SIZES = {"K": NEIGHBORS, "L": LANES, "E": EDGES, "C": CROSSINGS, "T": LIGHTS, "R": ROUTE}
_ARRAYS: dict[str, Any] = {field.name: field.type for field in fields(Observation)}
SHAPES: dict[str, tuple[int, ...]] = {
    name: tuple(_SIZES.get(axis) or int(axis) for axis in array.dim_str.split()[1:]) for name, array in _ARRAYS.items()
}
"""Shape of each array for one agent; masks are int8, all others float32."""


@dataclass(frozen=True, eq=False)
class Atlas:
    """Maps of B scenes side by side, and the routes of M agents: cut once for each episode. Padding is far away."""

    lane_points: Float[np.ndarray, "B n 10 2"]
    lane_heading: Float[np.ndarray, "B n 10"]
    lane_middle: Float[np.ndarray, "B n 2"]
    lane_facts: Float[np.ndarray, "B n 3"]
    """Class, speed limit, stop sign."""
    lane_light: Int64[np.ndarray, "B n"]
    """Index of the light; the last one is none."""
    on_route: Bool[np.ndarray, "M n"]
    edges: Float[np.ndarray, "B e 4"]
    edge_middle: Float[np.ndarray, "B e 2"]
    crossings: Float[np.ndarray, "B c 8"]
    crossing_middle: Float[np.ndarray, "B c 2"]
    light_point: Float[np.ndarray, "B T1 2"]
    """The last light of each scene is none, far away."""
    last_logged: Int64[np.ndarray, "B A 91"]
    """Last step with a logged state, up to each step."""
    routes: tuple[Route, ...]
    route_points: Float[np.ndarray, "M r 2"]
    """Points beyond a route's end are far away."""
    route_heading: Float[np.ndarray, "M r"]
    route_limit: Float[np.ndarray, "M r"]
    route_length: Int64[np.ndarray, "M"]
    route_ground: Float[np.ndarray, "M r"]
    heights: dict[str, RouteHeights]
    """Of pieces of lanes ("lanes"), "edges", "crossings" and "lights"; empty where no scene has levels."""


def build_atlas(world: World, routes: tuple[Route, ...]) -> Atlas:
    """Maps and routes of a world.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        routes: Routes of the M planner-driven agents, in the order of `world.actors`.
    """
    scenes = world.scenes
    points = _stack([scene.lanes.points for scene in scenes], _FAR_M)
    num_lights = max(len(scene.lights.lane) for scene in scenes)
    lane_light = _stack([np.where(s.lanes.light < 0, num_lights, s.lanes.light) for s in scenes], num_lights)
    owner = _stack([scene.lanes.lane for scene in scenes], -1)
    light_point = padded([s.lights.point for s in scenes], (len(scenes), num_lights + 1, 2), _FAR_M)
    facts = [np.stack([s.lanes.lane_type, s.lanes.limit_mps, s.lanes.has_stop_sign], -1) for s in scenes]
    edges, crossings = _stack([s.edges for s in scenes], _FAR_M), _stack([s.crossings for s in scenes], _FAR_M)
    on_route = [np.isin(owner[b], route.lanes) for (b, _), route in zip(world.actors, routes)]
    lane_middle, edge_middle = points[:, :, SEGMENT_POINTS // 2], (edges[..., :2] + edges[..., 2:]) / 2
    crossing_middle = crossings.reshape(*crossings.shape[:2], 4, 2).mean(2)
    route_points = _stack([route.points for route in routes] or [np.zeros((0, 2))], _FAR_M)
    route_ground = _stack([route.ground for route in routes] or [np.zeros(0)], 0.0)
    heights: dict[str, RouteHeights] = {}
    if world.has_levels.any():
        features = {
            "lanes": (lane_middle, [s.lanes.z[:, SEGMENT_POINTS // 2] for s in scenes]),
            "edges": (edge_middle, [s.edges_z for s in scenes]),
            "crossings": (crossing_middle, [s.crossings_z for s in scenes]),
            "lights": (light_point, [s.lights.z for s in scenes]),
        }
        scene_rows = world.actors[:, 0]
        for name, (middle, z) in features.items():
            padded_z = padded(z, middle.shape[:2])
            heights[name] = RouteHeights.measure(middle[scene_rows], padded_z[scene_rows], route_points, route_ground)
    return Atlas(
        lane_points=points,
        lane_heading=compute_headings(points),
        lane_middle=lane_middle,
        lane_facts=_stack(facts, 0.0),
        lane_light=lane_light,
        on_route=np.stack(on_route) if on_route else np.zeros((0, owner.shape[1]), bool),
        edges=edges,
        edge_middle=edge_middle,
        crossings=crossings,
        crossing_middle=crossing_middle,
        light_point=light_point,
        last_logged=np.maximum.accumulate(np.where(world.valid, np.arange(TOTAL_STEPS), 0), axis=2),
        routes=routes,
        route_points=route_points,
        route_heading=_stack([route.heading for route in routes] or [np.zeros(0)], 0.0),
        route_limit=_stack([route.limit_mps for route in routes] or [np.zeros(0)], 0.0),
        route_length=np.array([len(route) for route in routes], np.int64),
        route_ground=route_ground,
        heights=heights,
    )


def _stack(arrays: list[np.ndarray], fill: float | int) -> np.ndarray:
    """Arrays of different lengths, padded to the longest, at least to a single row."""
    longest = max(1, *(len(array) for array in arrays))
    return padded(arrays, (len(arrays), longest, *arrays[0].shape[1:]), fill)


def observe(world: World, atlas: Atlas, state: WorldState, *, frame: Frame = "ego", steps: int) -> Observation:
    """Observations of the planner-driven agents at the present step.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        atlas: Maps and routes of the world, cut once per episode.
        state: Present state of the world.
        frame: Frame of all positions: "ego" = each agent's own frame, "world" = the map frame.
        steps: Length of the episode in steps of 0.1 s, for the time that is left.
    """
    scene, agent = world.actors.T
    row, count = np.arange(len(scene)), len(scene)
    motion = state.motion[scene, agent]  # [M, 5]
    log_step = len(state.track) - 1
    is_ego_frame = frame == "ego"
    origin, angle = (motion[:, :2], motion[:, 2]) if is_ego_frame else (np.zeros((count, 2)), np.zeros(count))

    # 1. Motion over the last 11 steps [M, 11, A, 5], and the other agents that are there, nearest first.
    past = np.stack(state.track[-HISTORY - 1 :], 1)[scene]
    is_present = np.moveaxis(find_presence(world, state)[0][scene, :, log_step - HISTORY :], 2, 1)  # [M, 11, A]
    neighbor_distance = _distance(motion, past[:, -1])
    neighbor_distance[~is_present[:, -1]] = np.inf
    neighbor_distance[row, agent] = np.inf
    middles = {"lanes": atlas.lane_middle, "edges": atlas.edge_middle, "crossings": atlas.crossing_middle}
    middles["lights"] = atlas.light_point
    distances = {name: _distance(motion, points[scene]) for name, points in middles.items()}
    distances["neighbors"] = neighbor_distance
    nearest_on_route = _distance(motion, atlas.route_points).argmin(1)
    if atlas.heights:
        _leave_out_other_levels(world, atlas, state, nearest_on_route, distances)
    neighbor, has_neighbor = _nearest(neighbor_distance, NEIGHBORS)
    steps_back = np.arange(HISTORY + 1)[:, None]
    neighbor_motion = past[row[:, None, None], steps_back, neighbor[:, None]]  # [M, 11, K, 5]
    is_neighbor_present = is_present[row[:, None, None], steps_back, neighbor[:, None]] & has_neighbor[:, None]
    ego_motion = past[row, :, agent]  # [M, 11, 5]
    # 2. The nearest rows of the map, lights whose state is known, and the route from the nearest place on.
    lane, has_lane = _nearest(distances["lanes"], LANES)
    edge, has_edge = _nearest(distances["edges"], EDGES)
    area, has_area = _nearest(distances["crossings"], CROSSINGS)
    lights, shape = find_lights(world, state), atlas.light_point.shape[:2]
    colors = padded([scene_lights.state[log_step] for scene_lights in lights], shape, 0)[scene]  # [M, T + 1]
    ages = padded([scene_lights.age_s[log_step] for scene_lights in lights], shape)[scene]
    light_distance = distances["lights"]
    light_distance[colors == 0] = np.inf
    light, has_light = _nearest(light_distance, LIGHTS)
    index = nearest_on_route[:, None] + np.arange(ROUTE)
    on_route = index < atlas.route_length[:, None]
    index = np.minimum(index, atlas.route_points.shape[1] - 1)
    segments = atlas.lane_points[scene[:, None], lane]  # [M, L, 10, 2]
    # 3. All points in the frame of the agents, at once, and split again.
    groups = [
        neighbor_motion[..., :2], ego_motion[..., :2], segments, atlas.edges[scene[:, None], edge],
        atlas.crossings[scene[:, None], area],
        atlas.light_point[scene[:, None], light], atlas.route_points[row[:, None], index],
        atlas.route_points[row, np.maximum(atlas.route_length - 1, 0)],
    ]  # fmt: skip
    points = np.concatenate([group.reshape(count, -1, 2) for group in groups], 1)
    ends = np.cumsum([group.size // (2 * count) for group in groups])[:-1] if count else [0] * (len(groups) - 1)
    x, y = points[..., 0] - origin[:, :1], points[..., 1] - origin[:, 1:]
    if is_ego_frame:
        x, y = to_heading_frame(x, y, angle[:, None])
    local = np.split(np.stack([x, y], -1), ends, axis=1)
    neighbor_points, ego_points, lane_points, edges, crossings, light_points, route_points, end = local
    # 4. Columns.
    direction = neighbor_motion[..., 2] - angle[:, None, None]
    poses = np.empty((*direction.shape, 4), np.float32)  # [M, 11, K, 4]
    poses[..., :2] = neighbor_points.reshape(*direction.shape, 2)
    poses[..., 2], poses[..., 3] = np.cos(direction), np.sin(direction)
    vx, vy = neighbor_motion[:, -1, :, 3], neighbor_motion[:, -1, :, 4]
    velocity = np.stack(to_heading_frame(vx, vy, angle[:, None]), -1)
    is_replayed = world.drivers[scene[:, None], neighbor] == Driver.REPLAY  # they alone have a log to go by
    age = np.where(is_replayed, STEP_S * (log_step - atlas.last_logged[scene[:, None], neighbor, log_step]), 0.0)
    size, object_type = world.size[scene[:, None], neighbor], world.object_type[scene[:, None], neighbor]
    neighbors = np.concatenate([poses[:, -1], velocity, size, object_type[..., None], age[..., None]], -1)
    history = np.where(is_neighbor_present[:, :-1, :, None], poses[:, :-1], np.float32(0.0))
    history = np.moveaxis(history, 1, 2)  # [M, K, 10, 4]
    lane_facts = atlas.lane_facts[scene[:, None], lane]
    lanes = np.concatenate([
        lane_points.reshape(count, lane.shape[1], -1), lane_facts[..., :2],
        colors[row[:, None], atlas.lane_light[scene[:, None], lane]][..., None],
        atlas.on_route[row[:, None], lane][..., None], lane_facts[..., 2:],
    ], -1)  # fmt: skip
    color = colors[row[:, None], light]
    lamps = [color == RED, color == YELLOW, color == GREEN, ages[row[:, None], light]]
    lamp_rows = np.concatenate([light_points, np.stack(lamps, -1)], -1)
    route = np.concatenate([route_points, atlas.route_limit[row[:, None], index][..., None]], -1)
    goal = np.concatenate([end[:, 0], np.ones((count, 1))], -1)
    ego_direction = ego_motion[..., 2] - angle[:, None]
    ego_history = np.stack(
        [*np.moveaxis(ego_points, -1, 0), np.cos(ego_direction), np.sin(ego_direction), signed_speed(ego_motion)], -1
    )
    ego_history = np.where(is_present[row, :, agent][..., None], ego_history, 0.0)
    first = slice(OWN_LANES)
    heading = atlas.lane_heading[scene[:, None], lane[:, first]]
    ego = _about_itself(
        world, ego_motion, segments[:, first], heading, has_lane[:, first], lane_facts[:, first, 1], steps - state.step
    )

    return Observation(
        ego=ego.astype(np.float32),
        ego_history=ego_history.astype(np.float32),
        neighbors=_rows(neighbors, has_neighbor, NEIGHBORS),
        neighbors_mask=_masks(has_neighbor, NEIGHBORS),
        neighbors_history=_rows(history.reshape(count, neighbor.shape[1], -1), has_neighbor, NEIGHBORS),
        lanes=_rows(lanes, has_lane, LANES),
        lanes_mask=_masks(has_lane, LANES),
        edges=_rows(edges.reshape(count, -1, 4), has_edge, EDGES),
        edges_mask=_masks(has_edge, EDGES),
        crossings=_rows(crossings.reshape(count, -1, 8), has_area, CROSSINGS),
        crossings_mask=_masks(has_area, CROSSINGS),
        lights=_rows(lamp_rows, has_light, LIGHTS),
        lights_mask=_masks(has_light, LIGHTS),
        route=_rows(route, on_route, ROUTE),
        route_mask=_masks(on_route, ROUTE),
        goal=np.where((atlas.route_length > 0)[:, None], goal, 0.0).astype(np.float32),
    )


def _leave_out_other_levels(
    world: World,
    atlas: Atlas,
    state: WorldState,
    nearest_on_route: Int64[np.ndarray, "M"],
    distances: dict[str, np.ndarray],
) -> None:
    """Put things above or below the roads of the observing agents infinitely far away.

    Args:
        world: Scenes that step together.
        atlas: Maps and routes of the world.
        state: Present state of the world.
        nearest_on_route: Index of the route's point nearest to each agent.
        distances: Distances from each agent to rows of the map and to "neighbors", changed in place.
    """
    scene, agent = world.actors.T
    height, z = world.height, state.z[-1]
    half = height[scene, agent][:, None] / 2
    ground = z[scene, agent] - half[:, 0]
    above_route = ground - atlas.route_ground[np.arange(len(scene)), nearest_on_route]
    # a box as high as the agent's whose height difference is 0 stands on the same ground
    neighbors = RouteHeights.measure(
        state.motion[scene][..., :2], z[scene] - half, atlas.route_points, atlas.route_ground
    )
    for name, heights in {**atlas.heights, "neighbors": neighbors}.items():
        difference = heights.differences(distances[name], ground, above_route)
        if name == "neighbors":
            is_same_level = heights_overlap(difference, 2 * half, height[scene])
        else:
            is_same_level = is_on_level(difference)
        distances[name][world.has_levels[scene][:, None] & ~is_same_level] = np.inf


def _rows(values: Float[np.ndarray, "M n c"], mask: Bool[np.ndarray, "M n"], length: int) -> np.ndarray:
    """Float32 [M, length, c] with zeros in rows beyond the mask."""
    out = np.zeros((len(values), length, values.shape[-1]), np.float32)
    out[:, : values.shape[1]] = values
    out[:, : values.shape[1]][~mask] = 0.0
    return out


def _masks(mask: Bool[np.ndarray, "M n"], length: int) -> Int8[np.ndarray, "M length"]:
    """Masks with zeros appended."""
    out = np.zeros((len(mask), length), np.int8)
    out[:, : mask.shape[1]] = mask
    return out


def _distance(motion: Float[np.ndarray, "M 5"], points: np.ndarray) -> Float[np.ndarray, "M n"]:
    """Distances from agents to points, of which x and y come first on the last axis."""
    dx, dy = points[..., 0] - motion[:, :1], points[..., 1] - motion[:, 1:2]
    return np.sqrt(dx * dx + dy * dy)


def _nearest(
    distance: Float[np.ndarray, "M n"], count: int
) -> tuple[Int64[np.ndarray, "M k"], Bool[np.ndarray, "M k"]]:
    """Indices of the nearest `count` columns of each row in order, and True up to a distance of 100 m."""
    row = np.arange(len(distance))[:, None]
    if distance.shape[1] > count:
        # the nearest in any order first: a full sort of all rows would cost more than all the rest
        index = np.argpartition(distance, count - 1, axis=1)[:, :count]
        index = index[row, np.argsort(distance[row, index], axis=1, kind="stable")]
    else:
        index = np.argsort(distance, axis=1, kind="stable")
    return index, distance[row, index] <= SEEN_M


def _about_itself(
    world: World,
    motion: Float[np.ndarray, "M 11 5"],
    segments: Float[np.ndarray, "M L 10 2"],
    heading: Float[np.ndarray, "M L 10"],
    has_lane: Bool[np.ndarray, "M L"],
    limit: Float[np.ndarray, "M L"],
    steps_left: int,
) -> Float[np.ndarray, "M 12"]:
    """The row `Observation.ego`."""
    scene, agent = world.actors.T
    current, previous = motion[:, -1], motion[:, -2]
    speed = signed_speed(current)
    yaw_rate = wrapped(current[:, 2] - previous[:, 2]) / STEP_S
    length = world.size[scene, agent, 0]
    moving = np.abs(speed) > 0.1
    steering = np.where(moving, np.arctan(WHEELBASE_PER_LENGTH * length * yaw_rate / np.where(moving, speed, 1.0)), 0.0)
    # the lane point that is nearest among those of lanes that run the agent's way
    offset = current[:, None, None, :2] - segments
    distance = np.hypot(offset[..., 0], offset[..., 1])
    is_same_direction = np.cos(heading - current[:, 2, None, None]) > 0
    distance = np.where(is_same_direction & has_lane[..., None], distance, np.inf).reshape(len(motion), -1)
    best, row = distance.argmin(1), np.arange(len(motion))
    on_lane = np.isfinite(distance[row, best])
    direction = heading.reshape(len(motion), -1)[row, best]
    off = offset.reshape(len(motion), -1, 2)[row, best]
    lateral = np.cos(direction) * off[:, 1] - np.sin(direction) * off[:, 0]
    to_lane = current[:, 2] - direction
    return np.stack([
        speed, (speed - signed_speed(previous)) / STEP_S, yaw_rate, steering, length, world.size[scene, agent, 1],
        np.where(on_lane, np.cos(to_lane), 0.0), np.where(on_lane, np.sin(to_lane), 0.0),
        np.where(on_lane, lateral, 0.0), np.where(on_lane, limit[row, best // SEGMENT_POINTS], 0.0),
        np.full(len(motion), STEP_S * steps_left), world.object_type[scene, agent],
    ], -1)  # fmt: skip
