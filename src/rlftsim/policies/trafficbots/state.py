"""Values that a TrafficBots policy hands around: the context of a scene and the state of running simulations.

Shapes: B scenarios, N rollouts, A agents, T decisions, M map tokens, W = 11 steps of a window, D width.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.geometry import heading_vector, wrap_angle
from rlftsim.policies.trafficbots.dynamics import leaves_map, max_action, move, reaches_destination
from rlftsim.policies.trafficbots.network import AgentConditioning, AgentContext, Windows, history_windows
from rlftsim.policies.trafficbots.scene import Scene
from rlftsim.rollout.types import AgentStates
from rlftsim.scenario.types import STEP_S


@dataclass(eq=False)
class Record:
    """Features of agents along rollouts as they were made, so that scoring need not compute them again."""

    draws: Float[Tensor, "B N A 17"] | None = None
    poses: list[Float[Tensor, "B N A 3"]] = field(default_factory=list)
    """Before each decision."""
    features: list[Float[Tensor, "B 1 N A D"]] = field(default_factory=list)

    def add(self, state: "TrafficBotsState", features: Float[Tensor, "B 1 N A D"]) -> None:
        """Add the next decision of the rollouts whose first one was added last; a first one begins anew.

        Args:
            state: before the decision.
            features: of the agents in it.
        """
        if state.num_decisions == 0:
            self.draws, self.poses, self.features = state.draws, [], []
        if state.draws is self.draws and state.num_decisions == len(self.poses):
            self.poses.append(state.traffic.windows.pose[..., -1, :].clone())  # a view would keep the window
            self.features.append(features)

    def along(self, states: Sequence["TrafficBotsState"]) -> Float[Tensor, "B T N A D"] | None:
        """Features at T decisions, if these states are the recorded ones."""
        if self.draws is None or len(self.poses) != len(states) or not torch.equal(self.draws, states[0].draws):
            return None
        for pose, state in zip(self.poses, states):
            if not torch.equal(pose, state.traffic.windows.pose[..., -1, :]):
                return None
        return torch.cat(self.features, 1)


@dataclass(frozen=True, eq=False)
class TrafficBotsContext:
    """Everything about a scene that agents do not change."""

    scene: Scene
    map_features: Float[Tensor, "B M D"]
    light_features: Float[Tensor, "B T L D"]
    """Of all 80 decisions."""
    around: AgentContext
    """Map, and lights at all decisions."""
    model: nn.Module
    """The model that made it."""
    record: Record | None = field(default=None, repr=False)
    """Of the last rollouts, where only the layers behind the agents' features are trained."""


@dataclass(frozen=True, eq=False)
class Imposed:
    """States that agents are put into whatever they decided, ego frame."""

    mask: Bool[Tensor, "B N A"]
    pose: Float[Tensor, "B N A 3"]
    motion: Float[Tensor, "B N A 3"]


def imposed_after(
    last: Float[Tensor, "B N A 3"], last_speed: Float[Tensor, "B N A"], forced: AgentStates, scene: Scene
) -> Imposed:
    """Forced poses, with the motion that leads to them from the last ones.

    Args:
        last: poses before, frame of the batch.
        last_speed: m/s.
        forced: states 0.1 s later, of a single step, frame of the batch.
        scene: has the ego frame.
    """
    mask = forced.valid[..., 0]
    pose = torch.where(mask[..., None], torch.cat([forced.position[..., 0, :], forced.heading], -1), last)
    # In the frame of the batch: a tenth of a millimeter of rounding would be 0.01 m/s².
    way = pose[..., :2] - last[..., :2]
    speed = (way * heading_vector(pose[..., 2])).sum(-1) / STEP_S
    yaw_rate = wrap_angle(pose[..., 2] - last[..., 2]) / STEP_S
    motion = torch.stack([speed, (speed - last_speed) / STEP_S, yaw_rate], -1)
    return Imposed(mask, scene.to_ego_frame(pose), motion)


@dataclass(frozen=True, eq=False)
class Traffic:
    """Agents of running simulations: their windows, and what has ended."""

    windows: Windows
    """[B, N, A, W]. An agent that has ended goes on in them, marked as not valid."""
    alive: Bool[Tensor, "B N A"]
    """False = padding, or has left the map: it goes on straight ahead and decides nothing until it is put somewhere."""
    destination: Int64[Tensor, "B N A"]
    active: Bool[Tensor, "B N A"]
    """False = there is no destination, or it has been reached."""

    def after(
        self,
        action: Float[Tensor, "B N A 2"],
        scene: Scene,
        imposed: Imposed | None = None,
        staying: Bool[Tensor, "B N A"] | None = None,
    ) -> "Traffic":
        """Agents after 0.1 s.

        Args:
            action: before tanh.
            scene: map and classes.
            imposed: agents that are put somewhere.
            staying: agents that do not end where they leave the map, besides those that are put somewhere.
        """
        now = self.windows
        action = torch.where(self.alive[..., None], action, 0.0)
        pose, motion = move(
            now.pose[..., -1, :], now.motion[..., -1, 0], action, max_action(scene.agent_class)[:, None]
        )
        # Both rules look at the pose that the action leads to, also where another one is imposed.
        # One that has left the map may be put back onto it, and has reached nothing meanwhile.
        reached = self.alive & reaches_destination(pose, self.destination.clamp(min=0), scene)
        ended = leaves_map(pose, scene)
        for kept in (staying, None if imposed is None else imposed.mask):
            ended = ended if kept is None else ended & ~kept
        alive = self.alive & ~ended
        if imposed is not None:
            alive = alive | (imposed.mask & scene.agent_mask[:, None])  # also one that had left the map before
            pose = torch.where(imposed.mask[..., None], imposed.pose, pose)
            motion = torch.where(imposed.mask[..., None], imposed.motion, motion)
        windows = Windows(
            torch.cat([now.valid[..., 1:], alive[..., None]], -1),
            torch.cat([now.pose[..., 1:, :], pose[..., None, :]], -2),
            torch.cat([now.motion[..., 1:, :], motion[..., None, :]], -2),
        )
        return replace(self, windows=windows, alive=alive, active=self.active & ~reached)


def traffic_at_start(scene: Scene, destination: Int64[Tensor, "B N A"]) -> Traffic:
    """Agents at the current step, after 10 steps of history.

    Args:
        scene: with its history.
        destination: map token of each agent; negative = none.
    """

    def repeated(v: Tensor) -> Tensor:
        return v[:, None].expand(-1, destination.shape[1], *v.shape[1:])

    history = history_windows(scene)
    windows = Windows(repeated(history.valid), repeated(history.pose), repeated(history.motion))
    # A destination may have been reached in the history.
    active = destination >= 0
    for step in range(1, windows.valid.shape[-1]):
        there = reaches_destination(windows.pose[..., step, :], destination.clamp(min=0), scene)
        active = active & ~(there & windows.valid[..., step - 1] & windows.valid[..., step])
    alive = scene.agent_mask[:, None] & windows.valid[..., -1]
    return Traffic(windows, alive, destination, active)


def whole_history(traffic: Sequence[Traffic]) -> Windows:
    """Agents [B, N, A, 10 + T] over all steps of their windows at T decisions in a row."""
    first, later = traffic[0].windows, [one.windows for one in traffic[1:]]
    return Windows(
        torch.cat([first.valid, *(w.valid[..., -1:] for w in later)], 3),
        torch.cat([first.pose, *(w.pose[..., -1:, :] for w in later)], 3),
        torch.cat([first.motion, *(w.motion[..., -1:, :] for w in later)], 3),
    )


@dataclass(eq=False)
class Memo:
    """The network's result in a state, so that it is computed once."""

    mean: Float[Tensor, "B N A 2"] | None = None


@dataclass(frozen=True, eq=False)
class TrafficBotsState:
    """State of N simulations of each scene."""

    traffic: Traffic
    given: AgentConditioning
    draws: Float[Tensor, "B N A 17"]
    """Personality (16 numbers) and index of the destination, -1 where there is none."""
    num_decisions: int = 0
    poses: Float[Tensor, "B N A 1 3"] | None = None
    """In the frame of the batch."""
    before: "TrafficBotsState | None" = None
    """State before the last decision: the noise of a decision depends on that of the one before."""
    decision: Float[Tensor, "B N A 2"] | None = None
    """The last one."""
    continues: Bool[Tensor, "B N A"] | None = None
    """True = the agent did what it decided, so that its noise goes on from there."""
    memo: Memo = field(default_factory=Memo, repr=False)
