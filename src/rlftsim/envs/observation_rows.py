"""What each planner-driven agent sees, an agent at a time, as machine code where numba is installed.

A pose or a frame is x, y, and cosine and sine of the heading.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from rlftsim.envs.actions import WHEELBASE_PER_LENGTH, sign_speed, wrap
from rlftsim.envs.compiled import compiled
from rlftsim.envs.scene import GREEN, RED, YELLOW
from rlftsim.envs.step_measures import find_on_route
from rlftsim.scenario.types import STEP_S

SEEN_M = 100.0
"""Rows farther than this are left out."""
RINGS = 128
OWN_LANES = 12
"""Nearest pieces that an agent's own lane is searched among."""


class MapArrays(NamedTuple):
    """Maps of U scenarios side by side. Padding is far away."""

    of_scene: Int64[np.ndarray, "B"]
    """Map of each scene."""
    x: Float[np.ndarray, "U N"]
    """Middles of lanes, edges, crossings and lights, in this order."""
    y: Float[np.ndarray, "U N"]
    lanes: Float[np.ndarray, "U n 10 2"]
    edges: Float[np.ndarray, "U e 2 2"]
    crossings: Float[np.ndarray, "U c 4 2"]
    lights: Float[np.ndarray, "U T 1 2"]
    lane_directions: Float[np.ndarray, "U n 10 2"]
    """Unit vectors along the lanes."""
    lane_facts: Float32[np.ndarray, "U n 3"]
    """Class, speed limit, stop sign."""
    lane_lights: Int64[np.ndarray, "U n"]
    """Light of each piece; the last light is none."""
    agent_facts: Float32[np.ndarray, "U A 3"]
    """Length, width, class."""


class RouteArrays(NamedTuple):
    """Routes of M agents side by side. Padding is far away."""

    points: Float[np.ndarray, "M r 2"]
    direction: Float[np.ndarray, "M r 2"]
    """Unit vectors along the routes."""
    limit: Float[np.ndarray, "M r"]
    length: Int64[np.ndarray, "M"]
    end: Float[np.ndarray, "M 2"]
    """Last points; far away without a route."""
    has_lane: Bool[np.ndarray, "M n"]
    """True = a piece of a lane is on the agent's route."""


class States(NamedTuple):
    """B scenes at a step and at the ten steps before."""

    track: tuple[Float[np.ndarray, "B A 5"], ...]
    """Motion at the eleven steps, the present one last."""
    directions: tuple[Float[np.ndarray, "B A 2"], ...]
    """Unit vectors along the headings."""
    is_present: Bool[np.ndarray, "11 B A"]
    log_age_s: Float32[np.ndarray, "B A"]
    """Age of the last logged state of replayed agents."""
    colors: Int64[np.ndarray, "B T"]
    """States of the lights."""
    light_age_s: Float[np.ndarray, "B T"]
    is_elsewhere: Bool[np.ndarray, "M _"]
    """True = a feature, in the order of `MapArrays`, or an agent is on another level than the agent that looks."""


@compiled
@no_type_check
def observe_scenes(maps, routes, states, actors, in_own_frame, arrays):
    """Write what agents see.

    Args:
        maps: Maps of all scenes, as `MapArrays`.
        routes: Routes of the agents, as `RouteArrays`.
        states: Scenes at the last eleven steps, as `States`.
        actors: Scene and agent of each agent that looks [M, 2].
        in_own_frame: False = positions in the frame of the map.
        arrays: Arrays of an `Observation` by name, filled with zeros.
    """
    for m in range(len(actors)):
        b, a = actors[m]
        motion = states.track[-1][b, a]
        cos, sin = states.directions[-1][b, a]
        pose = motion[0], motion[1], cos, sin
        frame = pose if in_own_frame else (0.0, 0.0, 1.0, 0.0)
        _observe_map(maps, routes, states, m, b, pose, frame, arrays)
        _observe_route(routes, m, pose, frame, arrays)
        _observe_neighbors(maps, states, m, b, a, frame, arrays)
        _observe_ego(maps, states, m, b, a, frame, arrays)


@compiled
@no_type_check
def _find_nearest(x, y, pose, is_hidden, count):
    """Rows of the nearest features in sight, nearest first: sorted into rings of equal area, then within each ring."""
    squared, ring, ends = np.empty(len(x)), np.empty(len(x), np.int64), np.zeros(RINGS + 2, np.int64)
    for row in range(len(x)):
        to_x, to_y = x[row] - pose[0], y[row] - pose[1]
        squared[row] = to_x * to_x + to_y * to_y
        is_visible = squared[row] <= SEEN_M * SEEN_M and not is_hidden[row]
        ring[row] = int(squared[row] * (RINGS / (SEEN_M * SEEN_M))) if is_visible else RINGS + 1
        ends[ring[row]] += 1
    num_rings = num_rows = 0  # as many as are shown
    while num_rings <= RINGS and num_rows < count:
        num_rows += ends[num_rings]
        ends[num_rings] = num_rows - ends[num_rings]  # where a ring begins, and later ends
        num_rings += 1
    rows = np.empty(num_rows, np.int64)
    for row in range(len(x)):
        if ring[row] < num_rings:
            rows[ends[ring[row]]] = row
            ends[ring[row]] += 1
    for i in range(num_rows):
        row, k = rows[i], i
        while k > 0 and squared[rows[k - 1]] > squared[row]:
            rows[k] = rows[k - 1]
            k -= 1
        rows[k] = row
    return rows[:count]


@compiled
@no_type_check
def _write_point(x, y, frame, columns, column):
    """Write a point in a frame to two columns."""
    _write_vector(x - frame[0], y - frame[1], frame, columns, column)


@compiled
@no_type_check
def _write_vector(x, y, frame, columns, column):
    """Write a vector in a frame to two columns."""
    columns[column] = frame[2] * x + frame[3] * y
    columns[column + 1] = frame[2] * y - frame[3] * x


@compiled
@no_type_check
def _observe_map(maps, routes, states, m, b, pose, frame, arrays):
    """Write lanes, edges, crossings and lights around an agent."""
    colors, light_age_s, end, b = states.colors[b], states.light_age_s[b], 0, maps.of_scene[b]
    points = (maps.lanes, maps.edges, maps.crossings, maps.lights)
    features = (arrays.lanes, arrays.edges, arrays.crossings, arrays.lights)
    masks = (arrays.lanes_mask, arrays.edges_mask, arrays.crossings_mask, arrays.lights_mask)
    for k in range(4):
        start, end = end, end + points[k].shape[1]
        is_hidden = states.is_elsewhere[m, start:end]
        if k == 3:
            is_hidden = is_hidden | (colors == 0)
        corners, columns, mask = points[k][b], features[k][m], masks[k][m]
        rows = _find_nearest(maps.x[b, start:end], maps.y[b, start:end], pose, is_hidden, len(mask))
        for i, row in enumerate(rows):
            mask[i] = 1
            for p in range(corners.shape[1]):
                _write_point(corners[row, p, 0], corners[row, p, 1], frame, columns[i], 2 * p)
            if k == 0:
                columns[i, -5] = maps.lane_facts[b, row, 0]
                columns[i, -4] = maps.lane_facts[b, row, 1]
                columns[i, -3] = colors[maps.lane_lights[b, row]]
                columns[i, -2] = routes.has_lane[m, row]
                columns[i, -1] = maps.lane_facts[b, row, 2]
            elif k == 3:
                columns[i, 2] = colors[row] == RED
                columns[i, 3] = colors[row] == YELLOW
                columns[i, 4] = colors[row] == GREEN
                columns[i, 5] = light_age_s[row]
        if k == 0:
            _compare_with_lane(maps, b, rows[:OWN_LANES], pose, arrays.ego[m])


@compiled
@no_type_check
def _compare_with_lane(maps, b, rows, pose, ego):
    """Write cosine and sine of the heading to the lane, lateral offset to it, and speed limit.

    The lane is that of the nearest point where lanes run the agent's way.
    """
    x, y, cos, sin = pose
    min_squared = np.inf
    for row in rows:
        for p in range(maps.lanes.shape[2]):
            to_x, to_y = maps.lanes[b, row, p, 0] - x, maps.lanes[b, row, p, 1] - y
            lane_cos, lane_sin = maps.lane_directions[b, row, p, 0], maps.lane_directions[b, row, p, 1]
            alignment, squared = cos * lane_cos + sin * lane_sin, to_x * to_x + to_y * to_y
            if alignment > 0 and squared < min_squared:
                min_squared = squared
                ego[6], ego[7] = alignment, sin * lane_cos - cos * lane_sin
                ego[8], ego[9] = to_x * lane_sin - to_y * lane_cos, maps.lane_facts[b, row, 1]


@compiled
@no_type_check
def _observe_route(routes, m, pose, frame, arrays):
    """Write the route from the place nearest to an agent on, and its end."""
    first = find_on_route(routes, m, pose[0], pose[1])
    for i in range(min(arrays.route.shape[1], routes.length[m] - first)):
        arrays.route_mask[m, i] = 1
        _write_point(routes.points[m, first + i, 0], routes.points[m, first + i, 1], frame, arrays.route[m, i], 0)
        arrays.route[m, i, 2] = routes.limit[m, first + i]
    if routes.length[m]:
        _write_point(routes.end[m, 0], routes.end[m, 1], frame, arrays.goal[m], 0)
        arrays.goal[m, 2] = 1.0


@compiled
@no_type_check
def _observe_neighbors(maps, states, m, b, a, frame, arrays):
    """Write the agents around an agent, now and at the ten steps before."""
    motions, last, facts = states.track[-1][b], len(states.track) - 1, maps.agent_facts[maps.of_scene[b]]
    is_hidden = ~states.is_present[last, b] | states.is_elsewhere[m, -len(motions) :]
    is_hidden[a] = True
    rows = _find_nearest(motions[:, 0], motions[:, 1], motions[a], is_hidden, arrays.neighbors.shape[1])
    directions = states.directions[-1][b]
    for i, row in enumerate(rows):
        arrays.neighbors_mask[m, i] = 1
        neighbor = arrays.neighbors[m, i]
        _write_point(motions[row, 0], motions[row, 1], frame, neighbor, 0)
        _write_vector(directions[row, 0], directions[row, 1], frame, neighbor, 2)
        _write_vector(motions[row, 3], motions[row, 4], frame, neighbor, 4)
        neighbor[6], neighbor[7], neighbor[8] = facts[row, 0], facts[row, 1], facts[row, 2]
        neighbor[9] = states.log_age_s[b, row]
    for t in range(last):
        motion, directions = states.track[t][b], states.directions[t][b]
        for i, row in enumerate(rows):
            if states.is_present[t, b, row]:
                history = arrays.neighbors_history[m, i]
                _write_point(motion[row, 0], motion[row, 1], frame, history, 4 * t)
                _write_vector(directions[row, 0], directions[row, 1], frame, history, 4 * t + 2)


@compiled
@no_type_check
def _observe_ego(maps, states, m, b, a, frame, arrays):
    """Write an agent's own numbers, now and at the ten steps before."""
    speed = last_speed = 0.0
    for t in range(len(states.track)):
        motion, history = states.track[t][b, a], arrays.ego_history[m, t]
        cos, sin = states.directions[t][b, a]
        last_speed, speed = speed, sign_speed(motion[3], motion[4], cos, sin)
        if states.is_present[t, b, a]:
            _write_point(motion[0], motion[1], frame, history, 0)
            _write_vector(cos, sin, frame, history, 2)
            history[4] = speed
    ego, facts = arrays.ego[m], maps.agent_facts[maps.of_scene[b], a]
    turn = states.track[-1][b, a, 2] - states.track[-2][b, a, 2]
    yaw_rate = wrap(turn) / STEP_S
    ego[0], ego[1], ego[2] = speed, (speed - last_speed) / STEP_S, yaw_rate
    if abs(speed) > 0.1:
        ego[3] = math.atan(WHEELBASE_PER_LENGTH * float(facts[0]) * yaw_rate / speed)
    ego[4], ego[5], ego[11] = facts[0], facts[1], facts[2]
