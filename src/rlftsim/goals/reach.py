"""How far somebody gets along a path in the time of a simulation, at speeds and accelerations that people drive. SI units."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rlftsim.goals.lane_paths import SPACING_M, LanePath
from rlftsim.scenario.types import FUTURE_STEPS, STEP_S

HORIZON_S = FUTURE_STEPS * STEP_S
MIN_SPEED_MPS = 0.3
"""So that time along a path stays finite for somebody who stands."""


@dataclass(frozen=True)
class Drive:
    """How somebody drives."""

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
    """Distances along a path at which somebody may be after `HORIZON_S`, m."""

    least_m: float
    """Braking all the way."""
    usual_m: float
    most_m: float


def reach_along(path: LanePath, speed_mps: float) -> Reach:
    """How far somebody gets along a path.

    Args:
        path: the way.
        speed_mps: at its start.
    """
    most = min(_distance_after(path, speed_mps, BRISK), _too_fast_from(path, speed_mps, BRISK))
    usual = min(_distance_after(path, speed_mps, USUAL), most)
    least = min(speed_mps**2 / (2 * BRISK.braking_mps2), most)
    return Reach(least, usual, most)


def _speed_limits(path: LanePath, speed_mps: float, drive: Drive) -> Float[np.ndarray, "S"]:
    """Speed at each point that curves and limits allow; who is faster than the limit now may stay so."""
    bend = np.sqrt(drive.sideways_mps2 / np.maximum(np.abs(path.curvature), 1e-4))
    return np.minimum(bend, np.maximum(path.speed_limit_mps * drive.over_limit, speed_mps))


def _distance_after(path: LanePath, speed_mps: float, drive: Drive) -> float:
    """Where somebody is after `HORIZON_S` who drives as fast as allowed; the path's end is as far as it goes."""
    allowed = _speed_limits(path, speed_mps, drive)
    squared = _running_bound(allowed[::-1] ** 2, 2 * drive.braking_mps2)[::-1]
    squared[0] = min(squared[0], speed_mps**2)
    squared = _running_bound(squared, 2 * drive.acceleration_mps2)
    speed = np.sqrt(squared)
    pace = SPACING_M / np.maximum((speed[1:] + speed[:-1]) / 2, MIN_SPEED_MPS)
    arrival_s = np.append(0.0, pace.cumsum())
    return float(np.interp(HORIZON_S, arrival_s, SPACING_M * np.arange(len(speed))))


def _running_bound(squared: Float[np.ndarray, "S"], gain: float) -> Float[np.ndarray, "S"]:
    """The squared speeds with none that gains more a metre than `gain` over any point before it."""
    slope = gain * SPACING_M * np.arange(len(squared))
    return np.minimum.accumulate(squared - slope) + slope


def _too_fast_from(path: LanePath, speed_mps: float, drive: Drive) -> float:
    """Distance of the first point at which somebody is too fast for the curve, however hard it braked; infinite if nowhere."""
    bend = drive.sideways_mps2 / np.maximum(np.abs(path.curvature), 1e-4)
    left = speed_mps**2 - 2 * drive.braking_mps2 * SPACING_M * np.arange(len(bend))
    fast = np.flatnonzero(left > bend)
    return float(SPACING_M * fast[0]) if len(fast) else float("inf")
