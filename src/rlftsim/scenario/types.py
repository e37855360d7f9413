"""A logged traffic scenario: tracks, map, lights.

Units: meters, seconds, radians, meters per second. Headings are counter-clockwise from +x. Frame: the *world* frame of
the log. Coordinates are float32 from reading on, because the official evaluator and the public SMART code round them
first. The exception is `MapFeatures.polygon_rest`. `Scenario.origin` is in whole meters: subtraction is exact.

Shapes: O objects, S steps at 10 Hz (91 or more; 11 in a test split), F map features, P map points, K light states.
Torch is not needed.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from functools import cached_property, wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, get_args, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int8, Int32, Int64, Shaped

from rlftsim.errors import ConfigError, DataError, in_short
from rlftsim.jobs.documents import MAX_NAME_BYTES

COARSEST_M = 0.01
"""Coordinates are refused where float32 has larger gaps."""
STEP_S = 0.1
MAX_SECONDS = 86_400.0
TIME_TOLERANCE_S = STEP_S / 2
"""A timestamp may be so far from its multiple of 0.1 s: in 9 s the clocks of real logs drift by up to 0.022 s, and
their steps differ by up to 0.011 s."""
HISTORY_STEPS = 11
CURRENT_STEP = 10
FUTURE_STEPS = 80
TOTAL_STEPS = 91
MOVING_M_S = 1.0
"""An agent moves if its mean logged speed is at least this."""
STOP_M_S = 0.5
STOP_STEPS = 10
"""A stop: slower than `STOP_M_S` for one second on end."""


def count_steps(seconds: float) -> int:
    """Number of steps of 0.1 s in a time.

    Args:
        seconds: Time in seconds, a multiple of 0.1 above zero.

    Raises:
        ConfigError: A time that is no such multiple.
    """
    is_number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
    steps = round(seconds / STEP_S) if is_number and 0 < seconds < MAX_SECONDS else 0
    if steps < 1 or abs(steps * STEP_S - seconds) > 1e-6:
        raise ConfigError(
            f"seconds must be a multiple of {STEP_S:g} above 0 and below {MAX_SECONDS:g}, got {in_short(seconds)}."
        )
    return steps


class ObjectType(IntEnum):
    """Type of road user, WOMD's numbers."""

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
"""Length, width and height of objects of further types."""


class MapFeatureType(IntEnum):
    """Type of map feature; the numbers of WOMD's `roadgraph_samples/type`."""

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
POLYGON_TYPES = (MapFeatureType.CROSSWALK, MapFeatureType.SPEED_BUMP, MapFeatureType.DRIVEWAY)


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

    Where `valid` is False the arrays hold the values of the log, because the metric reads some of these.
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

    def select(self, objects: Shaped[np.ndarray, "n"]) -> "Tracks":
        """Tracks of the objects that a mask or indices name."""
        return Tracks(**{column.name: getattr(self, column.name)[objects] for column in fields(self)})

    def cut(self, steps: slice) -> "Tracks":
        """Tracks of all objects over some steps."""
        names = ("position", "heading", "velocity", "size", "valid")
        return replace(self, **{name: getattr(self, name)[:, steps] for name in names})


def to_float32(values: Float[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Nearest float32. Values out of range become infinite without a warning, and are refused by a check later."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _no_rows(columns: int) -> Int64[np.ndarray, "0 columns"]:
    return np.zeros((0, columns), np.int64)


@dataclass(frozen=True, eq=False)
class LaneTopology:
    """Links between lanes; rows start with a lane's feature id and are in file order. Without links all are empty."""

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

    @classmethod
    def of(cls, **columns: Any) -> "LaneTopology":
        """Links row by row.

        Args:
            columns: Fields by name; tables of links as lists of rows, without rows or left out where there are none.
        """
        tables = {name: table for name, table in vars(cls()).items() if table is not None and name in columns}
        rows = {name: np.array(columns[name], np.int64).reshape(-1, table.shape[1]) for name, table in tables.items()}
        return cls(**columns | rows)


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
    def of(
        cls,
        features: Iterable[tuple[int, int, np.ndarray]],
        topology: LaneTopology | None = None,
        *,
        has_polygon_rest: bool = False,
    ) -> "MapFeatures":
        """Map of features one by one.

        Args:
            features: Feature id, `MapFeatureType` number and points [n, 3] of each, in the order of the map.
            topology: Links between the lanes; None = lanes without links.
            has_polygon_rest: True keeps the rounding error of polygons.
        """
        ids, types, lines = zip(*features) if (features := list(features)) else ((), (), ())
        lengths = np.array([len(line) for line in lines], np.int64)
        exact = np.concatenate([np.zeros((0, 3)), *lines])  # [P, 3] float64
        points, error = to_float32(exact), np.zeros_like(exact)
        # only of finite points: infinity minus infinity would warn before the point is refused by name
        is_polygon = np.repeat(np.isin(types, POLYGON_TYPES), lengths)[:, None]
        np.subtract(exact, points, out=error, where=is_polygon & np.isfinite(points))
        return cls(
            feature_id=np.array(ids, np.int64),
            feature_type=np.array(types, np.int8),
            points=points,
            offsets=np.append(0, np.cumsum(lengths)),
            topology=topology or LaneTopology(),
            polygon_rest=to_float32(error) if has_polygon_rest else None,
        )

    def __len__(self) -> int:
        return len(self.feature_id)

    def polyline(self, index: int | np.integer) -> Float32[np.ndarray, "n 3"]:
        """Points of feature `index`, world frame."""
        return self.points[self.offsets[index] : self.offsets[index + 1]]

    def polygon(self, index: int | np.integer) -> Float64[np.ndarray, "n 3"]:
        """Points of a crosswalk, bump or driveway, world frame, in the precision of the source."""
        polygon = self.polyline(index).astype(np.float64)
        span = slice(self.offsets[index], self.offsets[index + 1])
        return polygon if self.polygon_rest is None else polygon + self.polygon_rest[span]

    def find_indices(self, types: tuple[int, ...]) -> Int64[np.ndarray, "n"]:
        """Indices of the features of the given types, in file order."""
        return np.flatnonzero(np.isin(self.feature_type, types))


@dataclass(frozen=True, eq=False)
class LightStates:
    """Traffic light observations, a row each, by step, then in the log's order (a lane may occur twice)."""

    step: Int32[np.ndarray, "K"]
    lane_id: Int64[np.ndarray, "K"]
    state: Int8[np.ndarray, "K"]
    stop_point: Float32[np.ndarray, "K 3"]

    @classmethod
    def of(cls, rows: Sequence[tuple[int, int, int, Any, Any, Any]]) -> "LightStates":
        """Light states of observations one by one.

        Args:
            rows: Step, lane id, `LightState` number, and x, y, z of the stop point in meters, world frame.
        """
        step, lane_id, state, *point = zip(*rows) if rows else ((),) * 6
        stop_point = to_float32(np.array(point, np.float64).T.reshape(-1, 3))
        return cls(np.array(step, np.int32), np.array(lane_id, np.int64), np.array(state, np.int8), stop_point)


@dataclass(frozen=True, eq=False)
class Scenario:
    """A logged scenario. Compared and hashed by identity, so that values computed from a scenario can be cached.

    Arrays must not change for the same reason, and arrays of a data set are read-only: a changed scenario is made with
    `dataclasses.replace` and copies.
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
    """Name of the data source that read the log, such as "womd"."""
    guessed: frozenset[str] = frozenset()
    """Values that the log lacks and the data source made up, such as "size" and "z"."""

    def check_scenario_id(self) -> None:
        """Check that the id can be a file name: films and rollouts are named after the scenario.

        Raises:
            DataError: The id is no text, empty, too long, or has a slash or a control character.
        """
        name = self.scenario_id
        is_text = isinstance(name, str) and len(name.encode(errors="replace")) <= MAX_NAME_BYTES
        if not is_text or not re.fullmatch(r"[^/\\\x00-\x1f]+", name) or name in (".", ".."):
            raise DataError(
                f"scenario id {in_short(name)} is no file name, and files are named after it: write it as text of at "
                f"most {MAX_NAME_BYTES} bytes without slashes and control characters"
            )

    def check_array_shapes(self) -> None:
        """Check that tracks, map and lights hold arrays with the axes that the classes declare.

        Raises:
            DataError: A value is no array, or an axis has a different length than in the arrays before.
        """
        for name, table in self.tables.items():
            _check_shapes(table, name)

    def check_consistency(self) -> None:
        """Check what every reader relies on: steps of 0.1 s, track indices, ids that differ, types, states, sizes, map.

        Sizes are checked at the current step: simulation and metric read no further sizes, and logs hold zeros where a
        state is not valid.

        Raises:
            DataError: A value breaks a rule; the message names track, map feature, light or index, and the value.
        """
        tracks = self.tracks
        if self.num_steps < HISTORY_STEPS:
            raise DataError(f"{self.num_steps} steps, the history alone has {HISTORY_STEPS}")
        for name in ("tracks_to_predict", "difficulty", "objects_of_interest"):
            if np.ndim(getattr(self, name)) != 1:
                raise DataError(f"{name} is {in_short(getattr(self, name))}, it must be a list of numbers")
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
        """Check that every valid state, map point and stop point is finite.

        Raises:
            DataError: A NaN or an infinite number; the message names track, step and field, or the point.
        """
        tracks = self.tracks
        for name in ("position", "heading", "velocity", "size"):
            is_finite = np.isfinite(getattr(tracks, name))
            is_finite = is_finite if name == "heading" else is_finite.all(-1)
            entries = np.argwhere(tracks.valid & ~is_finite)  # [n, 2] rows of (track, step)
            if len(entries):
                track, step = entries[0]
                raise DataError(
                    f"track {tracks.object_id[track]} has a NaN or infinite {name} at step {step}, where it is marked "
                    "valid: correct the value or mark the state as not valid"
                )
        lines = self.map_features
        entries = np.flatnonzero(~np.isfinite(lines.points).all(1))
        if len(entries):
            owner = np.searchsorted(lines.offsets, entries[0], side="right") - 1
            index = entries[0] - lines.offsets[owner]
            raise DataError(
                f"map feature {lines.feature_id[owner]} has a NaN or infinite point (its point {index}): "
                "correct it or leave the feature out"
            )
        entries = np.flatnonzero(~np.isfinite(self.lights.stop_point).all(-1))
        if len(entries):
            raise DataError(
                f"stop point {entries[0]} of the traffic lights is NaN or infinite: correct it or leave the light out"
            )

    def check_precision(self) -> None:
        """Check that float32 resolves every position to a centimeter, which holds up to 131 km from the origin.

        Raises:
            DataError: A position lies farther out, as in UTM coordinates; the message names track, step, position
                and the gap of float32.
        """
        tracks = self.tracks
        with np.errstate(invalid="ignore"):  # states that are not valid may hold infinities
            spacing = np.spacing(np.abs(tracks.position)).max(-1)  # [O, S] distance to the next float32
        entries = np.argwhere(tracks.valid & (spacing > COARSEST_M))
        way_out = "subtract an origin near it, in whole meters, from x and y of tracks, map and lights"
        if len(entries):
            track, step = entries[0]
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

    def window(self, start: int, num_steps: int = TOTAL_STEPS) -> "Scenario":
        """Some steps of the log as a scenario of its own, in which "now" is ten steps after the first.

        Args:
            start: First step of the window; a later one than 0 is part of the id.
            num_steps: Length of the window; it ends earlier where the log does. 11 withhold the future.
        """
        steps, lights = slice(start, start + num_steps), self.lights
        is_inside = (lights.step >= start) & (lights.step < start + num_steps)
        observed = {column.name: getattr(lights, column.name)[is_inside] for column in fields(lights)}
        return replace(
            self,
            scenario_id=f"{self.scenario_id}@{start}" if start else self.scenario_id,
            timestamps_s=self.timestamps_s[steps],
            tracks=self.tracks.cut(steps),
            lights=LightStates(**observed | {"step": observed["step"] - observed["step"].dtype.type(start)}),
        )

    @property
    def tables(self) -> dict[str, Any]:
        """Tables of arrays by the names that messages and shards give them."""
        features = self.map_features
        return {"tracks": self.tracks, "map": features, "topology": features.topology, "lights": self.lights}

    @property
    def num_steps(self) -> int:
        """91 of the Waymo dataset, more of a longer log, or 11 where the future is withheld."""
        return self.tracks.valid.shape[1]

    @property
    def has_future(self) -> bool:
        """True where the log has the 80 future steps of the metric, or more."""
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

        A track to predict that is not valid at the current step is left out, because only valid agents are simulated.
        """
        # each track once, even where the ego is among the tracks to predict
        indices = np.unique(np.append(self.tracks_to_predict, self.ego_index).astype(np.int64))
        indices = indices[self.tracks.valid[indices, CURRENT_STEP]]
        return indices[np.argsort(self.tracks.object_id[indices], kind="stable")]

    @cached_property
    def origin(self) -> Float[np.ndarray, "2"]:
        """Center of the *map* frame: ego position at the current step in whole meters, float64, world frame."""
        return np.round(self.tracks.position[self.ego_index, CURRENT_STEP, :2].astype(np.float64))

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # without what is cached

    def __repr__(self) -> str:
        types = self.tracks.object_type[self.simulated_indices]
        counts = [(int((types == t).sum()), t.name.lower()) for t in ObjectType]
        counts_text = ", ".join(f"{count} {name}{'s' if count != 1 else ''}" for count, name in counts if count)
        return (
            f"Scenario({self.scenario_id!r}, {len(types)} agents ({counts_text or 'none'}), {self.num_steps} steps, "
            f"{len(self.map_features)} map features)"
        )

    def _repr_html_(self) -> str | None:
        return render_html(self)


_HTML_RENDERERS: dict[type, Callable[[Any], str | None]] = {}


def register_html(displayed_type: type, render: Callable[[Any], str | None]) -> None:
    """Choose how a notebook shows values of a class. The viewer registers a renderer on import.

    Args:
        displayed_type: Class whose `_repr_html_` calls `render_html`.
        render: Function from a value to a text in HTML; None = the notebook prints the value.
    """
    _HTML_RENDERERS[displayed_type] = render


def render_html(value: Any) -> str | None:
    """Text in HTML that a notebook shows for a value; None for a class without a registered renderer."""
    render = _HTML_RENDERERS.get(type(value))
    return None if render is None else render(value)


def _check_shapes(table: Any, name: str) -> None:
    sizes: dict[str, int] = {}
    for column in fields(table):
        value, is_optional = getattr(table, column.name), type(None) in get_args(column.type)
        declared: Any = get_args(column.type)[0] if is_optional else column.type
        if not hasattr(declared, "dim_str") or (value is None and is_optional):
            continue
        axes = declared.dim_str.split()
        declared_shape = f"[{', '.join(axes)}]"
        if not isinstance(value, np.ndarray):
            raise DataError(f"{name}.{column.name} is {type(value).__name__}, it must be an array {declared_shape}")
        expected = []
        for axis, length in zip(axes, value.shape):
            symbol, _, summand = axis.partition("+")  # such as "F+1"
            extra = int(summand or 0)
            expected.append(int(axis) if axis.isdigit() else sizes.setdefault(symbol, length - extra) + extra)
        if value.shape != tuple(expected) or len(axes) != value.ndim:
            lengths = ", ".join(f"{symbol} = {size}" for symbol, size in sizes.items())
            raise DataError(f"{name}.{column.name} has the shape {value.shape}, it must be {declared_shape}: {lengths}")


def _check_time_base(timestamps_s: Any, num_steps: int) -> None:
    """Check that timestamps are 0.1 s apart: else speeds, tokens and scores would be wrong by a factor."""
    if np.ndim(timestamps_s) != 1:
        raise DataError(f"timestamps are {in_short(timestamps_s)}, not one number for each step")
    if len(timestamps_s) != num_steps:
        raise DataError(f"{len(timestamps_s)} timestamps for {num_steps} steps")
    offset_s = timestamps_s - timestamps_s[0]
    steps = np.flatnonzero(~(np.abs(offset_s - STEP_S * np.arange(num_steps)) <= TIME_TOLERANCE_S))  # NaN, too
    if len(steps):
        step = steps[0]
        raise DataError(
            f"step {step} is {offset_s[step]:.3f} s after step 0 instead of {STEP_S * step:.1f} s: steps must be "
            f"{STEP_S:g} s apart, so resample the log to 10 Hz or correct its timestamps"
        )


def _check_unique(complaint: str, ids: Int[np.ndarray, "n"]) -> None:
    values, count = np.unique(ids, return_counts=True)
    if (count > 1).any():
        raise DataError(complaint.format(values[count.argmax()], count.max()))


def _check_types(
    label: str, ids: Int64[np.ndarray, "n"], field_name: str, codes: Int8[np.ndarray, "n"], enumeration: type[IntEnum]
) -> None:
    rows = np.flatnonzero(~np.isin(codes, list(enumeration)))
    if len(rows):
        choices = ", ".join(f"{member.value} {member.name.lower()}" for member in enumeration)
        raise DataError(f"{label} {ids[rows[0]]}: {field_name} {codes[rows[0]]} is none of {choices}")


@runtime_checkable
class Scenarios(Protocol):
    """Scenarios by position: a list or a data set."""

    def __len__(self) -> int:
        """Number of scenarios."""
        ...

    def __getitem__(self, position: int, /) -> Scenario:
        """Scenario at a position."""
        ...


def list_scenario_ids(scenarios: Scenarios) -> Iterable[str]:
    """Scenario ids in order."""
    # a data set has the ids in the index: no scenario is read
    scenario_ids = getattr(scenarios, "scenario_ids", None)
    return scenario_ids if scenario_ids is not None else (scenarios[i].scenario_id for i in range(len(scenarios)))


_CACHE = "_cached_values"
Value = TypeVar("Value")
Arguments = ParamSpec("Arguments")


def cached_on_scenario(
    compute: Callable[Concatenate[Scenario, Arguments], Value],
) -> Callable[Concatenate[Scenario, Arguments], Value]:
    """Decorator that caches a function of a scenario, and of further hashable arguments, with the scenario.

    The values are dropped together with the scenario, also those that refer to the scenario.
    """

    @wraps(compute)
    def remembered(scenario: Scenario, *arguments: Arguments.args, **named: Arguments.kwargs) -> Value:
        values = scenario.__dict__.setdefault(_CACHE, {})
        key = (compute, arguments, tuple(named.items()))
        if key not in values:
            values[key] = compute(scenario, *arguments, **named)
        return values[key]

    return remembered
