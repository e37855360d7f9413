"""Maneuvers that agents made in the log, named as the proposals are. Frame: world, m."""

import numpy as np
from jaxtyping import Float

from rlftsim.goals.maneuvers.lane_paths import lanes_for
from rlftsim.goals.maneuvers.proposals import (
    KINDS,
    LANE_CHANGE_OFFSET_M,
    LANE_CHANGES,
    NEAREST_GOAL_M,
    CurrentAgent,
    Proposal,
    distance_to,
    own_paths,
)
from rlftsim.goals.maneuvers.side_paths import lane_change_paths
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.maneuver import Maneuver, maneuver_of_turn
from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario

IN_LANE_M = 1.5
"""Greatest distance to the middle of a lane for an agent that is in it."""
BEYOND_END_M = 10.0
"""Paths along the lanes are searched so far beyond the logged distance."""


def logged_maneuver(scenario: Scenario, track: int) -> Proposal | None:
    """Logged maneuver and endpoint of a vehicle or cyclist; None if it hardly moved or has no logged future.

    Turns are named by the change of heading. An agent that went straight has changed lanes if its endpoint is in a
    neighboring lane and in none that its own lane continues into.

    Args:
        scenario: with its future.
        track: index of a simulated track.
    """
    # 1. The logged path from the current step on, and the change of heading along it.
    tracks = scenario.tracks
    if int(tracks.object_type[track]) not in KINDS:
        return None
    steps = CURRENT_STEP + np.flatnonzero(tracks.valid[track, CURRENT_STEP:])
    way = tracks.position[track, steps].astype(np.float64)  # [S, 3]
    if np.linalg.norm(way[-1, :2] - way[0, :2]) < NEAREST_GOAL_M:
        return None
    heading = np.unwrap(tracks.heading[track, steps].astype(np.float64))
    # 2. Its name.
    maneuver = maneuver_of_turn(float(heading[-1] - heading[0]))
    if maneuver == Maneuver.STRAIGHT:
        maneuver = _lane_change(scenario, track, way) or maneuver
    if maneuver is None:
        return None
    return Proposal(int(tracks.object_id[track]), maneuver, way[-1, :2], way, is_logged=True)


def _lane_change(scenario: Scenario, track: int, way: Float[np.ndarray, "S 3"]) -> Maneuver | None:
    """Lane change that a straight path ends with, if any."""
    agent = CurrentAgent.of(scenario, track)
    if agent.kind != ObjectType.VEHICLE:
        return None
    lanes = lanes_for(lane_graph(scenario), agent.kind)
    driven_m = float(np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1).sum())
    own = own_paths(agent, lanes, length_m=driven_m + BEYOND_END_M)
    if not own or distance_to(own, way[-1]) < LANE_CHANGE_OFFSET_M:
        return None
    for maneuver, side in LANE_CHANGES:
        # At speed 0 the change is as short as it can be: the path is soon in the middle of the other lane.
        beside = [
            path
            for one in own
            for path, _ in lane_change_paths(lanes, one, side=side, speed_mps=0.0, length_m=driven_m + BEYOND_END_M)
        ]
        if beside and distance_to(beside, way[-1]) < IN_LANE_M:
            return maneuver
    return None
