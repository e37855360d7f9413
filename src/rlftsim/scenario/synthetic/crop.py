"""The part of a network's map that belongs to one scenario."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.scenario.synthetic.ground import Ground
from rlftsim.scenario.synthetic.map_features import Feature, NetworkMap
from rlftsim.scenario.types import LANE_TYPES, LaneTopology, MapFeatures, MapFeatureType

MAP_GRID_PER_M = 256
HEIGHT_GRID_PER_M = 128
MPH_PER_MPS = 2.236936


def on_grid(values: Float[np.ndarray, "..."], per_unit: int) -> Float[np.ndarray, "..."]:
    """Values rounded to a grid, float32, never -0.0: the codec stores such values in a few bits.

    Args:
        values: any numbers.
        per_unit: grid points per unit, a power of two.
    """
    return (np.rint(np.asarray(values, np.float64) * per_unit) / per_unit + 0.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class MapCropper:
    """All points of a network's map in one array, so that a crop is one distance computation."""

    network_map: NetworkMap
    ground: Ground
    points: Float[np.ndarray, "P 2"]
    offsets: np.ndarray

    @staticmethod
    def of(network_map: NetworkMap, ground: Ground) -> "MapCropper":
        """Cropper of a map.

        Args:
            network_map: map of the whole network in plan coordinates.
            ground: heights for the points of the crop.
        """
        sizes = [len(feature.points) for feature in network_map.features]
        points = np.concatenate([feature.points for feature in network_map.features])
        return MapCropper(network_map, ground, points, np.append(0, np.cumsum(sizes)))

    def crop(self, centers: Float[np.ndarray, "n 2"], radius_m: float) -> MapFeatures:
        """Features within a radius of any of the centers.

        Lanes keep one contiguous stretch, lines and edges fall into pieces, crosswalks stay whole. The first piece
        keeps the id.

        Args:
            centers: plan coordinates, m.
            radius_m: points farther from all centers are cut off.
        """
        # 1. Points inside, for all features at once.
        # a running minimum: all distances at once would take 8 bytes times points times centers
        nearest = np.full(len(self.points), np.inf)
        for center in centers:
            np.minimum(nearest, ((self.points - center) ** 2).sum(axis=1), out=nearest)
        inside = nearest < radius_m**2  # [P]
        # 2. Pieces of each feature.
        kept: list[tuple[int, Feature, np.ndarray]] = []
        next_id = len(self.network_map.features) + 1
        for index, feature in enumerate(self.network_map.features):
            pieces = cut_feature(feature, inside[self.offsets[index] : self.offsets[index + 1]])
            for number, piece in enumerate(pieces):
                kept.append((feature.feature_id if number == 0 else next_id, feature, piece))
                next_id += number > 0
        # 3. Arrays of the kept pieces.
        whole = self.network_map
        points = np.concatenate([piece for _, _, piece in kept]) if kept else np.zeros((0, 2))  # [P, 2]
        height = on_grid(self.ground.height_at(points), HEIGHT_GRID_PER_M)  # [P]
        is_lane = np.array([feature.feature_type in LANE_TYPES for _, feature, _ in kept])
        speed = np.array([feature.speed_mps for _, feature, _ in kept]) * MPH_PER_MPS * is_lane
        lanes = [row for row in kept if row[1].feature_type in LANE_TYPES]
        lengths = {feature_id: len(piece) for feature_id, _, piece in lanes}
        # links between lanes that still meet: the end of the first and the start of the second are both in the crop
        starts = {lane_id for lane_id, feature, piece in lanes if np.array_equal(piece[0], feature.points[0])}
        ends = {lane_id for lane_id, feature, piece in lanes if np.array_equal(piece[-1], feature.points[-1])}
        links = [(lane, after) for lane, after in whole.entry_exit if lane in ends and after in starts]
        neighbors = [
            (lane, side, other, 0, lengths[lane] - 1, 0, lengths[other] - 1)
            for lane, side, other in whole.neighbors
            if lane in lengths and other in lengths
        ]
        present = {feature_id for feature_id, _, _ in kept}
        signs = [(sign, lane) for sign, lane in whole.stop_sign_lanes if sign in present and lane in lengths]
        return MapFeatures(
            feature_id=np.array([feature_id for feature_id, _, _ in kept], np.int64),
            feature_type=np.array([feature.feature_type for _, feature, _ in kept], np.int8),
            points=np.concatenate([on_grid(points, MAP_GRID_PER_M), height[:, None]], axis=1),
            offsets=np.append(0, np.cumsum([len(piece) for _, _, piece in kept])).astype(np.int64),
            topology=LaneTopology(
                entry_lanes=_rows([(b, a) for a, b in links], 2),
                exit_lanes=_rows(links, 2),
                neighbors=_rows(neighbors, 7),
                stop_sign_lanes=_rows(signs, 2),
                speed_limit_mph=on_grid(np.rint(speed / 5.0) * 5.0, 1),
                interpolating=np.array([feature.interpolating for _, feature, _ in kept], bool),
            ),
        )


def _rows(rows: list[tuple[int, ...]], columns: int) -> np.ndarray:
    return np.array(sorted(rows), np.int64).reshape(-1, columns)


def cut_feature(feature: Feature, inside: Bool[np.ndarray, "n"]) -> list[Float[np.ndarray, "m 2"]]:
    """Pieces of a feature that survive a crop.

    Args:
        feature: one of the whole map.
        inside: True for its points that lie in the crop.
    """
    if not inside.any():
        return []
    if feature.feature_type in (MapFeatureType.CROSSWALK, MapFeatureType.STOP_SIGN):
        return [feature.points]
    # runs of points inside: a run begins where the mask rises and ends where it falls
    bounds = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int8), [0]])))
    starts, stops = bounds[::2], bounds[1::2]
    if feature.feature_type in LANE_TYPES:
        starts, stops = starts[:1], stops[-1:]  # a lane in two pieces would be two lanes without a link
    return [feature.points[a:b] for a, b in zip(starts, stops, strict=True) if b - a >= 2]
