"""Values of a TrafficBots policy: the context of a scene and the state of running simulations, which actions move.

Shapes: B scenarios, N rollouts, A agents, T decisions, M map tokens, W = 11 steps of a window, D width.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.geometry import heading_vector, wrap_angle
from rlftsim.policies.trafficbots.map_tokens import MapTokenType
from rlftsim.policies.trafficbots.network import AgentConditioning, AgentContext, Windows, history_windows, join_windows
from rlftsim.policies.trafficbots.scene import Scene
from rlftsim.rollout.types import AgentStates
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
    seconds: float = STEP_S,
) -> tuple[Float[Tensor, "*g 3"], Float[Tensor, "*g 3"]]:
    """Pose and motion (speed, acceleration, yaw rate) after an action.

    Args:
        pose: Poses before the step.
        speed: Speeds before the step, negative backwards, m/s.
        action: Actions before tanh, as the network returns.
        limit: Largest actions of the agents, from `max_action`.
        seconds: Duration of the action.
    """
    acceleration, yaw_rate = (limit * action.tanh()).unbind(-1)
    # Midpoint rule: speed and heading in the middle of the step.
    distance = (speed + acceleration * (seconds / 2)) * seconds
    heading = pose[..., 2]
    position = pose[..., :2] + distance[..., None] * heading_vector(heading + yaw_rate * (seconds / 2))
    moved = torch.cat([position, (heading + yaw_rate * seconds)[..., None]], -1)
    return moved, torch.stack([speed + acceleration * seconds, acceleration, yaw_rate], -1)


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


@dataclass(eq=False)
class Record:
    """Features of agents along the last rollouts, so that scoring need not compute the features again."""

    draws: Float[Tensor, "B N A 17"] | None = None
    poses: list[Float[Tensor, "B N A 3"]] = field(default_factory=list)
    """Poses before each decision."""
    features: list[Float[Tensor, "B 1 N A D"]] = field(default_factory=list)

    def add(self, state: "State", features: Float[Tensor, "B 1 N A D"]) -> None:
        """Add the next decision of the recorded rollouts; a first decision begins a new record.

        Args:
            state: State before the decision; ignored if it belongs to other rollouts.
            features: Features of the agents in this state.
        """
        if state.num_decisions == 0:
            self.draws, self.poses, self.features = state.draws, [], []
        if state.draws is self.draws and state.num_decisions == len(self.poses):
            self.poses.append(state.traffic.windows.pose[..., -1, :].clone())  # a view would keep the window
            self.features.append(features)

    def find_features(self, states: Sequence["State"]) -> Float[Tensor, "B T N A D"] | None:
        """Features at T decisions; None unless the states are those of the record."""
        if self.draws is None or len(self.poses) != len(states) or not torch.equal(self.draws, states[0].draws):
            return None
        poses = [state.traffic.windows.pose[..., -1, :] for state in states]
        return torch.cat(self.features, 1) if all(map(torch.equal, self.poses, poses)) else None


@dataclass(frozen=True, eq=False)
class Context:
    """Values of a scene that agents do not change."""

    scene: Scene
    map_features: Float[Tensor, "B M D"]
    light_features: Float[Tensor, "B T L D"]
    """Features at all 80 decisions."""
    agent_context: AgentContext
    """Map, and lights at all decisions."""
    model: nn.Module
    """The model that encoded the scene."""
    record: Record | None = field(default=None, repr=False)
    """Record of the last rollouts, where only the layers behind the agents' features are trained."""


@dataclass(frozen=True, eq=False)
class ImposedStates:
    """States that agents are put into whatever was decided, ego frame."""

    mask: Bool[Tensor, "B N A"]
    pose: Float[Tensor, "B N A 3"]
    motion: Float[Tensor, "B N A 3"]


def compute_imposed_states(
    last: Float[Tensor, "B N A 3"], last_speed: Float[Tensor, "B N A"], forced: AgentStates, scene: Scene
) -> ImposedStates:
    """Forced poses, with the motion from the last poses to the forced ones.

    Args:
        last: Poses before the step, frame of the batch.
        last_speed: Speeds before the step, m/s, negative backwards.
        forced: States 0.1 s later, of a single step, frame of the batch.
        scene: Scene that has the ego frame.
    """
    mask = forced.valid[..., 0]
    pose = torch.where(mask[..., None], torch.cat([forced.position[..., 0, :], forced.heading], -1), last)
    # In the frame of the batch: a tenth of a millimeter of rounding would be 0.01 m/s².
    offset = pose[..., :2] - last[..., :2]
    speed = (offset * heading_vector(pose[..., 2])).sum(-1) / STEP_S
    yaw_rate = wrap_angle(pose[..., 2] - last[..., 2]) / STEP_S
    motion = torch.stack([speed, (speed - last_speed) / STEP_S, yaw_rate], -1)
    return ImposedStates(mask, scene.to_ego_frame(pose), motion)


@dataclass(frozen=True, eq=False)
class Traffic:
    """Agents of running simulations."""

    windows: Windows
    """[B, N, A, W]. An agent that has ended goes on, marked as not valid."""
    alive: Bool[Tensor, "B N A"]
    """False = padding, or an agent that has left the map: goes on straight ahead until put onto the map again."""
    destination: Int64[Tensor, "B N A"]
    active: Bool[Tensor, "B N A"]
    """False = there is no destination, or it has been reached."""

    def advance(
        self,
        action: Float[Tensor, "B N A 2"],
        scene: Scene,
        imposed: ImposedStates | None = None,
        staying: Bool[Tensor, "B N A"] | None = None,
    ) -> "Traffic":
        """Agents after 0.1 s.

        Args:
            action: Actions before tanh; those of agents that have ended do not count.
            scene: Scene with map and agent classes.
            imposed: States of agents that are put somewhere; None = no agent is.
            staying: True = the agent does not end where it leaves the map; None = only imposed agents stay.
        """
        windows = self.windows
        action = torch.where(self.alive[..., None], action, 0.0)
        limit = max_action(scene.agent_class)[:, None]
        pose, motion = move(windows.pose[..., -1, :], windows.motion[..., -1, 0], action, limit)
        # Both rules look at the pose that the action leads to, also where another pose is imposed.
        # An agent that has left the map may be put back onto it, and has reached nothing meanwhile.
        reached = self.alive & reaches_destination(pose, self.destination.clamp(min=0), scene)
        ended = leaves_map(pose, scene)
        ended = ended if staying is None else ended & ~staying
        alive = self.alive & ~ended
        if imposed is not None:
            alive = alive | (imposed.mask & scene.agent_mask[:, None])  # also an agent that had left the map before
            pose = torch.where(imposed.mask[..., None], imposed.pose, pose)
            motion = torch.where(imposed.mask[..., None], imposed.motion, motion)
        step = Windows(alive, pose, motion).apply(lambda v: v[:, :, :, None])
        windows = join_windows([windows.apply(lambda v: v[:, :, :, 1:]), step])
        return replace(self, windows=windows, alive=alive, active=self.active & ~reached)


def start_traffic(scene: Scene, destination: Int64[Tensor, "B N A"]) -> Traffic:
    """Agents at the current step, after 10 steps of history.

    Args:
        scene: Scene with the history of the agents.
        destination: Map token of each agent's destination; negative = none.
    """
    windows = history_windows(scene).apply(lambda v: v[:, None].expand(-1, destination.shape[1], *v.shape[1:]))
    # A destination may have been reached in the history.
    active = destination >= 0
    for step in range(1, windows.valid.shape[-1]):
        is_reached = reaches_destination(windows.pose[..., step, :], destination.clamp(min=0), scene)
        active = active & ~(is_reached & windows.valid[..., step - 1] & windows.valid[..., step])
    alive = scene.agent_mask[:, None] & windows.valid[..., -1]
    return Traffic(windows, alive, destination, active)


def join_history(traffic: Sequence[Traffic]) -> Windows:
    """Agents [B, N, A, 10 + T] over all steps of the windows at T decisions in a row."""
    last_steps = [later.windows.apply(lambda v: v[:, :, :, -1:]) for later in traffic[1:]]
    return join_windows([traffic[0].windows, *last_steps])


@dataclass(eq=False)
class Memo:
    """The network's result in a state, computed once."""

    mean: Float[Tensor, "B N A 2"] | None = None


@dataclass(frozen=True, eq=False)
class State:
    """State of N simulations of each scene."""

    traffic: Traffic
    conditioning: AgentConditioning
    draws: Float[Tensor, "B N A 17"]
    """Personality (16 numbers) and index of the destination, -1 where there is none."""
    continues: Bool[Tensor, "B N A"]
    """True = the agent moved as decided, so that the noise goes on from this decision; False before the first."""
    num_decisions: int = 0
    poses: Float[Tensor, "B N A 1 3"] | None = None
    """Poses in the frame of the batch."""
    previous: "State | None" = None
    """State before the last decision: the noise of a decision depends on the noise of the decision before."""
    decision: Float[Tensor, "B N A 2"] | None = None
    """The last decision."""
    memo: Memo = field(default_factory=Memo, repr=False)
