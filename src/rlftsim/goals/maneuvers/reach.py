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
    """A driving style: the accelerations and speeds that it uses at most."""

    acceleration_mps2: float
    braking_mps2: float
    sideways_mps2: float
    """In curves."""
    over_limit: float
    """Factor on speed limits."""


USUAL = Drive(acceleration_mps2=1.2, braking_mps2=2.0, sideways_mps2=2.0, over_limit=1.0)
BRISK = Drive(acceleration_mps2=2.5, braking_mps2=4.0, sideways_mps2=3.5, over_limit=1.2)
"""The most that is still plausible."""


@dataclass(frozen=True)
class Reach:
    """Distances along a path that are plausible after `HORIZON_S`, m."""

    least_m: float
    """Braking all the way."""
    usual_m: float
    most_m: float


def reach_along(path: LanePath, speed_mps: float) -> Reach:
    """Least, usual and greatest plausible distance along a path after `HORIZON_S`.

    Args:
        path: the way an agent can take; distances count from its first point.
        speed_mps: at the path's start.
    """
    most = min(_distance_after(path, speed_mps, BRISK), _too_fast_from(path, speed_mps, BRISK))
    usual = min(_distance_after(path, speed_mps, USUAL), most)
    least = min(speed_mps**2 / (2 * BRISK.braking_mps2), most)
    return Reach(least, usual, most)


def _distance_after(path: LanePath, speed_mps: float, drive: Drive) -> float:
    """Distance after `HORIZON_S` at the highest allowed speeds; at most the length of the path."""
    # 1. Speed that curves and limits allow at each point [S]; an agent above the limit now may keep its speed.
    curve = np.sqrt(drive.sideways_mps2 / np.maximum(np.abs(path.curvature), MIN_CURVATURE))
    allowed = np.minimum(curve, np.maximum(path.speed_limit_mps * drive.over_limit, speed_mps))
    # 2. Constant acceleration is linear in (squared speed, distance), v² = v0² + 2 a s: one backward pass keeps the
    #    braking in time for what comes, one forward pass the acceleration from the start.
    squared = _running_bound(allowed[::-1] ** 2, 2 * drive.braking_mps2)[::-1]
    squared[0] = min(squared[0], speed_mps**2)
    squared = _running_bound(squared, 2 * drive.acceleration_mps2)
    # 3. Time of arrival at each point, inverted at the horizon.
    speed = np.sqrt(squared)
    pace = SPACING_M / np.maximum((speed[1:] + speed[:-1]) / 2, MIN_SPEED_MPS)
    arrival_s = np.append(0.0, pace.cumsum())
    return float(np.interp(HORIZON_S, arrival_s, SPACING_M * np.arange(len(speed))))


def _running_bound(squared: Float[np.ndarray, "S"], gain: float) -> Float[np.ndarray, "S"]:
    """Squared speeds, lowered until none exceeds an earlier one by more than `gain` per meter between them."""
    slope = gain * SPACING_M * np.arange(len(squared))
    return np.minimum.accumulate(squared - slope) + slope


def _too_fast_from(path: LanePath, speed_mps: float, drive: Drive) -> float:
    """Distance to the first point whose curve is too tight even after full braking; infinite if there is none."""
    curve = drive.sideways_mps2 / np.maximum(np.abs(path.curvature), MIN_CURVATURE)
    left = speed_mps**2 - 2 * drive.braking_mps2 * SPACING_M * np.arange(len(curve))
    fast = np.flatnonzero(left > curve)
    return float(SPACING_M * fast[0]) if len(fast) else float("inf")
