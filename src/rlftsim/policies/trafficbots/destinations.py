"""Destinations: the map token that an agent is heading for at the end of the log.

Frame: ego. Shapes: A agents, M map tokens.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from rlftsim.policies.trafficbots.map_tokens import VEHICLE_LANES, MapTokens, MapTokenType, tokenize_map
from rlftsim.policies.trafficbots.tracks import agent_motions
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.types import TOTAL_STEPS, Scenario, cached_on_scenario
from rlftsim.tokens.vocabulary import class_of_type

VEHICLE, PEDESTRIAN, CYCLIST = range(3)
NO_DESTINATION = -1
MAX_LANE_DISTANCE_M = 3.0
"""Largest distance of an agent's last pose from the agent's lane."""
LOOKAHEAD_S = 5.0
"""Time for which an agent that is on no lane is taken to go on at the last speed."""
MAX_WALK_LANES = 3


class Nodes:
    """Nodes of the map tokens of given types."""

    def __init__(self, tokens: MapTokens, types: tuple[int, ...]):
        mask: Bool[np.ndarray, "M 20"] = tokens.node_mask & np.isin(tokens.type, types)[:, None]
        self.token = np.nonzero(mask)[0]  # [n]
        self.position = tokens.position[mask][:, :2]
        self.direction = tokens.direction[mask][:, :2]

    def nearest(self, point: Float64[np.ndarray, "2"]) -> int:
        """Token of the nearest node; `NO_DESTINATION` without nodes."""
        if not len(self.token):
            return NO_DESTINATION
        return int(self.token[np.linalg.norm(self.position - point, axis=1).argmin()])

    def nearest_in_direction(self, point: Float64[np.ndarray, "2"], heading: float) -> int:
        """Token of the nearest node within reach that runs in a direction; `NO_DESTINATION` without such a node.

        Args:
            point: Position x and y, m, ego frame.
            heading: Direction in rad; directions of nodes differ by less than 90 degrees.
        """
        distance = np.linalg.norm(self.position - point, axis=1)
        is_aligned = self.direction @ np.array([np.cos(heading), np.sin(heading)]) > 0
        nodes = np.flatnonzero((distance < MAX_LANE_DISTANCE_M) & is_aligned)
        return int(self.token[nodes[distance[nodes].argmin()]]) if len(nodes) else NO_DESTINATION


class DestinationMap:
    """Candidates for destinations: nodes of lanes and road edges, and the links between lanes."""

    def __init__(self, map_tokens: MapTokens, successors: dict[int, list[int]]):
        self.map_tokens = map_tokens
        self.successors = successors
        self.vehicle_lanes = Nodes(map_tokens, VEHICLE_LANES)
        self.bike_lanes = Nodes(map_tokens, (MapTokenType.BIKE_LANE,))
        self.edges = Nodes(map_tokens, (MapTokenType.EDGE_BOUNDARY,))
        is_lane = np.isin(map_tokens.type, VEHICLE_LANES)
        self.last_tokens = {int(id_): int(k) for k, id_ in enumerate(map_tokens.feature_id) if is_lane[k]}

    def destinations(self, last: Float64[np.ndarray, "4"], agent_class: int) -> dict[int, float]:
        """Tokens that an agent may be heading for, with probabilities; empty if there are none.

        Args:
            last: Position x and y, heading and speed at the agent's last logged step, ego frame.
            agent_class: Class of the agent: 0 vehicle, 1 pedestrian, 2 cyclist.
        """
        heading, speed = last[2:]
        position = last[:2]
        predicted_position = position + LOOKAHEAD_S * speed * np.array([np.cos(heading), np.sin(heading)])
        if agent_class == VEHICLE:
            token = self.vehicle_lanes.nearest_in_direction(position, heading)
            if token != NO_DESTINATION:
                return self._walk_lanes(int(self.map_tokens.feature_id[token]), 1)
        is_cyclist = agent_class == CYCLIST
        token = self.bike_lanes.nearest_in_direction(predicted_position, heading) if is_cyclist else NO_DESTINATION
        token = self.edges.nearest(predicted_position) if token == NO_DESTINATION else token
        return {} if token == NO_DESTINATION else {token: 1.0}

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
