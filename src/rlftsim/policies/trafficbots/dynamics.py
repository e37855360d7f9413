"""Motion of agents under their actions, and two rules: a destination is reached, the map is left.

Shapes: B scenarios, N rollouts, A agents. Poses in the ego frame.
"""

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import heading_vector
from rlftsim.policies.trafficbots.map_tokens import MapTokenType
from rlftsim.policies.trafficbots.scene import Scene
from rlftsim.scenario.types import STEP_S

MAX_ACTION = ((5.0, 1.5), (7.0, 7.0), (6.0, 3.0))
"""Largest acceleration (m/s²) and yaw rate (rad/s) of vehicles, pedestrians and cyclists."""
LANE_REACHED_M, EDGE_REACHED_M = 50.0, 10.0
LANE_REACHED_RAD = math.radians(30.0)


def max_action(agent_class: Int64[Tensor, "*g"]) -> Float[Tensor, "*g 2"]:
    """Largest acceleration and yaw rate of each agent."""
    return torch.tensor(MAX_ACTION, device=agent_class.device)[agent_class]


def move(
    pose: Float[Tensor, "*g 3"],
    speed: Float[Tensor, "*g"],
    action: Float[Tensor, "*g 2"],
    limit: Float[Tensor, "*#g 2"],
) -> tuple[Float[Tensor, "*g 3"], Float[Tensor, "*g 3"]]:
    """Pose and motion (speed, acceleration, yaw rate) after 0.1 s.

    Args:
        pose: Poses before the step.
        speed: Speeds before the step, negative backwards, m/s.
        action: Actions before tanh, as the network returns.
        limit: Largest actions of the agents, from `max_action`.
    """
    acceleration, yaw_rate = (limit * action.tanh()).unbind(-1)
    # Midpoint rule: speed and heading in the middle of the step.
    distance = (speed + acceleration * (STEP_S / 2)) * STEP_S
    heading = pose[..., 2]
    position = pose[..., :2] + distance[..., None] * heading_vector(heading + yaw_rate * (STEP_S / 2))
    moved = torch.cat([position, (heading + yaw_rate * STEP_S)[..., None]], -1)
    return moved, torch.stack([speed + acceleration * STEP_S, acceleration, yaw_rate], -1)


def reaches_destination(
    pose: Float[Tensor, "B N A 3"], destination: Int64[Tensor, "B N A"], scene: Scene
) -> Bool[Tensor, "B N A"]:
    """True = near a lane and in its direction, or near an edge.

    Args:
        pose: Poses of the agents, ego frame, m and rad.
        destination: Map token of each agent's destination, at least 0.
        scene: Scene with the map.
    """
    batch = torch.arange(len(pose), device=pose.device)[:, None, None]
    nodes, mask = scene.node_pose[batch, destination], scene.node_mask[batch, destination]  # [B, N, A, 20, ...]
    distance = (nodes[..., :2] - pose[..., None, :2]).norm(dim=-1)
    is_aligned = (nodes[..., 2] - pose[..., None, 2]).cos() > math.cos(LANE_REACHED_RAD)
    is_lane = scene.map_type[batch, destination] <= MapTokenType.BIKE_LANE  # [B, N, A]

    def has_node(condition: Tensor) -> Tensor:
        return (condition & mask).any(-1)

    # Distance and direction need not be those of the same node.
    lane = has_node(distance < LANE_REACHED_M) & has_node(is_aligned)
    return torch.where(is_lane, lane, has_node(distance < EDGE_REACHED_M))


def leaves_map(pose: Float[Tensor, "B N A 3"], scene: Scene) -> Bool[Tensor, "B N A"]:
    """True = outside of the map's bounding box.

    Args:
        pose: Poses of the agents, ego frame, m and rad.
        scene: Scene with the map; without a map no agent leaves.
    """
    x_min, x_max, y_min, y_max = scene.map_box[:, None, None].unbind(-1)
    x, y = pose[..., 0], pose[..., 1]
    return (x < x_min) | (x > x_max) | (y < y_min) | (y > y_max)
