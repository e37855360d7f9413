"""What an agent did in the record, in the words of the proposals. Frame: world, metres."""

import numpy as np
from jaxtyping import Float

from rlftsim.goals.lane_paths import lanes_for
from rlftsim.goals.manoeuvre import Manoeuvre, manoeuvre_of_turn
from rlftsim.goals.proposals import (
    KINDS,
    LANE_CHANGE_OFFSET_M,
    NEAREST_GOAL_M,
    Driver,
    Proposal,
    distance_to,
    own_paths,
)
from rlftsim.goals.side_paths import lane_change_paths
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario

IN_LANE_M = 1.5
"""From the middle of a lane, for somebody who is in it."""
BEYOND_END_M = 10.0
"""Ways along the lanes are looked at so far beyond the way driven."""


def recorded_manoeuvre(scenario: Scenario, track: int) -> Proposal | None:
    """What a simulated vehicle or cyclist did and where the record left it; None where it hardly moved or nothing is recorded.

    Turns are named by the change of heading. Who went straight has changed lanes if its end is in a neighbouring lane, and
    in none that its own one leads to.
    """
    recorded = _recorded_way(scenario, track)
    if recorded is None:
        return None
    way, turn = recorded
    manoeuvre = manoeuvre_of_turn(turn)
    if manoeuvre == Manoeuvre.STRAIGHT:
        manoeuvre = _lane_change(scenario, track, way) or manoeuvre
    if manoeuvre is None:
        return None
    object_id = int(scenario.tracks.object_id[track])
    return Proposal(object_id, manoeuvre, way[-1, :2], way, is_recorded=True)


def _recorded_way(scenario: Scenario, track: int) -> tuple[Float[np.ndarray, "S 3"], float] | None:
    """Positions from the current step on and the change of heading along them."""
    tracks = scenario.tracks
    if int(tracks.object_type[track]) not in KINDS:
        return None
    steps = CURRENT_STEP + np.flatnonzero(tracks.valid[track, CURRENT_STEP:])
    way = tracks.position[track, steps].astype(np.float64)
    if np.linalg.norm(way[-1, :2] - way[0, :2]) < NEAREST_GOAL_M:
        return None
    heading = np.unwrap(tracks.heading[track, steps].astype(np.float64))
    return way, float(heading[-1] - heading[0])


def _lane_change(scenario: Scenario, track: int, way: Float[np.ndarray, "S 3"]) -> Manoeuvre | None:
    """Which lane change a straight way ends with, if any."""
    driver = Driver.of(scenario, track)
    if driver.kind != ObjectType.VEHICLE:
        return None
    lanes = lanes_for(lane_graph(scenario), driver.kind)
    driven_m = float(np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1).sum())
    own = own_paths(driver, lanes, length_m=driven_m + BEYOND_END_M)
    if not own or distance_to(own, way[-1]) < LANE_CHANGE_OFFSET_M:
        return None
    for manoeuvre, side in ((Manoeuvre.LANE_CHANGE_LEFT, 1), (Manoeuvre.LANE_CHANGE_RIGHT, -1)):
        beside = [
            path
            for one in own
            for path, _ in lane_change_paths(lanes, one, side=side, speed_mps=0.0, length_m=driven_m + BEYOND_END_M)
        ]
        if beside and distance_to(beside, way[-1]) < IN_LANE_M:
            return manoeuvre
    return None
