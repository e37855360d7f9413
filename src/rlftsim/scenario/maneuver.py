"""Maneuvers: names of paths by the change of heading, for the index and for goal proposals; names of conflicts."""

from enum import StrEnum

import numpy as np

from rlftsim.scenario.types import CURRENT_STEP, Scenario

STRAIGHT_RAD = np.radians(30.0)
"""A path that turns by less goes straight."""
UTURN_RAD = np.radians(135.0)
"""A path that turns by at least this much is a U-turn."""
_STATIONARY_SPEED_MPS = 2.0
_STATIONARY_DISTANCE_M = 5.0


class Maneuver(StrEnum):
    """Maneuver of an agent between the current step and the end of its log."""

    STRAIGHT = "straight"
    LEFT = "left"
    RIGHT = "right"
    LEFT_UTURN = "left_uturn"
    LANE_CHANGE_LEFT = "lane_change_left"
    LANE_CHANGE_RIGHT = "lane_change_right"
    UTURN = "uturn"
    """A U-turn to either side: the index does not distinguish them."""
    STATIONARY = "stationary"
    UNKNOWN = "unknown"
    """The future is withheld, or the agent is not valid in it."""

    @property
    def usual_turn_rad(self) -> float:
        """Change of heading in the clearest case, counter-clockwise."""
        turns = {Maneuver.LEFT: 90.0, Maneuver.RIGHT: -90.0, Maneuver.LEFT_UTURN: 180.0}
        return float(np.radians(turns.get(self, 0.0)))


BENCHMARK_MANEUVERS = (
    *(Maneuver.STRAIGHT, Maneuver.LEFT, Maneuver.RIGHT),
    *(Maneuver.LEFT_UTURN, Maneuver.LANE_CHANGE_LEFT, Maneuver.LANE_CHANGE_RIGHT),
)
"""The six of the paper's maneuver benchmark, which goals are proposed for."""
VEHICLE_CONFLICTS = ("following", "merging", "crossing")
"""Conflicts of the ego with vehicles; windows with any of these are the conflict windows."""


def classify_turn(turn_rad: float) -> Maneuver | None:
    """Maneuver of a path by the change of heading; None for a U-turn to the right, for which the benchmark has no name.

    Args:
        turn_rad: Heading at the end minus heading at the start, turned continuously, rad, counter-clockwise.
    """
    if abs(turn_rad) < STRAIGHT_RAD:
        return Maneuver.STRAIGHT
    if turn_rad >= UTURN_RAD:
        return Maneuver.LEFT_UTURN
    if turn_rad <= -UTURN_RAD:
        return None
    return Maneuver.LEFT if turn_rad > 0 else Maneuver.RIGHT


def classify_ego_maneuver(scenario: Scenario) -> Maneuver:
    """Maneuver of the ego's logged track from the current step to its last valid step.

    Stationary: never faster than 2 m/s and it ends within 5 m. Else by the change of heading, turned continuously:
    below 30 degrees straight (lane changes too), from 135 degrees a U-turn, in between left (counter-clockwise) or
    right.
    """
    tracks, ego = scenario.tracks, scenario.ego_index
    steps = CURRENT_STEP + np.flatnonzero(tracks.valid[ego, CURRENT_STEP:])
    if not scenario.has_future or len(steps) < 2:
        return Maneuver.UNKNOWN
    distance_m = np.linalg.norm(tracks.position[ego, steps[-1], :2] - tracks.position[ego, steps[0], :2])
    # both conditions: a slow car in a queue gets away, and a fast one may come back to its start
    with np.errstate(over="ignore"):  # a velocity of 1e38 m/s is none, and its length is infinite
        top_speed_mps = np.linalg.norm(tracks.velocity[ego, steps], axis=-1).max()
    if top_speed_mps < _STATIONARY_SPEED_MPS and distance_m < _STATIONARY_DISTANCE_M:
        return Maneuver.STATIONARY
    # unwrapped, so that a turn through pi counts as the small turn it is
    heading = np.unwrap(tracks.heading[ego, steps].astype(np.float64))
    maneuver = classify_turn(float(heading[-1] - heading[0]))
    return Maneuver.UTURN if maneuver in (Maneuver.LEFT_UTURN, None) else maneuver
