"""Maneuvers: names of paths by the change of heading, for the index of a data set and for goal proposals."""

from enum import StrEnum

import numpy as np

STRAIGHT_RAD = np.radians(30.0)
"""A path that turns by less goes straight."""
UTURN_RAD = np.radians(135.0)
"""A path that turns by at least this much is a U-turn."""


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
