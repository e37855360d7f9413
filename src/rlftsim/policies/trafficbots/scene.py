"""A batch of scenarios as padded tensors in ego frames: the network's input, float32 as built.

Logged agents come with gaps filled, speed with a sign, acceleration and yaw rate by differences. Their destinations are
the map tokens that they are heading for at the end of the log.

Shapes: B scenarios, M map tokens, L light tokens, A agents, S steps of 0.1 s. M and L are at least 1: a scenario
without tokens has padding.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from rlftsim.geometry import rotate, wrap_angle
from rlftsim.policies.trafficbots.attention import relative_pose
from rlftsim.policies.trafficbots.map_tokens import (
    VEHICLE_LANES,
    MapTokens,
    MapTokenType,
    ego_pose,
    to_ego_frame,
    tokenize_lights,
    tokenize_map,
)
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.types import STEP_S, TOTAL_STEPS, Scenario, cached_on_scenario
from rlftsim.tokens.vocabulary import class_of_type

VEHICLE, PEDESTRIAN, CYCLIST = range(3)
NO_DESTINATION = -1
MAX_LANE_DISTANCE_M = 3.0
"""Largest distance of an agent's last pose from the agent's lane."""
LOOKAHEAD_S = 5.0
"""Time for which an agent that is on no lane is taken to go on at the last speed."""
MAX_WALK_LANES = 3
BIKE_LANES, EDGES = (MapTokenType.BIKE_LANE,), (MapTokenType.EDGE_BOUNDARY,)
NODE_TYPES = (VEHICLE_LANES, BIKE_LANES, EDGES)
"""Types of map tokens whose nodes are looked for together."""


@dataclass(frozen=True, eq=False)
class AgentMotions:
    """Motions of the simulated agents, zeros where they are not valid."""

    position: Float64[np.ndarray, "A S 3"]
    heading: Float64[np.ndarray, "A S"]
    """Without jumps by a full turn, rad."""
    motion: Float64[np.ndarray, "A S 3"]
    """Speed along the heading, negative backwards (m/s); acceleration (m/s²); yaw rate (rad/s)."""
    valid: Bool[np.ndarray, "A S"]
    """True from the first to the last logged step."""
    size: Float64[np.ndarray, "A 3"]
    """Length, width and height, mean over the logged steps, m."""


@cached_on_scenario
def agent_motions(scenario: Scenario, num_steps: int) -> AgentMotions:
    """Motions of the simulated agents over the first steps of the log; later steps are not looked at.

    Args:
        scenario: Scenario with at least `num_steps` logged steps.
        num_steps: Number S of steps: 11 = history, 91 = the whole log.
    """
    tracks, indices, pose = scenario.tracks, scenario.simulated_indices, ego_pose(scenario)
    logged = tracks.valid[indices, :num_steps]  # [A, S]
    values = (tracks.position, tracks.heading, tracks.velocity, tracks.size)
    position, heading, velocity, size = (v[indices, :num_steps].astype(np.float64) for v in values)
    position, heading = to_ego_frame(position, pose), heading - pose[2]
    forward = (velocity * np.stack([np.cos(heading + pose[2]), np.sin(heading + pose[2])], -1)).sum(-1)
    speed = np.sign(forward) * np.linalg.norm(velocity, axis=-1)
    states = np.concatenate([position, heading[..., None], speed[..., None]], -1)  # [A, S, 5]
    filled, valid = np.zeros_like(states), np.zeros_like(logged)
    rates = np.zeros((*logged.shape, 2))  # acceleration, yaw rate
    steps = np.arange(num_steps)
    for agent, is_logged in enumerate(logged):
        logged_steps = np.flatnonzero(is_logged)
        start, stop = logged_steps[0], logged_steps[-1] + 1
        values = states[agent, logged_steps]
        values[:, 3] = np.unwrap(values[:, 3])
        columns = [np.interp(steps[start:stop], logged_steps, column) for column in values.T]
        filled[agent, start:stop] = np.stack(columns, -1)
        valid[agent, start:stop] = True
        # Speed and heading differ from step to step; the first step has no step before.
        rates[agent, start + 1 : stop] = np.diff(filled[agent, start:stop][:, [4, 3]], axis=0) / STEP_S
    # Not a product with `logged`: values of steps that are not valid may be NaN.
    size = np.where(logged[..., None], size, 0.0)
    return AgentMotions(
        position=filled[..., :3],
        heading=filled[..., 3],
        motion=np.concatenate([filled[..., 4:], rates], -1),
        valid=valid,
        size=size.sum(1) / logged.sum(1)[:, None],
    )


@dataclass(frozen=True, eq=False)
class Scene:
    """Map, lights and logged agents of a batch, padded."""

    node_pose: Float[Tensor, "B M 20 3"]
    """Start and direction of each segment of each map token."""
    node_mask: Bool[Tensor, "B M 20"]
    map_type: Int64[Tensor, "B M"]
    map_box: Float[Tensor, "B 4"]
    """Smallest and largest x, smallest and largest y of the map; infinite without one."""
    light_token: Int64[Tensor, "B L"]
    """Map token of each light."""
    light_mask: Bool[Tensor, "B L"]
    light_state: Int64[Tensor, "B L S"]
    agent_mask: Bool[Tensor, "B A"]
    agent_class: Int64[Tensor, "B A"]
    size: Float[Tensor, "B A 3"]
    valid: Bool[Tensor, "B A S"]
    pose: Float[Tensor, "B A S 3"]
    motion: Float[Tensor, "B A S 3"]
    """Speed, acceleration and yaw rate."""
    origin: Float[Tensor, "B 3"]
    """x, y and heading of the ego frame in the frame of the batch."""

    @property
    def map_mask(self) -> Bool[Tensor, "B M"]:
        """True = the map token exists."""
        return self.node_mask[..., 0]

    @property
    def map_pose(self) -> Float[Tensor, "B M 3"]:
        """Pose of each map token: the pose of the first node."""
        return self.node_pose[..., 0, :]

    @property
    def light_pose(self) -> Float[Tensor, "B L 3"]:
        """Pose of each light: the pose of the light's map token."""
        return self.map_pose.gather(1, self.light_token[..., None].expand(-1, -1, 3))

    def to_batch_frame(self, pose: Float[Tensor, "B N A 3"]) -> Float[Tensor, "B N A 3"]:
        """Poses of the ego frame in the frame of the batch, headings in [-pi, pi)."""
        origin = self.origin[:, None, None]  # [B, 1, 1, 3]
        position = rotate(pose[..., :2], origin[..., 2]) + origin[..., :2]
        return torch.cat([position, wrap_angle(pose[..., 2] + origin[..., 2])[..., None]], -1)

    def to_ego_frame(self, pose: Float[Tensor, "B N A 3"]) -> Float[Tensor, "B N A 3"]:
        """Poses of the batch's frame in the ego frame."""
        return relative_pose(pose, self.origin[:, None, None])


def build_scene(batch: ScenarioBatch, num_steps: int, max_map_tokens: int | None) -> Scene:
    """Scene of a batch, on the batch's device.

    Args:
        batch: Scenarios with at least `num_steps` logged steps.
        num_steps: Number S of steps of agents and lights: 11 = history, 91 = the whole log.
        max_map_tokens: Largest number of map tokens of a scenario; tokens far from the evaluated agents go first.
    """
    rows = [
        _rows(scenario, num_steps, max_map_tokens, origin)
        for scenario, origin in zip(batch.scenarios, batch.origin.cpu().numpy())
    ]
    pad = {name: max(1, *(len(row[name]) for row in rows)) for name in ("node_mask", "light_token")}
    counts = {name: pad["node_mask"] for name in ("node_pose", "node_mask", "map_type")}
    counts |= {name: pad["light_token"] for name in ("light_token", "light_mask", "light_state")}
    counts |= {name: batch.agent_mask.shape[1] for name in ("size", "valid", "pose", "motion")}
    stacked = {name: _stack([row[name] for row in rows], counts.get(name)).to(batch.device) for name in rows[0]}
    return Scene(**stacked, agent_mask=batch.agent_mask, agent_class=class_of_type(batch.object_type))


def _stack(arrays: Sequence[np.ndarray], count: int | None) -> Tensor:
    """Arrays along a new first axis, zeros appended up to `count` rows each."""
    if count is not None:
        arrays = [np.concatenate([a, np.zeros((count - len(a), *a.shape[1:]), a.dtype)]) for a in arrays]
    stacked = torch.from_numpy(np.stack(arrays))
    return stacked.float() if stacked.is_floating_point() else stacked


def _rows(
    scenario: Scenario, num_steps: int, max_map_tokens: int | None, batch_origin: Float[np.ndarray, "2"]
) -> dict[str, np.ndarray]:
    """Rows of a scenario in each field that `build_scene` pads, float64."""
    tokens, lights = tokenize_map(scenario, max_map_tokens), tokenize_lights(scenario, max_map_tokens)
    motions, origin = agent_motions(scenario, num_steps), ego_pose(scenario)
    heading = np.arctan2(tokens.direction[..., 1], tokens.direction[..., 0])  # [M, 20]
    nodes = tokens.position[tokens.node_mask]
    low, high = (nodes.min(0), nodes.max(0)) if len(nodes) else (np.full(3, -np.inf), np.full(3, np.inf))
    return {
        "node_pose": np.concatenate([tokens.position[..., :2], heading[..., None]], -1),
        "node_mask": tokens.node_mask,
        "map_type": tokens.type,
        "map_box": np.array([low[0], high[0], low[1], high[1]]),
        "light_token": lights.token,
        "light_mask": np.ones(len(lights.token), bool),
        "light_state": lights.state[:, :num_steps],
        "size": motions.size,
        "valid": motions.valid,
        "pose": np.concatenate([motions.position[..., :2], motions.heading[..., None]], -1),
        "motion": motions.motion,
        "origin": np.append(origin[:2] - batch_origin, origin[2]),
    }


class DestinationMap:
    """Candidates for destinations: nodes of lanes and road edges, and the links between lanes."""

    def __init__(self, map_tokens: MapTokens, successors: dict[int, list[int]]):
        self.map_tokens = map_tokens
        self.successors = successors
        is_lane = np.isin(map_tokens.type, VEHICLE_LANES)
        self.last_tokens = {int(id_): int(k) for k, id_ in enumerate(map_tokens.feature_id) if is_lane[k]}
        nodes = {types: map_tokens.node_mask & np.isin(map_tokens.type, types)[:, None] for types in NODE_TYPES}
        self.nodes: dict[tuple[int, ...], tuple[np.ndarray, ...]] = {
            types: (np.nonzero(mask)[0], map_tokens.position[mask][:, :2], map_tokens.direction[mask][:, :2])
            for types, mask in nodes.items()
        }

    def destinations(self, last: Float64[np.ndarray, "4"], agent_class: int) -> dict[int, float]:
        """Tokens that an agent may be heading for, with probabilities; empty if there are none.

        Args:
            last: Position x and y, heading and speed at the agent's last logged step, ego frame.
            agent_class: Class of the agent: 0 vehicle, 1 pedestrian, 2 cyclist.
        """
        position, heading, speed = last[:2], last[2], last[3]
        predicted_position = position + LOOKAHEAD_S * speed * np.array([np.cos(heading), np.sin(heading)])
        token = NO_DESTINATION
        if agent_class == VEHICLE:
            token = self._find_node(VEHICLE_LANES, position, heading)
            if token != NO_DESTINATION:
                return self._walk_lanes(int(self.map_tokens.feature_id[token]), 1)
        elif agent_class == CYCLIST:
            token = self._find_node(BIKE_LANES, predicted_position, heading)
        token = self._find_node(EDGES, predicted_position) if token == NO_DESTINATION else token
        return {} if token == NO_DESTINATION else {token: 1.0}

    def _find_node(self, types: tuple[int, ...], point: Float64[np.ndarray, "2"], heading: float | None = None) -> int:
        """Token of the nearest node of some types, with a heading only of those within reach that run in its direction
        (less than 90 degrees apart); `NO_DESTINATION` without such a node."""
        token, position, direction = self.nodes[types]
        distance = np.linalg.norm(position - point, axis=1)
        if heading is not None:
            is_aligned = direction @ np.array([np.cos(heading), np.sin(heading)]) > 0
            distance = np.where((distance < MAX_LANE_DISTANCE_M) & is_aligned, distance, np.inf)
        return int(token[distance.argmin()]) if np.isfinite(distance).any() else NO_DESTINATION

    def _walk_lanes(self, lane: int, depth: int) -> dict[int, float]:
        """Last tokens of the lanes that a walk from a lane may end on, with probabilities, each fork at random."""
        next_lanes = self.successors.get(lane, [])
        end = {self.last_tokens[lane]: 1.0}
        # A fork ends the walk, except at the first lane.
        if not next_lanes or depth > MAX_WALK_LANES or (depth > 1 and len(next_lanes) > 1):
            return end
        probabilities: dict[int, float] = {}
        for next_lane in next_lanes:
            ends = self._walk_lanes(next_lane, depth + 1) if next_lane in self.last_tokens else end
            for token, probability in ends.items():
                probabilities[token] = probabilities.get(token, 0.0) + probability / len(next_lanes)
        return probabilities


@cached_on_scenario
def destination_labels(scenario: Scenario, max_tokens: int | None) -> Int64[np.ndarray, "A"]:
    """Destination of each simulated agent at the end of the log; `NO_DESTINATION` for an agent without.

    The choice at forks depends on the scenario and the agent alone.

    Args:
        scenario: Scenario with the logged future.
        max_tokens: Largest number of map tokens, as in `tokenize_map`; None = no limit.
    """
    motions = agent_motions(scenario, TOTAL_STEPS)
    destination_map = DestinationMap(tokenize_map(scenario, max_tokens), _successors(scenario))
    indices = scenario.simulated_indices
    classes = class_of_type(torch.from_numpy(scenario.tracks.object_type[indices].astype(np.int64))).tolist()
    labels = np.full(len(indices), NO_DESTINATION)
    for agent, (index, agent_class) in enumerate(zip(indices, classes)):
        step = np.flatnonzero(motions.valid[agent])[-1]
        heading, speed = motions.heading[agent, step], motions.motion[agent, step, 0]
        last = np.array([*motions.position[agent, step, :2], heading, speed])
        candidates = destination_map.destinations(last, agent_class)
        if candidates:
            key = derive_seed(0, "destination", scenario.scenario_id, scenario.tracks.object_id[index])
            rng = np.random.Generator(np.random.Philox(key=key))
            probabilities = np.array(list(candidates.values())) / sum(candidates.values())
            labels[agent] = rng.choice(list(candidates), p=probabilities)
    return labels


def _successors(scenario: Scenario) -> dict[int, list[int]]:
    """Lanes that follow each lane, by feature id: as logged, or from the geometry where a log has no links."""
    links: dict[int, list[int]] = {}
    for lane, successor in scenario.map_features.topology.exit_lanes.tolist():
        links.setdefault(lane, []).append(successor)
    if links:
        return links
    graph = lane_graph(scenario)
    ids = graph.lane_id.tolist()
    return {ids[k]: [ids[j] for j in successors] for k, successors in enumerate(graph.successors)}
