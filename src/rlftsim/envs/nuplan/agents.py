"""Traffic for nuPlan's closed loop: a policy drives all vehicles, pedestrians and bicycles around nuPlan's ego.

An episode is that of `envs.world`: objects and map come from nuPlan's history and map, nuPlan moves the ego, the world
all others. nuPlan tells where the ego is one step late: traffic is stepped first, then the ego's pose is put in. After
8 s a new episode begins with the last second of the old one, on the lights of that time.

Signatures: nuplan-devkit 1.2.2, `nuplan/planning/simulation/observation/abstract_observation.py`.
"""
# pyright: reportMissingImports=false

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from rlftsim.envs.alpasim_session import EGO, LoggedObject, PosePath, build_session_scenario
from rlftsim.envs.world import Dice, World, WorldState, begin, build_world, step_world
from rlftsim.errors import ConfigError
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.polylines import densify
from rlftsim.scenario.synthetic.map_features import oriented_rings, split_ring
from rlftsim.scenario.types import (
    CURRENT_STEP,
    FUTURE_STEPS,
    STEP_S,
    LightState,
    LightStates,
    MapFeatures,
    MapFeatureType,
    ObjectType,
)

TYPES = {"VEHICLE": ObjectType.VEHICLE, "PEDESTRIAN": ObjectType.PEDESTRIAN, "BICYCLE": ObjectType.CYCLIST}
"""Types of nuPlan that the policy drives; all others, such as cones, are those of the log."""
LIGHTS = {"GREEN": LightState.GO, "YELLOW": LightState.CAUTION, "RED": LightState.STOP}
MAP_RADIUS_M = 150.0
"""Half of the side of the square around the ego whose map is seen."""
ROAD_LAYERS = ("ROADBLOCK", "INTERSECTION", "CARPARK_AREA")
"""Layers that make up nuPlan's drivable area."""
MAX_JITTER_S = 0.02
"""Largest difference of a simulation step from 0.1 s: logged times are not quite regular."""

_load = cache(load_policy)


class RlftsimAgents:
    """An observation of nuPlan, built by hydra; an `AbstractObservation` by registration.

    Args:
        model: Run, model folder, registered name, or address on Hugging Face.
        scenario: nuPlan's scenario: log, map and lights.
        seed: Seed of the traffic.

    Raises:
        ConfigError: nuplan-devkit is not installed.
    """

    def __init__(self, model: str, scenario: Any, seed: int = 0) -> None:
        try:
            from nuplan.planning.simulation.observation.abstract_observation import AbstractObservation
        except ImportError as error:
            raise ConfigError(f"RlftsimAgents runs inside nuPlan ({error}): install nuplan-devkit.") from None
        AbstractObservation.register(RlftsimAgents)
        self.model, self.scenario, self.seed = model, scenario, seed
        self.reset()

    def reset(self) -> None:
        """Forget the episode."""
        self.num_episodes = 0
        self.index = 0
        self.time_us = 0
        self.agents: list[Any] = []
        """nuPlan's agents of the world's rows behind the ego's."""
        self.origin = np.zeros(2)
        """Ego at the begin of the episode in whole meters, which float32 holds."""
        self.episode: tuple[World, WorldState] | None = None
        """None before the first step."""

    def initialize(self) -> None:
        """Forget the episode, and load the model, once a process."""
        self.reset()
        _load(self.model)

    def observation_type(self) -> Any:
        """nuPlan's `DetectionsTracks`."""
        from nuplan.planning.simulation.observation.observation_type import DetectionsTracks

        return DetectionsTracks

    def get_observation(self) -> Any:
        """All tracks at the present iteration: agents of the policy, and other objects from the log."""
        if self.episode is None:
            return self.scenario.initial_tracked_objects
        from nuplan.common.actor_state.agent import Agent
        from nuplan.common.actor_state.oriented_box import OrientedBox
        from nuplan.common.actor_state.state_representation import StateSE2, StateVector2D
        from nuplan.common.actor_state.tracked_objects import TrackedObjects

        world, state = self.episode
        motion = state.motion[0].copy()  # [A, 5]
        motion[:, :2] += self.origin + world.scenes[0].scenario.origin
        logged = self.scenario.get_tracked_objects_at_iteration(self.index).tracked_objects
        objects = [other for other in logged if other.tracked_object_type.name not in (*TYPES, EGO)]
        for agent, (x, y, heading, vx, vy) in zip(self.agents, motion[1:].tolist()):
            box = OrientedBox.from_new_pose(agent.box, StateSE2(x, y, heading))
            metadata = replace(agent.metadata, timestamp_us=self.time_us)
            objects.append(Agent(agent.tracked_object_type, box, StateVector2D(vx, vy), metadata))
        return self.observation_type()(TrackedObjects(objects))

    def update_observation(self, iteration: Any, next_iteration: Any, history: Any) -> None:
        """Step the traffic to the next iteration.

        Args:
            iteration: Iteration of the last ego state and observation of the history.
            next_iteration: Iteration 0.1 s later.
            history: Ego states and observations, the oldest first.

        Raises:
            ConfigError: Iterations are not 0.1 s apart.
        """
        step_s = next_iteration.time_s - iteration.time_s
        if abs(step_s - STEP_S) > MAX_JITTER_S:
            raise ConfigError(
                f"iterations are {step_s:.3f} s apart, traffic moves in steps of {STEP_S:g} s: set "
                "scenario_builder.scenario_mapping.subsample_ratio_override=0.5, as nuPlan's own settings do."
            )
        if self.episode is None or self.episode[1].step == FUTURE_STEPS:
            world, state = self._begin_episode(history, iteration.index)
        else:
            world, state = self.episode
            state = self._correct_ego(world, state, history.current_state[0].center)
        coasting = state.motion[0, 0].copy()
        coasting[:2] += STEP_S * coasting[3:]
        self.episode = world, step_world(world, state, coasting[None])
        self.index, self.time_us = next_iteration.index, next_iteration.time_us

    def _begin_episode(self, history: Any, index: int) -> tuple[World, WorldState]:
        """The world at the last sample of a history, which is that of an iteration."""
        egos, center = history.ego_states, history.ego_states[-1].center
        times = np.array([ego.time_us for ego in egos], np.int64)
        self.origin = np.round([center.x, center.y])
        seen: dict[str, list[tuple[int, Any]]] = {}
        for row, observation in enumerate(history.observations):
            for agent in observation.tracked_objects:
                seen.setdefault(agent.track_token, []).append((row, agent.center))
        self.agents = [a for a in history.observations[-1].tracked_objects if a.tracked_object_type.name in TYPES]
        samples = list(enumerate(ego.center for ego in egos))
        logged = [self._log(EGO, ObjectType.VEHICLE, egos[-1].car_footprint.oriented_box, times, samples)]
        for agent in self.agents:
            object_type = TYPES[agent.tracked_object_type.name]
            logged.append(self._log(agent.track_token, object_type, agent.box, times, seen[agent.track_token]))
        scenario = build_session_scenario(self.scenario.token, None, logged, int(times[-1]))
        lights = self.scenario.get_traffic_light_status_at_iteration(index)
        features, states = build_map(self.scenario.map_api, lights, self.origin)
        scenario = replace(scenario, map_features=features, lights=states, guessed=frozenset({"z"}))
        world = build_world([scenario], _load(self.model), rules={"ego": "planner"})
        state = begin(world, [Dice(self.seed, self.num_episodes)])
        self.num_episodes += 1
        return world, state

    def _log(
        self, name: str, object_type: ObjectType, box: Any, times: np.ndarray, samples: list[tuple[int, Any]]
    ) -> LoggedObject:
        """Object with the poses of its center at some samples of the history."""
        rows = [row for row, _ in samples]
        x, y, heading = np.array([(pose.x, pose.y, pose.heading) for _, pose in samples]).T
        pose = np.stack([x - self.origin[0], y - self.origin[1], np.zeros(len(x)), np.unwrap(heading)], -1)
        return LoggedObject(name, object_type, (box.length, box.width, box.height), False, PosePath(times[rows], pose))

    def _correct_ego(self, world: World, state: WorldState, center: Any) -> WorldState:
        """State with the true pose of the ego in place of the one that the last step assumed."""
        position = np.array([center.x, center.y]) - self.origin - world.scenes[0].scenario.origin
        velocity = (position - state.track[-2][0, 0, :2]) / STEP_S
        motion = state.motion.copy()
        motion[0, 0] = [*position, center.heading, *velocity]
        return replace(state, track=(*state.track[:-1], motion))


def build_map(map_api: Any, lights: Iterable[Any], origin: Float[np.ndarray, "2"]) -> tuple[MapFeatures, LightStates]:
    """Map and lights of nuPlan around a point, which is the origin of the result.

    Args:
        map_api: nuPlan's map.
        lights: Status of lights at the current step.
        origin: Point in nuPlan's frame, m.

    Returns:
        Lanes and connectors, boundaries of lanes as broken lines (nuPlan does not say which lines are painted), edges
        of the drivable area with the road on the left, crosswalks; and the lights at the first points of connectors.
    """
    import shapely
    from nuplan.common.actor_state.state_representation import Point2D
    from nuplan.common.maps.maps_datatypes import SemanticMapLayer

    names = ("LANE", "LANE_CONNECTOR", "CROSSWALK", *ROAD_LAYERS)
    layers = {name: SemanticMapLayer[name] for name in names}
    proximal = map_api.get_proximal_map_objects(Point2D(*origin.tolist()), MAP_RADIUS_M, list(layers.values()))
    objects = {name: proximal[layer] for name, layer in layers.items()}

    def trace(path: Any) -> Float[np.ndarray, "n 2"]:
        return densify(np.array([(pose.x, pose.y) for pose in path.discrete_path]) - origin, 1.0)

    lines = [(MapFeatureType.LANE_SURFACE_STREET, trace(lane.baseline_path)) for lane in objects["LANE_CONNECTOR"]]
    connectors = {str(lane.id): row for row, lane in enumerate(objects["LANE_CONNECTOR"])}
    lines += [(MapFeatureType.LANE_SURFACE_STREET, trace(lane.baseline_path)) for lane in objects["LANE"]]
    boundaries = {side.id: side for lane in objects["LANE"] for side in (lane.left_boundary, lane.right_boundary)}
    lines += [(MapFeatureType.LINE_BROKEN_SINGLE_WHITE, trace(side)) for side in boundaries.values()]
    area = shapely.union_all([block.polygon for name in ROAD_LAYERS for block in objects[name]])
    area = area.buffer(0.3).buffer(-0.3)  # closes slits between blocks
    for ring, is_median in [] if area.is_empty else oriented_rings(area):
        edge = densify(ring - origin, 1.0)
        feature_type = MapFeatureType.EDGE_MEDIAN if is_median else MapFeatureType.EDGE_BOUNDARY
        # blocks end beyond the square: their ends there are no edges
        lines += [(feature_type, run) for run in split_ring(edge, np.abs(edge).max(1) <= MAP_RADIUS_M)]
    for crosswalk in objects["CROSSWALK"]:
        lines.append((MapFeatureType.CROSSWALK, np.array(crosswalk.polygon.exterior.coords)[:-1, :2] - origin))
    flat = [(row, int(line_type), np.pad(line, ((0, 0), (0, 1)))) for row, (line_type, line) in enumerate(lines)]
    rows = [(connectors.get(str(light.lane_connector_id)), light.status.name) for light in lights]
    states = [
        (CURRENT_STEP, row, int(LIGHTS.get(name, LightState.UNKNOWN)), *flat[row][2][0])
        for row, name in rows
        if row is not None
    ]
    return MapFeatures.of(flat), LightStates.of(states)
