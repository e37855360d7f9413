"""Boxes from what SUMO has shown so far, for logs and for logs that are run again.

Plain numbers in a fixed order of operations, so that a log that SUMO repeats has the same bits. Plan coordinates, m.
"""

import math
from typing import NamedTuple

from rlftsim.scenario.types import STEP_S, ObjectType

REAR_AXLE_FROM_BUMPER = 0.78
"""Fraction of the length between front bumper and rear axle."""
WALKER_REACH_M = 0.4
WALKER_SMOOTHING = 0.2
"""Fraction of the way to a pedestrian, whom SUMO moves in jerks, that the box covers in a step."""

SumoPose = tuple[float, float, float]
"""Position that SUMO reports, of a vehicle the front bumper's, and the angle in degrees clockwise from north."""
BodyMotion = tuple[float, float, float, float, float]
"""x, y, heading, vx, vy of the center."""


class BodyShape(NamedTuple):
    """Constants of a body that SUMO's position drags along."""

    reach_m: float
    """Distance from the front back to the axle, which cannot slip sideways."""
    ahead_m: float
    """Distance from the center forward to the front."""
    left_m: float
    """Habit of the driver: offset to the left of the lane's center."""
    smoothing: float
    """Fraction of the way to SUMO's position that the front covers in a step."""


class BodyState(NamedTuple):
    """All that the next box depends on besides SUMO's next pose."""

    front_x: float
    front_y: float
    axle_x: float
    axle_y: float
    center_x: float
    center_y: float


def build_shape(object_type: ObjectType, length_m: float, left_m: float = 0.0) -> BodyShape:
    """Constants of a body.

    Args:
        object_type: Type of the road user; SUMO reports the center of a pedestrian.
        length_m: Length of the body, m.
        left_m: Habit of the driver, m to the left of the lane's center.
    """
    if object_type == ObjectType.PEDESTRIAN:
        return BodyShape(WALKER_REACH_M, 0.0, 0.0, WALKER_SMOOTHING)
    return BodyShape(REAR_AXLE_FROM_BUMPER * length_m, length_m / 2, left_m, 1.0)


def begin_body(shape: BodyShape, pose: SumoPose) -> BodyState:
    """State of a body when SUMO shows it for the first time: directed along SUMO's angle.

    Args:
        shape: Constants of the body.
        pose: First pose that SUMO reports.
    """
    angle = math.radians(90.0 - pose[2])
    return _put_behind(shape, *_move_left(shape, pose), math.cos(angle), math.sin(angle))


def advance_body(shape: BodyShape, state: BodyState, pose: SumoPose) -> tuple[BodyState, BodyMotion]:
    """State and box of a body 0.1 s later: the axle is dragged behind the front (a tractrix).

    Args:
        shape: Constants of the body.
        state: State before the step.
        pose: Pose that SUMO reports after the step.
    """
    x, y = _move_left(shape, pose)
    if shape.smoothing < 1.0:
        x = state.front_x + shape.smoothing * (x - state.front_x)
        y = state.front_y + shape.smoothing * (y - state.front_y)
    dx, dy = x - state.axle_x, y - state.axle_y
    distance = math.sqrt(dx * dx + dy * dy) or 1.0
    dx, dy = dx / distance, dy / distance
    following = _put_behind(shape, x, y, dx, dy)
    velocity = (following.center_x - state.center_x) / STEP_S, (following.center_y - state.center_y) / STEP_S
    return following, (following.center_x, following.center_y, math.atan2(dy, dx), *velocity)


def _put_behind(shape: BodyShape, x: float, y: float, dx: float, dy: float) -> BodyState:
    """State of a body whose front is at x, y and which points along dx, dy."""
    reach_m, ahead_m, *_ = shape
    return BodyState(x, y, x - reach_m * dx, y - reach_m * dy, x - ahead_m * dx, y - ahead_m * dy)


def _move_left(shape: BodyShape, pose: SumoPose) -> tuple[float, float]:
    """SUMO's position moved by the habit of the driver."""
    angle = math.radians(90.0 - pose[2])
    return pose[0] - shape.left_m * math.sin(angle), pose[1] + shape.left_m * math.cos(angle)
