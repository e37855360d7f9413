"""Motion of agents under their actions, and the two rules that end something: a destination reached, the map left.

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
        pose: before.
        speed: before, negative backwards, m/s.
        action: before tanh, as the network has it.
        limit: of `max_action`.
    """
    acceleration, yaw_rate = (limit * action.tanh()).unbind(-1)
    # Midpoint rule: speed and heading in the middle of the step.
    way = (speed + acceleration * (STEP_S / 2)) * STEP_S
    heading = pose[..., 2]
    position = pose[..., :2] + way[..., None] * heading_vector(heading + yaw_rate * (STEP_S / 2))
    moved = torch.cat([position, (heading + yaw_rate * STEP_S)[..., None]], -1)
    return moved, torch.stack([speed + acceleration * STEP_S, acceleration, yaw_rate], -1)


def reaches_destination(
    pose: Float[Tensor, "B N A 3"], destination: Int64[Tensor, "B N A"], scene: Scene
) -> Bool[Tensor, "B N A"]:
    """True = near a lane and in its direction, or near an edge.

    Args:
        pose: of the agents.
        destination: map token of each.
        scene: its map.
    """
    batch = torch.arange(len(pose), device=pose.device)[:, None, None]
    nodes, mask = scene.node_pose[batch, destination], scene.node_mask[batch, destination]  # [B, N, A, 20, ...]
    distance = (nodes[..., :2] - pose[..., None, :2]).norm(dim=-1)
    along = (nodes[..., 2] - pose[..., None, 2]).cos() > math.cos(LANE_REACHED_RAD)
    is_lane = scene.map_type[batch, destination] <= MapTokenType.BIKE_LANE  # [B, N, A]

    def any_node(condition: Tensor) -> Tensor:
        return (condition & mask).any(-1)

    # Distance and direction need not be those of the same node.
    lane = any_node(distance < LANE_REACHED_M) & any_node(along)
    return torch.where(is_lane, lane, any_node(distance < EDGE_REACHED_M))


def leaves_map(pose: Float[Tensor, "B N A 3"], scene: Scene) -> Bool[Tensor, "B N A"]:
    """True = outside of the map's bounding box.

    Args:
        pose: of the agents.
        scene: its map.
    """
    x_min, x_max, y_min, y_max = scene.map_box[:, None, None].unbind(-1)
    x, y = pose[..., 0], pose[..., 1]
    return (x < x_min) | (x > x_max) | (y < y_min) | (y > y_max)
