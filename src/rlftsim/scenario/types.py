"""One logged traffic scenario: tracks, map, lights.

Units: meters, seconds, radians, meters per second. Headings are counter-clockwise from +x. Frame: the *world* frame of
the log. Coordinates are float32 from reading on, because the official evaluator and the public SMART code round them
before they do anything else. The one exception is `MapFeatures.polygon_rest`. `Scenario.origin` is in whole meters, so
that subtracting it is exact.

Shapes: O objects, S steps at 10 Hz (91; 11 in a test split), F map features, P map points, K light states. Nothing here
needs torch.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from enum import IntEnum
from functools import cached_property
from typing import Any, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int8, Int32, Int64

from rlftsim.errors import DataError, in_short
from rlftsim.jobs.documents import MAX_NAME_BYTES

COARSEST_M = 0.01
"""Coordinates are refused where float32 has larger gaps."""
STEP_S = 0.1
TIME_TOLERANCE_S = STEP_S / 2
"""A timestamp may be so far from its multiple of 0.1 s: in 9 s the clocks of real logs drift by up to 0.022 s, and
their steps differ by up to 0.011 s."""
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


MEDIAN_SIZE_M = {
    ObjectType.VEHICLE: (4.61, 2.06, 1.59),
    ObjectType.PEDESTRIAN: (0.88, 0.84, 1.70),
    ObjectType.CYCLIST: (1.84, 0.84, 1.77),
}
"""Length, width and height where a log has none: medians of WOMD (18 631 vehicles, 2 288 pedestrians, 127 cyclists)."""
OTHER_SIZE_M = (1.0, 1.0, 1.0)
"""The same for all other objects."""


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
    """Logged objects in file order.

    Where `valid` is False the other fields hold the values of the log, because the metric reads some of them.
    """

    object_id: Int64[np.ndarray, "O"]
    object_type: Int8[np.ndarray, "O"]
    position: Float32[np.ndarray, "O S 3"]
    """Center of the box, world frame."""
    heading: Float32[np.ndarray, "O S"]
    velocity: Float32[np.ndarray, "O S 2"]
    size: Float32[np.ndarray, "O S 3"]
    """Length, width, height of the box."""
    valid: Bool[np.ndarray, "O S"]


def _no_rows(columns: int) -> Int64[np.ndarray, "0 columns"]:
    return np.zeros((0, columns), np.int64)


@dataclass(frozen=True, eq=False)
class LaneTopology:
    """Links between lanes; rows start with a lane's feature id and are in file order. Empty where a source has none."""

    entry_lanes: Int64[np.ndarray, "n_entry 2"] = field(default_factory=lambda: _no_rows(2))
    """lane, lane before it."""
    exit_lanes: Int64[np.ndarray, "n_exit 2"] = field(default_factory=lambda: _no_rows(2))
    """lane, lane after it."""
    neighbors: Int64[np.ndarray, "n_neighbor 7"] = field(default_factory=lambda: _no_rows(7))
    """lane, side (0 left, 1 right), neighbor's feature id, own start and end index, neighbor's start and end index."""
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
    """Rounding error of the points of crosswalks, bumps and driveways, zero elsewhere: double precision minus float32.

    The public SMART code cuts these polygons in double precision. None where a source has float32 alone, or the points
    have been moved.
    """

    @classmethod
    def of(cls, features: Iterable[tuple[int, int, np.ndarray]], topology: LaneTopology | None = None) -> "MapFeatures":
        """Map of features one by one.

        Args:
            features: feature id, `MapFeatureType` number and points [n, 3] of each, in the order of the map.
            topology: links between its lanes; None = none.
        """
        ids, types, lines = zip(*features) if (features := list(features)) else ((), (), ())
        return cls(
            feature_id=np.array(ids, np.int64),
            feature_type=np.array(types, np.int8),
            points=np.concatenate([np.zeros((0, 3)), *lines]).astype(np.float32),
            offsets=np.append(0, np.cumsum([len(line) for line in lines])).astype(np.int64),
            topology=topology or LaneTopology(),
        )

    def __len__(self) -> int:
        return len(self.feature_id)

    def polyline(self, index: int | np.integer) -> Float32[np.ndarray, "n 3"]:
        """Points of feature `index`, world frame."""
        return self.points[self.offsets[index] : self.offsets[index + 1]]

    def polygon(self, index: int | np.integer) -> Float64[np.ndarray, "n 3"]:
        """Points of a crosswalk, bump or driveway, world frame, in the precision of the source."""
        polygon = self.polyline(index).astype(np.float64)
        own = slice(self.offsets[index], self.offsets[index + 1])
        return polygon if self.polygon_rest is None else polygon + self.polygon_rest[own]

    def find_indices(self, types: tuple[int, ...]) -> Int64[np.ndarray, "n"]:
        """Indices of the features of the given types, in file order."""
        return np.flatnonzero(np.isin(self.feature_type, types))


@dataclass(frozen=True, eq=False)
class LightStates:
    """Traffic light observations, one row each, by step, then in the log's order (a lane may occur twice)."""

    step: Int32[np.ndarray, "K"]
    lane_id: Int64[np.ndarray, "K"]
    state: Int8[np.ndarray, "K"]
    stop_point: Float32[np.ndarray, "K 3"]


@dataclass(frozen=True, eq=False)
class Scenario:
    """One logged scenario. Compared and hashed by identity, so that values derived from it can be cached.

    Its arrays must not change for the same reason, and those of a data set are read-only: a changed scenario is made
    with `dataclasses.replace` and copies.
    """

    scenario_id: str
    timestamps_s: Float[np.ndarray, "S"]
    tracks: Tracks
    map_features: MapFeatures
    lights: LightStates
    ego_index: int
    """Index of the logging vehicle in `tracks`."""
    tracks_to_predict: Int32[np.ndarray, "n"]
    """Track indices, in file order."""
    difficulty: Int8[np.ndarray, "n"]
    objects_of_interest: Int64[np.ndarray, "m"]
    """Object ids."""
    source: str = "unknown"
    """Name of the data source that it was read by, such as "womd"."""
    guessed: frozenset[str] = frozenset()
    """Values that the log lacks and the data source made up, such as "size" and "z"."""

    def check_scenario_id(self) -> None:
        """Check that the id can be a file name: films and rollouts are named after their scenario.

        Raises:
            DataError: it is no text or empty, too long, or has a slash or a control character.
        """
        name = self.scenario_id
        is_text = isinstance(name, str) and len(name.encode(errors="replace")) <= MAX_NAME_BYTES
        if not is_text or not re.fullmatch(r"[^/\\\x00-\x1f]+", name) or name in (".", ".."):
            raise DataError(
                f"scenario id {in_short(name)} is no file name, and files are named after it: write it as text of at "
                f"most {MAX_NAME_BYTES} bytes without slashes and control characters"
            )

    def check_array_shapes(self) -> None:
        """Check that tracks, map and lights hold arrays with the axes that their classes declare.

        Raises:
            DataError: something else, or an axis of another length than in the arrays before it.
        """
        features = self.map_features
        parts = {"tracks": self.tracks, "map": features, "topology": features.topology, "lights": self.lights}
        for place, part in parts.items():
            _check_shapes(part, place)

    def check_consistency(self) -> None:
        """Check what every reader relies on: steps of 0.1 s, track indices, ids that differ, types, states, sizes, map.

        Sizes are those at the current step: simulation and metric read no others, and logs hold zeros where a state is
        not valid.

        Raises:
            DataError: names the track, map feature, light or index, and its value.
        """
        tracks = self.tracks
        if self.num_steps < HISTORY_STEPS:
            raise DataError(f"{self.num_steps} steps, the history alone has {HISTORY_STEPS}")
        for name, indices in (("ego_index", [self.ego_index]), ("tracks_to_predict", self.tracks_to_predict)):
            for index in indices:
                if not 0 <= index < len(tracks.object_id):
                    raise DataError(f"{name} names track index {index}, but there are {len(tracks.object_id)} tracks")
        _check_time_base(self.timestamps_s, self.num_steps)
        lines, lights = self.map_features, self.lights
        _check_unique("object id {} belongs to {} tracks: give each its own", tracks.object_id)
        _check_unique("map feature id {} belongs to {} features: give each its own", lines.feature_id)
        _check_unique("tracks_to_predict names track index {} {} times: name it once", self.tracks_to_predict)
        _check_types("track", tracks.object_id, "type", tracks.object_type, ObjectType)
        _check_types("map feature", lines.feature_id, "type", lines.feature_type, MapFeatureType)
        _check_types("light of lane", lights.lane_id, "state", lights.state, LightState)
        cuts = lines.offsets
        if len(cuts) != len(lines) + 1 or cuts[0] != 0 or cuts[-1] != len(lines.points) or (np.diff(cuts) < 0).any():
            raise DataError(
                f"map.offsets does not divide {len(lines.points)} points among {len(lines)} features: it must rise "
                f"from 0 to {len(lines.points)} in {len(lines) + 1} numbers, as MapFeatures.of makes it"
            )
        size = tracks.size[:, CURRENT_STEP]
        flat = np.argwhere((size <= 0) & tracks.valid[:, CURRENT_STEP, None])
        if len(flat):
            track, side = flat[0]
            name = ("length", "width", "height")[side]
            raise DataError(
                f"track {tracks.object_id[track]}: {name} is {size[track, side]:g} at the current step "
                f"({CURRENT_STEP}), it must be above zero"
            )

    def check_finite_arrays(self) -> None:
        """Check every valid state and every map point.

        Raises:
            DataError: one holds a NaN or an infinite number. Names track, step and field, or map feature and point.
        """
        tracks = self.tracks
        fields = {
            "position": tracks.position,
            "heading": tracks.heading[..., None],
            "velocity": tracks.velocity,
            "size": tracks.size,
        }
        for name, values in fields.items():
            bad = np.argwhere(tracks.valid & ~np.isfinite(values).all(-1))  # [n, 2] rows of (track, step)
            if len(bad):
                track, step = bad[0]
                raise DataError(
                    f"track {tracks.object_id[track]} has a NaN or infinite {name} at step {step}, where it is marked "
                    "valid: correct the value or mark the state as not valid"
                )
        lines = self.map_features
        bad_points = np.flatnonzero(~np.isfinite(lines.points).all(1))
        if len(bad_points):
            owner = np.searchsorted(lines.offsets, bad_points[0], side="right") - 1
            place = bad_points[0] - lines.offsets[owner]
            raise DataError(
                f"map feature {lines.feature_id[owner]} has a NaN or infinite point (its point {place}): "
                "correct it or leave the feature out"
            )

    def check_precision(self) -> None:
        """Check that float32 resolves every position to a centimeter, as it does up to 131 km from the origin.

        Raises:
            DataError: A position lies farther out, as in UTM coordinates; the message names track, step, place and
                what float32 resolves.
        """
        tracks = self.tracks
        with np.errstate(invalid="ignore"):  # states that are not valid may hold infinities
            spacing = np.spacing(np.abs(tracks.position)).max(-1)  # [O, S] distance to the next float32
        bad = np.argwhere(tracks.valid & (spacing > COARSEST_M))
        way_out = "subtract an origin near it, in whole meters, from x and y of tracks, map and lights"
        if len(bad):
            track, step = bad[0]
            x, y, z = tracks.position[track, step].tolist()
            raise DataError(
                f"track {tracks.object_id[track]} is at ({x:.0f}, {y:.0f}, {z:.0f}) m at step {step}, where float32 "
                f"resolves {spacing[track, step]:g} m: {way_out}"
            )
        for name, points in (("map point", self.map_features.points), ("stop point", self.lights.stop_point)):
            distant = np.flatnonzero((np.spacing(np.abs(points)) > COARSEST_M).any(-1))
            if len(distant):
                x, y, z = points[distant[0]].tolist()
                raise DataError(
                    f"{name} {distant[0]} is at ({x:g}, {y:g}, {z:g}) m, too far out for float32: {way_out}"
                )

    @property
    def num_steps(self) -> int:
        """91, or 11 where the future is withheld."""
        return self.tracks.valid.shape[1]

    @property
    def has_future(self) -> bool:
        """True where the log has the 80 future steps."""
        return self.num_steps >= TOTAL_STEPS

    @property
    def has_evaluated_future(self) -> bool:
        """True where an evaluated agent has a valid state after the current step, so that there is a log to compare
        with."""
        return self.has_future and bool(self.tracks.valid[self.evaluated_indices, HISTORY_STEPS:TOTAL_STEPS].any())

    @cached_property
    def simulated_indices(self) -> Int64[np.ndarray, "A"]:
        """Simulated tracks: those valid at the current step, in track order."""
        return np.flatnonzero(self.tracks.valid[:, CURRENT_STEP])

    @cached_property
    def evaluated_indices(self) -> Int64[np.ndarray, "E"]:
        """Evaluated tracks: the ego and the tracks to predict, by ascending object id as in the official evaluator.

        A track to predict that is not valid at the current step is left out, because it is not simulated.
        """
        # each track once, even where the ego is among the tracks to predict
        chosen = np.unique(np.append(self.tracks_to_predict, self.ego_index).astype(np.int64))
        chosen = chosen[self.tracks.valid[chosen, CURRENT_STEP]]
        return chosen[np.argsort(self.tracks.object_id[chosen], kind="stable")]

    @cached_property
    def origin(self) -> Float[np.ndarray, "2"]:
        """Center of the *map* frame: ego position at the current step in whole meters, float64, world frame."""
        return np.round(self.tracks.position[self.ego_index, CURRENT_STEP, :2].astype(np.float64))

    def __repr__(self) -> str:
        types = self.tracks.object_type[self.simulated_indices]
        counts = [(int((types == t).sum()), t.name.lower()) for t in ObjectType]
        kinds = ", ".join(f"{count} {kind}{'s' if count != 1 else ''}" for count, kind in counts if count)
        return (
            f"Scenario({self.scenario_id!r}, {len(types)} agents ({kinds or 'none'}), {self.num_steps} steps, "
            f"{len(self.map_features)} map features)"
        )

    def _repr_html_(self) -> str | None:
        return render_html(self)


_HTML_RENDERERS: dict[type, Callable[[Any], str | None]] = {}


def register_html(shown: type, render: Callable[[Any], str | None]) -> None:
    """Choose how a notebook shows values of a class. The viewer registers itself when it is imported.

    Args:
        shown: Class whose `_repr_html_` calls `render_html`.
        render: Function from a value to a text in HTML; None = the notebook prints the value.
    """
    _HTML_RENDERERS[shown] = render


def render_html(value: Any) -> str | None:
    """Text in HTML that a notebook shows for a value; None where nothing was registered for its class."""
    render = _HTML_RENDERERS.get(type(value))
    return None if render is None else render(value)


def _check_shapes(part: Any, place: str) -> None:
    sizes: dict[str, int] = {}
    for one in fields(part):
        value, is_optional = getattr(part, one.name), type(None) in get_args(one.type)
        declared: Any = get_args(one.type)[0] if is_optional else one.type
        if not hasattr(declared, "dim_str") or (value is None and is_optional):
            continue
        axes = declared.dim_str.split()
        shown = f"[{', '.join(axes)}]"
        if not isinstance(value, np.ndarray):
            raise DataError(f"{place}.{one.name} is {type(value).__name__}, it must be an array {shown}")
        wanted = []
        for axis, length in zip(axes, value.shape):
            name, _, more = axis.partition("+")  # such as "F+1"
            extra = int(more or 0)
            wanted.append(int(axis) if axis.isdigit() else sizes.setdefault(name, length - extra) + extra)
        if value.shape != tuple(wanted) or len(axes) != value.ndim:
            known = ", ".join(f"{name} = {size}" for name, size in sizes.items())
            raise DataError(f"{place}.{one.name} has the shape {value.shape}, it must be {shown}: {known}")


def _check_time_base(timestamps_s: Float[np.ndarray, "t"], num_steps: int) -> None:
    """Refuse timestamps that are not 0.1 s apart: speeds, tokens and scores would be wrong by a factor."""
    if np.ndim(timestamps_s) != 1:
        raise DataError(f"timestamps are {in_short(timestamps_s)}, not one number for each step")
    if len(timestamps_s) != num_steps:
        raise DataError(f"{len(timestamps_s)} timestamps for {num_steps} steps")
    offset_s = timestamps_s - timestamps_s[0]
    wrong = np.flatnonzero(~(np.abs(offset_s - STEP_S * np.arange(num_steps)) <= TIME_TOLERANCE_S))  # NaN, too
    if len(wrong):
        step = wrong[0]
        raise DataError(
            f"step {step} is {offset_s[step]:.3f} s after step 0 instead of {STEP_S * step:.1f} s: steps must be "
            f"{STEP_S:g} s apart, so resample the log to 10 Hz or correct its timestamps"
        )


def _check_unique(complaint: str, ids: Int[np.ndarray, "n"]) -> None:
    values, count = np.unique(ids, return_counts=True)
    if (count > 1).any():
        raise DataError(complaint.format(values[count.argmax()], count.max()))


def _check_types(
    thing: str, ids: Int64[np.ndarray, "n"], field_name: str, codes: Int8[np.ndarray, "n"], kinds: type[IntEnum]
) -> None:
    wrong = np.flatnonzero(~np.isin(codes, list(kinds)))
    if len(wrong):
        known = ", ".join(f"{kind.value} {kind.name.lower()}" for kind in kinds)
        raise DataError(f"{thing} {ids[wrong[0]]}: {field_name} {codes[wrong[0]]} is none of {known}")


@runtime_checkable
class Scenarios(Protocol):
    """Scenarios by position: a list of them, or a data set."""

    def __len__(self) -> int:
        """Number of scenarios."""
        ...

    def __getitem__(self, position: int, /) -> Scenario:
        """Scenario at a position."""
        ...


def list_scenario_ids(scenarios: Scenarios) -> Iterable[str]:
    """Scenario ids in order."""
    # a data set has them in its index: its scenarios need not be read
    known = getattr(scenarios, "scenario_ids", None)
    return known if known is not None else (scenarios[i].scenario_id for i in range(len(scenarios)))
