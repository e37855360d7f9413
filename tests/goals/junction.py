"""A junction with every maneuver, drawn by hand. Coordinates relative to the ego, which comes along +x."""

import numpy as np

from rlftsim.scenario.types import MapFeatures, MapFeatureType, ObjectType, Scenario
from scenes import EGO_POSITION_M, Mover, build_scenario, polylines

LANE = MapFeatureType.LANE_SURFACE_STREET


def arc(x: float, y: float, radius: float, start: float, stop: float) -> list[tuple[float, float]]:
    """Points of a circle about (x, y) between two angles in degrees."""
    angles = np.radians(np.linspace(start, stop, 25))
    return list(zip(x + radius * np.cos(angles), y + radius * np.sin(angles)))


OWN = [
    (LANE, [(-60, 0), (20, 0)]),
    (LANE, [(20, 0), (40, 0)]),
    (LANE, [(40, 0), (240, 0)]),
    (LANE, arc(20, 12, 12, -90, 0)),  # left, out of the junction at (32, 12)
    (LANE, [(32, 12), (32, 100)]),
    (LANE, arc(20, -8, 8, 90, 0)),  # right, out at (28, -8)
    (LANE, [(28, -8), (28, -100)]),
]
BESIDE = (LANE, [(-60, 3.5), (240, 3.5)])
BACK = (LANE, [(140, 14), (-60, 14)])
DOUBLE_LINE = (MapFeatureType.LINE_SOLID_DOUBLE_YELLOW, [(-60, 1.75), (240, 1.75)])


def junction(*more: tuple[MapFeatureType, list[tuple[float, float]]]) -> MapFeatures:
    """The junction and further features."""
    return polylines([*OWN, *more])


def driving(*more: tuple[MapFeatureType, list[tuple[float, float]]], **mover: object) -> Scenario:
    """The ego before the junction."""
    settings = {"speed_mps": 8.0, **mover}
    movers = (Mover(**settings), Mover(ObjectType.PEDESTRIAN, x_m=9.0, y_m=-6.0))  # type: ignore[arg-type]
    return build_scenario("junction", movers, junction(*more))


def relative(position: np.ndarray) -> np.ndarray:
    """World coordinates relative to the ego."""
    return position - np.array(EGO_POSITION_M)
