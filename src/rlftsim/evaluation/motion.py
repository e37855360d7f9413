"""Motion of all agents of a world over time, in a log or a rollout, and the gaps between them.

A agents, S steps of 0.1 s after the current one, K samples of vehicles.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.types import CURRENT_STEP, ObjectType, Scenario
from rlftsim.viewer.scene import compute_overlap

STRIDE = 5
"""Steps between samples of density, speed, gaps, overlaps and incidents."""
MOVING_MPS = 0.5
LANE_HALF_WIDTH_M = 1.8


@dataclass(frozen=True, eq=False)
class Motion:
    """Agents of a world over time, map frame."""

    position: Float[np.ndarray, "A S 2"]
    heading: Float[np.ndarray, "A S"]
    size: Float[np.ndarray, "A 3"]
    z: Float[np.ndarray, "A"]
    """Height of the center when first seen, which agents keep, as in the metric."""
    valid: Bool[np.ndarray, "A S"]
    is_vehicle: Bool[np.ndarray, "A"]
    ego: int

    def steps(self, steps: slice) -> "Motion":
        """Motion over some of the steps."""
        cut = {name: getattr(self, name)[:, steps] for name in ("position", "heading", "valid")}
        return replace(self, **cut)


def read_log(scenario: Scenario) -> Motion:
    """Motion of all agents of a log after the current step, those included that are seen later.

    Args:
        scenario: World with a log of any length.
    """
    tracks, future = scenario.tracks, slice(CURRENT_STEP + 1, None)
    size = np.where(tracks.valid[..., None], tracks.size, 0).max(1)
    z = tracks.position[np.arange(len(size)), tracks.valid.argmax(1), 2]
    return Motion(
        tracks.position[:, future, :2] - scenario.origin, tracks.heading[:, future], size, z, tracks.valid[:, future],
        tracks.object_type == ObjectType.VEHICLE, scenario.ego_index,
    )  # fmt: skip


def read_rollouts(scenario: Scenario, rollouts: Rollouts) -> Iterator[Motion]:
    """Motion in each rollout of a scenario.

    Args:
        scenario: World as it was simulated, with visitors where agents enter.
        rollouts: Rollouts of that world alone.
    """
    tracks, simulated = scenario.tracks, scenario.simulated_indices
    ego = int(np.flatnonzero(simulated == scenario.ego_index)[0])
    for number in range(rollouts.num_rollouts):
        position, heading = rollouts.position[0, number].cpu().numpy(), rollouts.heading[0, number].cpu().numpy()
        valid = np.ones(heading.shape, bool) if rollouts.valid is None else rollouts.valid[0, number].cpu().numpy()
        is_vehicle = tracks.object_type[simulated] == ObjectType.VEHICLE
        count = len(simulated)  # padding comes behind
        size, z = tracks.size[simulated, CURRENT_STEP], tracks.position[simulated, CURRENT_STEP, 2]
        yield Motion(position[:count], heading[:count], size, z, valid[:count], is_vehicle, ego)


def find_collisions(
    position: Float[np.ndarray, "A S 2"], heading: Float[np.ndarray, "A S"], size: Float[np.ndarray, "A 3"],
    valid: Bool[np.ndarray, "A S"],
) -> Bool[np.ndarray, "A S-1"]:  # fmt: skip
    """True where an agent begins to overlap another agent; not at the first sample, nor where the agent appears.

    Args:
        position: Centers of the agents, m.
        heading: Headings of the agents, rad.
        size: Length, width and height of the boxes, m.
        valid: True where an agent is present.
    """
    overlap = compute_overlap(position[None], heading[None], size[:, 0], size[:, 1], valid[None])[0]
    return overlap[:, 1:] & ~overlap[:, :-1] & valid[:, :-1]


def measure_gaps(
    position: Float[np.ndarray, "P S 2"], heading: Float[np.ndarray, "A S"], follows: Bool[np.ndarray, "A S"],
    valid: Bool[np.ndarray, "P S"],
) -> Float[np.ndarray, "K"]:  # fmt: skip
    """Distance of the centers of vehicles to the nearest point ahead in a lane's width, m; infinite without any.

    Args:
        position: Centers of the agents and, behind these, further points that vehicles may stand in front of, m.
        heading: Headings of the agents, rad.
        follows: Samples to measure, True K times.
        valid: True where there is an agent or point to be met.
    """
    agent, step = np.nonzero(follows)
    offset = position[:, step] - position[agent, step]  # [P, K, 2]
    cos, sin = np.cos(heading[agent, step]), np.sin(heading[agent, step])
    ahead, left = offset[..., 0] * cos + offset[..., 1] * sin, offset[..., 1] * cos - offset[..., 0] * sin
    leads = valid[:, step] & (ahead > 0.5) & (np.abs(left) < LANE_HALF_WIDTH_M)
    return np.where(leads, ahead, np.inf).min(0)
