"""Map and traffic lights as tokens: pieces of polylines of at most 20 segments, about 1 m each.

Frame: ego, i.e. the ego's position and heading at the current step are the origin and the x axis; float64.

Shapes: M map tokens, L light tokens, S logged steps. The rules are those of TrafficBots V1.5 (arXiv 2406.10898).
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float64, Int64

from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, LightState, MapFeatureType, Scenario, cached_on_scenario

NUM_NODES = 20
"""Largest number of nodes (segments) of a token."""
MIN_NODES = 4
"""Shorter pieces are dropped."""
MAP_MARGIN_M, HEIGHT_MARGIN_M = 500.0, 6.0
"""Tokens farther than this from the agents that matter are dropped."""
MIN_TOKENS_IN_MARGIN = 10
"""With fewer tokens within the margins, map and tracks do not fit together, and all tokens stay."""


class MapTokenType(IntEnum):
    """Type of a map token, in the order of the network's input."""

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
_FEATURE_TYPES = {
    MapTokenType.FREEWAY: (_Feature.LANE_FREEWAY,),
    MapTokenType.STREET: (_Feature.LANE_UNDEFINED, _Feature.LANE_SURFACE_STREET),
    MapTokenType.BIKE_LANE: (_Feature.LANE_BIKE,),
    MapTokenType.EDGE_BOUNDARY: (_Feature.EDGE_UNKNOWN, _Feature.EDGE_BOUNDARY),
    MapTokenType.EDGE_MEDIAN: (_Feature.EDGE_MEDIAN,),
    MapTokenType.LINE_BROKEN: (
        *(_Feature.LINE_BROKEN_SINGLE_WHITE, _Feature.LINE_BROKEN_SINGLE_YELLOW, _Feature.LINE_BROKEN_DOUBLE_YELLOW),
    ),
    MapTokenType.LINE_SOLID: (_Feature.LINE_SOLID_SINGLE_WHITE, _Feature.LINE_SOLID_SINGLE_YELLOW),
    MapTokenType.LINE_DOUBLE: (
        *(_Feature.LINE_UNKNOWN, _Feature.LINE_SOLID_DOUBLE_WHITE, _Feature.LINE_SOLID_DOUBLE_YELLOW),
        _Feature.LINE_PASSING_DOUBLE_YELLOW,
    ),
    MapTokenType.BUMP_OR_DRIVEWAY: (_Feature.SPEED_BUMP, _Feature.DRIVEWAY),
    MapTokenType.CROSSWALK: (_Feature.CROSSWALK,),
}
_TOKEN_TYPES = {feature: token for token, features in _FEATURE_TYPES.items() for feature in features}
_POLYGONS = (_Feature.SPEED_BUMP, _Feature.DRIVEWAY, _Feature.CROSSWALK)

_LIGHTS = (
    (LightState.UNKNOWN,),
    (LightState.ARROW_STOP, LightState.STOP),
    (LightState.ARROW_CAUTION, LightState.CAUTION),
    (LightState.ARROW_GO, LightState.GO),
    (LightState.FLASHING_STOP, LightState.FLASHING_CAUTION),
)
"""Unknown, stop, caution, go, flashing: the order of the network's input."""
_LIGHT_STATES = {light: state for state, lights in enumerate(_LIGHTS) for light in lights}
UNKNOWN_LIGHT, NUM_LIGHT_STATES = 0, 5


@dataclass(frozen=True, eq=False)
class MapTokens:
    """Map tokens of a scenario, each a piece of a map feature."""

    position: Float64[np.ndarray, "M 20 3"]
    """Start of each segment; zeros past the last segment."""
    direction: Float64[np.ndarray, "M 20 3"]
    """From the start of each segment to its end, m."""
    node_mask: Bool[np.ndarray, "M 20"]
    type: Int64[np.ndarray, "M"]
    """A `MapTokenType`."""
    feature_id: Int64[np.ndarray, "M"]
    """Id of the map feature that the token is cut from."""

    def __len__(self) -> int:
        return len(self.type)


@dataclass(frozen=True, eq=False)
class LightTokens:
    """Lights of a scenario, a token for each piece of the lights' lanes, by lane id."""

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
        points: Points [..., 2 or 3] of the world frame, m.
        pose: Origin of the ego frame, from `ego_pose`.
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = points[..., 0] - pose[0], points[..., 1] - pose[1]
    return np.concatenate([np.stack([cos * x + sin * y, cos * y - sin * x], -1), points[..., 2:]], -1)


@cached_on_scenario
def tokenize_map(scenario: Scenario, max_tokens: int | None = 1024) -> MapTokens:
    """Map tokens of a scenario, in file order.

    Args:
        scenario: Scenario with or without a map; without a map there are no tokens.
        max_tokens: Largest number of tokens; tokens far from the agents that matter go first. None = no limit.
    """
    features, pose = scenario.map_features, ego_pose(scenario)
    stop_sign_lanes = set(features.topology.stop_sign_lanes[:, 1].tolist())
    rows = []
    for index, (feature_id, feature_type) in enumerate(zip(features.feature_id, features.feature_type)):
        token_type = _TOKEN_TYPES.get(MapFeatureType(feature_type))
        if token_type is None:  # a stop sign
            continue
        if token_type in (MapTokenType.FREEWAY, MapTokenType.STREET) and int(feature_id) in stop_sign_lanes:
            token_type = MapTokenType.STOP_SIGN_LANE
        if feature_type in _POLYGONS:
            lines = sides_of_polygon(features.polygon(index))
        else:
            # WOMD has a point every half meter
            lines = [features.polyline(index)[::2].astype(np.float64)]
        for line in lines:
            line = to_ego_frame(line, pose)
            pieces = (segments for segments in cut_line(len(line) - 1) if len(segments) >= MIN_NODES)
            rows += [(line[piece], line[piece + 1] - line[piece], int(token_type), int(feature_id)) for piece in pieces]
    positions, directions, types, ids = zip(*rows) if rows else ((), (), (), ())
    counts = np.array([len(p) for p in positions], np.int64)
    mask = np.arange(NUM_NODES) < counts[:, None]  # [M, 20]
    types, ids = np.array(types, np.int64), np.array(ids, np.int64)
    tokens = MapTokens(_pad_nodes(mask, positions), _pad_nodes(mask, directions), mask, types, ids)
    index = _select_tokens(tokens, _find_relevant_positions(scenario), max_tokens)
    return MapTokens(**{field.name: getattr(tokens, field.name)[index] for field in fields(tokens)})


def cut_line(num_segments: int) -> Iterator[Int64[np.ndarray, "_"]]:
    """Indices of the segments of each token of a line: nearly equal numbers of at most 20."""
    num_tokens = max(num_segments, 0) // NUM_NODES + 1
    starts = [k * num_segments // num_tokens for k in range(num_tokens + 1)]
    return (np.arange(start, end) for start, end in itertools.pairwise(starts))


def sides_of_polygon(polygon: Float64[np.ndarray, "n 3"]) -> list[Float64[np.ndarray, "_ 3"]]:
    """The two longer sides of a polygon taken as four corners, each in both directions, a point every meter.

    Args:
        polygon: Points in order, m. Fewer than three, or four that coincide, have no sides.
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
def tokenize_lights(scenario: Scenario, max_tokens: int | None = 1024, *, of_history: bool = True) -> LightTokens:
    """Light tokens of a scenario.

    Args:
        scenario: Scenario with or without lights and a map.
        max_tokens: Largest number of map tokens, as in `tokenize_map`.
        of_history: True leaves out lights that were not observed up to the current step, as a simulation must.
    """
    lights, map_tokens = scenario.lights, tokenize_map(scenario, max_tokens)
    rows = []
    for lane in np.unique(lights.lane_id):
        is_of_lane = (lights.lane_id == lane) & (lights.step < scenario.num_steps)
        is_observed, state = np.zeros(scenario.num_steps, bool), np.full(scenario.num_steps, UNKNOWN_LIGHT)
        is_observed[lights.step[is_of_lane]] = True
        state[lights.step[is_of_lane]] = [_LIGHT_STATES[LightState(s)] for s in lights.state[is_of_lane]]
        if not is_observed[: HISTORY_STEPS if of_history else None].any():
            continue
        rows += [(token, is_observed, state) for token in np.flatnonzero(map_tokens.feature_id == lane)]
    tokens, observed, states = zip(*rows) if rows else ((), (), ())
    shape = (len(tokens), scenario.num_steps)
    return LightTokens(
        np.array(tokens, np.int64), np.array(observed, bool).reshape(shape), np.array(states, np.int64).reshape(shape)
    )


def _pad_nodes(mask: Bool[np.ndarray, "M 20"], nodes: Sequence[np.ndarray]) -> Float64[np.ndarray, "M 20 3"]:
    padded = np.zeros((*mask.shape, 3))
    padded[mask] = np.concatenate([np.zeros((0, 3)), *nodes])
    return padded


def _find_relevant_positions(scenario: Scenario) -> Float64[np.ndarray, "n 3"]:
    """Positions in the history of the ego, the objects of interest and the tracks to predict, ego frame."""
    tracks = scenario.tracks
    matters = np.isin(tracks.object_id, scenario.objects_of_interest)
    matters[scenario.ego_index] = True
    matters[scenario.tracks_to_predict] = True
    is_logged = tracks.valid[:, :HISTORY_STEPS] & matters[:, None]
    if not is_logged.any():
        return np.zeros((1, 3))  # the frame's origin, where the ego would be
    return to_ego_frame(tracks.position[:, :HISTORY_STEPS][is_logged].astype(np.float64), ego_pose(scenario))


def _select_tokens(tokens: MapTokens, agents: Float64[np.ndarray, "n 3"], limit: int | None) -> Int64[np.ndarray, "m"]:
    """Indices of the tokens near agents."""
    # 1. Some node inside of the agents' bounding box, grown by the margins.
    low, high = agents.min(0), agents.max(0)
    margin = np.maximum(high - low, (MAP_MARGIN_M, MAP_MARGIN_M, HEIGHT_MARGIN_M))
    above = ((tokens.position > low - margin) & tokens.node_mask[..., None]).any(1)  # [M, 3]
    below = ((tokens.position < high + margin) & tokens.node_mask[..., None]).any(1)
    is_selected = (above & below).all(-1)
    if is_selected.sum() < MIN_TOKENS_IN_MARGIN:
        is_selected[:] = True
    # 2. Still too many: in file order, tokens with both ends beyond a radius that is halved again and again.
    radius = MAP_MARGIN_M
    while limit is not None and is_selected.sum() > limit:
        last = tokens.node_mask.sum(1) - 1
        ends = np.stack([tokens.position[:, 0], tokens.position[np.arange(len(tokens)), last]], 1)  # [M, 2, 3]
        distance = np.linalg.norm(ends[:, :, None] - agents, axis=-1).min((1, 2))
        distant_tokens = np.flatnonzero(is_selected & (distance >= radius))
        is_selected[distant_tokens[: is_selected.sum() - limit]] = False
        radius /= 2
    return np.flatnonzero(is_selected)
