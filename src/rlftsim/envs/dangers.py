"""Events of a planner's agent, and how near an episode is to them: the danger is at least 0 where the event happened.

An event of your own is an object with `danger(view) -> float`. Splitting (`envs.splitting`) is unbiased for any danger
and cheap for a good one: of two moments the one with the greater danger should be likelier to end in the event.

The danger of a contact is minus the number of standard deviations by which another agent has to depart from its speed
and turn rate so that both surely meet within 3 s. The planner is expected along its route: where it turns across the
way of others, its present motion shows the conflict a second late. Both go on with their present acceleration for 2 s,
so a planner that brakes in time is in no danger. Frame: map, meters, seconds; K other agents.
"""

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from rlftsim.envs.actions import ACCELERATION_MPS2, signed_speed, to_heading_frame
from rlftsim.envs.contact import STOPPED_MPS, Collision
from rlftsim.envs.episode import Episode, EpisodeState, off_road_m
from rlftsim.envs.planner_scores import find_signals, passes_red_light
from rlftsim.envs.world import find_lights, find_presence
from rlftsim.errors import ConfigError, in_short
from rlftsim.geometry import wrapped
from rlftsim.realism.map_based import OUTSIDE_M
from rlftsim.scenario.types import CURRENT_STEP, STEP_S

HARD_BRAKING_MPS2 = 6.0
NEVER = -np.inf
"""Danger where nothing can happen."""
NEARLY = -1e-6
"""Largest danger of an event that has not happened."""
AHEAD_S = np.arange(0.0, 3.01, 0.25)
HOLD_S = 2.0
"""Time for which an acceleration goes on."""
EASE_M = 8.0, 4.0
"""Ways after which an offset from the route and one of the heading have fallen to 1/e."""
MOVING = (1.5, 0.25, 0.15)
"""Standard deviations of a moving agent: acceleration (m/s²), drift to the side (m/s), position even at once (m)."""
STANDING = (0.3, 0.0, 0.1)
"""Of an agent that stands; a parked one beside the path must not hide what else happens."""
STANDING_MPS = 0.5
SIGMA_PER_S = 0.25
"""What a second until the contact counts, in standard deviations."""
SURE = 2.0
"""Standard deviations inside a box from which on a contact is sure, and only the time until then counts."""
REACH_M = 60.0
TURN_STEPS, SPEED_STEPS = 3, 5
"""Steps that turn rates and accelerations are measured over."""
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
        counts = find_presence(world, self.state.world, 1)[1][0, scene] & ~self.state.touched[self.row]
        counts[agent] = False
        return np.flatnonzero(counts & (np.abs(motion[:, :2] - motion[agent, :2]).max(1) < reach_m))


@runtime_checkable
class Event(Protocol):
    """Something that may happen to a planner's agent.

    One with a costly danger may have `has_happened(view) -> bool`, too: it is asked where only that counts.
    """

    def danger(self, view: StepView) -> float:
        """How near it is at a step: at least 0 exactly where it has happened, at this step or before."""
        ...


@dataclass(frozen=True)
class Contact:
    """The planner's agent touches another one."""

    at_fault: bool
    """True = only contacts that are its fault count, see `contact.classify_collision`."""

    def has_happened(self, view: StepView) -> bool:
        """True from the contact on."""
        return any(collision.at_fault or not self.at_fault for collision in view.collisions)

    def danger(self, view: StepView) -> float:
        """0 from the contact on; before, minus the least of `costs`."""
        return 0.0 if self.has_happened(view) else min(-float(self.costs(view).min(initial=np.inf)), NEARLY)

    def costs(self, view: StepView) -> Float[np.ndarray, "K"]:
        """Standard deviations to a contact with each agent near, beyond those that make one sure."""
        rows, (scene, agent) = view.others(REACH_M), view.index
        track, world_size = view.state.world.track, view.episode.world.size[scene]
        now, time = track[-1][scene], AHEAD_S[:, None]
        speed, before = (np.maximum(signed_speed(track[-1 - k][scene]), 0.0) for k in (0, SPEED_STEPS))
        acceleration = np.clip((speed - before) / (SPEED_STEPS * STEP_S), -ACCELERATION_MPS2, ACCELERATION_MPS2)
        turn = wrapped(now[:, 2] - track[-1 - TURN_STEPS][scene][:, 2]) / (TURN_STEPS * STEP_S)
        curvature = np.where(speed < STANDING_MPS, 0.0, turn / np.maximum(speed, STANDING_MPS))
        # 1. poses of the planner and of the others
        driven = _drive(speed, acceleration, time)  # [t, A]
        route = view.episode.atlas.routes[view.row].points
        if len(route) > 1:
            ego = _follow(route, now[agent], driven[:, agent])
        else:
            ego = _arc(now[agent], driven[:, agent], curvature[agent] * driven[:, agent])  # [t, 3]
        other, size, other_driven = now[rows], world_size[rows], driven[:, rows]
        path = _arc(other, other_driven, curvature[rows] * other_driven)  # [t, K, 3]
        # 2. standard deviations ahead of the others, behind them, and to their sides; who brakes does not back up
        is_standing = speed[rows] < STANDING_MPS
        deviation, drift, position = np.where(is_standing[:, None], STANDING, MOVING).T
        ahead = deviation * time**2 / 2
        sigma = position + np.stack([ahead, np.minimum(ahead, other_driven), drift * time])  # [3, t, K]
        distance = _distances(ego, _OUTLINE * view.ego_size, path, size, sigma)  # [t, K, p]
        if not self.at_fault:
            return (distance.min(-1) + SIGMA_PER_S * time).min(0)
        # 3. the planner is to blame while it moves: for what its front meets, and for standing ones anywhere
        nearest = np.where(is_standing, distance.min(-1), distance[..., : len(_FRONT)].min(-1))
        is_moving = speed[agent] + acceleration[agent] * np.minimum(time, HOLD_S) > STOPPED_MPS
        return np.where(is_moving, nearest + SIGMA_PER_S * time, np.inf).min(0)


def _drive(
    speed: Float[np.ndarray, "A"], acceleration: Float[np.ndarray, "A"], time_s: Float[np.ndarray, "t 1"]
) -> Float[np.ndarray, "t A"]:
    """Meters driven with an acceleration that goes on for a while, at most down to standstill."""
    stop_s = speed / np.maximum(-acceleration, 1e-6)
    held = np.minimum(np.minimum(time_s, HOLD_S), np.where(acceleration < 0, stop_s, np.inf))
    coasted = np.maximum(speed + acceleration * HOLD_S, 0.0) * np.maximum(time_s - HOLD_S, 0.0)
    return speed * held + acceleration / 2 * held**2 + coasted


def _follow(
    route: Float[np.ndarray, "R 2"], pose: Float[np.ndarray, "5"], driven: Float[np.ndarray, "t"]
) -> Float[np.ndarray, "t 3"]:
    """x, y, heading after some meters along a route, which is eased into from beside it."""
    step = np.diff(route, axis=0)
    length, direction = np.hypot(*step.T), np.arctan2(step[:, 1], step[:, 0])
    fraction = np.clip(((pose[:2] - route[:-1]) * step).sum(1) / length**2, 0.0, 1.0)
    offset = pose[:2] - route[:-1] - fraction[:, None] * step
    nearest = int((offset**2).sum(1).argmin())
    along = np.concatenate([[0.0], np.cumsum(length)])
    begin = along[nearest] + fraction[nearest] * length[nearest]
    at = begin + driven
    x, y = (np.interp(at, along, route[:, axis]) for axis in range(2))
    heading = np.interp(np.append(at, begin), (along[1:] + along[:-1]) / 2, np.unwrap(direction))
    aside = np.cos(direction[nearest]) * offset[nearest, 1] - np.sin(direction[nearest]) * offset[nearest, 0]
    beyond, aside = np.maximum(at - along[-1], 0.0), aside * np.exp(-driven / EASE_M[0])
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    turned = wrapped(pose[2:3] - heading[-1]) * np.exp(-driven / EASE_M[1])
    return np.stack([x + beyond * cos - aside * sin, y + beyond * sin + aside * cos, heading[:-1] + turned], -1)


def _arc(
    motion: Float[np.ndarray, "*#s 5"], driven: Float[np.ndarray, "*s"], turned: Float[np.ndarray, "*s"]
) -> Float[np.ndarray, "*s 3"]:
    """x, y, heading after some meters on an arc that turns by some angle."""
    direction = motion[..., 2] + turned / 2
    chord = driven * np.sinc(turned / (2 * np.pi))
    x, y = motion[..., 0] + chord * np.cos(direction), motion[..., 1] + chord * np.sin(direction)
    return np.stack([x, y, motion[..., 2] + turned], -1)


def _distances(
    ego: Float[np.ndarray, "t 3"],
    points: Float[np.ndarray, "p 2"],
    other: Float[np.ndarray, "t K 3"],
    size: Float[np.ndarray, "K 2"],
    sigma: Float[np.ndarray, "3 t K"],
) -> Float[np.ndarray, "t K p"]:
    """Standard deviations, along and across the others, by which points of the planner's box are not surely in them."""
    cos, sin = np.cos(ego[..., 2, None]), np.sin(ego[..., 2, None])
    x = ego[..., 0, None] + cos * points[:, 0] - sin * points[:, 1]  # [t, p]
    y = ego[..., 1, None] + sin * points[:, 0] + cos * points[:, 1]
    dx, dy = x[:, None] - other[..., :1], y[:, None] - other[..., 1:2]  # [t, K, p]
    along, across = to_heading_frame(dx, dy, other[..., 2:])
    off_x = (np.abs(along) - size[:, :1] / 2) / np.where(along > 0, sigma[0, ..., None], sigma[1, ..., None])
    off_y = (np.abs(across) - size[:, 1:] / 2) / sigma[2, ..., None]
    outside = np.hypot(np.maximum(off_x, 0.0), np.maximum(off_y, 0.0))
    return SURE + outside + np.clip(np.maximum(off_x, off_y), -SURE, 0.0)


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


def measure_danger(event: Event, view: StepView, *, is_branching_point: bool) -> float:
    """Danger at a step; between the steps at which branches begin, only whether the event has happened.

    Args:
        event: Event that is measured.
        view: What it sees.
        is_branching_point: True at the end of a block, where the danger itself decides.
    """
    has_happened = getattr(event, "has_happened", None)
    if is_branching_point or has_happened is None:
        return event.danger(view)
    return 0.0 if has_happened(view) else NEVER


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
