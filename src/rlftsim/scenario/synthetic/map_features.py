"""Map of a whole network in WOMD's terms: lanes and links, road lines, road edges, stop signs, crosswalks."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from rlftsim.scenario.polylines import arc_length, find_runs, resample_to
from rlftsim.scenario.synthetic.network import Connector, Lane, Network
from rlftsim.scenario.synthetic.street_plan import Street, offset_polyline
from rlftsim.scenario.types import MapFeatureType

POINT_SPACING_M = 0.5
FREEWAY_LIMIT_MPS = 24.0
SOLID_BEFORE_JUNCTION_M = 25.0
CURB_RADIUS_M = 4.5
OPEN_END_M = 22.0
MOUTH_M = 4.0
MEDIAN_AREA_PER_PERIMETER_M = 4.0


@dataclass(frozen=True, eq=False)
class Feature:
    """One map feature in plan coordinates."""

    feature_id: int
    feature_type: MapFeatureType
    points: Float[np.ndarray, "n 2"]
    speed_mps: float = 0.0
    interpolating: bool = False


@dataclass(frozen=True, eq=False)
class NetworkMap:
    """All features of a network; ids are unique in it."""

    features: tuple[Feature, ...]
    entry_exit: tuple[tuple[int, int], ...]
    """Lane and the lane that follows."""
    neighbors: tuple[tuple[int, int, int], ...]
    """Lane, side (0 left, 1 right), neighbor."""
    stop_sign_lanes: tuple[tuple[int, int], ...]
    light_lanes: tuple[tuple[str, int, int, str], ...]
    """Junction, link index, feature id of the connector, direction letter."""
    drivable: Any = field(repr=False, default=None)
    """Drivable area as a shapely geometry."""


def resample(points: Float[np.ndarray, "n 2"], spacing_m: float = POINT_SPACING_M) -> Float[np.ndarray, "m 2"]:
    """Points at equal distances along a polyline, first and last kept.

    Args:
        points: Polyline with n points, m.
        spacing_m: Largest distance between two points of the result, m.
    """
    return resample_to(points, int(np.ceil(arc_length(points)[-1] / spacing_m)) + 1)


# --- drivable area ------------------------------------------------------------------------------------------------


def _strip(shape: Float[np.ndarray, "n 2"], left_m: float, right_m: float) -> Any:
    """Polygon between two offsets of a polyline (meters to the left, meters to the right)."""
    import shapely

    points = resample(shape, 2.0)
    ring = np.concatenate([offset_polyline(points, left_m), offset_polyline(points, -right_m)[::-1]])
    return shapely.Polygon(ring).buffer(0)


def _street_strips(network: Network) -> dict[str, Any]:
    """Paved strip of each street as compiled: all lanes but sidewalks."""
    strips = {}
    for street in network.plan.streets:
        if network.plan.network_type == "freeway":  # as planned, so that no gap is left where segments meet
            strips[street.street_id] = _strip(street.points, 0.3, street.roadway_width_m)
            continue
        paved = [k for k, lane in enumerate(street.lanes) if lane.lane_type != "sidewalk"]
        leftmost = network.lane((street.street_id, paved[-1]))
        left = leftmost.width_m / 2 + (0.3 if street.reverse_id is None else 0.05)
        right = street.roadway_width_m - leftmost.width_m / 2
        strips[street.street_id] = _strip(leftmost.shape, left, right)
    return strips


def _mouth(network: Network, street: Street, node_id: str) -> Any:
    """Roadway of a street continued straight into a junction, without its parking strip, so that curbs meet there."""
    leftmost = network.lane((street.street_id, len(street.lanes) - 1))
    end = leftmost.shape[-2:] if street.to_node == node_id else leftmost.shape[:2]
    tangent = (end[1] - end[0]) / max(float(np.linalg.norm(end[1] - end[0])), 1e-6)
    reach = MOUTH_M * tangent
    line = np.stack([end[1], end[1] + reach] if street.to_node == node_id else [end[0] - reach, end[0]])
    width = sum(lane.width_m for lane in street.lanes if lane.lane_type not in ("sidewalk", "parking"))
    return _strip(line, leftmost.width_m / 2, width - leftmost.width_m / 2)


def _junction_area(network: Network, node_id: str, strips: dict[str, Any]) -> Any:
    """Connectors and crosswalks with rounded curbs, cut to the neighborhood of the junction."""
    import shapely

    shape = shapely.Polygon(network.junction_shapes[node_id]).buffer(0)
    # streets count up to 14 m before the junction, far enough to round the corners between them
    surroundings = shape.buffer(14.0)
    connectors = [c for c in network.connectors if c.junction == node_id and len(c.shape) > 1]
    strokes = [(connector.shape, connector.width_m / 2 + 0.2) for connector in connectors]
    strokes += [(line, width / 2) for junction, line, width in network.crosswalks if junction == node_id]
    areas = [shapely.LineString(line).buffer(reach, cap_style="flat") for line, reach in strokes]
    streets = [street for street in network.plan.streets if node_id in (street.from_node, street.to_node)]
    areas += [strips[street.street_id].intersection(surroundings) for street in streets]
    areas += [_mouth(network, street, node_id).intersection(shape) for street in streets]
    area = shapely.union_all(areas)
    # growing and shrinking by the same radius rounds inner corners only: those are the curbs
    rounded = area.buffer(CURB_RADIUS_M).buffer(-CURB_RADIUS_M)
    return shapely.union_all([area, rounded.intersection(shape.buffer(5.0))])


def compute_drivable_area(network: Network) -> Any:
    """Union of the streets' strips and the junctions, as a shapely geometry in plan coordinates."""
    import shapely

    strips = _street_strips(network)
    fringe = {node.node_id for node in network.plan.fringe_nodes}
    areas = list(strips.values()) + [shapely.Polygon(taper) for taper in network.plan.tapers]
    if network.plan.network_type != "freeway":
        areas += [
            _junction_area(network, node.node_id, strips)
            for node in network.plan.nodes
            if node.node_id not in fringe and node.node_id in network.junction_shapes
        ]
    area = shapely.union_all(areas).buffer(0.3).buffer(-0.3)  # closes slits between strips
    if network.plan.network_type != "freeway":
        return area
    # One carriageway at a time: smoothing both at once would close a narrow median here and there.
    carriageways = getattr(area, "geoms", [area])
    return shapely.union_all([carriageway.buffer(2.0).buffer(-4.0).buffer(2.0) for carriageway in carriageways])


def oriented_rings(area: Any) -> list[tuple[Float[np.ndarray, "n 2"], bool]]:
    """Rings of a polygon with the area on the left: outer rings counter-clockwise, holes clockwise.

    Returns:
        Closed rings (first point repeated at the end) and whether each is a median, a thin hole.
    """
    import shapely

    rings = []
    for polygon in getattr(area, "geoms", [area]):
        # WOMD's convention, which the metric relies on: the road is to the left of a road edge
        oriented = shapely.geometry.polygon.orient(polygon, 1.0)
        rings.append((np.asarray(oriented.exterior.coords), False))
        for hole in oriented.interiors:
            # tiny holes are slits between strips, not obstacles to a car
            size = shapely.Polygon(hole).area
            if size > 2.0:
                rings.append((np.asarray(hole.coords), size / hole.length < MEDIAN_AREA_PER_PERIMETER_M))
    return rings


def split_ring(ring: Float[np.ndarray, "n 2"], is_selected: np.ndarray) -> list[Float[np.ndarray, "m 2"]]:
    """Runs of consecutive selected points of a closed ring, in order. A ring with all points selected stays closed.

    Args:
        ring: Closed polyline with n points, m; the last is the first again.
        is_selected: True for the points of the runs, a value for each of the n points.
    """
    if is_selected.all():
        return [ring]
    points, is_inside = ring[:-1], is_selected[:-1]
    # start at a point outside of all runs: then no run passes the seam
    start = int(np.flatnonzero(~is_inside)[0])
    points, is_inside = np.roll(points, -start, axis=0), np.roll(is_inside, -start)
    return [points[a:b] for a, b in find_runs(is_inside) if b - a >= 2]


def _edge_features(network: Network, area: Any) -> Iterator[tuple[MapFeatureType, np.ndarray]]:
    """Road edges: borders of the drivable area, open at the ends of the network, where the road goes on."""
    ends = np.stack([node.position for node in network.plan.fringe_nodes])
    for ring, is_median in oriented_rings(area):
        points = resample(ring)
        is_inner = (np.linalg.norm(points[:, None] - ends[None], axis=-1) > OPEN_END_M).all(axis=1)
        edge_type = MapFeatureType.EDGE_MEDIAN if is_median else MapFeatureType.EDGE_BOUNDARY
        yield from ((edge_type, run) for run in split_ring(points, is_inner))


# --- lanes and lines ----------------------------------------------------------------------------------------------


def _lane_type(lane: Lane) -> MapFeatureType:
    if lane.lane_type == "bicycle":
        return MapFeatureType.LANE_BIKE
    return MapFeatureType.LANE_FREEWAY if lane.speed_mps > FREEWAY_LIMIT_MPS else MapFeatureType.LANE_SURFACE_STREET


def _left_border(network: Network, lane: Lane) -> Float[np.ndarray, "n 2"]:
    """Line along the left of a lane. On a freeway as planned, so that lines do not break where segments meet."""
    street = lane.street
    assert street is not None
    if network.plan.network_type == "freeway":
        return offset_polyline(street.points, -sum(planned.width_m for planned in street.lanes[lane.index + 1 :]))
    return offset_polyline(resample(lane.shape, 2.0), lane.width_m / 2)


def _between_lanes(
    line: Float[np.ndarray, "n 2"], beside_bicycles: bool, solid_tail: bool
) -> list[tuple[MapFeatureType, np.ndarray]]:
    """Line between two lanes of one direction, solid before a junction, where lanes must not be changed any more."""
    points = resample(line)
    if beside_bicycles:
        return [(MapFeatureType.LINE_SOLID_SINGLE_WHITE, points)]
    if not solid_tail:
        return [(MapFeatureType.LINE_BROKEN_SINGLE_WHITE, points)]
    cut = max(0, len(points) - 1 - int(SOLID_BEFORE_JUNCTION_M / POINT_SPACING_M))
    rows = [(MapFeatureType.LINE_SOLID_SINGLE_WHITE, points[cut:])]
    return [(MapFeatureType.LINE_BROKEN_SINGLE_WHITE, points[: cut + 1]), *rows] if cut > 0 else rows


def _line_features(network: Network) -> Iterator[tuple[MapFeatureType, np.ndarray]]:
    """Road lines of all streets."""
    fringe = {node.node_id for node in network.plan.fringe_nodes}
    for street in network.plan.streets:
        lanes = [network.lane((street.street_id, k)) for k in range(len(street.lanes))]
        driven = [lane for lane in lanes if lane.lane_type in ("travel", "bicycle")]
        solid_tail = network.plan.network_type != "freeway" and street.to_node not in fringe
        for lane, left in pairwise(driven):
            has_bicycles = "bicycle" in (lane.lane_type, left.lane_type)
            yield from _between_lanes(_left_border(network, lane), has_bicycles, solid_tail)
        # To the left of a direction: a line along a median, or a shared line between the directions.
        separator = resample(_left_border(network, driven[-1]))
        if street.reverse_id is None:
            if street.street_class != "ramp":
                yield MapFeatureType.LINE_SOLID_SINGLE_YELLOW, separator
        elif street.street_id < street.reverse_id:
            is_minor = street.street_class == "residential"
            broken, solid = MapFeatureType.LINE_BROKEN_SINGLE_YELLOW, MapFeatureType.LINE_SOLID_DOUBLE_YELLOW
            yield broken if is_minor else solid, separator
        if street.street_class == "freeway":
            yield MapFeatureType.LINE_SOLID_SINGLE_WHITE, resample(_left_border(network, lanes[0]))


def _stop_points(network: Network) -> Iterator[tuple[np.ndarray, list[Connector]]]:
    """Approaches with a stop sign: position right of the stop line, connectors that the sign controls."""
    approaches: dict[str, list[Connector]] = defaultdict(list)
    for connector in network.connectors:
        if connector.state in ("s", "w"):
            approaches[connector.from_lane[0]].append(connector)
    for street_id, connectors in approaches.items():
        outermost = network.lane((street_id, min(c.from_lane[1] for c in connectors)))
        street = outermost.street
        assert street is not None
        # lanes between the outermost lane and the sidewalk lie between the lane and the sign
        right = sum(x.width_m for x in street.lanes[: outermost.index] if x.lane_type != "sidewalk")
        border = offset_polyline(outermost.shape, -(outermost.width_m / 2 + right + 0.6))
        yield border[-1], connectors


def build_network_map(network: Network) -> NetworkMap:
    """All map features of a network, lanes first. Connectors at the network's ends (turn-arounds) are left out."""
    fringe = {node.node_id for node in network.plan.fringe_nodes}
    features: list[Feature] = []
    lane_ids: dict[str, int] = {}  # of compiled lanes, and of connectors by the first lane

    def _add(feature_type: MapFeatureType, points: np.ndarray, speed: float = 0.0, interpolating: bool = False) -> int:
        """Append a feature; its id counts from 1."""
        features.append(Feature(len(features) + 1, feature_type, points, speed, interpolating))
        return len(features)

    # 1. Lanes of streets, then those through junctions.
    for lane in network.lanes.values():
        if lane.street is not None and lane.lane_type in ("travel", "bicycle"):
            lane_ids[lane.lane_id] = _add(_lane_type(lane), resample(lane.shape), lane.speed_mps)
    connectors = [c for c in network.connectors if c.junction not in fringe and len(c.shape) > 1]
    for connector in connectors:
        origin = network.lane(connector.from_lane)
        feature_type = MapFeatureType.LANE_BIKE if connector.is_bicycle else _lane_type(origin)
        lane_ids[connector.lane_id] = _add(feature_type, resample(connector.shape), connector.speed_mps, True)

    # 2. Lines, edges, crosswalks, stop signs.
    area = compute_drivable_area(network)
    for feature_type, points in [*_line_features(network), *_edge_features(network, area)]:
        _add(feature_type, points)
    for _, line, width in network.crosswalks:
        polygon = np.concatenate([offset_polyline(line, width / 2), offset_polyline(line, -width / 2)[::-1]])
        _add(MapFeatureType.CROSSWALK, polygon)
    signs = []
    for position, controlled in _stop_points(network):
        sign = _add(MapFeatureType.STOP_SIGN, position[None])
        lanes = sorted({network.lane(c.from_lane).lane_id for c in controlled})
        signs += [(sign, lane_ids[lane_id]) for lane_id in lanes]

    # 3. Links between lanes.
    entry_exit, neighbors = [], []
    for connector in connectors:
        middle = lane_ids[connector.lane_id]
        entry_exit.append((lane_ids[network.lane(connector.from_lane).lane_id], middle))
        entry_exit.append((middle, lane_ids[network.lane(connector.to_lane).lane_id]))
    for lane in network.lanes.values():
        if lane.lane_id not in lane_ids or lane.street is None:
            continue
        for side, step in ((0, 1), (1, -1)):  # SUMO counts lanes from right to left
            neighbor_id = f"{lane.street.street_id}_{lane.index + step}"
            if neighbor_id in lane_ids:
                neighbors.append((lane_ids[lane.lane_id], side, lane_ids[neighbor_id]))
    lights = [(c.light, c.link_index, lane_ids[c.lane_id], c.direction) for c in connectors if c.light is not None]
    return NetworkMap(tuple(features), tuple(entry_exit), tuple(neighbors), tuple(signs), tuple(lights), area)
