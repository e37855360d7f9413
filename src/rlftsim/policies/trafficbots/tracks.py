"""Logged agents as input of TrafficBots: gaps filled, speed with a sign, acceleration and yaw rate by differences.

Frame: ego, float64. Shapes: A simulated agents, S steps.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from rlftsim.policies.trafficbots.map_tokens import ego_pose, to_ego_frame
from rlftsim.scenario.types import STEP_S, Scenario, cached_on_scenario


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
