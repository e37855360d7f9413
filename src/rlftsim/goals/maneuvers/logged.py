"""Maneuvers that agents made in the log, with the names of proposals. Frame: world, m."""

import numpy as np
from jaxtyping import Float

from rlftsim.goals.maneuvers.lane_paths import lanes_for
from rlftsim.goals.maneuvers.proposals import (
    LANE_AGENT_TYPES,
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
from rlftsim.scenario.maneuver import Maneuver, classify_turn
from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario

IN_LANE_M = 1.5
"""Greatest distance to the middle of a lane for an agent in the lane."""
BEYOND_END_M = 10.0
"""Paths along the lanes are searched so far beyond the logged distance."""


def logged_maneuver(scenario: Scenario, track: int) -> Proposal | None:
    """Logged maneuver and endpoint of a vehicle or cyclist; None for hardly any motion or no logged future.

    Turns are named by the change of heading. An agent that went straight has changed lanes if the endpoint is in a
    neighboring lane and in no lane that the own lane continues into.

    Args:
        scenario: Scenario with its logged future.
        track: Index of a simulated track in the scenario.
    """
    # 1. The logged path from the current step on, and the change of heading along it.
    tracks = scenario.tracks
    if int(tracks.object_type[track]) not in LANE_AGENT_TYPES:
        return None
    steps = CURRENT_STEP + np.flatnonzero(tracks.valid[track, CURRENT_STEP:])
    path = tracks.position[track, steps].astype(np.float64)  # [S, 3]
    if np.linalg.norm(path[-1, :2] - path[0, :2]) < NEAREST_GOAL_M:
        return None
    heading = np.unwrap(tracks.heading[track, steps].astype(np.float64))
    # 2. Its name.
    maneuver = classify_turn(float(heading[-1] - heading[0]))
    if maneuver == Maneuver.STRAIGHT:
        maneuver = _find_lane_change(scenario, track, path) or maneuver
    if maneuver is None:
        return None
    return Proposal(int(tracks.object_id[track]), maneuver, path[-1, :2], path, is_logged=True)


def _find_lane_change(scenario: Scenario, track: int, path: Float[np.ndarray, "S 3"]) -> Maneuver | None:
    """Lane change at the end of a straight path, if any."""
    agent = CurrentAgent.from_track(scenario, track)
    if agent.object_type != ObjectType.VEHICLE:
        return None
    lanes = lanes_for(lane_graph(scenario), agent.object_type)
    length_m = float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum()) + BEYOND_END_M
    paths = own_paths(agent, lanes, length_m=length_m)
    if not paths or distance_to(paths, path[-1]) < LANE_CHANGE_OFFSET_M:
        return None
    for maneuver, side in LANE_CHANGES:
        # At speed 0 the change is as short as it can be: the path is soon in the middle of the other lane.
        changes = [lane_change_paths(lanes, start, side=side, speed_mps=0.0, length_m=length_m) for start in paths]
        neighbor_paths = [neighbor_path for candidates in changes for neighbor_path, _ in candidates]
        if neighbor_paths and distance_to(neighbor_paths, path[-1]) < IN_LANE_M:
            return maneuver
    return None
