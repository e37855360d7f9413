"""Events of a planner's agent, and how near an episode is to them: the danger is at least 0 where the event happened.

An event of your own is an object with `danger(view) -> float`. Splitting (`envs.splitting`) is unbiased for any danger
and cheap for a good one: of two moments the one with the greater danger should be likelier to end in the event.

The danger of a contact is minus the number of standard deviations by which another agent has to depart from its speed
and turn rate so that both meet within 3 s: half of that if the planner goes on as now, and half of that if it brakes.
The first half sees conflicts early, the second one ranks those that a planner answers by braking anyway, such as a
queue ahead. Frame: map, meters, seconds; K other agents.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float

from rlftsim.envs.actions import ACCELERATION_MPS2, signed_speed
from rlftsim.envs.contact import Collision
from rlftsim.envs.episode import Episode, EpisodeState, off_road_m
from rlftsim.envs.planner_scores import find_signals
from rlftsim.envs.road import MAX_PAIRS, OUTSIDE_M
from rlftsim.errors import ConfigError, in_short
from rlftsim.geometry import wrapped
from rlftsim.realism.traffic_lights import compute_traffic_light_violation
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
        """Change of speed over the last step, m/s²; 0 before the first."""
        before, now = (signed_speed(step[self.index]) for step in self.state.world.track[-2:])
        return float(now - before) / STEP_S if self.step else 0.0

    def others(self, reach_m: float = np.inf) -> np.ndarray:
        """Rows of the agents that are there, near and not yet touched."""
        scene, agent = self.index
        world, motion = self.episode.world, self.state.world.motion[scene]
        counts = world.is_observed[scene, :, CURRENT_STEP + self.step] & ~self.state.touched[self.row]
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
        """0 from the contact on; before, minus half the sum of standard deviations, see the module."""
        if any(collision.at_fault or not self.at_fault for collision in view.collisions):
            return 0.0
        costs = self.costs(view)
        return min(-float(costs.mean(0).min()), NEARLY) if costs.size else NEVER

    def costs(self, view: StepView) -> Float[np.ndarray, "2 K"]:
        """Standard deviations to a contact with each agent near, if the planner goes on as now, and if it brakes."""
        rows, (scene, agent) = view.others(REACH_M), view.index
        track, world_size = view.state.world.track, view.episode.world.size[scene]
        now, before = track[-1][scene], track[-1 - TURN_STEPS][scene]
        turn_rate = wrapped(now[:, 2] - before[:, 2]) / (TURN_STEPS * STEP_S)
        turn_rate = np.where(np.hypot(now[:, 3], now[:, 4]) < STANDING_MPS, 0.0, turn_rate)
        other, size = now[rows], world_size[rows]
        speed = np.maximum(signed_speed(now[agent]), STANDING_MPS)
        stopping_s = np.minimum(AHEAD_S, speed / ACCELERATION_MPS2)
        driven = np.stack([speed * AHEAD_S, speed * stopping_s - ACCELERATION_MPS2 / 2 * stopping_s**2])  # [2, t]
        ego = _arc(now[agent], driven, turn_rate[agent] / speed * driven)  # [2, t, 3]
        path = _arc(other, np.hypot(other[:, 3], other[:, 4]) * AHEAD_S[:, None], turn_rate[rows] * AHEAD_S[:, None])
        is_standing = np.hypot(other[:, 3], other[:, 4]) < STANDING_MPS
        acceleration, drift, position = np.where(is_standing[:, None], STANDING, MOVING).T
        time = AHEAD_S[:, None]
        sigma = np.stack([position + acceleration * time**2 / 2, position + drift * time], -1)  # [t, K, 2]
        # the planner is to blame for what its front meets, and for standing ones that it touches anywhere
        points = _OUTLINE * view.ego_size
        distance = _distances(ego, points, path, size, sigma)  # [2, t, K, p]
        front = distance[..., : len(_FRONT)].min(-1)
        nearest = np.where(is_standing | (not self.at_fault), distance.min(-1), front)
        return (nearest + SIGMA_PER_S * time).min(1)


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
    sigma: Float[np.ndarray, "t K 2"],
) -> Float[np.ndarray, "2 t K p"]:
    """Distances of points of the planner's box to other boxes, in standard deviations along and across the others."""
    cos, sin = np.cos(ego[..., 2, None]), np.sin(ego[..., 2, None])
    x = ego[..., 0, None] + cos * points[:, 0] - sin * points[:, 1]  # [2, t, p]
    y = ego[..., 1, None] + sin * points[:, 0] + cos * points[:, 1]
    dx, dy = x[:, :, None] - other[..., :1], y[:, :, None] - other[..., 1:2]  # [2, t, K, p]
    cos, sin = np.cos(other[..., 2:]), np.sin(other[..., 2:])
    along = np.maximum(np.abs(cos * dx + sin * dy) - size[:, :1] / 2, 0.0) / sigma[..., :1]
    across = np.maximum(np.abs(cos * dy - sin * dx) - size[:, 1:] / 2, 0.0) / sigma[..., 1:]
    return np.hypot(along, across)


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
        scenario, step = view.episode.world.scenes[scene].scenario, view.step
        signals = find_signals(scenario)
        if signals is None:
            return NEVER
        driven = np.stack([motion[scene, agent, :2] for motion in view.state.world.track[CURRENT_STEP:]])
        if step:
            x, y = torch.from_numpy(driven + scenario.origin).float().T[:, None, None]
            passed = compute_traffic_light_violation(
                x, y, torch.ones(1, 1, step, dtype=torch.bool), signals, first_step=CURRENT_STEP, max_pairs=MAX_PAIRS
            )
            if passed.any():
                return 0.0
        lights = view.episode.world.scenes[scene].lights
        ahead = lights.point - view.ego[:2]
        forward = ahead @ [np.cos(view.ego[2]), np.sin(view.ego[2])]
        distance = np.hypot(*ahead.T)[forward > 0]
        speed = float(signed_speed(view.ego))
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
