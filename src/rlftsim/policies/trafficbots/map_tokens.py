"""Map and traffic lights as tokens: pieces of polylines of at most 20 segments, about 1 m each.

Frame: ego, i.e. the ego's position and heading at the current step are the origin and the x axis; float64.

Shapes: M map tokens, L light tokens, S logged steps. The rules are those of TrafficBots V1.5 (arXiv 2406.10898).
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float64, Int64

from rlftsim.scenario.derived import cached_on_scenario
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, LightState, MapFeatureType, Scenario

NUM_NODES = 20
"""Nodes (segments) of a token, at most."""
MIN_NODES = 4
"""Shorter pieces are dropped."""
MAP_MARGIN_M, HEIGHT_MARGIN_M = 500.0, 6.0
"""Tokens farther than this from the agents that matter are dropped."""
MIN_TOKENS_NEAR = 10
"""With fewer tokens within the margins, map and tracks do not fit together, and all tokens are kept."""


class MapTokenType(IntEnum):
    """Kind of map token, the order of the network's input."""

    FREEWAY = 0
    STREET = 1
    STOP_SIGN_LANE = 2
    BIKE_LANE = 3
    EDGE_BOUNDARY = 4
    EDGE_MEDIAN = 5
    LINE_BROKEN = 6
    LINE_SOLID = 7
    LINE_DOUBLE = 8
    BUMP_OR_DRIVEWAY = 9
    CROSSWALK = 10


VEHICLE_LANES = (MapTokenType.FREEWAY, MapTokenType.STREET, MapTokenType.STOP_SIGN_LANE)

_Feature = MapFeatureType
_TYPE_OF_FEATURE = {
    _Feature.LANE_UNDEFINED: MapTokenType.STREET,
    _Feature.LANE_FREEWAY: MapTokenType.FREEWAY,
    _Feature.LANE_SURFACE_STREET: MapTokenType.STREET,
    _Feature.LANE_BIKE: MapTokenType.BIKE_LANE,
    _Feature.EDGE_UNKNOWN: MapTokenType.EDGE_BOUNDARY,
    _Feature.EDGE_BOUNDARY: MapTokenType.EDGE_BOUNDARY,
    _Feature.EDGE_MEDIAN: MapTokenType.EDGE_MEDIAN,
    _Feature.LINE_UNKNOWN: MapTokenType.LINE_DOUBLE,
    _Feature.LINE_BROKEN_SINGLE_WHITE: MapTokenType.LINE_BROKEN,
    _Feature.LINE_BROKEN_SINGLE_YELLOW: MapTokenType.LINE_BROKEN,
    _Feature.LINE_BROKEN_DOUBLE_YELLOW: MapTokenType.LINE_BROKEN,
    _Feature.LINE_SOLID_SINGLE_WHITE: MapTokenType.LINE_SOLID,
    _Feature.LINE_SOLID_SINGLE_YELLOW: MapTokenType.LINE_SOLID,
    _Feature.LINE_SOLID_DOUBLE_WHITE: MapTokenType.LINE_DOUBLE,
    _Feature.LINE_SOLID_DOUBLE_YELLOW: MapTokenType.LINE_DOUBLE,
    _Feature.LINE_PASSING_DOUBLE_YELLOW: MapTokenType.LINE_DOUBLE,
    _Feature.SPEED_BUMP: MapTokenType.BUMP_OR_DRIVEWAY,
    _Feature.DRIVEWAY: MapTokenType.BUMP_OR_DRIVEWAY,
    _Feature.CROSSWALK: MapTokenType.CROSSWALK,
}
_POLYGONS = (_Feature.SPEED_BUMP, _Feature.DRIVEWAY, _Feature.CROSSWALK)

# Unknown, stop, caution, go, flashing: the order of the network's input.
_STATE_OF_LIGHT = {
    LightState.UNKNOWN: 0,
    LightState.ARROW_STOP: 1,
    LightState.STOP: 1,
    LightState.ARROW_CAUTION: 2,
    LightState.CAUTION: 2,
    LightState.ARROW_GO: 3,
    LightState.GO: 3,
    LightState.FLASHING_STOP: 4,
    LightState.FLASHING_CAUTION: 4,
}
UNKNOWN_LIGHT, NUM_LIGHT_STATES = 0, 5


@dataclass(frozen=True, eq=False)
class MapPieces:
    """Map tokens of one scenario."""

    position: Float64[np.ndarray, "M 20 3"]
    """Start of each segment; zeros past the last one."""
    direction: Float64[np.ndarray, "M 20 3"]
    """From the start of each segment to its end, m."""
    node_mask: Bool[np.ndarray, "M 20"]
    type: Int64[np.ndarray, "M"]
    """A `MapTokenType`."""
    feature_id: Int64[np.ndarray, "M"]
    """Of the map feature that the piece is cut from."""

    def __len__(self) -> int:
        return len(self.type)


@dataclass(frozen=True, eq=False)
class LightTokens:
    """Lights of one scenario, a token for each piece of their lanes, by lane id."""

    token: Int64[np.ndarray, "L"]
    """Index of the map token."""
    observed: Bool[np.ndarray, "L S"]
    state: Int64[np.ndarray, "L S"]
    """0 unknown or not observed, 1 stop, 2 caution, 3 go, 4 flashing."""


def ego_pose(scenario: Scenario) -> Float64[np.ndarray, "3"]:
    """x, y and heading of the ego at the current step, world frame: the origin of the ego frame."""
    tracks, ego = scenario.tracks, scenario.ego_index
    return np.append(tracks.position[ego, CURRENT_STEP, :2], tracks.heading[ego, CURRENT_STEP]).astype(np.float64)


def to_ego_frame(points: np.ndarray, pose: Float64[np.ndarray, "3"]) -> np.ndarray:
    """Points of the world frame in the ego frame; z stays.

    Args:
        points: [..., 2 or 3], m.
        pose: of `ego_pose`.
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = points[..., 0] - pose[0], points[..., 1] - pose[1]
    return np.concatenate([np.stack([cos * x + sin * y, cos * y - sin * x], -1), points[..., 2:]], -1)


@cached_on_scenario
def map_pieces(scenario: Scenario, max_tokens: int | None = 1024) -> MapPieces:
    """Map tokens of a scenario, in file order.

    Args:
        scenario: any; without a map there are none.
        max_tokens: where there are more, those far from the agents that matter go first; None = no limit.
    """
    features, pose = scenario.map_features, ego_pose(scenario)
    stop_sign_lanes = set(features.topology.stop_sign_lanes[:, 1].tolist())
    positions, directions, types, ids = [], [], [], []
    for index, (feature_id, feature_type) in enumerate(zip(features.feature_id, features.feature_type)):
        kind = _TYPE_OF_FEATURE.get(MapFeatureType(feature_type))
        if kind is None:  # a stop sign
            continue
        if kind in (MapTokenType.FREEWAY, MapTokenType.STREET) and int(feature_id) in stop_sign_lanes:
            kind = MapTokenType.STOP_SIGN_LANE
        if feature_type in _POLYGONS:
            lines = sides_of_polygon(features.polygon(index))
        else:
            # WOMD has a point every half meter
            lines = [features.polyline(index)[::2].astype(np.float64)]
        for line in lines:
            line = to_ego_frame(line, pose)
            for piece in cut_line(len(line) - 1):
                if len(piece) >= MIN_NODES:
                    positions.append(line[piece])
                    directions.append(line[piece + 1] - line[piece])
                    types.append(int(kind))
                    ids.append(int(feature_id))
    counts = np.array([len(p) for p in positions], np.int64)
    mask = np.arange(NUM_NODES) < counts[:, None]  # [M, 20]
    pieces = MapPieces(
        position=_fill(mask, positions),
        direction=_fill(mask, directions),
        node_mask=mask,
        type=np.array(types, np.int64),
        feature_id=np.array(ids, np.int64),
    )
    kept = _near_agents(pieces, _positions_that_matter(scenario), max_tokens)
    return MapPieces(
        pieces.position[kept], pieces.direction[kept], mask[kept], pieces.type[kept], pieces.feature_id[kept]
    )


def cut_line(num_segments: int) -> Iterator[Int64[np.ndarray, "_"]]:
    """Indices of the segments of each piece of a line: nearly equal pieces of at most 20."""
    num_pieces = max(num_segments, 0) // NUM_NODES + 1
    starts = [k * num_segments // num_pieces for k in range(num_pieces + 1)]
    return (np.arange(start, end) for start, end in itertools.pairwise(starts))


def sides_of_polygon(polygon: Float64[np.ndarray, "n 3"]) -> list[Float64[np.ndarray, "_ 3"]]:
    """The two longer sides of a polygon taken as four corners, each in both directions, a point every meter.

    Args:
        polygon: points in order. Fewer than three, or four that coincide, have no sides.
    """
    if len(polygon) < 3:
        return []
    a, b, c, d = polygon[np.arange(4) * len(polygon) // 4]
    is_first_longer = np.linalg.norm((b - a)[:2]) > np.linalg.norm((c - b)[:2])
    lines = []
    for start, end in ((a, b), (c, d)) if is_first_longer else ((a, d), (c, b)):
        length = np.linalg.norm(end - start)
        if length > 0:
            line = np.append(start + (end - start) / length * np.arange(int(length) + 1)[:, None], end[None], 0)
            lines += [line, line[::-1]]
    return lines


@cached_on_scenario
def light_tokens(scenario: Scenario, max_tokens: int | None = 1024, *, of_history: bool = True) -> LightTokens:
    """Light tokens of a scenario.

    Args:
        scenario: any.
        max_tokens: of `map_pieces`.
        of_history: leave out lights that were not observed up to the current step, as a simulation must.
    """
    lights, pieces = scenario.lights, map_pieces(scenario, max_tokens)
    tokens, observed, states = [], [], []
    for lane in np.unique(lights.lane_id):
        own = (lights.lane_id == lane) & (lights.step < scenario.num_steps)
        seen, state = np.zeros(scenario.num_steps, bool), np.full(scenario.num_steps, UNKNOWN_LIGHT)
        seen[lights.step[own]] = True
        state[lights.step[own]] = [_STATE_OF_LIGHT[LightState(s)] for s in lights.state[own]]
        if not seen[: HISTORY_STEPS if of_history else None].any():
            continue
        for token in np.flatnonzero(pieces.feature_id == lane):
            tokens.append(token)
            observed.append(seen)
            states.append(state)
    shape = (len(tokens), scenario.num_steps)
    return LightTokens(
        np.array(tokens, np.int64), np.array(observed, bool).reshape(shape), np.array(states, np.int64).reshape(shape)
    )


def _fill(mask: Bool[np.ndarray, "M 20"], pieces: list[np.ndarray]) -> Float64[np.ndarray, "M 20 3"]:
    filled = np.zeros((*mask.shape, 3))
    filled[mask] = np.concatenate([np.zeros((0, 3)), *pieces])
    return filled


def _positions_that_matter(scenario: Scenario) -> Float64[np.ndarray, "n 3"]:
    """Positions in the history of the ego, the objects of interest and the tracks to predict, ego frame."""
    tracks = scenario.tracks
    matters = np.isin(tracks.object_id, scenario.objects_of_interest)
    matters[scenario.ego_index] = True
    matters[scenario.tracks_to_predict] = True
    known = tracks.valid[:, :HISTORY_STEPS] & matters[:, None]
    if not known.any():
        return np.zeros((1, 3))  # the frame's origin, where the ego would be
    return to_ego_frame(tracks.position[:, :HISTORY_STEPS][known].astype(np.float64), ego_pose(scenario))


def _near_agents(
    pieces: MapPieces, agents: Float64[np.ndarray, "n 3"], max_tokens: int | None
) -> Int64[np.ndarray, "m"]:
    """Indices of the tokens to keep."""
    # 1. Some node inside of the agents' bounding box, grown by the margins.
    low, high = agents.min(0), agents.max(0)
    margin = np.maximum(high - low, (MAP_MARGIN_M, MAP_MARGIN_M, HEIGHT_MARGIN_M))
    above = ((pieces.position > low - margin) & pieces.node_mask[..., None]).any(1)  # [M, 3]
    below = ((pieces.position < high + margin) & pieces.node_mask[..., None]).any(1)
    kept = (above & below).all(-1)
    if kept.sum() < MIN_TOKENS_NEAR:
        kept[:] = True
    # 2. Still too many: in file order, those whose ends are both beyond a radius that is halved again and again.
    radius = MAP_MARGIN_M
    while max_tokens is not None and kept.sum() > max_tokens:
        last = pieces.node_mask.sum(1) - 1
        ends = np.stack([pieces.position[:, 0], pieces.position[np.arange(len(pieces)), last]], 1)  # [M, 2, 3]
        distance = np.linalg.norm(ends[:, :, None] - agents, axis=-1).min((1, 2))
        far = np.flatnonzero(kept & (distance >= radius))
        kept[far[: kept.sum() - max_tokens]] = False
        radius /= 2
    return np.flatnonzero(kept)
