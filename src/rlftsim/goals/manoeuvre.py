"""What a driver may do next, and how a way driven is named."""

from enum import StrEnum

import numpy as np

STRAIGHT_RAD = np.radians(30.0)
"""A way that turns less goes straight on, as in a data set's index."""
UTURN_RAD = np.radians(135.0)
"""A way that turns at least so much turns round."""


class Manoeuvre(StrEnum):
    """The six manoeuvres of the paper's benchmark."""

    STRAIGHT = "straight"
    LEFT = "left"
    RIGHT = "right"
    LEFT_UTURN = "left_uturn"
    LANE_CHANGE_LEFT = "lane_change_left"
    LANE_CHANGE_RIGHT = "lane_change_right"

    @property
    def usual_turn_rad(self) -> float:
        """How much one turns in the clearest case, counter-clockwise."""
        turns = {Manoeuvre.LEFT: 90.0, Manoeuvre.RIGHT: -90.0, Manoeuvre.LEFT_UTURN: 180.0}
        return float(np.radians(turns.get(self, 0.0)))


def manoeuvre_of_turn(turn_rad: float) -> Manoeuvre | None:
    """Name of a way by the change of heading along it; None for turning round to the right, which has no name here.

    Args:
        turn_rad: heading at the end minus heading at the start, turned continuously.
    """
    if abs(turn_rad) < STRAIGHT_RAD:
        return Manoeuvre.STRAIGHT
    if turn_rad >= UTURN_RAD:
        return Manoeuvre.LEFT_UTURN
    if turn_rad <= -UTURN_RAD:
        return None
    return Manoeuvre.LEFT if turn_rad > 0 else Manoeuvre.RIGHT
