"""Events of a planner's agent, and how near an episode is to them: the danger is at least 0 where the event happened.

An event of your own is an object with `danger(view) -> float`. Splitting (`envs.splitting`) is unbiased for any danger
and cheap for a good one: of two moments the one with the greater danger should be likelier to end in the event.

The danger of a contact is minus the number of standard deviations by which another agent has to depart from its speed
and turn rate so that both meet within 3 s. It is counted twice: if the planner goes on as now, which sees conflicts
early, and if it brakes, which ranks those that a planner answers by braking anyway. The geometric mean of both, with
weights 3 to 1, told failing episodes from others best, 1 and 2 s before the contact. Frame: map, meters, seconds; K
other agents.
"""

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from rlftsim.envs.actions import ACCELERATION_MPS2, signed_speed, to_heading_frame
from rlftsim.envs.contact import STOPPED_MPS, Collision
from rlftsim.envs.episode import Episode, EpisodeState, off_road_m
from rlftsim.envs.planner_scores import find_signals, passes_red_light
from rlftsim.envs.road import OUTSIDE_M
from rlftsim.envs.world import find_lights, find_presence
from rlftsim.errors import ConfigError, in_short
from rlftsim.geometry import wrapped
from rlftsim.scenario.types import CURRENT_STEP, STEP_S

HARD_BRAKING_MPS2 = 6.0
NEVER = -np.inf
"""Danger where nothing can happen."""
NEARLY = -1e-6
"""Largest danger of an event that has not happened."""
AHEAD_S = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0])
MOVING = (1.5, 0.25, 0.15)
"""Standard deviations of a moving agent: acceleration (m/s²), drift to the side (m/s), position even at once (m)."""
STANDING = (0.3, 0.0, 0.1)
"""Of an agent that stands; a parked one beside the path must not hide what else happens."""
STANDING_MPS = 0.5
SIGMA_PER_S = 0.5
"""What a second until the contact counts, in standard deviations."""
GOES_ON = 0.75
"""Weight of a planner that goes on, against one that brakes."""
REACH_M = 60.0
TURN_STEPS = 3
"""Steps that turn rates are measured over."""
_SIDE = np.linspace(-0.5, 0.5, 5)
_FRONT = np.stack([np.full(5, 0.5), _SIDE], -1)
_OUTLINE = np.concatenate([_FRONT, *(np.stack([_SIDE[:4], np.full(4, y)], -1) for y in (-0.5, 0.5)), [[-0.5, 0.0]]])
"""Points around a box, in lengths and widths; the front bumper first."""


@dataclass(frozen=True, eq=False)
class StepView:
    """What an event sees at a step."""

    episode: Episode
    state: EpisodeState
    row: int
    """Row of the planner's agent among those of the episode."""

    @property
    def step(self) -> int:
        """Steps of 0.1 s since the beginning."""
        return self.state.world.step

    @property
    def index(self) -> tuple[int, int]:
        """Scene and agent in the arrays of the world."""
        scene, agent = self.episode.world.actors[self.row]
        return int(scene), int(agent)

    @property
    def ego(self) -> Float[np.ndarray, "5"]:
        """x, y, heading, vx, vy of the planner's agent."""
        return self.state.world.motion[self.index]

    @property
    def ego_size(self) -> Float[np.ndarray, "2"]:
        """Length and width."""
        return self.episode.world.size[self.index]

    @property
    def collisions(self) -> tuple[Collision, ...]:
        """Contacts so far."""
        return self.state.collisions[self.row]

    @property
    def off_road_m(self) -> float:
        """Distance of the farthest corner off the road, negative on the road."""
        return float(off_road_m(self.episode, self.state.world, np.array([self.row]))[0])

    @property
    def acceleration(self) -> float:
        """Lowest change of speed within a step of the last action, m/s²; 0 before the first."""
        steps = self.state.world.track[-1 - self.episode.controls.steps :]
        speed = signed_speed(np.stack([motion[self.index] for motion in steps]))
        return float(np.diff(speed).min()) / STEP_S if self.step else 0.0

    def others(self, reach_m: float = np.inf) -> np.ndarray:
        """Rows of the agents that are there, near and not yet touched."""
        scene, agent = self.index
        world, motion = self.episode.world, self.state.world.motion[scene]
        counts = find_presence(world, self.state.world, 1)[1][scene, :, 0] & ~self.state.touched[self.row]
        counts[agent] = False
        return np.flatnonzero(counts & (np.abs(motion[:, :2] - motion[agent, :2]).max(1) < reach_m))


@runtime_checkable
class Event(Protocol):
    """Something that may happen to a planner's agent."""

    def danger(self, view: StepView) -> float:
        """How near it is at a step: at least 0 exactly where it has happened, at this step or before."""
        ...


@dataclass(frozen=True)
class Contact:
    """The planner's agent touches another one."""

    at_fault: bool
    """True = only contacts that are its fault count, see `contact.classify_collision`."""

    def danger(self, view: StepView) -> float:
        """0 from the contact on; before, minus the mean number of standard deviations, see the module."""
        if any(collision.at_fault or not self.at_fault for collision in view.collisions):
            return 0.0
        costs = self.costs(view)
        return min(-float((costs[0] ** GOES_ON * costs[1] ** (1 - GOES_ON)).min()), NEARLY) if costs.size else NEVER

    def costs(self, view: StepView) -> Float[np.ndarray, "2 K"]:
        """Standard deviations to a contact with each agent near, if the planner goes on as now, and if it brakes."""
        rows, (scene, agent) = view.others(REACH_M), view.index
        track, world_size = view.state.world.track, view.episode.world.size[scene]
        now, before = track[-1][scene], track[-1 - TURN_STEPS][scene]
        turn_rate = wrapped(now[:, 2] - before[:, 2]) / (TURN_STEPS * STEP_S)
        turn_rate = np.where(np.hypot(now[:, 3], now[:, 4]) < STANDING_MPS, 0.0, turn_rate)
        other, size, time = now[rows], world_size[rows], AHEAD_S[:, None]
        # 1. poses of the planner that goes on and of one that brakes, and of the others
        speed = max(float(signed_speed(now[agent][None])[0]), 0.0)
        driving_s = np.stack([AHEAD_S, np.minimum(AHEAD_S, speed / ACCELERATION_MPS2)])  # [2, t]
        driven = np.stack([speed * AHEAD_S, speed * driving_s[1] - ACCELERATION_MPS2 / 2 * driving_s[1] ** 2])
        ego = _arc(now[agent], driven, turn_rate[agent] / max(speed, STANDING_MPS) * driven)  # [2, t, 3]
        other_speed = np.hypot(other[:, 3], other[:, 4])
        path = _arc(other, other_speed * time, turn_rate[rows] * time)  # [t, K, 3]
        # 2. standard deviations ahead of the others, behind them, and to their sides; who brakes does not back up
        is_standing = other_speed < STANDING_MPS
        acceleration, drift, position = np.where(is_standing[:, None], STANDING, MOVING).T
        ahead = acceleration * time**2 / 2
        sigma = position + np.stack([ahead, np.minimum(ahead, other_speed * time), drift * time])  # [3, t, K]
        distance = _distances(ego, _OUTLINE * view.ego_size, path, size, sigma)  # [2, t, K, p]
        if not self.at_fault:
            return (distance.min(-1) + SIGMA_PER_S * time).min(1)
        # 3. the planner is to blame while it moves: for what its front meets, and for standing ones anywhere
        nearest = np.where(is_standing, distance.min(-1), distance[..., : len(_FRONT)].min(-1))
        is_moving = (speed > STOPPED_MPS) & (driving_s >= AHEAD_S)
        return np.where(is_moving[..., None], nearest + SIGMA_PER_S * time, np.inf).min(1)


def _arc(
    motion: Float[np.ndarray, "*#s 5"], driven: Float[np.ndarray, "*s"], turned: Float[np.ndarray, "*s"]
) -> Float[np.ndarray, "*s 3"]:
    """x, y, heading after some meters on an arc that turns by some angle."""
    direction = motion[..., 2] + turned / 2
    chord = driven * np.sinc(turned / (2 * np.pi))
    x, y = motion[..., 0] + chord * np.cos(direction), motion[..., 1] + chord * np.sin(direction)
    return np.stack([x, y, motion[..., 2] + turned], -1)


def _distances(
    ego: Float[np.ndarray, "2 t 3"],
    points: Float[np.ndarray, "p 2"],
    other: Float[np.ndarray, "t K 3"],
    size: Float[np.ndarray, "K 2"],
    sigma: Float[np.ndarray, "3 t K"],
) -> Float[np.ndarray, "2 t K p"]:
    """Distances of points of the planner's box to other boxes, in standard deviations along and across the others."""
    cos, sin = np.cos(ego[..., 2, None]), np.sin(ego[..., 2, None])
    x = ego[..., 0, None] + cos * points[:, 0] - sin * points[:, 1]  # [2, t, p]
    y = ego[..., 1, None] + sin * points[:, 0] + cos * points[:, 1]
    dx, dy = x[:, :, None] - other[..., :1], y[:, :, None] - other[..., 1:2]  # [2, t, K, p]
    along, across = to_heading_frame(dx, dy, other[..., 2:])
    off_x = np.maximum(np.abs(along) - size[:, :1] / 2, 0.0) / np.where(
        along > 0, sigma[0, ..., None], sigma[1, ..., None]
    )
    off_y = np.maximum(np.abs(across) - size[:, 1:] / 2, 0.0) / sigma[2, ..., None]
    return np.hypot(off_x, off_y)


@dataclass(frozen=True)
class OffRoad:
    """A corner of the planner's agent is 0.3 m off the road, as in the scores."""

    def danger(self, view: StepView) -> float:
        """Meters beyond that line."""
        return 0.0 if view.state.outside[view.row] else min(view.off_road_m - OUTSIDE_M, NEARLY)


@dataclass(frozen=True)
class RedLight:
    """The planner's agent passes the stop point of a red light on its lane, as in the scores."""

    def danger(self, view: StepView) -> float:
        """0 from the violation on; before, minus the seconds until the nearest stop point, less those to brake in."""
        scene, agent = view.index
        world = view.episode.world
        lights = find_lights(world, view.state.world)[scene]
        if find_signals(world.scenes[scene].scenario, world.scenes[scene].num_steps) is None:
            return NEVER
        driven = np.stack([m[scene, agent, :2] for m in view.state.world.track[CURRENT_STEP:]])
        if passes_red_light(replace(world.scenes[scene], lights=lights), driven):
            return 0.0
        ahead = lights.point - view.ego[:2]
        forward = ahead @ [np.cos(view.ego[2]), np.sin(view.ego[2])]
        distance = np.hypot(*ahead.T)[forward > 0]
        speed = float(signed_speed(view.ego[None])[0])
        return NEVER if not len(distance) else min(
            speed / (2 * ACCELERATION_MPS2) - float(distance.min()) / max(speed, STANDING_MPS), NEARLY
        )  # fmt: skip


@dataclass(frozen=True)
class HardBraking:
    """The planner's agent has lost speed by 6 m/s² or more within a step."""

    def danger(self, view: StepView) -> float:
        """Deceleration beyond 6 m/s², of the worst step so far."""
        return -view.acceleration - HARD_BRAKING_MPS2


EVENTS: dict[str, Event] = {
    "at_fault_collision": Contact(at_fault=True),
    "collision": Contact(at_fault=False),
    "off_road": OffRoad(),
    "red_light": RedLight(),
    "hard_braking": HardBraking(),
}


def find_event(event: Any) -> Event:
    """Event by name, or an event of your own.

    Raises:
        ConfigError: Neither a name of `EVENTS` nor an object with `danger(view)`.
    """
    if isinstance(event, str) and event in EVENTS:
        return EVENTS[event]
    if isinstance(event, Event) and not isinstance(event, type):
        return event
    raise ConfigError(f"event {in_short(event)}: name {', '.join(EVENTS)}, or give an object with danger(view).")
