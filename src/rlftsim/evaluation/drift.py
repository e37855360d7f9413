"""Departure of simulated traffic from the log in ways that drivers would name: speed, stops, lanes, contacts.

The meta-metric rewards slow traffic, which hits nothing and stays on the road. These numbers, reported beside it, show
at what price a score was reached: means over evaluated agents and rollouts of a scenario.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from rlftsim.geometry import boxes_overlap, wrapped
from rlftsim.realism import SimulatedStates
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.polylines import densify
from rlftsim.scenario.types import (
    CURRENT_STEP,
    MOVING_M_S,
    STEP_S,
    STOP_M_S,
    STOP_STEPS,
    TOTAL_STEPS,
    ObjectType,
    Scenario,
    cached_on_scenario,
)

LANE_SPACING_M = 1.0
LANE_REACH_M = 3.0
"""Farther from every lane center a vehicle is not in a lane."""
LANE_HEADING = np.radians(60.0)
"""Lanes of another direction than this are crossed, not followed."""
STRAIGHT_RADIUS_M = 100.0
"""Lanes of a larger radius are straight."""
FASTEST_M_S = 60.0
"""Faster steps are no driving."""
LANE_STEPS = 5
"""Lanes are looked up at every fifth step."""


class Drift(NamedTuple):
    """See the fields; NaN where a scenario has no such agent, lane or contact."""

    speed_gap: float
    """Mean speed of moving agents minus that of their log, m/s; negative = slower than the log."""
    speed_gap_all: float
    """The same over all simulated agents, not the evaluated ones alone."""
    speed_p10: float
    """Percentiles of the speed of moving agents, m/s."""
    speed_p50: float
    speed_p90: float
    unlogged_stop_rate: float
    """Moving agents that stop, of those whose log does not."""
    lane_offset_straight: float
    """Mean distance of vehicles from the center of their lane, m, on straight lanes."""
    lane_offset_curved: float
    lane_heading_straight: float
    """Mean absolute angle between vehicles and their lane, rad, on straight lanes."""
    lane_heading_curved: float
    contact_speed: float
    """Mean relative speed of the first contact of agents that collide, m/s."""


def measure_drift(scenario: Scenario, states: SimulatedStates) -> Drift:
    """Drift of a scenario's rollouts; the drift of the log shows the numbers of a perfect model.

    Args:
        scenario: Scenario with the logged future.
        states: Rollouts of the scenario; repeated rollouts count once, which changes no mean.
    """
    # 1. Agents in the order of the scenario's tracks, from the current step on.
    tracks, everyone = scenario.tracks, scenario.simulated_indices
    rows = states.find_rows(tracks.object_id[everyone])
    x, y, angle = (v.cpu().numpy()[:, rows].astype(np.float64) for v in (states.x, states.y, states.heading))
    start = np.broadcast_to(tracks.position[everyone, CURRENT_STEP, :2], (len(x), len(everyone), 2))  # [N, A, 2]
    position = np.concatenate([start[:, :, None], np.stack([x, y], -1)], 2)  # [N, A, 81, 2]
    velocity = np.diff(position, axis=2) / STEP_S  # [N, A, 80, 2]
    evaluated = np.flatnonzero(np.isin(everyone, scenario.evaluated_indices))  # [E], places among all simulated agents
    # 2. Speeds at the steps at which the log has one.
    window = slice(CURRENT_STEP, TOTAL_STEPS)
    valid = tracks.valid[everyone, window]
    valid = valid[:, 1:] & valid[:, :-1]  # [A, 80]
    logged = np.linalg.norm(np.diff(tracks.position[everyone, window, :2].astype(np.float64), axis=1), axis=-1) / STEP_S
    speed = np.linalg.norm(velocity, axis=-1)  # [N, A, 80]
    mean_logged = np.where(valid, logged, 0.0).sum(1) / np.maximum(valid.sum(1), 1)
    moving = mean_logged >= MOVING_M_S  # [A]
    gap_simulated = _speed_gap(speed, logged, moving[:, None] & valid)
    valid, logged, speed, moving = valid[evaluated], logged[evaluated], speed[:, evaluated], moving[evaluated]
    tracked = everyone[evaluated]
    counted = speed[:, moving[:, None] & valid]  # [N, moving steps]
    gap = _speed_gap(speed, logged, moving[:, None] & valid)
    slow, median, fast = (float(p) for p in np.percentile(counted, (10, 50, 90))) if counted.size else [math.nan] * 3
    # 3. Stops that the log does not have.
    never_stops = moving & ~_stops(logged, valid)
    stops = _stops(speed[:, never_stops], valid[never_stops])  # [N, agents]
    offset, turned = _measure_lanes(scenario, position[:, evaluated, 1:], angle[:, evaluated], tracked)
    contact = _contact_speed(scenario, position[:, :, 1:], angle, velocity, everyone, evaluated)
    return Drift(gap, gap_simulated, slow, median, fast, _mean(stops), *offset, *turned, contact)


def _speed_gap(
    speed: Float[np.ndarray, "N A T"], logged: Float[np.ndarray, "A T"], counted: Bool[np.ndarray, "A T"]
) -> float:
    """Mean speed minus the mean logged speed at the steps that are counted."""
    return float(speed[:, counted].mean() - logged[counted].mean()) if counted.any() else math.nan


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")


def _stops(speed: Float[np.ndarray, "*n T"], valid: Bool[np.ndarray, "k T"]) -> Bool[np.ndarray, "*n"]:
    """True for agents that stand for `STOP_STEPS` valid steps on end."""
    stands = (speed < STOP_M_S) & valid
    return np.asarray(np.lib.stride_tricks.sliding_window_view(stands, STOP_STEPS, axis=-1).all(-1).any(-1))


class LanePoints(NamedTuple):
    """Points along the centers of all lanes."""

    tree: KDTree
    position: Float[np.ndarray, "P 2"]
    heading: Float[np.ndarray, "P"]
    curved: Bool[np.ndarray, "P"]


@cached_on_scenario
def find_lane_points(scenario: Scenario) -> LanePoints | None:
    """Points of a scenario's lanes, world frame, m; None where the map has no lane."""
    lines = []
    for line in lane_graph(scenario).lines:
        points = densify(line[:, :2], LANE_SPACING_M)
        tangent = np.gradient(points, axis=0)
        heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        step = np.maximum(np.linalg.norm(tangent, axis=-1), 1e-6)
        # A polyline turns at its corners alone: its curvature is that over some meters to both sides.
        turn = np.abs(np.gradient(np.convolve(np.pad(heading, 3, mode="edge"), np.full(7, 1 / 7), "valid")))
        lines.append((points, heading, turn / step > 1 / STRAIGHT_RADIUS_M))
    if not lines:
        return None
    position, heading, curved = (np.concatenate(arrays) for arrays in zip(*lines))
    return LanePoints(KDTree(position), position, heading, curved)


def _measure_lanes(
    scenario: Scenario,
    position: Float[np.ndarray, "N E T 2"],
    angle: Float[np.ndarray, "N E T"],
    tracked: Int[np.ndarray, "E"],
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Mean offset from the lane center, m, and mean angle to the lane, rad; each on straight and on curved lanes."""
    lanes = find_lane_points(scenario)
    vehicles = scenario.tracks.object_type[tracked] == ObjectType.VEHICLE
    if lanes is None or not vehicles.any():
        return (float("nan"), float("nan")), (float("nan"), float("nan"))
    points = position[:, vehicles, LANE_STEPS - 1 :: LANE_STEPS].reshape(-1, 2)  # [P, 2]
    heading = angle[:, vehicles, LANE_STEPS - 1 :: LANE_STEPS].reshape(-1)
    # Of the points in reach the nearest along whose lane the vehicle drives: crossings lie on top of each other.
    distance, index = lanes.tree.query(points, k=16, distance_upper_bound=LANE_REACH_M)  # [P, 16]
    index = np.minimum(index, len(lanes.heading) - 1)  # missing neighbors have an infinite distance
    turned = np.abs(wrapped(heading[:, None] - lanes.heading[index]))
    first = np.where(turned <= LANE_HEADING, distance, np.inf).argmin(1)[:, None]
    nearest, error = (np.take_along_axis(v, first, 1)[:, 0] for v in (index, turned))
    is_in_lane = np.isfinite(np.take_along_axis(distance, first, 1)[:, 0]) & (error <= LANE_HEADING)
    lane_heading = lanes.heading[nearest]
    gap = points - lanes.position[nearest]
    offset = np.abs(np.cos(lane_heading) * gap[:, 1] - np.sin(lane_heading) * gap[:, 0])  # across the lane
    straight, curved = is_in_lane & ~lanes.curved[nearest], is_in_lane & lanes.curved[nearest]
    return (_mean(offset[straight]), _mean(offset[curved])), (_mean(error[straight]), _mean(error[curved]))


def _contact_speed(
    scenario: Scenario,
    position: Float[np.ndarray, "N A T 2"],
    angle: Float[np.ndarray, "N A T"],
    velocity: Float[np.ndarray, "N A T 2"],
    everyone: Int[np.ndarray, "A"],
    evaluated: Int[np.ndarray, "E"],
) -> float:
    """Mean relative speed at the first contact of evaluated agents with any agent, m/s."""
    size = scenario.tracks.size[everyone, CURRENT_STEP, :2].astype(np.float64)  # [A, 2], length and width
    reach = np.linalg.norm(size, axis=-1) / 2
    # In the log an agent that is lost stands at the origin, and comes back at once: it did not drive there.
    drove = np.linalg.norm(velocity, axis=-1) < FASTEST_M_S  # [N, A, T]
    speeds = []
    for agent in evaluated:
        gap = position - position[:, agent, None]  # [N, A, T, 2]
        is_candidate = (gap**2).sum(-1) < (reach + reach[agent])[:, None] ** 2
        is_candidate[:, agent] = False
        is_candidate &= drove & drove[:, agent, None]
        rollout, partner, step = is_candidate.nonzero()
        partner_angle = angle[is_candidate]
        hit = boxes_overlap(gap[is_candidate], angle[rollout, agent, step], partner_angle, size[agent], size[partner])
        rollout, partner, step = rollout[hit], partner[hit], step[hit]
        # The first contact of each rollout: pairs sorted by step, then the first of every rollout.
        order = np.lexsort((step, rollout))
        first = order[np.unique(rollout[order], return_index=True)[1]]
        closing = velocity[rollout, agent, step] - velocity[rollout, partner, step]
        speeds.append(np.linalg.norm(closing[first], axis=-1))
    return _mean(np.concatenate([np.zeros(0), *speeds]))
