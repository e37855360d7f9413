"""Observations of planner-driven agents: arrays of fixed size, rows nearest first.

M agents over B scenes; K neighbors, L pieces of lanes, E pieces of road edges, C crossings, T lights, R route points.
Frame: the observing agent's own at the present step (x ahead, y left), or the map frame; meters, seconds, radians.
Unused rows are zeros, and 0 in the mask. Things above or below the agent's road, as at a bridge, are left out.
"""

from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int8, Int64

from rlftsim.envs.drivers import Driver
from rlftsim.envs.levels import RouteHeights, is_on_level
from rlftsim.envs.observation_rows import MapArrays, RouteArrays, States, observe_scenes
from rlftsim.envs.route import Route, compute_headings
from rlftsim.envs.scene import SEGMENT_POINTS, Lights
from rlftsim.envs.world import World, WorldState, find_lights, find_presence, padded
from rlftsim.geometry import heights_overlap
from rlftsim.scenario.types import STEP_S

Frame = Literal["ego", "world"]

NEIGHBORS, LANES, EDGES, CROSSINGS, LIGHTS, ROUTE = 32, 64, 64, 8, 16, 40
BOUND = 1e4
"""No number is larger: spaces must be bounded. Maps reach a few hundred meters."""
HISTORY = 10
FAR_M = 1e7
"""Coordinate of padding."""


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
_Arrays = namedtuple("_Arrays", SHAPES)


@dataclass(frozen=True, eq=False)
class Atlas:
    """Maps and routes around M agents, cut once for each episode; padding is far away."""

    maps: MapArrays
    routes: tuple[Route, ...]
    route_arrays: RouteArrays
    lights: tuple[Int64[np.ndarray, "S B T1"], Float[np.ndarray, "S B T1"]]
    """States and ages of the lights in the log; the last light is none, far away."""
    log_age_s: Float32[np.ndarray, "S B A"]
    """Age of the last logged state of replayed agents."""
    route_ground: Float[np.ndarray, "M r"]
    heights: RouteHeights | None
    """Of the features whose middles are in `maps`; None where no scene has levels."""


def build_atlas(world: World, routes: tuple[Route, ...]) -> Atlas:
    """Maps and routes of a world.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        routes: Routes of the M planner-driven agents, in the order of `world.actors`.
    """
    scenes = list(dict.fromkeys(world.scenes))  # a scenario has a single scene
    of_scene = np.array([scenes.index(scene) for scene in world.scenes])
    rows = of_scene[world.actors[:, 0]]
    num_lights = 1 + max(len(scene.lights.lane) for scene in scenes)
    owner = _stack([scene.lanes.lane for scene in scenes], -1)
    facts = [np.stack([s.lanes.lane_type, s.lanes.limit_mps, s.lanes.has_stop_sign], -1) for s in scenes]
    lane_lights = [np.where(s.lanes.light < 0, num_lights - 1, s.lanes.light) for s in scenes]
    lanes = _stack([scene.lanes.points for scene in scenes], FAR_M)
    headings = compute_headings(lanes)
    features = {
        "lanes": lanes,
        "edges": _stack([scene.edges.reshape(-1, 2, 2) for scene in scenes], FAR_M),
        "crossings": _stack([scene.crossings.reshape(-1, 4, 2) for scene in scenes], FAR_M),
        "lights": _stack([scene.lights.point[:, None] for scene in scenes], FAR_M, num_lights),
    }
    middles = (lanes[:, :, SEGMENT_POINTS // 2], *(points.mean(2) for points in list(features.values())[1:]))
    middle = np.concatenate(middles, 1)  # [U, N, 2]
    agent_facts = [np.stack([scene.size[:, 0], scene.size[:, 1], scene.object_type], -1) for scene in scenes]
    maps = MapArrays(
        of_scene=of_scene,
        x=middle[..., 0].copy(),
        y=middle[..., 1].copy(),
        **features,
        lane_directions=np.stack([np.cos(headings), np.sin(headings)], -1),
        lane_facts=_stack(facts, 0.0).astype(np.float32),
        lane_lights=_stack(lane_lights, num_lights - 1),
        agent_facts=padded(agent_facts, (len(scenes), world.mask.shape[1], 3)).astype(np.float32),
    )
    points = _stack([route.points for route in routes], FAR_M)
    length = np.array([len(route) for route in routes], np.int64)
    route_heading = padded([route.heading for route in routes], points.shape[:2])
    route_arrays = RouteArrays(
        points=points,
        direction=np.stack([np.cos(route_heading), np.sin(route_heading)], -1),
        limit=padded([route.limit_mps for route in routes], points.shape[:2]),
        length=length,
        end=points[np.arange(len(routes)), np.maximum(length - 1, 0)],
        has_lane=np.stack([np.isin(owner[row], route.lanes) for row, route in zip(rows, routes)]),
    )
    route_ground, heights = padded([route.ground for route in routes], points.shape[:2]), None
    if world.has_levels.any():
        columns = zip(*((s.lanes.z[:, SEGMENT_POINTS // 2], s.edges_z, s.crossings_z, s.lights.z) for s in scenes))
        z = [padded(list(column), points.shape[:2]) for column, points in zip(columns, features.values())]
        heights = RouteHeights.measure(middle[rows], np.concatenate(z, 1)[rows], points, route_ground)
    steps = np.arange(world.valid.shape[2])
    last_logged = np.maximum.accumulate(np.where(world.valid, steps, 0), axis=2)
    # replayed agents alone have a log to go by
    age = np.where((world.drivers == Driver.REPLAY)[..., None], STEP_S * (steps - last_logged), 0.0)
    return Atlas(
        maps=maps,
        routes=routes,
        route_arrays=route_arrays,
        lights=_stack_lights([scene.lights for scene in world.scenes], num_lights),
        log_age_s=np.moveaxis(age, 2, 0).astype(np.float32),
        route_ground=route_ground,
        heights=heights,
    )


def _stack(arrays: list[np.ndarray], fill: float | int, min_rows: int = 1) -> np.ndarray:
    """Arrays of different lengths, padded to the longest, at least to so many rows."""
    longest = max(min_rows, *(len(array) for array in arrays))
    return padded(arrays, (len(arrays), longest, *arrays[0].shape[1:]), fill)


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
    log_step, lights = len(state.track) - 1, atlas.lights
    if state.sumo_states:
        lights = _stack_lights(find_lights(world, state), lights[0].shape[2])
    if atlas.heights is None:
        is_elsewhere = np.zeros((len(world.actors), atlas.maps.x.shape[1] + world.mask.shape[1]), bool)
    else:
        is_elsewhere = _find_other_levels(world, atlas, atlas.heights, state)
    states = States(
        track=state.track[-HISTORY - 1 :],
        directions=state.directions[-HISTORY - 1 :],
        is_present=_find_history(world, state),
        log_age_s=atlas.log_age_s[log_step],
        colors=lights[0][log_step],
        light_age_s=lights[1][log_step],
        is_elsewhere=is_elsewhere,
    )
    arrays = _Arrays(**{
        name: np.zeros((len(world.actors), *shape), np.int8 if name.endswith("_mask") else np.float32)
        for name, shape in SHAPES.items()
    })  # fmt: skip
    observe_scenes(atlas.maps, atlas.route_arrays, states, world.actors, frame == "ego", arrays)
    arrays.ego[:, 10] = STEP_S * (steps - state.step)
    return Observation(*arrays)


def _find_history(world: World, state: WorldState) -> Bool[np.ndarray, "11 B A"]:
    """True where an agent was there: before it entered, its row was somebody else's."""
    is_present = find_presence(world, state, HISTORY + 1)[0]
    if not world.open_worlds:
        return is_present
    has_left = np.stack(state.has_left[-HISTORY - 1 :])
    return is_present & ~np.maximum.accumulate(has_left[::-1])[::-1]


def _find_other_levels(world: World, atlas: Atlas, heights: RouteHeights, state: WorldState) -> Bool[np.ndarray, "M _"]:
    """True for things and agents above or below the roads of the observing agents.

    Args:
        world: Scenes that step together.
        atlas: Maps and routes of the world.
        heights: Heights of the things on the maps.
        state: Present state of the world.
    """
    scene, agent = world.actors.T
    height, z, positions = world.height, state.z[-1][scene], state.motion[scene][..., :2]
    half = height[scene, agent][:, None] / 2
    ground = state.z[-1][scene, agent] - half[:, 0]
    position, route = state.motion[scene, agent, :2], atlas.route_arrays.points
    nearest_on_route = np.square(route - position[:, None]).sum(-1).argmin(1)
    above_route = ground - atlas.route_ground[np.arange(len(scene)), nearest_on_route]
    features = np.stack([atlas.maps.x, atlas.maps.y], -1)[atlas.maps.of_scene[scene]]
    # a box as high as the agent's whose height difference is 0 stands on the same ground
    neighbors = RouteHeights.measure(positions, z - half, route, atlas.route_ground)
    to_features, to_agents = (
        measured.differences(np.linalg.norm(points - position[:, None], axis=-1), ground, above_route)
        for measured, points in ((heights, features), (neighbors, positions))
    )
    is_same_level = [is_on_level(to_features), heights_overlap(to_agents, 2 * half, height[scene])]
    return world.has_levels[scene][:, None] & ~np.concatenate(is_same_level, 1)
