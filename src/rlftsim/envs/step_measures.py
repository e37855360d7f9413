"""What a step of 0.1 s means for planner-driven agents: boxes in reach, and the way along the route."""

import math
from typing import no_type_check

import numpy as np

from rlftsim.envs.actions import wrap
from rlftsim.envs.compiled import compiled
from rlftsim.envs.route import SPACING_M


@compiled
@no_type_check
def measure_steps(previous, moved, half_diagonal, actors, motion, is_observed, reach_m, routes, in_reach, measures):
    """Measure a step of each agent.

    Args:
        previous: Motion of the agents before the step [M, 5].
        moved: Motion after the step [M, 5].
        half_diagonal: Half of the diagonals of the agents' boxes [M], m.
        actors: Scene and agent of each agent [M, 2].
        motion: Motion of all agents after the step [B, A, 5].
        is_observed: True = the agent is there [B, A].
        reach_m: Distances at which boxes may overlap [M, A], negative for an agent itself.
        routes: Routes of the agents, as `RouteArrays`.
        in_reach: Array [M, A] that takes True for each box in reach.
        measures: Array [M, 4] that takes the longest way of a corner, the distance along the route (0 without one), the
            way ahead, and the distance to the route's end, m.
    """
    for m in range(len(actors)):
        b, (x, y, heading) = actors[m, 0], moved[m, :3]
        dx, dy, turn = x - previous[m, 0], y - previous[m, 1], heading - previous[m, 2]
        measures[m, 0] = np.hypot(dx, dy) + abs(wrap(turn)) * half_diagonal[m]
        measures[m, 2] = math.cos(heading) * dx + math.sin(heading) * dy
        measures[m, 3] = np.hypot(x - routes.end[m, 0], y - routes.end[m, 1])
        for a in range(motion.shape[1]):
            reach, to_x, to_y = reach_m[m, a], motion[b, a, 0] - x, motion[b, a, 1] - y
            in_reach[m, a] = is_observed[b, a] and reach > 0 and to_x * to_x + to_y * to_y <= reach * reach
        measures[m, 1] = 0.0
        if routes.length[m]:
            row = find_on_route(routes, m, x, y)
            to_x, to_y = x - routes.points[m, row, 0], y - routes.points[m, row, 1]
            forward = routes.direction[m, row, 0] * to_x + routes.direction[m, row, 1] * to_y
            measures[m, 1] = SPACING_M * row + forward


@compiled
@no_type_check
def find_on_route(routes, m, x, y):
    """Row of the point of an agent's route that is nearest to a place; 0 without a route.

    Args:
        routes: Routes of the agents, as `RouteArrays`.
        m: Row of the agent.
        x: Coordinate of the place, m.
        y: Coordinate of the place, m.
    """
    nearest, min_squared = 0, np.inf
    for row in range(routes.length[m]):
        to_x, to_y = x - routes.points[m, row, 0], y - routes.points[m, row, 1]
        if to_x * to_x + to_y * to_y < min_squared:
            nearest, min_squared = row, to_x * to_x + to_y * to_y
    return nearest
