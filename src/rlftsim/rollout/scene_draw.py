"""Initial states of a whole scene, drawn from the lanes, by the rules of the scenario generation challenge.

The challenge gives map, past and present lights, the ego's past, and the number of agents of each type. The logged
states of the other agents must not be read. The draw has no model of where traffic is and how fast: agents stand or
move along lanes near the ego, pedestrians at the side, all with the median size of the type.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rlftsim.geometry import boxes_overlap
from rlftsim.rollout.edge_scenes import without_future
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.lane_graph import LaneGraph, lane_graph
from rlftsim.scenario.polylines import arc_length
from rlftsim.scenario.types import (
    CURRENT_STEP,
    HISTORY_STEPS,
    MEDIAN_SIZE_M,
    OTHER_SIZE_M,
    STEP_S,
    ObjectType,
    Scenario,
)

REACH_M = 80.0
"""Agents are drawn this near to the ego, as far as its sensors see."""
STANDING_FRACTION = 0.5
"""Fraction of agents that stand."""
FASTEST_MPS = {ObjectType.VEHICLE: 13.4, ObjectType.PEDESTRIAN: 1.8, ObjectType.CYCLIST: 6.0}
SIDE_M = (3.0, 8.0)
"""Distance of pedestrians from the center of the lane."""
MAX_DRAWS = 30
"""Draws until an agent overlaps no other; the last is taken."""


def draw_scene(scenario: Scenario, rollout: int, *, seed: int) -> Scenario:
    """The scenario without a future, named after the rollout, with drawn histories of all agents but the ego.

    Args:
        scenario: Scenario whose map, lights up to the current step, ego's past, object ids and types are read.
        rollout: Number of the rollout that begins so; each has a draw of its own.
        seed: Seed of all draws.
    """
    graph = lane_graph(scenario)
    rng = np.random.Generator(np.random.Philox(key=derive_seed(seed, "scene", scenario.scenario_id, rollout)))
    history, agents = without_future(scenario), scenario.simulated_indices
    tracks = history.tracks.select(agents)
    ego = int(np.searchsorted(agents, scenario.ego_index))
    types = [ObjectType(value) for value in tracks.object_type]
    size = np.array([MEDIAN_SIZE_M.get(object_type, OTHER_SIZE_M) for object_type in types])  # [A, 3]
    size[ego] = tracks.size[ego, CURRENT_STEP]
    states = np.zeros((len(agents), HISTORY_STEPS, 4))  # x, y, z, heading
    # The ego's own past; where the log lost it, the current state.
    logged = np.concatenate([tracks.position[ego], tracks.heading[ego, :, None]], -1)
    states[ego] = np.where(tracks.valid[ego, :, None], logged, logged[CURRENT_STEP])
    current = states[ego, CURRENT_STEP] - [0, 0, size[ego, 2] / 2, 0]
    distance = np.linalg.norm(graph.points[:, :2] - current[:2], axis=-1)
    candidates = np.flatnonzero(distance <= REACH_M)
    present = [ego]
    for agent in (row for row in range(len(agents)) if row != ego):
        for _ in range(MAX_DRAWS):
            if len(candidates):
                states[agent] = _draw_history(graph, int(rng.choice(candidates)), types[agent], rng)
            else:  # no lane is near: it stands somewhere around the ego
                offset = rng.uniform(-1, 1, 4) * (REACH_M, REACH_M, 0, np.pi)
                states[agent] = current + offset
            states[agent, :, 2] += size[agent, 2] / 2
            pose, neighbors = states[agent, CURRENT_STEP], states[present, CURRENT_STEP]
            gap = neighbors[:, :2] - pose[:2]
            if not boxes_overlap(gap, pose[3:], neighbors[:, 3], size[agent], size[present]).any():
                break
        present.append(agent)
    position = states[..., :3].astype(np.float32)
    velocity = np.gradient(states[..., :2], STEP_S, axis=1).astype(np.float32)
    drawn_tracks = replace(
        tracks,
        position=position,
        heading=states[..., 3].astype(np.float32),
        velocity=velocity,
        size=np.repeat(size[:, None], HISTORY_STEPS, 1).astype(np.float32),
        valid=np.ones(position.shape[:2], bool),
    )
    names = ("tracks_to_predict", "difficulty", "objects_of_interest")
    cleared = {name: getattr(scenario, name)[:0] for name in names}
    name = f"{scenario.scenario_id}-{rollout}"  # so that the policy's dice differ, too
    return replace(history, scenario_id=name, tracks=drawn_tracks, ego_index=ego, **cleared)


def _draw_history(
    graph: LaneGraph, point: int, object_type: ObjectType, rng: np.random.Generator
) -> Float[np.ndarray, "S 4"]:
    """x, y, z on the ground and heading over the history, along the lane of a point where the history ends."""
    lane = graph.owner[point]
    first, line = graph.first[lane], graph.lines[lane]
    distance, heading = arc_length(line), np.unwrap(graph.heading[first : first + len(line)])
    end = distance[point - first]
    fastest = FASTEST_MPS.get(object_type, 0.0)
    if object_type == ObjectType.VEHICLE and graph.speed_limit_mps[lane] > 0:
        fastest = graph.speed_limit_mps[lane]
    # no farther than from the start of the lane
    speed = 0.0 if rng.random() < STANDING_FRACTION else min(rng.uniform(0, fastest), end / (CURRENT_STEP * STEP_S))
    at = end - speed * STEP_S * np.arange(CURRENT_STEP, -1, -1)
    x, y, z, heading = (np.interp(at, distance, values) for values in (*line.T, heading))
    if object_type == ObjectType.PEDESTRIAN:
        side = rng.choice((-1, 1)) * rng.uniform(*SIDE_M)
        x, y = x - np.sin(heading) * side, y + np.cos(heading) * side
    return np.stack([x, y, z, np.arctan2(np.sin(heading), np.cos(heading))], -1)
