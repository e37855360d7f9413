"""Observations of planner-driven agents: arrays of fixed size, rows nearest first.

M agents over B scenes; K neighbors, L pieces of lanes, E pieces of road edges, C crossings, T lights, R route points.
Frame: the observing agent's own at the present step (x ahead, y left), or the map frame; meters, seconds, radians.
Unused rows are zeros, and 0 in the mask. Things above or below the agent's road, as at a bridge, are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Complex, Float, Float32, Int8, Int64

from rlftsim.envs.actions import WHEELBASE_PER_LENGTH, signed_speed
from rlftsim.envs.drivers import Driver
from rlftsim.envs.levels import RouteHeights, is_on_level
from rlftsim.envs.road import measure_square
from rlftsim.envs.route import Route, compute_headings
from rlftsim.envs.scene import GREEN, RED, SEGMENT_POINTS, YELLOW, Lights
from rlftsim.envs.world import World, WorldState, find_lights, find_presence, padded
from rlftsim.errors import ConfigError
from rlftsim.geometry import heights_overlap, wrapped
from rlftsim.scenario.types import STEP_S

Frame = Literal["ego", "world"]

NEIGHBORS, LANES, EDGES, CROSSINGS, LIGHTS, ROUTE = 32, 64, 64, 8, 16, 40
SEEN_M = 100.0
"""Rows farther than this are left out."""
BOUND = 1e4
"""No number is larger: spaces must be bounded. Maps reach a few hundred meters."""
HISTORY = 10
OWN_LANES = 12
"""Nearest pieces that an agent's own lane is searched among."""
FAR_M = 1e7
"""Coordinate of padding."""
_ROW_BITS = (1 << 24) - 1
_SEEN_KEY = int(np.float64(SEEN_M * SEEN_M).view(np.int64)) | _ROW_BITS
_COLORS = np.array([RED, YELLOW, GREEN])


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
    """Maps and routes around M agents, cut once for each episode. Points are x + iy; padding is far away."""

    x: Float[np.ndarray, "M N"]
    """Middles of all lanes, edges, crossings, lights and route points, and space for the agents, side by side."""
    y: Float[np.ndarray, "M N"]
    index: Int64[np.ndarray, "M N"]
    """Rows of these things in the arrays below, counted over all agents."""
    columns: dict[str, slice]
    """Columns of "lanes", "edges", "crossings", "lights", "neighbors" and "route" in `x`, `y` and `index`."""
    points: dict[str, Complex[np.ndarray, "M n p"]]
    """All points of lanes, edges, crossings and lights."""
    lane_direction: Complex[np.ndarray, "M n 10"]
    """Unit vectors along the lanes."""
    lane_rows: Float32[np.ndarray, "M n 25"]
    """Space for points, class, speed limit, space for the light, on the route, stop sign."""
    lane_light: Int64[np.ndarray, "M n"]
    """Index of the light among those of all agents; an agent's last one is none."""
    lights: tuple[Int64[np.ndarray, "S B T1"], Float[np.ndarray, "S B T1"]]
    """States and ages of the lights in the log; the last light is none, far away."""
    agent_facts: Float32[np.ndarray, "B A 3"]
    """Length, width, class."""
    log_age_s: Float32[np.ndarray, "S B A"]
    """Age of the last logged state of replayed agents."""
    routes: tuple[Route, ...]
    route_points: Complex[np.ndarray, "M r"]
    """Points beyond a route's end are far away, as many as are shown."""
    route_heading: Float[np.ndarray, "M r"]
    route_limit: Float[np.ndarray, "M r"]
    route_length: Int64[np.ndarray, "M"]
    route_ground: Float[np.ndarray, "M r"]
    heights: dict[str, RouteHeights]
    """Of pieces of lanes ("lanes"), "edges", "crossings" and "lights"; empty where no scene has levels."""

    @cached_property
    def edges(self) -> Float[np.ndarray, "M e 4"]:
        """Segments of road edges around each agent."""
        return self.points["edges"].view(np.float64)

    @cached_property
    def route_end(self) -> Complex[np.ndarray, "M"]:
        """Last points of the routes; far away without one."""
        return self.route_points[np.arange(len(self.routes)), np.maximum(self.route_length - 1, 0)]


def build_atlas(world: World, routes: tuple[Route, ...]) -> Atlas:
    """Maps and routes of a world.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        routes: Routes of the M planner-driven agents, in the order of `world.actors`.
    """
    rows, scenes = world.actors[:, 0], world.scenes
    num_lights = max(LIGHTS, 1 + max(len(scene.lights.lane) for scene in scenes))
    owner = _stack([scene.lanes.lane for scene in scenes], -1, LANES)
    facts = [np.stack([s.lanes.lane_type, s.lanes.limit_mps, s.lanes.has_stop_sign], -1) for s in scenes]
    lane_rows = np.zeros((*owner[rows].shape, SHAPES["lanes"][1]), np.float32)
    lane_rows[..., [-5, -4, -1]] = _stack(facts, 0.0, LANES)[rows]
    for row, route in enumerate(routes):
        lane_rows[row, :, -2] = np.isin(owner[rows[row]], route.lanes)
    lane_light = [np.where(s.lanes.light < 0, num_lights - 1, s.lanes.light) for s in scenes]
    lane_light = _stack(lane_light, num_lights - 1, LANES)[rows] + num_lights * np.arange(len(rows))[:, None]
    lane_points = _stack([scene.lanes.points for scene in scenes], FAR_M, LANES)
    corners = {
        "lanes": lane_points.reshape(*owner.shape, -1),
        "edges": _stack([scene.edges for scene in scenes], FAR_M, EDGES),
        "crossings": _stack([scene.crossings for scene in scenes], FAR_M, CROSSINGS),
        "lights": _stack([scene.lights.point for scene in scenes], FAR_M, num_lights),
    }
    points = {name: _to_complex(array)[rows] for name, array in corners.items()}
    beyond = np.full((ROUTE, 2), FAR_M)  # a route shows as many points at its end as anywhere
    route_xy = _stack([np.concatenate([route.points, beyond]) for route in routes], FAR_M, ROUTE)
    route_points = _to_complex(route_xy)[..., 0]
    route_ground = padded([route.ground for route in routes], route_points.shape)
    space = np.full((len(rows), max(world.mask.shape[1], NEIGHBORS + 1)), FAR_M + 0j)
    middles = {name: array.mean(-1) for name, array in points.items()}
    middles |= {"lanes": points["lanes"][..., SEGMENT_POINTS // 2], "neighbors": space, "route": route_points}
    largest = max(middles, key=lambda name: middles[name].size)
    if middles[largest].size > _ROW_BITS:
        raise ConfigError(
            f"{len(rows)} agents with {middles[largest].shape[1]} {largest} each are too many to observe at once: make "
            "fewer environments."
        )
    index = {name: np.arange(middle.size).reshape(middle.shape) for name, middle in middles.items()}
    num_agents = world.mask.shape[1]
    index["neighbors"] = np.minimum(np.arange(space.shape[1]), num_agents - 1) + num_agents * rows[:, None]
    ends = np.cumsum([0, *(middle.shape[1] for middle in middles.values())])
    heights: dict[str, RouteHeights] = {}
    if world.has_levels.any():
        features = {
            "lanes": [s.lanes.z[:, SEGMENT_POINTS // 2] for s in scenes],
            "edges": [s.edges_z for s in scenes],
            "crossings": [s.crossings_z for s in scenes],
            "lights": [s.lights.z for s in scenes],
        }
        for name, z in features.items():
            middle = middles[name]
            padded_z = padded(z, (len(scenes), middle.shape[1]))[rows]
            heights[name] = RouteHeights.measure(middle[..., None].view(np.float64), padded_z, route_xy, route_ground)
    steps = np.arange(world.valid.shape[2])
    last_logged = np.maximum.accumulate(np.where(world.valid, steps, 0), axis=2)
    # replayed agents alone have a log to go by
    age = np.where((world.drivers == Driver.REPLAY)[..., None], STEP_S * (steps - last_logged), 0.0)
    return Atlas(
        x=np.concatenate([np.real(middle) for middle in middles.values()], 1),
        y=np.concatenate([np.imag(middle) for middle in middles.values()], 1),
        index=np.concatenate(list(index.values()), 1),
        columns={name: slice(*ends[i : i + 2]) for i, name in enumerate(middles)},
        points=points,
        lane_direction=np.exp(1j * compute_headings(lane_points))[rows],
        lane_rows=lane_rows,
        lane_light=lane_light,
        lights=_stack_lights([scene.lights for scene in scenes], num_lights),
        agent_facts=np.concatenate([world.size, world.object_type[..., None]], -1).astype(np.float32),
        log_age_s=np.moveaxis(age, 2, 0).astype(np.float32),
        routes=routes,
        route_points=route_points,
        route_heading=padded([route.heading for route in routes], route_points.shape),
        route_limit=padded([route.limit_mps for route in routes], route_points.shape),
        route_length=np.array([len(route) for route in routes], np.int64),
        route_ground=route_ground,
        heights=heights,
    )


def _stack(arrays: list[np.ndarray], fill: float | int, least: int) -> np.ndarray:
    """Arrays of different lengths, padded to the longest, at least to so many rows."""
    longest = max(least, *(len(array) for array in arrays))
    return padded(arrays, (len(arrays), longest, *arrays[0].shape[1:]), fill)


def _to_complex(points: Float[np.ndarray, "*n c"]) -> Complex[np.ndarray, "*n p"]:
    """Points x + iy, of coordinates x, y, x, y, ... on the last axis."""
    return np.ascontiguousarray(points).view(np.complex128)


def _stack_lights(
    lights: Sequence[Lights], count: int
) -> tuple[Int64[np.ndarray, "S B T1"], Float[np.ndarray, "S B T1"]]:
    """States and ages of the lights of each scene, padded with lights that are none."""
    shape = len(lights), count, len(lights[0].state)
    states, ages = padded([s.state.T for s in lights], shape, 0), padded([s.age_s.T for s in lights], shape)
    return np.moveaxis(states, 2, 0), np.moveaxis(ages, 2, 0)


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
    row, count, log_step = np.arange(len(scene)), len(scene), len(state.track) - 1
    past = np.array(state.track[-HISTORY - 1 :])  # [11, B, A, 5]
    others = past[-1].take(scene, axis=0)  # [M, A, 5]
    motion = others[row, agent]  # [M, 5]
    position, forward = _to_complex(motion[:, :2]), np.cos(motion[:, 2:3]) + 1j * np.sin(motion[:, 2:3])  # [M, 1]
    rotation = forward.conj() if frame == "ego" else np.ones_like(forward)

    def to_frame(offset):  # without types, which would be read anew at every step
        return offset * rotation if frame == "ego" else offset + position

    is_present = _find_history(world, state)  # [B, A, 11]

    # 1. Squared distances, infinite where there is nothing to see.
    squared = measure_square(atlas.x - motion[:, :1], atlas.y - motion[:, 1:2])  # [M, N]
    distances = {name: squared[:, columns] for name, columns in atlas.columns.items()}
    nearest_on_route = distances.pop("route").argmin(1)
    to_others = distances["neighbors"][:, : others.shape[1]]
    to_others[...] = measure_square(others[..., 0] - motion[:, :1], others[..., 1] - motion[:, 1:2])
    to_others[~is_present[..., -1].take(scene, axis=0)] = np.inf
    lights = atlas.lights
    if state.sumo_states:
        lights = _stack_lights(find_lights(world, state), lights[0].shape[2])
    color, light_age = lights[0][log_step].take(scene, axis=0), lights[1][log_step].take(scene, axis=0)  # [M, T1]
    distances["lights"][color == 0] = np.inf
    if atlas.heights:
        _leave_out_other_levels(world, atlas, state, nearest_on_route, {**distances, "neighbors": to_others})
    to_others[row, agent] = -1.0  # each agent comes before its neighbors
    # 2. The nearest rows in order.
    rows, is_hidden = _find_nearest_rows(atlas, squared, list(distances))
    # 3. The map in the frame of the agents.
    arrays = {name: np.empty((count, *SHAPES[name]), np.float32) for name in ("ego", "route", "goal", *distances)}
    arrays["lanes"] = atlas.lane_rows.reshape(-1, atlas.lane_rows.shape[2]).take(rows["lanes"], axis=0)
    arrays["lanes"][..., -3] = color.take(atlas.lane_light.take(rows["lanes"]))
    for name, points in atlas.points.items():
        size = points.shape[2]
        offset = points.reshape(-1, size).take(rows[name], axis=0).reshape(count, -1)  # [M, k p]
        offset -= position
        if name == "lanes":
            first = slice(OWN_LANES)
            beside_lane = _compare_with_lane(atlas, forward, offset, rows[name][:, first], is_hidden[name][:, first])
        _view_points(arrays[name], size)[...] = to_frame(offset).reshape(count, -1, size)
    lamps = arrays["lights"][..., 2:]
    lamps[..., :3] = color.take(rows["lights"])[..., None] == _COLORS
    lamps[..., 3] = light_age.take(rows["lights"])
    # 4. The route from the nearest place on, and its end.
    index = nearest_on_route[:, None] + np.arange(ROUTE)
    is_hidden["route"] = index >= atlas.route_length[:, None]
    index += atlas.route_points.shape[1] * row[:, None]
    _view_points(arrays["route"], 1)[..., 0] = to_frame(atlas.route_points.take(index) - position)
    arrays["route"][..., 2] = atlas.route_limit.take(index)
    _view_points(arrays["goal"], 1)[...] = to_frame(atlas.route_end[:, None] - position)
    arrays["goal"][:, 2] = 1.0
    is_hidden["goal"] = atlas.route_length == 0
    # 5. The agent itself and its neighbors, now and at the ten steps before.
    who, neighbors = rows["neighbors"], arrays["neighbors"]
    moved = past.reshape(HISTORY + 1, -1, 5).take(who, axis=1)  # [11, M, 1 + K, 5]
    offset = to_frame(_view_points(moved, 1)[..., 0] - position)
    direction = moved[..., 2] - (motion[:, 2:3] if frame == "ego" else 0.0)
    history = np.empty((*who.shape, HISTORY, 4), np.float32)  # [M, 1 + K, 10, 4]
    _view_points(history, 1)[..., 0] = offset[:-1].transpose(1, 2, 0)
    before = direction[:-1].transpose(1, 2, 0).astype(np.float32)
    history[..., 2], history[..., 3] = np.cos(before), np.sin(before)
    is_absent = ~is_present.reshape(-1, HISTORY + 1).take(who, axis=0)  # [M, 1 + K, 11]
    is_absent |= is_hidden["neighbors"][..., None]
    history.view(np.complex128)[is_absent[..., :-1]] = 0.0  # four numbers at once
    is_hidden["neighbors"] = is_hidden["neighbors"][:, 1:]
    _view_points(neighbors, 1)[..., 0] = offset[-1, :, 1:]
    neighbors[..., 2], neighbors[..., 3] = np.cos(direction[-1, :, 1:]), np.sin(direction[-1, :, 1:])
    _view_points(neighbors[..., 4:], 1)[..., 0] = _view_points(moved[-1, :, 1:, 3:], 1)[..., 0] * rotation
    neighbors[..., 6:9] = atlas.agent_facts.reshape(-1, 3).take(who[:, 1:], axis=0)
    neighbors[..., 9] = atlas.log_age_s[log_step].take(who[:, 1:])
    # 6. The agent's own numbers.
    speed = signed_speed(moved[:, :, 0])  # [11, M]
    ego_history = np.empty((count, *SHAPES["ego_history"]), np.float32)
    _view_points(ego_history, 1)[..., 0], ego_history[..., 4] = offset[..., 0].T, speed.T
    ego_history[..., 2], ego_history[..., 3] = np.cos(direction[..., 0].T), np.sin(direction[..., 0].T)
    ego_history[is_absent[:, 0]] = 0.0
    ego, facts = arrays["ego"], atlas.agent_facts[scene, agent]
    turn_rad = wrapped(motion[:, 2] - moved[-2, :, 0, 2])
    ego[:, :4] = _measure_ego(speed, turn_rad, world.size[scene, agent, 0])
    ego[:, 4:6], ego[:, 6:10], ego[:, 11] = facts[:, :2], beside_lane, facts[:, 2]
    ego[:, 10] = STEP_S * (steps - state.step)

    for name, is_nothing in is_hidden.items():
        arrays[name][is_nothing] = 0.0
    masks = {f"{name}_mask": (~is_hidden[name]).view(np.int8) for name in ("route", *distances)}
    history = history[:, 1:].reshape(count, NEIGHBORS, -1)
    return Observation(**arrays, **masks, ego_history=ego_history, neighbors_history=history)


def _find_history(world: World, state: WorldState) -> Bool[np.ndarray, "B A 11"]:
    """True where an agent was there: before it entered, its row was somebody else's."""
    is_present = find_presence(world, state, HISTORY + 1)[0]
    if not world.open_worlds:
        return is_present
    has_left = np.stack(state.has_left[-HISTORY - 1 :], -1)
    return is_present & ~np.maximum.accumulate(has_left[..., ::-1], -1)[..., ::-1]


def _find_nearest_rows(
    atlas: Atlas, squared: Float[np.ndarray, "M N"], names: Sequence[str]
) -> tuple[dict[str, Int64[np.ndarray, "M k"]], dict[str, Bool[np.ndarray, "M k"]]]:
    """Rows of what is nearest to each agent in order, by name, and True for those out of sight.

    The bits of a positive number sort as the number does; the lowest ones, which tell fractions of a micrometer apart,
    give way to the row, as numbers are sorted faster than rows by numbers.
    """
    keys = squared.view(np.int64)
    keys &= ~_ROW_BITS
    keys |= atlas.index
    rows, is_hidden = {}, {}
    for name in names:
        nearest, num_shown = keys[:, atlas.columns[name]], SHAPES[name][0] + (name == "neighbors")
        if nearest.shape[1] > num_shown:
            nearest.partition(num_shown - 1, axis=1)
        nearest = nearest[:, :num_shown]
        nearest.sort(axis=1)
        rows[name], is_hidden[name] = nearest & _ROW_BITS, nearest > _SEEN_KEY
    return rows, is_hidden


def _measure_ego(
    speed: Float[np.ndarray, "t M"], turn_rad: Float[np.ndarray, "M"], length: Float[np.ndarray, "M"]
) -> Float[np.ndarray, "M 4"]:
    """Speed, acceleration, yaw rate and steering angle of agents with the speeds of the last steps."""
    yaw_rate, is_moving = turn_rad / STEP_S, np.abs(speed[-1]) > 0.1
    turn = WHEELBASE_PER_LENGTH * length * yaw_rate / np.where(is_moving, speed[-1], 1.0)
    steering = np.where(is_moving, np.arctan(turn), 0.0)
    return np.stack([speed[-1], (speed[-1] - speed[-2]) / STEP_S, yaw_rate, steering], -1)


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
        distances: Squared distances from each agent to rows of the map and to "neighbors", changed in place.
    """
    scene, agent = world.actors.T
    height, z = world.height, state.z[-1]
    half = height[scene, agent][:, None] / 2
    ground = z[scene, agent] - half[:, 0]
    above_route = ground - atlas.route_ground[np.arange(len(scene)), nearest_on_route]
    # a box as high as the agent's whose height difference is 0 stands on the same ground
    route_xy = atlas.route_points[..., None].view(np.float64)
    neighbors = RouteHeights.measure(state.motion[scene][..., :2], z[scene] - half, route_xy, atlas.route_ground)
    for name, heights in {**atlas.heights, "neighbors": neighbors}.items():
        difference = heights.differences(np.sqrt(distances[name]), ground, above_route)
        if name == "neighbors":
            is_same_level = heights_overlap(difference, 2 * half, height[scene])
        else:
            is_same_level = is_on_level(difference)
        distances[name][world.has_levels[scene][:, None] & ~is_same_level] = np.inf


def _view_points(array: np.ndarray, count: int) -> np.ndarray:
    """The first 2 * count columns as so many points x + iy."""
    return array[..., : 2 * count].view(np.complex64 if array.dtype == np.float32 else np.complex128)


def _compare_with_lane(
    atlas: Atlas,
    forward: Complex[np.ndarray, "M 1"],
    offset: Complex[np.ndarray, "M n"],
    lanes: Int64[np.ndarray, "M L"],
    is_hidden: Bool[np.ndarray, "M L"],
) -> Float[np.ndarray, "M 4"]:
    """Cosine and sine of the heading to the lane, lateral offset to it, speed limit; zeros away from lanes.

    Args:
        atlas: Maps and routes of the world.
        forward: Unit vectors along the agents.
        offset: Offsets from the agents to the points of the nearest pieces of lanes, L of them or more, m.
        lanes: Rows of the L nearest pieces in the atlas.
        is_hidden: True = too far away.
    """
    turn = atlas.lane_direction.reshape(-1, SEGMENT_POINTS).take(lanes, axis=0).reshape(len(lanes), -1)
    offset = offset[:, : turn.shape[1]]
    # the point that is nearest among those of lanes that run the agent's way
    squared = measure_square(np.real(offset).copy(), np.imag(offset).copy())
    squared[np.real(turn * forward.conj()) <= 0] = np.inf
    squared.reshape(*lanes.shape, -1)[is_hidden] = np.inf
    best = np.arange(len(lanes)), squared.argmin(1)
    direction = turn[best].conj()
    turn, lateral = forward[:, 0] * direction, -np.imag(offset[best] * direction)
    limit = atlas.lane_rows.reshape(-1, atlas.lane_rows.shape[2])[lanes[best[0], best[1] // SEGMENT_POINTS], -4]
    values = np.array([np.real(turn), np.imag(turn), lateral, limit])
    return np.where(np.isfinite(squared[best]), values, 0.0).T
