"""What goes wrong in long rollouts beside collisions: vehicles leave the road, pass red lights, or stand for no reason.

A agents, S steps of 0.1 s after the current one, K samples, one at every fifth step.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from rlftsim.evaluation.drift import find_lane_points
from rlftsim.evaluation.motion import LANE_HALF_WIDTH_M, MOVING_MPS, STRIDE, Motion, measure_gaps
from rlftsim.realism.agents import Trajectories
from rlftsim.realism.features import DEFAULT_COMPUTE
from rlftsim.realism.map_based import MAP_END_M, OUTSIDE_M, RoadEdges, build_road_edges, compute_distance_to_road_edge
from rlftsim.realism.traffic_lights import Signals, build_signals, compute_traffic_light_violation
from rlftsim.scenario.types import HISTORY_STEPS, STEP_S, Scenario, cached_on_scenario

LONGEST_STAND_S = 20.0
FREE_WAY_M = 20.0
"""A vehicle with an agent or a red light so near ahead has a reason to stand."""
DEVICE = torch.device("cpu")
MAX_PAIRS = DEFAULT_COMPUTE.pairs_on(DEVICE)


@dataclass(frozen=True, eq=False)
class Incidents:
    """Incidents of the agents of a world at each sample."""

    leaves_road: Bool[np.ndarray, "A K"]
    """A vehicle that drives has a corner 0.3 m off the road, and had none at the sample before."""
    passes_red: Bool[np.ndarray, "A K"]
    """A vehicle passes a red light within the half second, as the metric counts it."""
    is_on_lane: Bool[np.ndarray, "A K"]
    """A vehicle has its center on a lane; those parked beside have not."""
    is_stuck: Bool[np.ndarray, "A K"]
    """Of these, one that has stood for more than 20 s without an agent or a red light within 20 m ahead."""

    def samples(self, samples: slice) -> "Incidents":
        """Incidents at some of the samples."""
        return Incidents(*(values[:, samples] for values in vars(self).values()))


@cached_on_scenario
def _build_road(scenario: Scenario) -> tuple[RoadEdges | None, Signals | None]:
    features = scenario.map_features
    signals = build_signals(features, scenario.lights, DEVICE, scenario.num_steps)
    return build_road_edges(features, DEVICE), signals


def find_incidents(motion: Motion, scenario: Scenario) -> Incidents:
    """Incidents of all agents of a world; without road edges nobody leaves the road.

    Args:
        motion: Motion over S steps, a multiple of 5.
        scenario: World with the map and the lights of these steps.
    """
    samples, lanes = motion.steps(slice(None, None, STRIDE)), find_lane_points(scenario)
    edges, signals = _build_road(scenario)
    # 1. vehicles that are there since the sample before, and that moved since then
    is_vehicle = samples.valid & motion.is_vehicle[:, None]  # [A, K]
    stays = is_vehicle.copy()
    stays[:, 1:] &= samples.valid[:, :-1]
    stays[:, 0] = False
    driven_m = np.linalg.norm(np.diff(samples.position, axis=1, prepend=samples.position[:, :1]), axis=-1)
    moves = stays & (driven_m >= MOVING_MPS * STRIDE * STEP_S)
    # 2. vehicles on lanes
    is_on_lane = np.zeros_like(moves)
    if lanes is not None:
        distance, _ = lanes.tree.query(samples.position[is_vehicle] + scenario.origin)
        is_on_lane[is_vehicle] = distance < LANE_HALF_WIDTH_M
    return Incidents(
        leaves_road=_find_departures(samples, moves, edges, scenario.origin),
        passes_red=_find_red_lights(motion, signals, scenario.origin),
        is_on_lane=is_on_lane,
        is_stuck=_find_stuck(samples, stays & ~moves & is_on_lane, signals, scenario.origin),
    )


def _find_departures(
    samples: Motion, moves: Bool[np.ndarray, "A K"], edges: RoadEdges | None, origin: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, "A K"]:
    is_off = np.zeros_like(moves)
    if edges is None or not moves.any():
        return is_off
    is_measured = moves.copy()  # the sample before and after each that moves
    is_measured[:, :-1] |= moves[:, 1:]
    agent = np.nonzero(is_measured)[0]
    x, y = (samples.position[is_measured] + origin).T
    pose = np.stack([x, y, samples.z[agent], samples.heading[is_measured]])[:, None, :, None]  # [4, 1, P, 1]
    states, size = Trajectories(*torch.from_numpy(pose).float()), torch.from_numpy(samples.size[agent, None]).float()
    distance = compute_distance_to_road_edge(states, size, edges, max_pairs=MAX_PAIRS)
    is_off[is_measured] = distance[0, :, 0].numpy() >= OUTSIDE_M
    leaves = moves & is_off
    leaves[:, 1:] &= ~is_off[:, :-1]
    return leaves


def _find_red_lights(
    motion: Motion, signals: Signals | None, origin: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, "A K"]:
    passes = np.zeros(motion.valid.shape, bool)  # [A, S]
    if signals is not None:
        x, y = torch.from_numpy(motion.position[motion.is_vehicle] + origin).float()[None].unbind(-1)  # [1, V, S]
        valid = motion.valid[motion.is_vehicle]
        stays = torch.from_numpy(valid[:, 1:] & valid[:, :-1])[None]
        violation = compute_traffic_light_violation(
            x, y, stays, signals, first_step=HISTORY_STEPS, max_pairs=MAX_PAIRS
        )  # fmt: skip
        passes[motion.is_vehicle, 1:] = violation[0].numpy()
    return np.asarray(passes.reshape(len(passes), -1, STRIDE).any(-1))


def _find_stuck(
    samples: Motion, stands: Bool[np.ndarray, "A K"], signals: Signals | None, origin: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, "A K"]:
    position, is_met, num_samples = samples.position, samples.valid, stands.shape[1]
    if signals is not None:
        steps = slice(HISTORY_STEPS, HISTORY_STEPS + STRIDE * num_samples, STRIDE)
        stop = signals.stop_start + signals.stop_progress[..., None] * signals.stop_direction  # [1, S, J, 2]
        position = np.concatenate([position, stop[0, steps].transpose(0, 1).numpy() - origin])
        is_met = np.concatenate([is_met, signals.is_red[0, steps].T.numpy()])
    is_idle = stands.copy()
    is_idle[stands] = measure_gaps(position, samples.heading, stands, is_met) > FREE_WAY_M
    index = np.arange(num_samples)
    last_busy = np.maximum.accumulate(np.where(is_idle, -1, index), axis=1)
    return is_idle & ((index - last_busy) * STRIDE * STEP_S > LONGEST_STAND_S)


def count_steps_on_map(motion: Motion, scenario: Scenario) -> int:
    """Steps until no lane is near the ego; all of them on a map without lanes.

    Args:
        motion: Motion over S steps.
        scenario: World with the map.
    """
    lanes, ego = find_lane_points(scenario), motion.position[motion.ego, ::STRIDE]
    if lanes is None:
        return motion.heading.shape[1]
    is_off = lanes.tree.query(ego + scenario.origin)[0] > MAP_END_M
    return int(is_off.argmax()) * STRIDE if is_off.any() else motion.heading.shape[1]
