"""One recorded traffic scenario: tracks, map, lights.

Units: metres, seconds, radians, metres per second. Headings are counter-clockwise from +x. Frame: the *world* frame of the
record. Coordinates are float32 from reading on, because the official evaluator and the public SMART code round them so before
they do anything else (but for one thing: `MapFeatures.polygon_rest`); `Scenario.origin` is in whole metres, so that subtracting it is exact.

Shapes: O objects, S steps at 10 Hz (91; 11 in a test split), F map features, P map points, K light states. Nothing here needs torch.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int8, Int32, Int64

from rlftsim.errors import DataError

STEP_S = 0.1
HISTORY_STEPS = 11
CURRENT_STEP = 10
FUTURE_STEPS = 80
TOTAL_STEPS = 91


class ObjectType(IntEnum):
    """Kind of road user, WOMD's numbers."""

    UNSET = 0
    VEHICLE = 1
    PEDESTRIAN = 2
    CYCLIST = 3
    OTHER = 4


class MapFeatureType(IntEnum):
    """Kind of map feature; the numbers of WOMD's `roadgraph_samples/type`."""

    LANE_UNDEFINED = 0
    LANE_FREEWAY = 1
    LANE_SURFACE_STREET = 2
    LANE_BIKE = 3
    LINE_UNKNOWN = 5
    LINE_BROKEN_SINGLE_WHITE = 6
    LINE_SOLID_SINGLE_WHITE = 7
    LINE_SOLID_DOUBLE_WHITE = 8
    LINE_BROKEN_SINGLE_YELLOW = 9
    LINE_BROKEN_DOUBLE_YELLOW = 10
    LINE_SOLID_SINGLE_YELLOW = 11
    LINE_SOLID_DOUBLE_YELLOW = 12
    LINE_PASSING_DOUBLE_YELLOW = 13
    EDGE_UNKNOWN = 14
    EDGE_BOUNDARY = 15
    EDGE_MEDIAN = 16
    STOP_SIGN = 17
    CROSSWALK = 18
    SPEED_BUMP = 19
    DRIVEWAY = 20


LANE_TYPES = (0, 1, 2, 3)
ROAD_EDGE_TYPES = (14, 15, 16)


class LightState(IntEnum):
    """State of a traffic light, WOMD's numbers."""

    UNKNOWN = 0
    ARROW_STOP = 1
    ARROW_CAUTION = 2
    ARROW_GO = 3
    STOP = 4
    CAUTION = 5
    GO = 6
    FLASHING_STOP = 7
    FLASHING_CAUTION = 8


@dataclass(frozen=True, eq=False)
class Tracks:
    """Recorded objects in file order. Where `valid` is False the other fields hold what the record stored (the metric reads some of it)."""

    object_id: Int64[np.ndarray, "O"]
    object_type: Int8[np.ndarray, "O"]
    position: Float32[np.ndarray, "O S 3"]
    """Centre of the box, world frame."""
    heading: Float32[np.ndarray, "O S"]
    velocity: Float32[np.ndarray, "O S 2"]
    size: Float32[np.ndarray, "O S 3"]
    """Length, width, height of the box."""
    valid: Bool[np.ndarray, "O S"]


def _no_rows(columns: int) -> Int64[np.ndarray, "0 columns"]:
    return np.zeros((0, columns), np.int64)


@dataclass(frozen=True, eq=False)
class LaneTopology:
    """How lanes hang together; every row starts with a lane's feature id, rows are in file order. Empty where a source lacks it."""

    entry_lanes: Int64[np.ndarray, "n_entry 2"] = field(default_factory=lambda: _no_rows(2))
    """lane, lane before it."""
    exit_lanes: Int64[np.ndarray, "n_exit 2"] = field(default_factory=lambda: _no_rows(2))
    """lane, lane after it."""
    neighbors: Int64[np.ndarray, "n_neighbor 7"] = field(default_factory=lambda: _no_rows(7))
    """lane, side (0 left, 1 right), neighbour's feature id, own start and end index, neighbour's start and end index."""
    boundaries: Int64[np.ndarray, "n_boundary 6"] = field(default_factory=lambda: _no_rows(6))
    """lane, side (0 left, 1 right), boundary's feature id, own start and end index, road line type as in WOMD."""
    stop_sign_lanes: Int64[np.ndarray, "n_stop 2"] = field(default_factory=lambda: _no_rows(2))
    """stop sign's feature id, lane it controls."""
    speed_limit_mph: Float32[np.ndarray, "F"] | None = None
    """One per map feature, 0 where unknown or no lane."""
    interpolating: Bool[np.ndarray, "F"] | None = None
    """True = the lane joins two others inside a junction."""


@dataclass(frozen=True, eq=False)
class MapFeatures:
    """Polylines, polygons and stop signs in file order; feature k owns `points[offsets[k]:offsets[k + 1]]`."""

    feature_id: Int64[np.ndarray, "F"]
    feature_type: Int8[np.ndarray, "F"]
    points: Float32[np.ndarray, "P 3"]
    offsets: Int64[np.ndarray, "F+1"]
    topology: LaneTopology = field(default_factory=LaneTopology)
    polygon_rest: Float32[np.ndarray, "P 3"] | None = None
    """What float32 took from the points of crosswalks, bumps and driveways, zero elsewhere: the public SMART code cuts these in double
    precision. None where a source has float32 alone, or the points have been moved."""

    def __len__(self) -> int:
        return len(self.feature_id)

    def polyline(self, index: int | np.integer) -> Float32[np.ndarray, "n 3"]:
        """Points of feature `index`, world frame."""
        return self.points[self.offsets[index] : self.offsets[index + 1]]

    def polygon(self, index: int | np.integer) -> Float64[np.ndarray, "n 3"]:
        """Points of a crosswalk, bump or driveway, world frame, as precise as they are known."""
        polygon = self.polyline(index).astype(np.float64)
        own = slice(self.offsets[index], self.offsets[index + 1])
        return polygon if self.polygon_rest is None else polygon + self.polygon_rest[own]

    def indices_of(self, types: tuple[int, ...]) -> Int64[np.ndarray, "n"]:
        """Indices of the features of the given types, in file order."""
        return np.flatnonzero(np.isin(self.feature_type, types))


@dataclass(frozen=True, eq=False)
class LightStates:
    """Traffic light observations, one row each, ordered by step and as listed in the record (a lane may be listed twice)."""

    step: Int32[np.ndarray, "K"]
    lane_id: Int64[np.ndarray, "K"]
    state: Int8[np.ndarray, "K"]
    stop_point: Float32[np.ndarray, "K 3"]


@dataclass(frozen=True, eq=False)
class Scenario:
    """One recorded scenario. Compared and hashed by identity, so that what is derived from it can be cached."""

    scenario_id: str
    timestamps_s: Float[np.ndarray, "S"]
    tracks: Tracks
    map_features: MapFeatures
    lights: LightStates
    ego_index: int
    """Index of the recording vehicle in `tracks`."""
    tracks_to_predict: Int32[np.ndarray, "n"]
    """Track indices, in file order."""
    difficulty: Int8[np.ndarray, "n"]
    objects_of_interest: Int64[np.ndarray, "m"]
    """Object ids."""

    def refuse_not_finite(self) -> None:
        """Look at every valid state and every map point.

        Raises:
            DataError: one holds a NaN or an infinite number: says which.
        """
        tracks = self.tracks
        kinds = {
            "position": tracks.position,
            "size, heading or velocity": np.concatenate([tracks.size, tracks.heading[..., None], tracks.velocity], -1),
        }
        for kind, values in kinds.items():
            bad = np.argwhere(tracks.valid & ~np.isfinite(values).all(-1))
            if len(bad):
                track, step = bad[0]
                raise DataError(
                    f"track {tracks.object_id[track]} has a NaN or infinite {kind} at step {step}, where it is marked valid"
                )
        lines = self.map_features
        bad_points = np.flatnonzero(~np.isfinite(lines.points).all(1))
        if len(bad_points):
            owner = np.searchsorted(lines.offsets, bad_points[0], side="right") - 1
            place = bad_points[0] - lines.offsets[owner]
            raise DataError(f"map feature {lines.feature_id[owner]} has a NaN or infinite point (its point {place})")

    @property
    def num_steps(self) -> int:
        """91, or 11 where the future is withheld."""
        return self.tracks.valid.shape[1]

    @property
    def has_future(self) -> bool:
        """Whether the 80 future steps are recorded."""
        return self.num_steps >= TOTAL_STEPS

    @cached_property
    def simulated_indices(self) -> Int64[np.ndarray, "A"]:
        """Tracks that are simulated: those valid at the current step, in track order."""
        return np.flatnonzero(self.tracks.valid[:, CURRENT_STEP])

    @cached_property
    def evaluated_indices(self) -> Int64[np.ndarray, "E"]:
        """Tracks that are evaluated: the ego and the tracks to predict, by ascending object id as in the official evaluator.

        A track to predict that is not valid at the current step is left out: nobody simulates it.
        """
        chosen = np.unique(np.append(self.tracks_to_predict, self.ego_index).astype(np.int64))
        chosen = chosen[self.tracks.valid[chosen, CURRENT_STEP]]
        return chosen[np.argsort(self.tracks.object_id[chosen], kind="stable")]

    @cached_property
    def origin(self) -> Float[np.ndarray, "2"]:
        """Ego position at the current step rounded to whole metres, float64: the centre of the scenario's *map* frame."""
        return np.round(self.tracks.position[self.ego_index, CURRENT_STEP, :2].astype(np.float64))


@runtime_checkable
class Scenarios(Protocol):
    """Scenarios that are looked up by position: a list of them, or a data set."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def __getitem__(self, position: int, /) -> Scenario:
        """One of them."""
        ...


def scenario_ids_of(scenarios: Scenarios) -> Iterable[str]:
    """Their ids in order; a data set knows them without reading its scenarios."""
    known = getattr(scenarios, "scenario_ids", None)
    return known if known is not None else (scenarios[i].scenario_id for i in range(len(scenarios)))
