"""Distance that a vehicle or cyclist covers along a path by the end of a simulation, at plausible speeds. SI units."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rlftsim.goals.maneuvers.lane_paths import SPACING_M, LanePath
from rlftsim.scenario.types import FUTURE_STEPS, STEP_S

HORIZON_S = FUTURE_STEPS * STEP_S
MIN_SPEED_MPS = 0.3
"""Lower bound on the speed when distances become times, so that a standing agent's arrival stays finite."""
MIN_CURVATURE = 1e-4
"""Lower bound on the curvature, rad/m, so that straight paths have a finite speed limit."""


@dataclass(frozen=True)
class Drive:
    """A driving style: largest accelerations and speeds."""

    acceleration_mps2: float
    braking_mps2: float
    sideways_mps2: float
    """In curves."""
    over_limit: float
    """Factor on speed limits."""


USUAL = Drive(acceleration_mps2=1.2, braking_mps2=2.0, sideways_mps2=2.0, over_limit=1.0)
BRISK = Drive(acceleration_mps2=2.5, braking_mps2=4.0, sideways_mps2=3.5, over_limit=1.2)
"""The fastest style that is still plausible."""


@dataclass(frozen=True)
class Reach:
    """Distances along a path that are plausible after `HORIZON_S`, m."""

    min_m: float
    """Braking all the way."""
    usual_m: float
    max_m: float


def compute_reach(path: LanePath, speed_mps: float) -> Reach:
    """Smallest, usual and greatest plausible distance along a path after `HORIZON_S`.

    Args:
        path: Path that an agent can take; distances count from the first point.
        speed_mps: Speed of the agent at the first point, m/s.
    """
    max_m = min(_compute_distance(path, speed_mps, BRISK), _find_tight_curve(path, speed_mps, BRISK))
    usual_m = min(_compute_distance(path, speed_mps, USUAL), max_m)
    return Reach(min(speed_mps**2 / (2 * BRISK.braking_mps2), max_m), usual_m, max_m)


def _compute_distance(path: LanePath, speed_mps: float, drive: Drive) -> float:
    """Distance after `HORIZON_S` at the highest allowed speeds; at most the length of the path."""
    # 1. Speed that curves and limits allow at each point [S]; an agent above the limit now may keep its speed.
    curve_speed = np.sqrt(drive.sideways_mps2 / np.maximum(np.abs(path.curvature), MIN_CURVATURE))
    max_speed = np.minimum(curve_speed, np.maximum(path.speed_limit_mps * drive.over_limit, speed_mps))
    # 2. Constant acceleration is linear in (squared speed, distance), v² = v0² + 2 a s: one backward pass keeps the
    #    braking in time for what comes, one forward pass the acceleration from the start.
    squared_speed = _running_bound(max_speed[::-1] ** 2, 2 * drive.braking_mps2)[::-1]
    squared_speed[0] = min(squared_speed[0], speed_mps**2)
    # 3. Time of arrival at each point, inverted at the horizon.
    speed = np.sqrt(_running_bound(squared_speed, 2 * drive.acceleration_mps2))
    pace = SPACING_M / np.maximum((speed[1:] + speed[:-1]) / 2, MIN_SPEED_MPS)
    arrival_s = np.append(0.0, pace.cumsum())
    return float(np.interp(HORIZON_S, arrival_s, SPACING_M * np.arange(len(speed))))


def _running_bound(squared_speed: Float[np.ndarray, "S"], gain: float) -> Float[np.ndarray, "S"]:
    """Squared speeds, lowered until none exceeds an earlier squared speed by more than `gain` per meter between."""
    slope = gain * SPACING_M * np.arange(len(squared_speed))
    return np.minimum.accumulate(squared_speed - slope) + slope


def _find_tight_curve(path: LanePath, speed_mps: float, drive: Drive) -> float:
    """Distance to the first point where the curve is too tight even after full braking; else infinite."""
    squared_bound = drive.sideways_mps2 / np.maximum(np.abs(path.curvature), MIN_CURVATURE)
    squared_speed = speed_mps**2 - 2 * drive.braking_mps2 * SPACING_M * np.arange(len(squared_bound))
    steps = np.flatnonzero(squared_speed > squared_bound)
    return float(SPACING_M * steps[0]) if len(steps) else float("inf")
