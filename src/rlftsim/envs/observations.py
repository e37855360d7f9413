"""Observations of planner-driven agents: arrays of fixed size, rows nearest first.

M agents over B scenes; K neighbors, L pieces of lanes, E pieces of road edges, C crossings, T lights, R route points.
Frame: the observing agent's own at the present step (x ahead, y left), or the map frame; meters, seconds, radians. Rows
beyond what is there are zeros, and 0 in their mask.
"""

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int8, Int64

from rlftsim.envs.actions import WHEELBASE_PER_LENGTH, signed_speed
from rlftsim.envs.drivers import Driver
from rlftsim.envs.route import Route
from rlftsim.envs.scene import GREEN, PIECE_POINTS, RED, YELLOW
from rlftsim.envs.world import World, WorldState
from rlftsim.geometry import wrapped
from rlftsim.scenario.types import STEP_S, TOTAL_STEPS

Frame = Literal["ego", "world"]

NEIGHBORS, LANES, EDGES, CROSSINGS, LIGHTS, ROUTE = 32, 64, 64, 8, 16, 40
SEEN_M = 100.0
"""Rows farther than this are left out."""
BOUND = 1e4
"""All numbers are cut to ± this: spaces must be bounded."""
HISTORY = 10
OWN_LANES = 12
"""Nearest pieces that an agent's own lane is searched among."""
_FAR_M = 1e7


@dataclass(frozen=True, eq=False)
class Observation:
    """What M agents see."""

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
        """Arrays of one agent by name."""
        return {field.name: getattr(self, field.name)[row] for field in fields(self)}

    def by_name(self) -> dict[str, np.ndarray]:
        """Arrays of all agents by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def flat(self) -> Float32[np.ndarray, "M D"]:
        """All numbers of each agent in one row, in the order of the fields."""
        parts = [getattr(self, field.name) for field in fields(self)]
        return np.concatenate([part.reshape(len(part), -1).astype(np.float32) for part in parts], axis=1)


SHAPES: dict[str, tuple[int, ...]] = {
    "ego": (12,),
    "ego_history": (HISTORY + 1, 5),
    "neighbors": (NEIGHBORS, 10),
    "neighbors_mask": (NEIGHBORS,),
    "neighbors_history": (NEIGHBORS, 4 * HISTORY),
    "lanes": (LANES, 2 * PIECE_POINTS + 5),
    "lanes_mask": (LANES,),
    "edges": (EDGES, 4),
    "edges_mask": (EDGES,),
    "crossings": (CROSSINGS, 8),
    "crossings_mask": (CROSSINGS,),
    "lights": (LIGHTS, 6),
    "lights_mask": (LIGHTS,),
    "route": (ROUTE, 3),
    "route_mask": (ROUTE,),
    "goal": (3,),
}
"""Shape of each array for one agent; masks are int8, all others float32."""


@dataclass(frozen=True, eq=False)
class Atlas:
    """Maps of B scenes side by side, and the routes of M agents: cut once for each episode. Padding is far away."""

    lane_points: Float[np.ndarray, "B n 10 2"]
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
    light_state: Int64[np.ndarray, "B 91 T1"]
    """The last light of each scene is none, with state 0."""
    light_age: Float[np.ndarray, "B 91 T1"]
    last_logged: Int64[np.ndarray, "B A 91"]
    """Last step with a logged state, up to each step."""
    routes: tuple[Route, ...]
    route_points: Float[np.ndarray, "M r 2"]
    """Points beyond a route's end are far away."""
    route_limit: Float[np.ndarray, "M r"]
    route_length: Int64[np.ndarray, "M"]


def build_atlas(world: World, routes: tuple[Route, ...]) -> Atlas:
    """Maps and routes of a world.

    Args:
        world: the scenes.
        routes: of the planner-driven agents.
    """
    scenes = world.scenes
    points = _stack([scene.lanes.points for scene in scenes], _FAR_M)
    num_lights = max(len(scene.lights.lane) for scene in scenes)
    lane_light = _stack([np.where(s.lanes.light < 0, num_lights, s.lanes.light) for s in scenes], num_lights)
    owner = _stack([scene.lanes.lane for scene in scenes], -1)
    states = [np.pad(s.lights.state, ((0, 0), (0, num_lights + 1 - len(s.lights.lane)))) for s in scenes]
    ages = [np.pad(s.lights.age_s, ((0, 0), (0, num_lights + 1 - len(s.lights.lane)))) for s in scenes]
    light_point = [
        np.pad(s.lights.point, ((0, num_lights + 1 - len(s.lights.lane)), (0, 0)), constant_values=_FAR_M)
        for s in scenes
    ]
    facts = [np.stack([s.lanes.kind, s.lanes.limit_mps, s.lanes.has_stop_sign], -1) for s in scenes]
    edges, crossings = _stack([s.edges for s in scenes], _FAR_M), _stack([s.crossings for s in scenes], _FAR_M)
    on_route = [np.isin(owner[b], route.lanes) for (b, _), route in zip(world.actors, routes)]
    return Atlas(
        lane_points=points,
        lane_middle=points[:, :, PIECE_POINTS // 2],
        lane_facts=_stack(facts, 0.0),
        lane_light=lane_light,
        on_route=np.stack(on_route) if on_route else np.zeros((0, owner.shape[1]), bool),
        edges=edges,
        edge_middle=(edges[..., :2] + edges[..., 2:]) / 2,
        crossings=crossings,
        crossing_middle=crossings.reshape(*crossings.shape[:2], 4, 2).mean(2),
        light_point=np.stack(light_point),
        light_state=np.stack(states),
        light_age=np.stack(ages),
        last_logged=np.maximum.accumulate(np.where(world.valid, np.arange(TOTAL_STEPS), 0), axis=2),
        routes=routes,
        route_points=_stack([route.points for route in routes] or [np.zeros((0, 2))], _FAR_M),
        route_limit=_stack([route.limit_mps for route in routes] or [np.zeros(0)], 0.0),
        route_length=np.array([len(route) for route in routes], np.int64),
    )


def _stack(parts: list[np.ndarray], fill: float | int) -> np.ndarray:
    """Arrays of different lengths, padded to the longest, at least to one row."""
    longest = max(1, *(len(part) for part in parts))
    out = np.full((len(parts), longest, *parts[0].shape[1:]), fill, parts[0].dtype)
    for row, part in zip(out, parts):
        row[: len(part)] = part
    return out


def observe(world: World, atlas: Atlas, state: WorldState, *, frame: Frame = "ego", steps: int) -> Observation:
    """What the planner-driven agents see now.

    Args:
        world: the scenes.
        atlas: their maps and routes.
        state: the present one.
        frame: "ego" = each agent's own frame, "world" = the map frame.
        steps: length of the episode, for the time that is left.
    """
    scene, agent = world.actors.T
    row = np.arange(len(scene))
    now = state.now[scene, agent]  # [M, 5]
    log_step = len(state.track) - 1
    if frame == "ego":
        origin, cos, sin = now[:, :2], np.cos(now[:, 2]), np.sin(now[:, 2])
        angle = now[:, 2]
    else:
        origin, cos, sin = np.zeros_like(now[:, :2]), np.ones(len(now)), np.zeros(len(now))
        angle = np.zeros(len(now))

    def turned(vector: np.ndarray) -> np.ndarray:  # [M, ..., 2]
        c, s = (values.reshape(-1, *[1] * (vector.ndim - 2)) for values in (cos, sin))
        x, y = vector[..., 0], vector[..., 1]
        return np.stack([c * x + s * y, c * y - s * x], -1)

    def local(points: np.ndarray) -> np.ndarray:
        return turned(points - origin.reshape(-1, *[1] * (points.ndim - 2), 2))

    def distance(points: np.ndarray) -> np.ndarray:
        """From the agents to points [M, n, 2]."""
        offset = points - now[:, None, :2]
        return np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2)

    # 1. Motion of everybody over the last 11 steps [M, 11, A, 5], own frame.
    past = np.stack(state.track[-HISTORY - 1 :], 1)[scene]
    there = np.moveaxis(world.there[scene, :, log_step - HISTORY : log_step + 1], 2, 1)  # [M, 11, A]
    # 2. Neighbors: the other agents that are there, nearest first.
    away = distance(past[:, -1, :, :2])
    away[~there[:, -1]] = np.inf
    away[row, agent] = np.inf
    chosen, near = _nearest(away, NEIGHBORS)
    steps_back = np.arange(HISTORY + 1)[:, None]
    seen = past[row[:, None, None], steps_back, chosen[:, None]]  # [M, 11, K, 5]
    seen_there = there[row[:, None, None], steps_back, chosen[:, None]] & near[:, None]
    place, direction = local(seen[..., :2]), seen[..., 2] - angle[:, None, None]
    poses = np.concatenate([place, np.cos(direction)[..., None], np.sin(direction)[..., None]], -1)  # [M, 11, K, 4]
    age = STEP_S * (log_step - atlas.last_logged[scene[:, None], chosen, log_step])
    held = world.drivers[scene[:, None], chosen] == Driver.REPLAY  # they alone have a log to go by
    facts = [world.size[scene[:, None], chosen], world.object_type[scene[:, None], chosen][..., None]]
    neighbors = np.concatenate(
        [poses[:, -1], turned(seen[:, -1, :, 3:]), *facts, np.where(held, age, 0)[..., None]], -1
    )
    history = np.where(seen_there[:, :-1, :, None], poses[:, :-1], 0.0)  # [M, 10, K, 4]
    # 3. The map.
    lane, lane_near = _nearest(distance(atlas.lane_middle[scene]), LANES)
    pieces = atlas.lane_points[scene[:, None], lane]  # [M, L, 10, 2]
    colors = atlas.light_state[scene, log_step]  # [M, T + 1]
    lane_facts = atlas.lane_facts[scene[:, None], lane]
    lane_color = colors[row[:, None], atlas.lane_light[scene[:, None], lane]]
    lanes = np.concatenate([
        local(pieces).reshape(len(now), lane.shape[1], -1), lane_facts[..., :2], lane_color[..., None],
        atlas.on_route[row[:, None], lane][..., None], lane_facts[..., 2:],
    ], -1)  # fmt: skip
    edge, edge_near = _nearest(distance(atlas.edge_middle[scene]), EDGES)
    edges = local(atlas.edges[scene[:, None], edge].reshape(len(now), -1, 2, 2))
    area, area_near = _nearest(distance(atlas.crossing_middle[scene]), CROSSINGS)
    crossings = local(atlas.crossings[scene[:, None], area].reshape(len(now), -1, 4, 2))
    # 4. Lights whose state is known.
    light_away = distance(atlas.light_point[scene])
    light_away[colors == 0] = np.inf
    light, light_near = _nearest(light_away, LIGHTS)
    color = colors[row[:, None], light]
    lamp = [(color == shown)[..., None] for shown in (RED, YELLOW, GREEN)]
    light_age = atlas.light_age[scene[:, None], log_step, light]
    lights = np.concatenate([local(atlas.light_point[scene[:, None], light]), *lamp, light_age[..., None]], -1)
    # 5. The route from the nearest place on, and its end.
    has_route = atlas.route_length > 0
    first = distance(atlas.route_points).argmin(1)
    index = first[:, None] + np.arange(ROUTE)
    on_route = index < atlas.route_length[:, None]
    index = np.minimum(index, atlas.route_points.shape[1] - 1)
    ahead, limit = atlas.route_points[row[:, None], index], atlas.route_limit[row[:, None], index]
    route = np.concatenate([local(ahead), limit[..., None]], -1)
    end = atlas.route_points[row, np.maximum(atlas.route_length - 1, 0)]
    goal = np.concatenate([local(end[:, None])[:, 0], np.ones((len(now), 1))], -1)
    # 6. The agent itself.
    own = past[row, :, agent]  # [M, 11, 5]
    own_direction = own[..., 2] - angle[:, None]
    ego_history = np.concatenate([
        local(own[..., :2]), np.cos(own_direction)[..., None], np.sin(own_direction)[..., None],
        signed_speed(own)[..., None],
    ], -1)  # fmt: skip
    ego_history = np.where(there[row, :, agent][..., None], ego_history, 0.0)
    ego = _about_itself(
        world, own, pieces[:, :OWN_LANES], lane_near[:, :OWN_LANES], lane_facts[:, :OWN_LANES, 1], steps - state.step
    )

    def rows(values: np.ndarray, mask: np.ndarray, count: int) -> np.ndarray:
        """Float32 [M, count, ...] with zeros in rows beyond the mask."""
        out = np.zeros((len(values), count, *values.shape[2:]), np.float32)
        kept = values.shape[1]
        shown = mask.reshape(*mask.shape, *[1] * (values.ndim - 2))
        out[:, :kept] = np.where(shown, np.clip(values, -BOUND, BOUND), 0.0)
        return out

    def masks(mask: np.ndarray, count: int) -> np.ndarray:
        out = np.zeros((len(mask), count), np.int8)
        out[:, : mask.shape[1]] = mask
        return out

    return Observation(
        ego=np.clip(ego, -BOUND, BOUND).astype(np.float32),
        ego_history=np.clip(ego_history, -BOUND, BOUND).astype(np.float32),
        neighbors=rows(neighbors, near, NEIGHBORS),
        neighbors_mask=masks(near, NEIGHBORS),
        neighbors_history=rows(np.moveaxis(history, 1, 2).reshape(len(now), chosen.shape[1], -1), near, NEIGHBORS),
        lanes=rows(lanes, lane_near, LANES),
        lanes_mask=masks(lane_near, LANES),
        edges=rows(edges.reshape(len(now), -1, 4), edge_near, EDGES),
        edges_mask=masks(edge_near, EDGES),
        crossings=rows(crossings.reshape(len(now), -1, 8), area_near, CROSSINGS),
        crossings_mask=masks(area_near, CROSSINGS),
        lights=rows(lights, light_near, LIGHTS),
        lights_mask=masks(light_near, LIGHTS),
        route=rows(route, on_route, ROUTE),
        route_mask=masks(on_route, ROUTE),
        goal=np.where(has_route[:, None], np.clip(goal, -BOUND, BOUND), 0.0).astype(np.float32),
    )


def _nearest(
    distance: Float[np.ndarray, "M n"], count: int
) -> tuple[Int64[np.ndarray, "M k"], Bool[np.ndarray, "M k"]]:
    """Indices of the nearest `count` columns of each row in order, and True where they are within sight."""
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
    own: Float[np.ndarray, "M 11 5"],
    pieces: Float[np.ndarray, "M L 10 2"],
    near: Bool[np.ndarray, "M L"],
    limit: Float[np.ndarray, "M L"],
    steps_left: int,
) -> Float[np.ndarray, "M 12"]:
    """The row `Observation.ego`."""
    scene, agent = world.actors.T
    now, before = own[:, -1], own[:, -2]
    speed = signed_speed(now)
    yaw_rate = wrapped(now[:, 2] - before[:, 2]) / STEP_S
    length = world.size[scene, agent, 0]
    moving = np.abs(speed) > 0.1
    steering = np.where(moving, np.arctan(WHEELBASE_PER_LENGTH * length * yaw_rate / np.where(moving, speed, 1.0)), 0.0)
    # the lane point that is nearest among those of lanes that run the agent's way
    along = np.diff(pieces, axis=2, append=2 * pieces[:, :, -1:] - pieces[:, :, -2:-1])  # [M, L, 10, 2]
    heading = np.arctan2(along[..., 1], along[..., 0])
    offset = now[:, None, None, :2] - pieces
    away = np.hypot(offset[..., 0], offset[..., 1])
    same_way = np.cos(heading - now[:, 2, None, None]) > 0
    away = np.where(same_way & near[..., None], away, np.inf).reshape(len(own), -1)
    best, row = away.argmin(1), np.arange(len(own))
    on_lane = np.isfinite(away[row, best])
    direction = heading.reshape(len(own), -1)[row, best]
    off = offset.reshape(len(own), -1, 2)[row, best]
    lateral = np.cos(direction) * off[:, 1] - np.sin(direction) * off[:, 0]
    to_lane = now[:, 2] - direction
    return np.stack([
        speed, (speed - signed_speed(before)) / STEP_S, yaw_rate, steering, length, world.size[scene, agent, 1],
        np.where(on_lane, np.cos(to_lane), 0.0), np.where(on_lane, np.sin(to_lane), 0.0),
        np.where(on_lane, lateral, 0.0), np.where(on_lane, limit[row, best // PIECE_POINTS], 0.0),
        np.full(len(own), STEP_S * steps_left), world.object_type[scene, agent],
    ], -1)  # fmt: skip
