"""Argoverse 2 maps: vector map archives (JSON) to map features, and the ground that maps cover.

The local map is cut out of the city's along a 30 m grid. Where the cut crosses a street, the outline of the drivable
area is no curb: such stretches are left out of the road edges, see `find_cuts`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.documents import read_json
from rlftsim.scenario.polylines import Heights, arc_length, densify, find_runs, resample_to
from rlftsim.scenario.types import LaneTopology, MapFeatures, MapFeatureType

CENTER_SPACING_M = 0.5
EDGE_SPACING_M = 1.0
GRID_M = 30.0
ON_GRID_M = 0.01
"""Coordinates are given in centimeters."""
LONGEST_WALL_ON_GRID_M = 1.0
"""Longest stretch of an outline along a grid line that may be a curb."""
LANE_TYPES = {
    "VEHICLE": MapFeatureType.LANE_SURFACE_STREET,
    "BUS": MapFeatureType.LANE_SURFACE_STREET,
    "BIKE": MapFeatureType.LANE_BIKE,
}
LINE_TYPES = {
    **dict.fromkeys(("NONE", "UNKNOWN")),
    **dict.fromkeys(("DASHED_WHITE", "DOUBLE_DASH_WHITE"), MapFeatureType.LINE_BROKEN_SINGLE_WHITE),
    **dict.fromkeys(("SOLID_WHITE", "SOLID_BLUE"), MapFeatureType.LINE_SOLID_SINGLE_WHITE),
    **dict.fromkeys(
        ("DOUBLE_SOLID_WHITE", "SOLID_DASH_WHITE", "DASH_SOLID_WHITE"), MapFeatureType.LINE_SOLID_DOUBLE_WHITE
    ),
    "DASHED_YELLOW": MapFeatureType.LINE_BROKEN_SINGLE_YELLOW,
    "DOUBLE_DASH_YELLOW": MapFeatureType.LINE_BROKEN_DOUBLE_YELLOW,
    "SOLID_YELLOW": MapFeatureType.LINE_SOLID_SINGLE_YELLOW,
    "DOUBLE_SOLID_YELLOW": MapFeatureType.LINE_SOLID_DOUBLE_YELLOW,
    **dict.fromkeys(("SOLID_DASH_YELLOW", "DASH_SOLID_YELLOW"), MapFeatureType.LINE_PASSING_DOUBLE_YELLOW),
}
"""Lane mark -> road line; None = no line."""
INSTALL_HINT = 'Argoverse 2 maps need shapely: pip install "rlftsim[av2]"'


@dataclass(frozen=True, eq=False)
class Lane:
    """One lane segment of the file; both boundaries run along the lane."""

    lane_id: int
    lane_type: str
    left: Float[np.ndarray, "_ 3"]
    right: Float[np.ndarray, "_ 3"]
    marks: tuple[str, str]
    """Left and right."""
    neighbors: tuple[int | None, int | None]
    """Left and right."""
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]
    is_intersection: bool

    def center(self) -> Float[np.ndarray, "n 3"]:
        """Center line. Computed, because the center lines of some files have all heights 0."""
        length = max(arc_length(self.left)[-1], arc_length(self.right)[-1])
        count = int(np.ceil(length / CENTER_SPACING_M))
        return (resample_to(self.left, count) + resample_to(self.right, count)) / 2


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground that a map covers."""

    heights: Heights
    area: Any
    """Union of the drivable areas, a shapely geometry."""
    walls: Any
    """Outline without the cuts."""
    cuts: Any
    """Stretches of the outline where the map was cut out of the city's."""

    def covers(self, positions: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """True for positions inside the drivable area, border included."""
        shapely = _shapely()
        return shapely.intersects_xy(self.area, positions[:, 0], positions[:, 1])

    def leaves_through_cut(self, path: Float[np.ndarray, "n 2"]) -> bool:
        """True if a path is outside the drivable area at least once, and left through a cut.

        The border that is nearer to the step over it decides; for a path that is never inside, the border nearer to its
        first point.

        Args:
            path: Positions [n, 2] in order of time, world frame, m.
        """
        shapely = _shapely()
        inside = self.covers(path)
        for start, stop in find_runs(~inside):
            steps = [path[k - 1 : k + 1] for k in (start, stop) if 0 < k < len(path)] or [path[[0, 0]]]
            to_cuts, to_walls = (
                # there may be no such border: infinitely far
                np.nan_to_num(shapely.distance(shapely.linestrings(steps), border), nan=np.inf)
                for border in (self.cuts, self.walls)
            )
            if (to_cuts <= to_walls).any():
                return True
        return False


def read_map(path: Path) -> tuple[MapFeatures, Ground]:
    """Map features of a vector map archive, and the ground.

    Lanes keep the ids of the file, further features are numbered after the highest lane id. Heights of road edges come
    from the nearest points of the outline.

    Raises:
        DataError: The file is damaged, or not of the published schema.
        ConfigError: shapely is not installed.
    """
    remedy = "get the file again"
    archive = read_json(path, remedy, missing=f"{path.name} is missing: {remedy}")
    groups = {}
    for name in ("lane_segments", "pedestrian_crossings", "drivable_areas"):
        groups[name] = archive.get(name)
        if not isinstance(groups[name], dict):
            raise DataError(f"{path.name} has no {name}: it is not a map of Argoverse 2 motion forecasting")
    lanes = [_read_lane(f"{path.name}: lane segment {key}", value) for key, value in groups["lane_segments"].items()]
    centers = {lane.lane_id: lane.center() for lane in lanes}
    if len(centers) < len(lanes):
        raise DataError(f"{path.name}: two lane segments have one id")
    lines, boundaries = _road_lines(path.name, lanes, centers)

    features = [(lane.lane_id, LANE_TYPES[lane.lane_type], centers[lane.lane_id]) for lane in lanes]
    features += [(line_id, line_type, points) for line_id, (line_type, points) in lines.items()]
    next_id = max([*centers, *lines], default=0) + 1
    for key, crossing in groups["pedestrian_crossings"].items():
        location = f"{path.name}: pedestrian crossing {key}"
        features.append((next_id, MapFeatureType.CROSSWALK, _crosswalk(location, crossing)))
        next_id += 1
    areas = [
        _read_points(f"{path.name}: drivable area {key}", value, "area_boundary", min_points=3)
        for key, value in groups["drivable_areas"].items()
    ]
    edges, ground = _road_edges(areas, lanes)
    features += [(next_id + k, MapFeatureType.EDGE_BOUNDARY, edge) for k, edge in enumerate(edges)]
    topology = _topology(lanes, centers, boundaries, len(features))
    return MapFeatures.of(features, topology), ground


def find_cuts(ring: Float[np.ndarray, "corners 2"]) -> Bool[np.ndarray, "lines"]:
    """Segments of an outline along which the map was cut out of the city's, True.

    Cuts lie on a line of the 30 m grid, within a centimeter, and are longer than a meter.

    Args:
        ring: Corners of the closed outline, world frame, m; the last is the first again.
    """
    lines = np.rint(ring / GRID_M)  # [n+1, 2] number of the nearest grid line along x and y
    is_on_grid = np.abs(ring - lines * GRID_M) <= ON_GRID_M
    is_on_line = is_on_grid[:-1] & is_on_grid[1:] & (lines[:-1] == lines[1:])  # [n, 2]
    length = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    is_cut = np.zeros(len(length), bool)
    for axis in range(2):
        if is_on_line[:, axis].all():
            continue
        # runs of segments on one line, begun where there is none, so that no run goes on over the end of the ring
        first = int(np.argmin(is_on_line[:, axis]))
        order = np.roll(np.arange(len(length)), -first)
        for start, stop in find_runs(is_on_line[order, axis]):
            run = order[start:stop]
            is_cut[run] |= length[run].sum() > LONGEST_WALL_ON_GRID_M
    return is_cut


def _road_edges(areas: list[np.ndarray], lanes: list[Lane]) -> tuple[list[Float[np.ndarray, "n 3"]], Ground]:
    """Outline of the drivable areas with the road on its left, without the cuts, and the ground."""
    shapely = _shapely()
    # Areas are tiles that abut, so single outlines would cross the road: tiles are merged, on the grid of the
    # coordinates, so that no slit is left between two tiles.
    tiles = shapely.make_valid(np.array([shapely.Polygon(area[:, :2]) for area in areas], dtype=object))
    area = shapely.union_all(tiles, grid_size=ON_GRID_M)
    stretches: dict[bool, list[np.ndarray]] = {False: [], True: []}  # by: is a cut
    for polygon in shapely.get_parts(area):
        if shapely.get_type_id(polygon) != 3:  # a line or point that is left of a damaged tile
            continue
        for number, ring in enumerate([polygon.exterior, *polygon.interiors]):
            points = shapely.get_coordinates(ring)
            # outer outlines counter-clockwise, holes clockwise
            points = points if shapely.is_ccw(ring) == (number == 0) else points[::-1]
            is_cut = find_cuts(points)
            first = int(np.argmax(is_cut != np.roll(is_cut, 1)))  # a change, or 0 where there is none
            corners = np.concatenate([points[first:-1], points[: first + 1]])
            is_cut = np.roll(is_cut, -first)
            starts = np.flatnonzero(np.diff(is_cut, prepend=not is_cut[0]))
            for start, stop in zip(starts, [*starts[1:], len(is_cut)]):
                stretches[bool(is_cut[start])].append(corners[start : stop + 1])
    heights = Heights(np.concatenate([np.zeros((0, 3)), *areas]))
    edges = []
    for wall in stretches[False]:
        points = densify(wall, EDGE_SPACING_M)
        edges.append(np.column_stack([points, heights.at(points)]))
    walls, cuts = (shapely.MultiLineString(stretches[is_cut]) for is_cut in (False, True))
    borders = [side for lane in lanes for side in (lane.left, lane.right)]
    return edges, Ground(Heights(np.concatenate([np.zeros((0, 3)), *borders])), area, walls, cuts)


def _road_lines(
    name: str, lanes: list[Lane], centers: Mapping[int, np.ndarray]
) -> tuple[dict[int, tuple[int, np.ndarray]], list[tuple[int, ...]]]:
    """Painted lines by id, each once though two lanes share it, and rows of `LaneTopology.boundaries`."""
    ids: dict[bytes, int] = {}
    lines: dict[int, tuple[int, np.ndarray]] = {}
    rows = []
    for lane in lanes:
        for side, (points, mark) in enumerate(zip((lane.left, lane.right), lane.marks)):
            if mark not in LINE_TYPES:
                raise DataError(f"{name}: lane segment {lane.lane_id} has the unknown lane mark {mark!r}")
            line_type = LINE_TYPES[mark]
            if line_type is None:
                continue
            # neighbors in opposite directions list the same points backwards
            geometry = min(points.tobytes(), points[::-1].tobytes())
            line_id = ids.setdefault(geometry, max(centers) + 1 + len(ids))
            lines.setdefault(line_id, (line_type, points))
            road_line = line_type - MapFeatureType.LINE_UNKNOWN
            rows.append((lane.lane_id, side, line_id, 0, len(centers[lane.lane_id]) - 1, road_line))
    return lines, rows


def _topology(
    lanes: list[Lane], centers: Mapping[int, np.ndarray], boundaries: list[tuple[int, ...]], num_features: int
) -> LaneTopology:
    """Links between the lanes of the file; lanes are the first features."""
    neighbors = []
    for lane in lanes:
        for side, neighbor_id in enumerate(lane.neighbors):
            if neighbor_id is not None and neighbor_id in centers:
                center, neighbor_center = centers[lane.lane_id], centers[neighbor_id]
                same_direction = np.linalg.norm(center[[0, -1], :2] - neighbor_center[[0, -1], :2], axis=1).sum()
                opposite = np.linalg.norm(center[[0, -1], :2] - neighbor_center[[-1, 0], :2], axis=1).sum()
                if same_direction <= opposite:
                    neighbors.append((lane.lane_id, side, neighbor_id, 0, len(center) - 1, 0, len(neighbor_center) - 1))
    interpolating = np.zeros(num_features, bool)
    interpolating[: len(lanes)] = [lane.is_intersection for lane in lanes]

    entries = [(lane.lane_id, link) for lane in lanes for link in lane.predecessors if link in centers]
    exits = [(lane.lane_id, link) for lane in lanes for link in lane.successors if link in centers]
    return LaneTopology.of(
        entry_lanes=entries, exit_lanes=exits, neighbors=neighbors, boundaries=boundaries, interpolating=interpolating
    )


def _read_lane(location: str, value: Any) -> Lane:
    if not isinstance(value, dict):
        raise DataError(f"{location} is no object")
    sided = [f"{side}_{field}" for field in ("lane_mark_type", "neighbor_id") for side in ("left", "right")]
    for name in ("id", "lane_type", "is_intersection", "predecessors", "successors", *sided):
        if name not in value:
            raise DataError(f"{location} has no {name}")
    lane_type = value["lane_type"]
    if lane_type not in list(LANE_TYPES):  # a list: the value may be of any type
        raise DataError(f"{location} has the unknown lane type {lane_type!r}")
    marks = (value["left_lane_mark_type"], value["right_lane_mark_type"])
    if not all(isinstance(mark, str) for mark in marks):
        raise DataError(f"{location} has the lane marks {marks}, they must be words")
    neighbors = (value["left_neighbor_id"], value["right_neighbor_id"])
    links = [value["predecessors"], value["successors"]]
    if not all(isinstance(link, list) for link in links):
        raise DataError(f"{location}: predecessors and successors must be lists")
    ids = [value["id"], *(n for n in neighbors if n is not None), *links[0], *links[1]]
    if not all(isinstance(lane_id, int) and not isinstance(lane_id, bool) and 0 <= lane_id < 2**62 for lane_id in ids):
        raise DataError(f"{location}: ids of lanes must be whole numbers from 0 on")
    return Lane(
        lane_id=value["id"],
        lane_type=lane_type,
        left=_read_points(location, value, "left_lane_boundary", min_points=2),
        right=_read_points(location, value, "right_lane_boundary", min_points=2),
        marks=marks,
        neighbors=neighbors,
        predecessors=tuple(links[0]),
        successors=tuple(links[1]),
        is_intersection=bool(value["is_intersection"]),
    )


def _read_points(location: str, value: Any, name: str, *, min_points: int) -> Float[np.ndarray, "n 3"]:
    points: Any = value.get(name) if isinstance(value, dict) else None
    try:
        coordinates = np.array([(point["x"], point["y"], point["z"]) for point in points], np.float64).reshape(-1, 3)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise DataError(f"{location}: {name} must be a list of points with x, y and z") from None
    if len(coordinates) < min_points:
        raise DataError(f"{location}: {name} has {len(coordinates)} points, it needs {min_points}")
    if not (np.abs(coordinates) < 1e7).all():  # NaN is not, either
        raise DataError(f"{location}: {name} has a NaN, infinite or impossible coordinate")
    return coordinates


def _crosswalk(location: str, value: Any) -> Float[np.ndarray, "4 3"]:
    """Polygon of the two edges of a crossing, turned so that the border does not cross."""
    first = _read_points(location, value, "edge1", min_points=2)[[0, -1]]
    second = _read_points(location, value, "edge2", min_points=2)[[0, -1]]
    # Edges in the same direction would make a bow tie: then the distance is shorter from end to end.
    direct = np.linalg.norm(first[1] - second[0]) + np.linalg.norm(first[0] - second[1])
    turned = np.linalg.norm(first[1] - second[1]) + np.linalg.norm(first[0] - second[0])
    return np.concatenate([first, second[::-1] if turned < direct else second])


def _shapely() -> Any:
    try:
        import shapely
    except ImportError as error:
        raise ConfigError(INSTALL_HINT) from error
    return shapely
