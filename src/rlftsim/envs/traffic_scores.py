"""Scores of the traffic around a planner: realism of the other agents, reactivity, and the blame for collisions.

Reactivity counts the seven events of ReactSim-Bench (arXiv 2606.14058), with thresholds of ours where the paper names
none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Int64, Shaped

from rlftsim.envs.contact import Collision, lane_search
from rlftsim.envs.planner_scores import LANE_M, WRONG_WAY_M, measure_wrong_way
from rlftsim.envs.record import Record
from rlftsim.envs.road import MAX_PAIRS, road_edges
from rlftsim.geometry import wrapped
from rlftsim.realism import METRIC_2025, SimulatedStates, score
from rlftsim.realism.agents import Trajectories
from rlftsim.realism.map_based import OUTSIDE_M, compute_distance_to_road_edge
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S, ObjectType, Scenario, cached_on_scenario
from rlftsim.viewer.scene import compute_overlap

RISKY_TTC_S = 1.0
INFEASIBLE_ACCELERATION_MPS2 = 8.0
"""Change of speed over half a second."""
INFEASIBLE_CURVATURE = 0.3
"""Turn per meter driven over half a second, rad/m: tighter than a radius of 3.3 m."""
SPAN_STEPS = 5
SLOW_MPS = 1.0
"""Curvature is not measured below this speed."""


@dataclass(frozen=True)
class TrafficScores:
    """Events of the other agents in an episode; rates are fractions of the other vehicles (contacts: of all)."""

    ego_contacts: float
    """Tracks in contact with the planner's agent."""
    risky_approach_rate: float
    """1 = the least time to collision fell below 1 s."""
    others_collision_rate: float
    others_offroad_rate: float
    others_wrong_way_rate: float
    others_acceleration_rate: float
    others_steering_rate: float
    blamed_others_rate: float
    """Of the contacts with the planner's agent, the fraction that was not its fault; NaN without a contact."""


def score_traffic(record: Record, least_ttc_s: float) -> TrafficScores:
    """Events of the other agents in an episode.

    Args:
        record: Record of the episode; a short episode is scored up to the end.
        least_ttc_s: Least time to collision of the planner's agent, as `PlannerScores` has it, s.
    """
    scene, motion = record.scene, record.motion
    # rows into which nobody has entered are no agents
    is_traffic = (np.arange(len(scene.object_id)) != record.agent) & record.is_observed.any(1)
    is_vehicle = is_traffic & (scene.object_type == ObjectType.VEHICLE)
    has_edges, has_lanes = (find(scene.scenario) is not None for find in (road_edges, lane_search))
    # 1. contacts among the others; those that begin with an overlap do not count
    length, width = scene.size[:, 0].astype(np.float32), scene.size[:, 1].astype(np.float32)
    overlaps = compute_overlap(
        motion[None, ..., :2].astype(np.float32), motion[None, ..., 2].astype(np.float32), length, width,
        (record.is_observed & is_traffic[:, None])[None], ignore_from=0,
        z=None if scene.levels is None else record.z[None], height=scene.size[:, 2],
    )[0].any(1)  # fmt: skip
    # 2. kinematics over half a second whose states are all known
    speed = np.linalg.norm(np.diff(motion[..., :2], axis=1), axis=-1) / STEP_S  # [A, T]
    speeds = _runs(speed, SPAN_STEPS + 1)
    change = np.abs(speeds[..., -1] - speeds[..., 0]) / (SPAN_STEPS * STEP_S)
    jolt = (change > INFEASIBLE_ACCELERATION_MPS2) & _runs(record.is_observed, SPAN_STEPS + 2).all(-1)
    driven = _runs(speed, SPAN_STEPS).sum(-1) * STEP_S
    headings = _runs(motion[..., 2], SPAN_STEPS + 1)
    turn = np.abs(wrapped(headings[..., -1] - headings[..., 0]))
    fast = (driven > SLOW_MPS * SPAN_STEPS * STEP_S) & _runs(record.is_observed, SPAN_STEPS + 1).all(-1)
    tight = np.where(fast, turn / np.maximum(driven, 1e-3), 0.0) > INFEASIBLE_CURVATURE
    return TrafficScores(
        ego_contacts=float(len(record.collisions)),
        risky_approach_rate=float(least_ttc_s < RISKY_TTC_S),
        others_collision_rate=_rate(overlaps, is_traffic),
        others_offroad_rate=_rate(_leaves_road(record, is_vehicle), is_vehicle & has_edges),
        others_wrong_way_rate=_rate(_drives_against(record, is_vehicle), is_vehicle & has_lanes),
        others_acceleration_rate=_rate(np.any(jolt, axis=1), is_vehicle),
        others_steering_rate=_rate(np.any(tight, axis=1), is_vehicle),
        blamed_others_rate=blamed_others_rate(record.collisions),
    )


def blamed_others_rate(collisions: Sequence[Collision]) -> float:
    """Fraction of contacts without fault of the planner's agent, in one episode or several; NaN without contacts."""
    return sum(not collision.at_fault for collision in collisions) / len(collisions) if collisions else np.nan


def _rate(event: Bool[np.ndarray, "A"], among: Bool[np.ndarray, "A"]) -> float:
    return float(event[among].mean()) if among.any() else np.nan


def _runs(values: Shaped[np.ndarray, "A t"], length: int) -> Shaped[np.ndarray, "A r n"]:
    """All runs of n consecutive steps; none where there are fewer steps."""
    if values.shape[1] < length:
        return np.zeros((len(values), 0, length), values.dtype)
    return np.lib.stride_tricks.sliding_window_view(values, length, axis=1)


def _leaves_road(record: Record, vehicles: Bool[np.ndarray, "A"]) -> Bool[np.ndarray, "A"]:
    """True = a vehicle's corner leaves the road during the episode; off the road from the start does not count."""
    edges, scene, leaves = road_edges(record.scene.scenario), record.scene, np.zeros(len(vehicles), bool)
    if edges is None:
        return leaves
    x, y = np.moveaxis(record.motion[..., :2] + scene.scenario.origin, -1, 0)
    pose = np.stack([x, y, record.z, record.motion[..., 2]])  # [4, A, T + 1]

    # those that stand do not leave the road
    agents = np.flatnonzero(vehicles & (pose != pose[..., :1]).any((0, 2)))
    if len(agents):
        states = Trajectories(*torch.from_numpy(pose[:, agents]).float()[:, None])
        size = torch.from_numpy(scene.size[agents, None]).float()
        off = compute_distance_to_road_edge(states, size, edges, max_pairs=MAX_PAIRS)[0].numpy() >= OUTSIDE_M
        is_observed = record.is_observed[agents]
        begins_off = np.take_along_axis(off, is_observed.argmax(1)[:, None], 1)[:, 0]
        leaves[agents] = ~begins_off & (off & is_observed).any(1)
    return leaves


def _drives_against(record: Record, vehicles: Bool[np.ndarray, "A"]) -> Bool[np.ndarray, "A"]:
    """True = drives 2 m or more within a second against every lane around the agent."""
    search, is_against = lane_search(record.scene.scenario), np.zeros(len(vehicles), bool)
    if search is None:
        return is_against
    # a replayed agent jumps over the gaps of its log
    is_step_observed = record.is_observed[:, 1:] & record.is_observed[:, :-1]
    step = np.where(is_step_observed, np.linalg.norm(np.diff(record.motion[..., :2], axis=1), axis=-1), 0.0)
    moving = np.flatnonzero(vehicles & (step.sum(1) >= WRONG_WAY_M[0]))
    for agent in moving:
        lane_points = search.find_points(record.motion[agent, 1:, :2], LANE_M, record.ground[agent, 1:])
        heading = record.motion[agent, 1:, 2]
        against = [
            bool(points) and bool((np.cos(search.heading[points] - direction) < 0).all())
            for points, direction in zip(lane_points, heading)
        ]
        is_against[agent] = measure_wrong_way(step[agent], np.array(against)) >= WRONG_WAY_M[0]
    return is_against


class _WithoutEgo(Scenario):
    """A scenario in which the ego is not evaluated."""

    @cached_property
    def evaluated_indices(self) -> Int64[np.ndarray, "E"]:
        """Tracks to predict, by ascending object id."""
        rows = np.unique(self.tracks_to_predict.astype(np.int64))
        rows = rows[self.tracks.valid[rows, CURRENT_STEP] & (rows != self.ego_index)]
        return rows[np.argsort(self.tracks.object_id[rows], kind="stable")]


@cached_on_scenario
def _leave_out_ego(scenario: Scenario) -> _WithoutEgo:
    return _WithoutEgo(**{field.name: getattr(scenario, field.name) for field in fields(Scenario)})


def compute_traffic_realism(records: Sequence[Record]) -> float:
    """Realism meta-metric of the agents to predict, the ego left out, over rollouts of a scenario.

    NaN where realism cannot be measured: no future, no road edges, an episode that ended early, or no other agent to
    predict.

    Args:
        records: Records of the same scenario, at least one, a rollout each.
    """
    scene = records[0].scene
    scenario = _leave_out_ego(scene.scenario)
    has_all_steps = all(record.steps == FUTURE_STEPS and not record.is_open for record in records)
    if not (scenario.has_evaluated_future and has_all_steps) or road_edges(scene.scenario) is None:
        return float("nan")
    motion = torch.from_numpy(np.stack([record.motion[:, 1:] for record in records]))  # [N, A, 80, 5]
    world = (motion[..., :2] + torch.from_numpy(scene.scenario.origin)).float()
    z = torch.from_numpy(scene.z).float()[None, :, None].expand(world.shape[:-1])
    states = SimulatedStates(scene.object_id, world[..., 0], world[..., 1], z, motion[..., 2].float())
    return float(score(scenario, states, METRIC_2025).meta_metric)
