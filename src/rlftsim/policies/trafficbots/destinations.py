"""Destinations: the map token that an agent is on its way to at the end of its log.

Frame: ego. Shapes: A agents, M map tokens.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from rlftsim.policies.trafficbots.map_tokens import VEHICLE_LANES, MapPieces, MapTokenType, map_pieces
from rlftsim.policies.trafficbots.tracks import agent_motions
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.derived import cached_on_scenario
from rlftsim.scenario.lane_graph import lane_graph
from rlftsim.scenario.types import TOTAL_STEPS, Scenario
from rlftsim.tokens.vocabulary import class_of_type

VEHICLE, PEDESTRIAN, CYCLIST = range(3)
NO_DESTINATION = -1
MAX_LANE_DISTANCE_M = 3.0
"""Between the last pose of an agent and the lane it is on."""
LOOKAHEAD_S = 5.0
"""An agent that is on no lane is taken to go on at its last speed for so long."""
MAX_LANES_AHEAD = 3


@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes of the map tokens of some types."""

    token: Int64[np.ndarray, "n"]
    position: Float64[np.ndarray, "n 2"]
    direction: Float64[np.ndarray, "n 2"]

    def nearest(self, point: Float64[np.ndarray, "2"]) -> int:
        """Token of the nearest node; `NO_DESTINATION` without nodes."""
        if not len(self.token):
            return NO_DESTINATION
        return int(self.token[np.linalg.norm(self.position - point, axis=1).argmin()])

    def along(self, point: Float64[np.ndarray, "2"], heading: float) -> int:
        """Token of the nearest node within reach that runs in a direction; `NO_DESTINATION` if there is none.

        Args:
            point: x and y, m.
            heading: rad; the angle to it is less than 90 degrees.
        """
        distance = np.linalg.norm(self.position - point, axis=1)
        agrees = self.direction @ np.array([np.cos(heading), np.sin(heading)]) > 0
        near = np.flatnonzero((distance < MAX_LANE_DISTANCE_M) & agrees)
        return int(self.token[near[distance[near].argmin()]]) if len(near) else NO_DESTINATION


class DestinationMap:
    """Candidates for destinations: nodes of lanes and road edges, and the links between lanes."""

    def __init__(self, pieces: MapPieces, successors: dict[int, list[int]]):
        self.pieces = pieces
        self.successors = successors
        self.vehicle_lanes = _nodes(pieces, VEHICLE_LANES)
        self.bike_lanes = _nodes(pieces, (MapTokenType.BIKE_LANE,))
        self.edges = _nodes(pieces, (MapTokenType.EDGE_BOUNDARY,))
        is_lane = np.isin(pieces.type, VEHICLE_LANES)
        self.last_piece = {int(id_): int(k) for k, id_ in enumerate(pieces.feature_id) if is_lane[k]}

    def destinations(self, last: Float64[np.ndarray, "4"], agent_class: int) -> dict[int, float]:
        """Tokens that an agent may be on its way to, and their probabilities; empty if there is none.

        Args:
            last: x, y, heading and speed at its last logged step.
            agent_class: 0 vehicle, 1 pedestrian, 2 cyclist.
        """
        x, y, heading, speed = last
        here = np.array([x, y])
        ahead = here + LOOKAHEAD_S * speed * np.array([np.cos(heading), np.sin(heading)])
        if agent_class == VEHICLE and (token := self.vehicle_lanes.along(here, heading)) != NO_DESTINATION:
            return self._lanes_ahead(int(self.pieces.feature_id[token]), 1)
        token = self.bike_lanes.along(ahead, heading) if agent_class == CYCLIST else NO_DESTINATION
        token = self.edges.nearest(ahead) if token == NO_DESTINATION else token
        return {} if token == NO_DESTINATION else {token: 1.0}

    def _lanes_ahead(self, lane: int, depth: int) -> dict[int, float]:
        """Last pieces of the lanes that a walk from a lane may end on, each fork at random."""
        next_lanes = self.successors.get(lane, [])
        ended = {self.last_piece[lane]: 1.0}
        # A fork ends the walk, except at the lane it starts from.
        if not next_lanes or depth > MAX_LANES_AHEAD or (depth > 1 and len(next_lanes) > 1):
            return ended
        found: dict[int, float] = {}
        for one in next_lanes:
            ends = self._lanes_ahead(one, depth + 1) if one in self.last_piece else ended
            for token, probability in ends.items():
                found[token] = found.get(token, 0.0) + probability / len(next_lanes)
        return found


@cached_on_scenario
def destination_labels(scenario: Scenario, max_tokens: int | None) -> Int64[np.ndarray, "A"]:
    """Destination of each simulated agent at the end of its log; `NO_DESTINATION` where there is none.

    The choice at forks depends on the scenario and the agent alone.

    Args:
        scenario: with its future.
        max_tokens: of `map_pieces`.
    """
    motions = agent_motions(scenario, TOTAL_STEPS)
    places = DestinationMap(map_pieces(scenario, max_tokens), _successors(scenario))
    indices = scenario.simulated_indices
    classes = class_of_type(torch.from_numpy(scenario.tracks.object_type[indices].astype(np.int64))).tolist()
    labels = np.full(len(indices), NO_DESTINATION)
    for agent, (index, agent_class) in enumerate(zip(indices, classes)):
        step = np.flatnonzero(motions.valid[agent])[-1]
        last = np.array(
            [*motions.position[agent, step, :2], motions.heading[agent, step], motions.motion[agent, step, 0]]
        )
        found = places.destinations(last, agent_class)
        if found:
            key = derive_seed(0, "destination", scenario.scenario_id, scenario.tracks.object_id[index])
            rng = np.random.Generator(np.random.Philox(key=key))
            labels[agent] = rng.choice(list(found), p=np.array(list(found.values())) / sum(found.values()))
    return labels


def _successors(scenario: Scenario) -> dict[int, list[int]]:
    """Lanes after each lane, by feature id: as logged, or from the geometry where a log has no links."""
    links: dict[int, list[int]] = {}
    for lane, after in scenario.map_features.topology.exit_lanes.tolist():
        links.setdefault(lane, []).append(after)
    if links:
        return links
    graph = lane_graph(scenario)
    ids = graph.lane_id.tolist()
    return {ids[k]: [ids[j] for j in after] for k, after in enumerate(graph.successors)}


def _nodes(pieces: MapPieces, types: tuple[int, ...]) -> Nodes:
    mask: Bool[np.ndarray, "M 20"] = pieces.node_mask & np.isin(pieces.type, types)[:, None]
    token = np.broadcast_to(np.arange(len(pieces))[:, None], mask.shape)[mask]
    return Nodes(token, pieces.position[mask][:, :2], pieces.direction[mask][:, :2])
