"""Rollouts of a minute held against the log of the same world, in windows of 10 s.

A agents, S steps of 0.1 s after the current one, K samples.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, ObjectType, Scenario
from rlftsim.viewer.scene import compute_overlap

WINDOW_STEPS = 100
STRIDE = 5
"""Steps between samples of density, speed, gaps and overlaps."""
NEAR_M = 60.0
MOVING_MPS = 0.5
LANE_HALF_WIDTH_M, LONGEST_GAP_M = 1.8, 60.0


@dataclass(frozen=True, eq=False)
class Motion:
    """Agents of a world over time, map frame."""

    position: Float[np.ndarray, "A S 2"]
    heading: Float[np.ndarray, "A S"]
    size: Float[np.ndarray, "A 2"]
    valid: Bool[np.ndarray, "A S"]
    is_vehicle: Bool[np.ndarray, "A"]
    ego: int

    def steps(self, steps: slice) -> "Motion":
        """Motion over some of the steps."""
        cut = {name: getattr(self, name)[:, steps] for name in ("position", "heading", "valid")}
        return replace(self, **cut)


def read_log(scenario: Scenario) -> Motion:
    """Motion of all agents of a log, those included that are seen later."""
    tracks, future = scenario.tracks, slice(CURRENT_STEP + 1, None)
    size = np.where(tracks.valid[..., None], tracks.size, 0).max(1)[:, :2]
    return Motion(
        tracks.position[:, future, :2] - scenario.origin, tracks.heading[:, future], size, tracks.valid[:, future],
        tracks.object_type == ObjectType.VEHICLE, scenario.ego_index,
    )  # fmt: skip


def read_rollouts(scenario: Scenario, rollouts: Rollouts) -> Iterator[Motion]:
    """Motion in each rollout of a scenario, which has visitors if agents enter."""
    tracks, simulated = scenario.tracks, scenario.simulated_indices
    ego = int(np.flatnonzero(simulated == scenario.ego_index)[0])
    for number in range(rollouts.num_rollouts):
        position, heading = rollouts.position[0, number].cpu().numpy(), rollouts.heading[0, number].cpu().numpy()
        valid = np.ones(heading.shape, bool) if rollouts.valid is None else rollouts.valid[0, number].cpu().numpy()
        is_vehicle = tracks.object_type[simulated] == ObjectType.VEHICLE
        yield Motion(position, heading, tracks.size[simulated, CURRENT_STEP, :2], valid, is_vehicle, ego)


@dataclass(frozen=True, eq=False)
class WindowSamples:
    """Samples of 10 s of one or more worlds."""

    density: Float[np.ndarray, "K"]
    """Agents within 60 m of the ego."""
    driving: Float[np.ndarray, "K"]
    """Of these, those that move."""
    speed: Float[np.ndarray, "K"]
    """Speeds of the moving agents within 60 m, m/s."""
    gap: Float[np.ndarray, "K"]
    """Distance to the next vehicle ahead on the lane of each moving vehicle within 60 m, m."""
    ego_speed: Float[np.ndarray, "K"]
    collisions: Float[np.ndarray, "K"]
    """Agents that begin to overlap another agent, in each world."""
    entries: Float[np.ndarray, "K"]
    """Agents that appear, in each world."""
    agent_minutes: Float[np.ndarray, "K"]
    """In each world."""


def measure_windows(motion: Motion) -> list[WindowSamples]:
    """Samples of each 10 s of a world."""
    num_windows = motion.heading.shape[1] // WINDOW_STEPS
    return [_measure(motion.steps(slice(k * WINDOW_STEPS, (k + 1) * WINDOW_STEPS))) for k in range(num_windows)]


def join_samples(samples: Sequence[WindowSamples]) -> WindowSamples:
    """Samples of several worlds in the same window."""
    return WindowSamples(*(np.concatenate(values) for values in zip(*(vars(sample).values() for sample in samples))))


def compute_distance(first: Float[np.ndarray, "k"], second: Float[np.ndarray, "m"]) -> float:
    """Wasserstein distance of two samples, in their unit; NaN where one is empty."""
    if not len(first) or not len(second):
        return float("nan")
    levels = np.linspace(0.005, 0.995, 199)
    return float(np.abs(np.quantile(first, levels) - np.quantile(second, levels)).mean())


def _measure(motion: Motion) -> WindowSamples:
    velocity = np.diff(motion.position, axis=1) / STEP_S
    both = motion.valid[:, 1:] & motion.valid[:, :-1]
    sampled = slice(0, velocity.shape[1], STRIDE)
    speed, both = np.linalg.norm(velocity, axis=-1)[:, sampled], both[:, sampled]
    position, heading = motion.position[:, :-1][:, sampled], motion.heading[:, :-1][:, sampled]
    valid = motion.valid[:, :-1][:, sampled]
    others = np.arange(len(valid)) != motion.ego
    near = valid & (np.linalg.norm(position - position[motion.ego], axis=-1) < NEAR_M) & others[:, None]
    moving = near & both & (speed > MOVING_MPS)
    overlap = compute_overlap(
        position[None], heading[None], motion.size[:, 0], motion.size[:, 1], valid[None]
    )[0]  # fmt: skip
    begins = overlap[:, 1:] & ~overlap[:, :-1] & valid[:, :-1]
    appears = motion.valid[:, 1:] & ~motion.valid[:, :-1]
    return WindowSamples(
        density=near.sum(0).astype(float),
        driving=moving.sum(0).astype(float),
        speed=speed[moving],
        gap=_measure_gaps(position, heading, moving & motion.is_vehicle[:, None], valid & motion.is_vehicle[:, None]),
        ego_speed=speed[motion.ego],
        collisions=np.array([float(begins.sum())]),
        entries=np.array([float(appears.sum())]),
        agent_minutes=np.array([motion.valid.sum() * STEP_S / 60]),
    )


def _measure_gaps(
    position: Float[np.ndarray, "A S 2"], heading: Float[np.ndarray, "A S"], follows: Bool[np.ndarray, "A S"],
    valid: Bool[np.ndarray, "A S"],
) -> Float[np.ndarray, "K"]:  # fmt: skip
    """Distance of the centers to the nearest vehicle ahead, of those that have one within 60 m."""
    agent, step = np.nonzero(follows)
    offset = position[:, step] - position[agent, step]  # [A, K, 2]
    cos, sin = np.cos(heading[agent, step]), np.sin(heading[agent, step])
    ahead, left = offset[..., 0] * cos + offset[..., 1] * sin, offset[..., 1] * cos - offset[..., 0] * sin
    leads = valid[:, step] & (ahead > 0.5) & (ahead < LONGEST_GAP_M) & (np.abs(left) < LANE_HALF_WIDTH_M)
    gap = np.where(leads, ahead, np.inf).min(0)
    return gap[np.isfinite(gap)]
