"""Logged agents as TrafficBots sees them: gaps filled, speed with a sign, acceleration and yaw rate by differences.

Frame: ego, float64. Shapes: A simulated agents, S steps.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from rlftsim.policies.trafficbots.map_tokens import ego_pose, to_ego_frame
from rlftsim.scenario.derived import cached_on_scenario
from rlftsim.scenario.types import STEP_S, Scenario


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
        scenario: with at least this many steps.
        num_steps: 11 = history, 91 = everything.
    """
    tracks, chosen, pose = scenario.tracks, scenario.simulated_indices, ego_pose(scenario)
    logged = tracks.valid[chosen, :num_steps]  # [A, S]
    position = to_ego_frame(tracks.position[chosen, :num_steps].astype(np.float64), pose)
    heading = tracks.heading[chosen, :num_steps].astype(np.float64) - pose[2]
    velocity = tracks.velocity[chosen, :num_steps].astype(np.float64)
    along = (velocity * np.stack([np.cos(heading + pose[2]), np.sin(heading + pose[2])], -1)).sum(-1)
    speed = np.sign(along) * np.linalg.norm(velocity, axis=-1)
    states = np.concatenate([position, heading[..., None], speed[..., None]], -1)  # [A, S, 5]
    filled, valid = np.zeros_like(states), np.zeros_like(logged)
    rates = np.zeros((*logged.shape, 2))  # acceleration, yaw rate
    steps = np.arange(num_steps)
    for agent, own in enumerate(logged):
        known = np.flatnonzero(own)
        span = slice(known[0], known[-1] + 1)
        values = states[agent, known]
        values[:, 3] = np.unwrap(values[:, 3])
        filled[agent, span] = np.stack([np.interp(steps[span], known, column) for column in values.T], -1)
        valid[agent, span] = True
        # Speed and heading differ from one step to the next; nothing is known before the first one.
        rates[agent, known[0] + 1 : known[-1] + 1] = np.diff(filled[agent, span][:, [4, 3]], axis=0) / STEP_S
    # Not a product with `logged`: values of steps that are not valid may be NaN.
    size = np.where(logged[..., None], tracks.size[chosen, :num_steps].astype(np.float64), 0.0)
    return AgentMotions(
        position=filled[..., :3],
        heading=filled[..., 3],
        motion=np.concatenate([filled[..., 4:], rates], -1),
        valid=valid,
        size=size.sum(1) / logged.sum(1)[:, None],
    )
