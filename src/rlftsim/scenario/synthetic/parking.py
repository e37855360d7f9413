"""Parked cars: along the curb in parking strips, and in rows in the interior of blocks."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from rlftsim.geometry import boxes_overlap
from rlftsim.scenario.synthetic.bodies import Body
from rlftsim.scenario.synthetic.map_features import resample
from rlftsim.scenario.synthetic.network import Network
from rlftsim.scenario.synthetic.street_plan import Street, offset_polyline
from rlftsim.scenario.synthetic.sumo import draw_size
from rlftsim.scenario.types import ObjectType

CLEAR_AT_JUNCTION_M = 12.0
_CARS, _PROBABILITIES = ("car", "suv", "van"), (0.66, 0.29, 0.05)


def _parked(position: np.ndarray, heading: float, size: tuple[float, float, float], num_steps: int) -> Body:
    """Body that stands still throughout the recording and is never among the tracks to predict."""
    motion = np.repeat(position[None], num_steps, axis=0), np.full(num_steps, heading), np.zeros((num_steps, 2))
    return Body(ObjectType.VEHICLE, 0, *motion, size, is_parked=True, is_evaluable=False)


def _draw_car(rng: np.random.Generator) -> tuple[float, float, float]:
    """Length, width and height of a car, SUV or van."""
    return draw_size(rng, str(rng.choice(_CARS, p=_PROBABILITIES)))


def park_in_strip(
    rng: np.random.Generator, line: Float[np.ndarray, "n 2"], occupancy: float, num_steps: int
) -> list[Body]:
    """Cars one behind another along a parking strip.

    Args:
        rng: Generator of all choices; also free spaces draw a car.
        line: Center line of the strip, n points in driving direction, m.
        occupancy: Probability in [0, 1] that a space has a car.
        num_steps: Length of the recording in steps of 0.1 s.
    """
    points = resample(line)
    spacing = float(np.linalg.norm(points[1] - points[0]))
    cars, start = [], CLEAR_AT_JUNCTION_M
    while True:
        size = _draw_car(rng)
        middle = start + size[0] / 2
        start += size[0] + rng.uniform(0.6, 1.6)
        if start > (len(points) - 1) * spacing - CLEAR_AT_JUNCTION_M:
            return cars
        if rng.random() >= occupancy:
            continue
        index = min(int(middle / spacing), len(points) - 2)
        tangent = points[index + 1] - points[index]
        heading = float(np.arctan2(tangent[1], tangent[0])) + rng.normal(0, 0.02)
        lateral = np.clip(rng.normal(0, 0.08), -0.15, 0.15)
        normal = np.array([-tangent[1], tangent[0]]) / np.linalg.norm(tangent)
        cars.append(_parked(points[index] + lateral * normal, heading, size, num_steps))


def park_in_strips(rng: np.random.Generator, network: Network, num_steps: int) -> Iterator[Body]:
    """Cars in all parking strips of a network; occupancy is drawn for every street.

    Args:
        rng: Generator of all choices; the order of lanes decides the draws.
        network: Compiled network with lanes of the type "parking".
        num_steps: Length of the recording in steps of 0.1 s.
    """
    for lane in network.lanes.values():
        if lane.lane_type == "parking":
            yield from park_in_strip(rng, lane.shape, float(rng.uniform(0.25, 0.9)), num_steps)


def _draw_row(
    rng: np.random.Generator, street: Street, setback_m: float, square: bool
) -> list[tuple[Float[np.ndarray, "2"], float]]:
    """Positions and headings of the cars in a row beside a street."""
    border = offset_polyline(resample(street.points, 4.0), -(street.roadway_width_m + setback_m))
    points = resample(border)
    pitch = rng.uniform(2.7, 3.0) if square else rng.uniform(6.0, 6.8)
    count = int(rng.integers(5, 16)) if square else int(rng.integers(3, 8))
    first = rng.uniform(8, max(9.0, len(points) * 0.5 - count * pitch))
    poses = []
    for k in range(count):
        index = int((first + k * pitch) / 0.5)
        if index >= len(points) - 2:
            break
        tangent = points[index + 1] - points[index]
        heading = float(np.arctan2(tangent[1], tangent[0]))
        if square:
            heading += np.pi / 2 if rng.random() < 0.7 else -np.pi / 2
        poses.append((points[index], heading))
    return poses


def park_in_lots(
    rng: np.random.Generator, network: Network, drivable: Any, num_steps: int, lots_per_street: float
) -> list[Body]:
    """Rows of parked cars 8-25 m beside the streets, clear of every roadway and of earlier cars.

    Args:
        rng: Generator of all choices; rejected cars are drawn, too.
        network: Compiled network whose streets have the lots.
        drivable: Drivable area of the network as a shapely geometry.
        num_steps: Length of the recording in steps of 0.1 s.
        lots_per_street: Mean number of lots beside a direction of a street.
    """
    import shapely

    # prepared: thousands of points are tested against one large area
    shapely.prepare(near_road := drivable.buffer(5.5))
    cars: list[Body] = []
    positions: list[np.ndarray] = []
    for street in network.plan.streets:
        for _ in range(int(rng.poisson(lots_per_street))):
            occupancy, square = rng.uniform(0.3, 0.95), bool(rng.random() < 0.75)
            setback = rng.uniform(8.5, 20.0)
            # square to the street a row is as deep as a car is long
            rows = [setback, setback + (rng.uniform(5.6, 6.2) if square else rng.uniform(8, 10))]
            for row in rows[: int(rng.integers(1, 3))]:
                for position, heading in _draw_row(rng, street, row, square):
                    # drawn before the position is judged: a rejected position must not change the next cars
                    size = _draw_car(rng)
                    clear = 2.6 if square else 6.0
                    if rng.random() >= occupancy or shapely.intersects_xy(near_road, *position):
                        continue
                    if positions and np.min(np.linalg.norm(np.array(positions) - position, axis=1)) < clear:
                        continue
                    positions.append(position)
                    wobble = position + rng.normal(0, 0.1, 2)
                    cars.append(_parked(wobble, heading + rng.normal(0, 0.03), size, num_steps))
    return drop_overlapping(cars)


def drop_overlapping(cars: list[Body]) -> list[Body]:
    """Cars in order, without cars whose box meets the box of an earlier car."""
    if not cars:
        return []
    position, size = np.stack([car.position[0] for car in cars]), np.array([car.size for car in cars])
    heading = np.array([car.heading[0] for car in cars])
    indices: list[int] = []
    for k in range(len(cars)):
        gap = position[indices] - position[k]
        if not boxes_overlap(gap, heading[k : k + 1], heading[indices], size[k], size[indices]).any():
            indices.append(k)
    return [cars[k] for k in indices]
