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
    """Values rounded to multiples of 1 / `per_unit` (a power of two), float32, never -0.0."""
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
        """Cropper of a map."""
        sizes = [len(feature.points) for feature in network_map.features]
        points = np.concatenate([feature.points for feature in network_map.features])
        return MapCropper(network_map, ground, points, np.append(0, np.cumsum(sizes)))

    def crop(self, centres: Float[np.ndarray, "n 2"], radius_m: float) -> MapFeatures:
        """Features within `radius_m` of any of the centres.

        Lanes keep one contiguous stretch, lines and edges fall into pieces, crosswalks stay whole. The first piece keeps the id.
        """
        nearest = np.full(len(self.points), np.inf)
        for centre in centres:
            np.minimum(nearest, ((self.points - centre) ** 2).sum(axis=1), out=nearest)
        inside = nearest < radius_m**2
        kept: list[tuple[int, Feature, np.ndarray]] = []
        next_id = len(self.network_map.features) + 1
        for index, feature in enumerate(self.network_map.features):
            pieces = cut_feature(feature, inside[self.offsets[index] : self.offsets[index + 1]])
            for number, piece in enumerate(pieces):
                kept.append((feature.feature_id if number == 0 else next_id, feature, piece))
                next_id += number > 0
        return self._assemble(kept)

    def _assemble(self, kept: list[tuple[int, Feature, np.ndarray]]) -> MapFeatures:
        points = np.concatenate([piece for _, _, piece in kept]) if kept else np.zeros((0, 2))
        height = on_grid(self.ground.height_at(points), HEIGHT_GRID_PER_M)
        is_lane = np.array([feature.feature_type in LANE_TYPES for _, feature, _ in kept])
        speed = np.array([feature.speed_mps for _, feature, _ in kept]) * MPH_PER_MPS * is_lane
        lanes = [row for row in kept if row[1].feature_type in LANE_TYPES]
        lengths = {feature_id: len(piece) for feature_id, _, piece in lanes}
        links = _links_not_cut(self.network_map.entry_exit, lanes)
        return MapFeatures(
            feature_id=np.array([feature_id for feature_id, _, _ in kept], np.int64),
            feature_type=np.array([feature.feature_type for _, feature, _ in kept], np.int8),
            points=np.concatenate([on_grid(points, MAP_GRID_PER_M), height[:, None]], axis=1),
            offsets=np.append(0, np.cumsum([len(piece) for _, _, piece in kept])).astype(np.int64),
            topology=self._topology(
                lengths,
                links,
                on_grid(np.rint(speed / 5.0) * 5.0, 1),
                np.array([feature.interpolating for _, feature, _ in kept], bool),
                {feature_id for feature_id, _, _ in kept},
            ),
        )

    def _topology(
        self,
        lengths: dict[int, int],
        links: list[tuple[int, int]],
        speed_mph: np.ndarray,
        interpolating: np.ndarray,
        present: set[int],
    ) -> LaneTopology:
        whole = self.network_map
        neighbors = [
            (lane, side, other, 0, lengths[lane] - 1, 0, lengths[other] - 1)
            for lane, side, other in whole.neighbors
            if lane in lengths and other in lengths
        ]
        signs = [(sign, lane) for sign, lane in whole.stop_sign_lanes if sign in present and lane in lengths]
        return LaneTopology(
            entry_lanes=_rows([(b, a) for a, b in links], 2),
            exit_lanes=_rows(links, 2),
            neighbors=_rows(neighbors, 7),
            stop_sign_lanes=_rows(signs, 2),
            speed_limit_mph=speed_mph,
            interpolating=interpolating,
        )


def _links_not_cut(
    links: tuple[tuple[int, int], ...], lanes: list[tuple[int, Feature, np.ndarray]]
) -> list[tuple[int, int]]:
    """Links between lanes that still meet: the end of the first and the start of the second are both in the crop."""
    starts = {lane_id for lane_id, feature, piece in lanes if np.array_equal(piece[0], feature.points[0])}
    ends = {lane_id for lane_id, feature, piece in lanes if np.array_equal(piece[-1], feature.points[-1])}
    return [(lane, after) for lane, after in links if lane in ends and after in starts]


def _rows(rows: list[tuple[int, ...]], columns: int) -> np.ndarray:
    return np.array(sorted(rows), np.int64).reshape(-1, columns)


def cut_feature(feature: Feature, inside: Bool[np.ndarray, "n"]) -> list[Float[np.ndarray, "m 2"]]:
    """Pieces of a feature that survive a crop; `inside` says which of its points lie in it."""
    if not inside.any():
        return []
    if feature.feature_type in (MapFeatureType.CROSSWALK, MapFeatureType.STOP_SIGN):
        return [feature.points]
    bounds = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int8), [0]])))
    starts, stops = bounds[::2], bounds[1::2]
    if feature.feature_type in LANE_TYPES:
        starts, stops = starts[:1], stops[-1:]
    return [feature.points[a:b] for a, b in zip(starts, stops, strict=True) if b - a >= 2]
