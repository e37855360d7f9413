"""Scenarios drawn by hand, for tests of everything that takes a scenario.

World frame, meters: the ego is near (1000, -200) at the current step. Nothing is symmetrical, so that no two distances
tie.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rlftsim.scenario.types import (
    CURRENT_STEP,
    STEP_S,
    TOTAL_STEPS,
    LightState,
    LightStates,
    MapFeatures,
    MapFeatureType,
    ObjectType,
    Scenario,
    Tracks,
)

SIZES_M = {
    ObjectType.VEHICLE: (4.6, 1.9, 1.6),
    ObjectType.PEDESTRIAN: (0.9, 0.8, 1.7),
    ObjectType.CYCLIST: (1.8, 0.8, 1.7),
}
EGO_POSITION_M = (1000.0, -200.0)


@dataclass(frozen=True)
class Mover:
    """An agent that drives an arc: its pose at the current step relative to the ego's, its speed and its turn rate."""

    kind: ObjectType = ObjectType.VEHICLE
    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0
    speed_mps: float = 8.0
    turn_rate_radps: float = 0.0
    missing: tuple[int, ...] = ()
    """Steps at which it is not seen."""

    def states(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position [91, 3], heading [91] and velocity [91, 2]."""
        time = (np.arange(TOTAL_STEPS) - CURRENT_STEP) * STEP_S
        heading = self.heading_rad + self.turn_rate_radps * time
        middle = self.heading_rad + self.turn_rate_radps * time / 2  # direction of the chord of an arc
        way = self.speed_mps * time * np.sinc(self.turn_rate_radps * time / 2 / np.pi)
        x = EGO_POSITION_M[0] + self.x_m + way * np.cos(middle)
        y = EGO_POSITION_M[1] + self.y_m + way * np.sin(middle)
        velocity = self.speed_mps * np.stack([np.cos(heading), np.sin(heading)], -1)
        return np.stack([x, y, np.full_like(x, 3.0)], -1), np.remainder(heading + np.pi, 2 * np.pi) - np.pi, velocity


TRAFFIC = (
    Mover(speed_mps=9.3),
    Mover(x_m=17.3, y_m=0.4, speed_mps=8.1),
    Mover(x_m=31.7, y_m=3.9, heading_rad=3.1, speed_mps=10.7, turn_rate_radps=0.02),
    Mover(ObjectType.PEDESTRIAN, x_m=12.1, y_m=-6.7, heading_rad=0.4, speed_mps=1.3, turn_rate_radps=0.05),
    Mover(ObjectType.CYCLIST, x_m=-14.9, y_m=-2.3, speed_mps=4.7, turn_rate_radps=-0.03),
    Mover(x_m=-9.2, y_m=4.6, heading_rad=1.2, speed_mps=0.0),
)
"""Two cars in a lane, one that comes toward them, a pedestrian, a cyclist and a parked car. The first is the ego."""


def tracks_of(movers: Sequence[Mover]) -> Tracks:
    """Logged tracks of some agents, ids from 100 on; zeros where an agent is not seen."""
    states = [mover.states() for mover in movers]
    valid = np.ones((len(movers), TOTAL_STEPS), bool)
    for row, mover in zip(valid, movers):
        row[list(mover.missing)] = False
    size = np.array([SIZES_M[mover.kind] for mover in movers], np.float32)[:, None].repeat(TOTAL_STEPS, 1)
    position, heading, velocity = (np.stack(part).astype(np.float32) for part in zip(*states))
    return Tracks(
        object_id=np.arange(100, 100 + len(movers), dtype=np.int64),
        object_type=np.array([mover.kind for mover in movers], np.int8),
        position=position * valid[..., None],
        heading=heading * valid,
        velocity=velocity * valid[..., None],
        size=size * valid[..., None],
        valid=valid,
    )


def polylines(features: Sequence[tuple[MapFeatureType, Sequence[tuple[float, float]]]]) -> MapFeatures:
    """Map features with ids from 1 on through corners given relative to the ego; a point about every metre."""
    lines = []
    for _, corners in features:
        points = [np.asarray(corners[0], np.float64)[None]]
        for start, end in zip(np.asarray(corners, np.float64), np.asarray(corners, np.float64)[1:]):
            count = max(int(np.ceil(np.hypot(*(end - start)))), 1)
            points.append(start + np.arange(1, count + 1)[:, None] / count * (end - start))
        lines.append(np.concatenate(points))
    flat = np.concatenate(lines) + EGO_POSITION_M
    return MapFeatures(
        feature_id=np.arange(1, len(features) + 1, dtype=np.int64),
        feature_type=np.array([kind for kind, _ in features], np.int8),
        points=np.concatenate([flat, np.full((len(flat), 1), 3.0)], -1).astype(np.float32),
        offsets=np.cumsum([0, *(len(line) for line in lines)]).astype(np.int64),
    )


NO_MAP = MapFeatures(np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros((0, 3), np.float32), np.zeros(1, np.int64))
NO_LIGHTS = LightStates(
    np.zeros(0, np.int32), np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros((0, 3), np.float32)
)


def straight_map() -> MapFeatures:
    """A road along x: a lane each way, the line between them, an edge on both sides, a crosswalk."""
    kind = MapFeatureType
    return polylines(
        [
            (kind.LANE_SURFACE_STREET, [(-60.3, 0.1), (140.6, 0.3)]),
            (kind.LANE_SURFACE_STREET, [(141.1, 3.8), (-59.4, 3.6)]),
            (kind.EDGE_BOUNDARY, [(-60.7, -2.3), (140.2, -2.1)]),
            (kind.EDGE_BOUNDARY, [(141.4, 5.9), (-60.1, 5.7)]),
            (kind.LINE_BROKEN_SINGLE_YELLOW, [(-60.2, 1.8), (140.9, 2.0)]),
            (kind.CROSSWALK, [(22.3, -2.2), (25.4, -2.1), (25.2, 5.8), (22.1, 5.7)]),
        ]
    )


def junction_map() -> MapFeatures:
    """The straight road and one that crosses it; feature 1 is the ego's lane, feature 7 the crossing one."""
    road = straight_map()
    crossing = polylines(
        [
            (MapFeatureType.LANE_SURFACE_STREET, [(43.2, -70.4), (43.6, 80.3)]),
            (MapFeatureType.EDGE_BOUNDARY, [(40.7, 79.8), (40.9, 7.3)]),
            (MapFeatureType.EDGE_BOUNDARY, [(46.3, -69.7), (46.1, -3.8)]),
        ]
    )
    return MapFeatures(
        feature_id=np.append(road.feature_id, crossing.feature_id + len(road)),
        feature_type=np.append(road.feature_type, crossing.feature_type),
        points=np.concatenate([road.points, crossing.points]),
        offsets=np.append(road.offsets, crossing.offsets[1:] + road.offsets[-1]),
    )


def bend_map(radius_m: float = 90.0) -> MapFeatures:
    """A road that winds to the left about (0, radius): no piece straight ahead of another, no two equally far."""
    angles = np.linspace(-0.71, 1.63, 263)

    def arc(offset_m: float, backwards: bool = False) -> list[tuple[float, float]]:
        radii = radius_m - offset_m + 1.5 * np.sin(9 * angles)
        points = np.stack([radii * np.sin(angles), radius_m - radii * np.cos(angles)], -1).tolist()
        return points[::-1] if backwards else points

    kind = MapFeatureType
    return polylines(
        [
            (kind.LANE_SURFACE_STREET, arc(0.1)),
            (kind.LANE_SURFACE_STREET, arc(3.7, backwards=True)),
            (kind.EDGE_BOUNDARY, arc(-2.2)),
            (kind.EDGE_BOUNDARY, arc(5.8, backwards=True)),
            (kind.LINE_SOLID_SINGLE_YELLOW, arc(1.9)),
        ]
    )


def light(lane_id: int, x_m: float, y_m: float, *, red_until: int = 50) -> LightStates:
    """A light on one lane, its stop point relative to the ego: red, and green from a step on."""
    steps = np.arange(TOTAL_STEPS, dtype=np.int32)
    point = np.array([EGO_POSITION_M[0] + x_m, EGO_POSITION_M[1] + y_m, 3.0], np.float32)
    return LightStates(
        step=steps,
        lane_id=np.full(TOTAL_STEPS, lane_id, np.int64),
        state=np.where(steps < red_until, LightState.STOP, LightState.GO).astype(np.int8),
        stop_point=np.tile(point, (TOTAL_STEPS, 1)),
    )


def build_scenario(
    scenario_id: str,
    movers: Sequence[Mover] = TRAFFIC,
    map_features: MapFeatures | None = None,
    lights: LightStates = NO_LIGHTS,
    *,
    num_predicted: int = 3,
) -> Scenario:
    """A scenario whose ego is the first mover and whose next `num_predicted` movers are to be predicted."""
    predicted = np.arange(1, min(num_predicted + 1, len(movers)), dtype=np.int32)
    return Scenario(
        scenario_id=scenario_id,
        timestamps_s=np.arange(TOTAL_STEPS) * STEP_S,
        tracks=tracks_of(movers),
        map_features=straight_map() if map_features is None else map_features,
        lights=lights,
        ego_index=0,
        tracks_to_predict=predicted,
        difficulty=np.ones(len(predicted), np.int8),
        objects_of_interest=np.zeros(0, np.int64),
    )


def straight_road(scenario_id: str = "straight") -> Scenario:
    """All of `TRAFFIC` on a straight road."""
    return build_scenario(scenario_id)


def junction_with_light(scenario_id: str = "junction") -> Scenario:
    """A junction with a light for the ego's lane, and cars that turn."""
    turning = (
        Mover(x_m=44.1, y_m=-24.6, heading_rad=1.57, speed_mps=6.2),
        Mover(x_m=37.4, y_m=0.2, heading_rad=0.1, speed_mps=5.1, turn_rate_radps=0.21),
    )
    return build_scenario(scenario_id, (*TRAFFIC, *turning), junction_map(), light(1, 38.0, 0.2), num_predicted=7)


def bend(scenario_id: str = "bend", num_agents: int = 6) -> Scenario:
    """A bending road with a light, on which no agent goes straight: no bearing is exactly 0 or 180 degrees.

    One agent has gaps, one is first seen at step 7.
    """
    movers = (
        Mover(speed_mps=9.3, turn_rate_radps=0.103),
        Mover(x_m=17.1, y_m=2.2, heading_rad=0.19, speed_mps=8.1, turn_rate_radps=0.09, missing=(3, 4, 25, 26, 89, 90)),
        Mover(x_m=30.9, y_m=9.7, heading_rad=-2.78, speed_mps=10.7, turn_rate_radps=-0.11),
        Mover(ObjectType.PEDESTRIAN, x_m=12.1, y_m=-6.7, heading_rad=0.4, speed_mps=1.3, turn_rate_radps=0.05),
        Mover(ObjectType.CYCLIST, x_m=-14.9, y_m=-2.3, heading_rad=-0.2, speed_mps=4.7, turn_rate_radps=-0.03),
        Mover(x_m=-9.2, y_m=4.6, heading_rad=1.2, speed_mps=2.1, turn_rate_radps=0.3, missing=tuple(range(7))),
    )
    return build_scenario(scenario_id, movers[:num_agents], bend_map(), light(1, 24.0, 3.2), num_predicted=5)


def lone_agent(scenario_id: str = "lone") -> Scenario:
    """The ego alone."""
    return build_scenario(scenario_id, TRAFFIC[:1])


def without_map(scenario_id: str = "no-map") -> Scenario:
    """`TRAFFIC` without a map."""
    return build_scenario(scenario_id, map_features=NO_MAP)


def crowd(scenario_id: str = "crowd", num_agents: int = 128) -> Scenario:
    """Many agents, cars, pedestrians and cyclists in turn."""
    rng = np.random.default_rng(5)
    kinds = (ObjectType.VEHICLE, ObjectType.PEDESTRIAN, ObjectType.CYCLIST)
    others = [
        Mover(kinds[k % 3], *rng.uniform((-50, -30, -3, 0, -0.1), (80, 30, 3, 9, 0.1)).tolist())
        for k in range(num_agents - 1)
    ]
    ego = Mover(speed_mps=9.3, turn_rate_radps=0.04)
    return build_scenario(scenario_id, (ego, *others), num_predicted=7)


def with_gaps(scenario_id: str = "gaps") -> Scenario:
    """Agents with gaps: some steps missing, first seen at step 7 or at the current step, gone before it."""
    second, third, fourth = (
        replace(TRAFFIC[1], missing=(3, 4, 25, 26, 27, 88, 89, 90)),
        replace(TRAFFIC[2], missing=tuple(range(7))),
        replace(TRAFFIC[4], missing=tuple(range(10))),
    )
    gone = Mover(x_m=-21.3, y_m=0.5, missing=tuple(range(8, TOTAL_STEPS)))
    return build_scenario(scenario_id, (TRAFFIC[0], second, third, TRAFFIC[3], fourth, gone), num_predicted=4)


def without_future(scenario_id: str = "test-split") -> Scenario:
    """The straight road as in a test split: 11 steps."""
    whole = straight_road(scenario_id)
    tracks = whole.tracks
    cut = {
        name: getattr(tracks, name)[:, : CURRENT_STEP + 1]
        for name in ("position", "heading", "velocity", "size", "valid")
    }
    return replace(whole, timestamps_s=whole.timestamps_s[: CURRENT_STEP + 1], tracks=replace(tracks, **cut))


def without_agents(steps: slice, scenario_id: str = "padded") -> Scenario:
    """The straight road with all agents not valid at some steps."""
    whole = straight_road(scenario_id)
    valid = whole.tracks.valid.copy()
    valid[:, steps] = False
    return replace(whole, tracks=replace(whole.tracks, valid=valid))


def without_ego(scenario_id: str = "no-ego") -> Scenario:
    """The straight road with an ego that is not valid at the current step."""
    whole = straight_road(scenario_id)
    valid = whole.tracks.valid.copy()
    valid[whole.ego_index, CURRENT_STEP] = False
    return replace(whole, tracks=replace(whole.tracks, valid=valid))


def without_road_edges(scenario_id: str = "no-edges") -> Scenario:
    """The straight road as in a log without road edges."""
    whole = straight_road(scenario_id)
    lanes = polylines([(MapFeatureType.LANE_SURFACE_STREET, [(-60.3, 0.1), (140.6, 0.3)])])
    return replace(whole, map_features=lanes)


def raised(
    scenario: Scenario, rise: Callable[[np.ndarray], np.ndarray], features: slice, tracks: Sequence[int]
) -> Scenario:
    """The scenario on the ground, with some features and tracks higher by a height (m) that depends on x."""
    maps, log = scenario.map_features, scenario.tracks
    points, position = maps.points.copy(), log.position.copy()
    position[..., 2] += log.size[..., 2] / 2
    for index in range(len(maps))[features]:
        line = points[maps.offsets[index] : maps.offsets[index + 1]]
        line[:, 2] += rise(line[:, 0] - EGO_POSITION_M[0])
    position[list(tracks), :, 2] += rise(position[list(tracks), :, 0] - EGO_POSITION_M[0])
    return replace(scenario, map_features=replace(maps, points=points), tracks=replace(log, position=position))
