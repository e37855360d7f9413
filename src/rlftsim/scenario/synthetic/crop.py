"""The part of a network's map that belongs to a scenario, on ground that rises and falls."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.scenario.polylines import find_runs
from rlftsim.scenario.synthetic.map_features import Feature, NetworkMap
from rlftsim.scenario.types import LANE_TYPES, LaneTopology, MapFeatures, MapFeatureType

_TWO_PI = 2 * np.pi


@dataclass(frozen=True)
class Ground:
    """Height of the ground, a plane with two sine waves: gentle to drive on, never flat, so that mistakes in z show."""

    height_m: float
    slope: tuple[float, float]
    waves: tuple[tuple[float, float, float, float], ...]
    """Amplitude in meters, wave numbers along x and y in rad/m, phase."""

    def height_at(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
        """Height in meters at points of the plane."""
        x, y = points[..., 0], points[..., 1]
        height = self.height_m + self.slope[0] * x + self.slope[1] * y
        for amplitude, wave_x, wave_y, phase in self.waves:
            height = height + amplitude * np.sin(wave_x * x + wave_y * y + phase)
        return height


def draw_ground(rng: np.random.Generator) -> Ground:
    """Ground that rises and falls by 1-2 m over 150 m and stays within about 5 m of 24 m in the whole network."""
    waves = []
    for _ in range(2):
        # a wave of this length, running in this direction
        length, angle = rng.uniform(150, 400), rng.uniform(0, _TWO_PI)
        number = _TWO_PI / length
        amplitude, wave_x, wave_y = rng.uniform(0.3, 0.8), number * np.cos(angle), number * np.sin(angle)
        waves.append((float(amplitude), float(wave_x), float(wave_y), float(rng.uniform(0, _TWO_PI))))
    angle, steepness = rng.uniform(0, _TWO_PI), rng.uniform(0, 0.006)
    return Ground(24.0, (float(steepness * np.cos(angle)), float(steepness * np.sin(angle))), tuple(waves))


MAP_GRID_PER_M = 256
HEIGHT_GRID_PER_M = 128
MPH_PER_MPS = 2.236936


def on_grid(values: Float[np.ndarray, "..."], per_unit: int) -> Float[np.ndarray, "..."]:
    """Values rounded to a grid, float32, never -0.0: the codec stores such values in a few bits.

    Args:
        values: Numbers in any unit, such as meters.
        per_unit: Number of grid points per unit, a power of two.
    """
    return (np.rint(np.asarray(values, np.float64) * per_unit) / per_unit + 0.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class MapCropper:
    """All points of a network's map in one array, so that a crop is one distance computation."""

    network_map: NetworkMap
    ground: Ground

    @cached_property
    def _points(self) -> Float[np.ndarray, "P 2"]:
        return np.concatenate([feature.points for feature in self.network_map.features])

    def crop(self, centers: Float[np.ndarray, "n 2"], radius_m: float) -> MapFeatures:
        """Features within a radius of any of the centers.

        Lanes keep one contiguous stretch, lines and edges fall into several, crosswalks stay whole. The first stretch
        keeps the id.

        Args:
            centers: Positions [n, 2] that the crop surrounds, plan coordinates, m.
            radius_m: Distance from the nearest center beyond which points are cut off, m.
        """
        # 1. Points inside, for all features at once.
        # a running minimum: all distances at once would take 8 bytes times points times centers
        nearest = np.full(len(self._points), np.inf)
        for center in centers:
            np.minimum(nearest, ((self._points - center) ** 2).sum(axis=1), out=nearest)
        inside = nearest < radius_m**2  # [P]
        # 2. Stretches of each feature inside.
        network_map = self.network_map
        stretches: list[tuple[int, Feature, np.ndarray]] = []
        next_id = len(network_map.features) + 1
        borders = np.cumsum([len(feature.points) for feature in network_map.features])
        for feature, inside_feature in zip(network_map.features, np.split(inside, borders)):
            for number, polyline in enumerate(cut_feature(feature, inside_feature)):
                stretches.append((feature.feature_id if number == 0 else next_id, feature, polyline))
                next_id += number > 0
        # 3. Links between lanes that still meet: the end of the first and the start of the second are both in the crop.
        lanes = [row for row in stretches if row[1].feature_type in LANE_TYPES]
        lengths = {feature_id: len(polyline) for feature_id, _, polyline in lanes}
        starts = {lane_id for lane_id, feature, polyline in lanes if np.array_equal(polyline[0], feature.points[0])}
        ends = {lane_id for lane_id, feature, polyline in lanes if np.array_equal(polyline[-1], feature.points[-1])}
        links = [(first, second) for first, second in network_map.entry_exit if first in ends and second in starts]
        neighbors = [
            (lane, side, neighbor, 0, lengths[lane] - 1, 0, lengths[neighbor] - 1)
            for lane, side, neighbor in network_map.neighbors
            if lane in lengths and neighbor in lengths
        ]
        present = {feature_id for feature_id, _, _ in stretches}
        signs = [(sign, lane) for sign, lane in network_map.stop_sign_lanes if sign in present and lane in lengths]
        # 4. Arrays of the stretches, F in all with P points.
        features = [feature for _, feature, _ in stretches]
        points = np.concatenate([np.zeros((0, 2)), *(polyline for _, _, polyline in stretches)])  # [P, 2]
        height = on_grid(self.ground.height_at(points), HEIGHT_GRID_PER_M)  # [P]
        is_lane = np.array([feature.feature_type in LANE_TYPES for feature in features])
        speed = np.array([feature.speed_mps for feature in features]) * MPH_PER_MPS * is_lane
        topology = LaneTopology.of(
            entry_lanes=sorted((second, first) for first, second in links),
            exit_lanes=sorted(links),
            neighbors=sorted(neighbors),
            stop_sign_lanes=sorted(signs),
            speed_limit_mph=on_grid(np.rint(speed / 5.0) * 5.0, 1),
            interpolating=np.array([feature.interpolating for feature in features], bool),
        )
        grid_points = np.column_stack([on_grid(points, MAP_GRID_PER_M), height])
        lines = np.split(grid_points, np.cumsum([len(polyline) for _, _, polyline in stretches]))
        ids, types = [feature_id for feature_id, _, _ in stretches], [feature.feature_type for feature in features]
        return MapFeatures.of(zip(ids, types, lines), topology)


def cut_feature(feature: Feature, inside: Bool[np.ndarray, "n"]) -> list[Float[np.ndarray, "m 2"]]:
    """Stretches of a feature that survive a crop.

    Args:
        feature: Feature of the whole map.
        inside: True for the points of the feature that lie in the crop.
    """
    if not inside.any():
        return []
    if feature.feature_type in (MapFeatureType.CROSSWALK, MapFeatureType.STOP_SIGN):
        return [feature.points]
    runs = find_runs(inside)
    if feature.feature_type in LANE_TYPES:
        runs = [(runs[0][0], runs[-1][1])]  # a lane in two stretches would be two lanes without a link
    return [feature.points[start:stop] for start, stop in runs if stop - start >= 2]
