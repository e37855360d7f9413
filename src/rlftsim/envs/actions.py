"""Actions of planners: what a number means, and the motion it leads to.

M agents, h steps of 0.1 s. Motion: x, y, heading, vx, vy; meters, seconds, radians. An agent's own frame has its origin
in the center of the box and x ahead.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64

from rlftsim.errors import ConfigError
from rlftsim.geometry import wrapped
from rlftsim.rollout.policy import Policy, TokenPolicy
from rlftsim.scenario.types import STEP_S, ObjectType
from rlftsim.tokens.vocabulary import CLASS_NAMES, STEPS_PER_TOKEN, class_of_type

ActionKind = Literal["bicycle", "bicycle_discrete", "pose", "trajectory", "token"]
Tracker = Literal["perfect", "bicycle"]

STEERING_RAD = 0.55
ACCELERATION_MPS2 = 4.0
HARDEST_BRAKING_MPS2 = 8.0
WHEELBASE_PER_LENGTH = 0.6
ACCELERATIONS, STEERINGS = 7, 13
"""Levels of the discrete bicycle; actions count steering fastest."""
POSE_LIMITS = np.array([4.0, 1.5, 0.35])
"""Largest |dx|, |dy| (m) and |dheading| (rad) of a step."""
TRAJECTORY_LIMITS = np.array([400.0, 400.0, math.pi])
LEAST_HORIZON, MOST_HORIZON = 5, 80
PURSUIT_S, LEAST_PURSUIT_M = 0.8, 3.0
"""The bicycle that tracks a trajectory steers for the point so far ahead in time, at least so far away."""


@dataclass(frozen=True, eq=False)
class Actors:
    """Planner-driven agents before an action."""

    name_of: Callable[[int], str]
    """Name of an agent in messages: object id and scenario."""
    motion: Float[np.ndarray, "M 5"]
    size: Float[np.ndarray, "M 2"]
    object_type: Int64[np.ndarray, "M"]


@dataclass(frozen=True, eq=False)
class Moves:
    """Motion that actions lead to."""

    motion: Float[np.ndarray, "M h 5"]
    clipped: Bool[np.ndarray, "M"]
    """True = the action was out of its bounds and has been cut to them."""


@runtime_checkable
class Controls(Protocol):
    """One way to act."""

    @property
    def steps(self) -> int:
        """Steps of 0.1 s that an action lasts."""
        ...

    @property
    def num_choices(self) -> int:
        """Number of discrete actions; 0 where actions are numbers."""
        ...

    @property
    def limits(self) -> np.ndarray:
        """Largest absolute values of an action, in its shape; of shape () for discrete ones."""
        ...

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion that one action of each agent leads to.

        Args:
            action: [M, *shape], or [M] whole numbers.
            actors: before the action.
        """
        ...


def controls_of(
    kind: ActionKind,
    policy: Policy | None = None,
    *,
    horizon: int = LEAST_HORIZON,
    tracker: Tracker = "perfect",
    reverse: bool = False,
    hard_braking: bool = False,
) -> Controls:
    """Controls of a name.

    Args:
        kind: of the action.
        policy: the traffic model, whose vocabulary "token" chooses from.
        horizon: number of poses of a "trajectory".
        tracker: of a trajectory: "perfect" puts the agent there, "bicycle" steers for it.
        reverse: True = a bicycle may drive backwards.
        hard_braking: True = a bicycle's lowest action brakes with 8 m/s² in place of 4.

    Raises:
        ConfigError: no such action, or one that the policy has no tokens for.
    """
    bicycle = Bicycle(reverse=reverse, hardest=HARDEST_BRAKING_MPS2 if hard_braking else ACCELERATION_MPS2)
    if kind == "bicycle":
        return bicycle
    if kind == "bicycle_discrete":
        return DiscreteBicycle(bicycle)
    if kind == "pose":
        return PoseControls()
    if kind == "trajectory":
        if not LEAST_HORIZON <= horizon <= MOST_HORIZON or tracker not in ("perfect", "bicycle"):
            raise ConfigError(
                f"a trajectory has {LEAST_HORIZON} to {MOST_HORIZON} poses and the tracker perfect or bicycle, got "
                f"{horizon} and {tracker!r}."
            )
        return TrajectoryControls(horizon, bicycle if tracker == "bicycle" else None)
    if kind == "token":
        if not isinstance(policy, TokenPolicy):
            raise ConfigError("action 'token' needs a traffic model with motion tokens: take another action or model.")
        return TokenControls(policy)
    raise ConfigError(f"action {kind!r}: known are bicycle, bicycle_discrete, pose, trajectory, token.")


def checked(action: Any, controls: Controls, name_of: Callable[[int], str], count: int) -> np.ndarray:
    """Actions of some agents as an array of the right shape and type.

    Args:
        action: [count, *shape] numbers, or [count] whole numbers.
        controls: of the action.
        name_of: name of a row's agent in messages.
        count: number of agents.

    Raises:
        ConfigError: no numbers, another shape, a NaN, or no such discrete action; names agent and entry.
    """
    shape = (count, *controls.limits.shape)
    try:
        array = np.asarray(action, np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"action of {name_of(0)} must be numbers in shape {shape[1:]}.") from None
    if array.shape != shape and array.shape[1:] == shape[1:]:
        raise ConfigError(f"actions have shape {array.shape}, they must have {shape}: one for each of {count}.")
    if array.shape != shape:
        raise ConfigError(f"action of {name_of(0)} has shape {array.shape[1:]}, it must have {shape[1:]}.")
    if controls.num_choices:
        wrong = ~((array >= 0) & (array < controls.num_choices) & (array == np.floor(array)))
    else:
        wrong = ~np.isfinite(array)
    if wrong.any():
        agent, *entry = np.argwhere(wrong)[0].tolist()
        where = f" at entry {', '.join(map(str, entry))}" if entry else ""
        known = f"a whole number below {controls.num_choices}" if controls.num_choices else "finite"
        raise ConfigError(f"action of {name_of(agent)}{where} is {array[(agent, *entry)]:g}, it must be {known}.")
    return array.astype(np.int64) if controls.num_choices else array


@dataclass(frozen=True)
class Bicycle:
    """Kinematic bicycle about the center of the box: acceleration × 4 m/s², steering × 0.55 rad."""

    reverse: bool = False
    hardest: float = ACCELERATION_MPS2
    steps: int = 1
    num_choices: int = 0

    @property
    def limits(self) -> np.ndarray:
        """Two numbers in [-1, 1]."""
        return np.ones(2)

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion after 0.1 s.

        Args:
            action: [M, 2].
            actors: vehicles.
        """
        _only_vehicles(actors, "bicycle")
        kept = np.clip(action, -1.0, 1.0)
        is_braking = (kept[:, 0] < 0) & (signed_speed(actors.motion) > 0)
        acceleration = kept[:, 0] * np.where(is_braking, self.hardest, ACCELERATION_MPS2)
        motion = self.drive(actors.motion, acceleration, kept[:, 1] * STEERING_RAD, actors.size[:, 0])
        return Moves(motion[:, None], np.any(kept != action, axis=1))

    def drive(
        self,
        motion: Float[np.ndarray, "*m 5"],
        acceleration: Float[np.ndarray, "*m"],
        steering: Float[np.ndarray, "*m"],
        length: Float[np.ndarray, "*#m"],
    ) -> Float[np.ndarray, "*m 5"]:
        """Motion after 0.1 s at constant acceleration and steering; the turn is integrated exactly.

        A bicycle that may not drive backwards but does so at first brakes with 4 m/s² until it stands.

        Args:
            motion: before.
            acceleration: m/s².
            steering: rad, positive to the left.
            length: of the vehicles, m.
        """
        x, y, heading = motion[..., 0], motion[..., 1], motion[..., 2]
        speed = signed_speed(motion)
        new_speed = speed + acceleration * STEP_S
        if not self.reverse:
            # a vehicle that backs up already brakes until it stands: nothing stops at once
            new_speed = np.maximum(new_speed, np.minimum(speed + ACCELERATION_MPS2 * STEP_S, 0.0))
        mean_speed = (speed + new_speed) / 2
        # the center lies between the axles, so it moves at an angle to the heading
        slip = np.arctan(np.tan(steering) / 2)
        turn = mean_speed * np.cos(slip) * np.tan(steering) / (WHEELBASE_PER_LENGTH * length) * STEP_S
        chord = mean_speed * STEP_S * np.sinc(turn / 2 / math.pi)  # of the arc
        towards = heading + slip + turn / 2
        new_heading = wrapped(heading + turn)
        along = new_heading + slip
        return np.stack([
            x + chord * np.cos(towards), y + chord * np.sin(towards), new_heading,
            new_speed * np.cos(along), new_speed * np.sin(along),
        ], -1)  # fmt: skip


@dataclass(frozen=True)
class DiscreteBicycle:
    """7 accelerations from -4 to 4 m/s² times 13 steering angles."""

    bicycle: Bicycle
    steps: int = 1
    num_choices: int = ACCELERATIONS * STEERINGS

    @property
    def limits(self) -> np.ndarray:
        """A single whole number has no limits of this kind."""
        return np.zeros(())

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion after 0.1 s.

        Args:
            action: [M] numbers below 91.
            actors: vehicles.
        """
        acceleration, steering = np.divmod(action, STEERINGS)
        levels = np.linspace(-1, 1, ACCELERATIONS)[acceleration], np.linspace(-1, 1, STEERINGS)[steering]
        return self.bicycle.move(np.stack(levels, -1), actors)


@dataclass(frozen=True)
class PoseControls:
    """dx, dy, dheading in the agent's own frame, cut to 4 m, 1.5 m, 0.35 rad."""

    steps: int = 1
    num_choices: int = 0

    @property
    def limits(self) -> np.ndarray:
        """Largest |dx|, |dy| and |dheading|."""
        return POSE_LIMITS

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion after 0.1 s.

        Args:
            action: [M, 3].
            actors: of any kind.
        """
        kept = np.clip(action, -POSE_LIMITS, POSE_LIMITS)
        # a float32 action rounds its bounds
        clipped = np.any(np.abs(action) > POSE_LIMITS + 1e-6, axis=1)
        return Moves(with_velocity(placed(kept[:, None], actors.motion), actors.motion), clipped)


@dataclass(frozen=True)
class TrajectoryControls:
    """H future poses in the agent's own frame, of which the first is carried out."""

    horizon: int
    tracker: Bicycle | None
    """None = the agent is put there."""
    steps: int = 1
    num_choices: int = 0

    @property
    def limits(self) -> np.ndarray:
        """Of H poses."""
        return np.tile(TRAJECTORY_LIMITS, (self.horizon, 1))

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion after 0.1 s.

        Args:
            action: [M, H, 3].
            actors: of any kind; vehicles for the bicycle.
        """
        kept = np.clip(action, -TRAJECTORY_LIMITS, TRAJECTORY_LIMITS)
        clipped = np.any(kept != action, axis=(1, 2))
        if self.tracker is None:
            first = np.clip(kept[:, :1], -POSE_LIMITS, POSE_LIMITS)
            clipped = clipped | np.any(first != kept[:, :1], axis=(1, 2))
            return Moves(with_velocity(placed(first, actors.motion), actors.motion), clipped)
        _only_vehicles(actors, "trajectory with the bicycle")
        # Steers for the point ahead; has the speed of the first pose, so that errors along do not remain.
        speed = signed_speed(actors.motion)
        away = np.linalg.norm(kept[..., :2], axis=-1)  # [M, H]
        wanted = pursuit_m(speed)[:, None]
        target = np.where((away >= wanted).any(1), (away >= wanted).argmax(1), self.horizon - 1)
        steering = pursue(kept[np.arange(len(kept)), target, :2], actors.size[:, 0])
        needed = (kept[:, 0, 0] / STEP_S - speed) / STEP_S
        lowest = -np.where(speed > 0, self.tracker.hardest, ACCELERATION_MPS2)
        acceleration = np.clip(needed, lowest, ACCELERATION_MPS2)
        motion = self.tracker.drive(actors.motion, acceleration, steering, actors.size[:, 0])
        return Moves(motion[:, None], clipped)


@dataclass(frozen=True, eq=False)
class TokenControls:
    """A motion token of the traffic model, carried out for half a second."""

    policy: TokenPolicy
    steps: int = STEPS_PER_TOKEN

    @property
    def num_choices(self) -> int:
        """Size of the vocabulary."""
        return self.policy.vocabulary.num_tokens

    @property
    def limits(self) -> np.ndarray:
        """A single whole number has no limits of this kind."""
        return np.zeros(())

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion over half a second.

        Args:
            action: [M] token ids.
            actors: of any kind.

        Raises:
            ConfigError: the agent's class has no such token.
        """
        vocabulary = self.policy.vocabulary
        classes = class_of_type(torch.from_numpy(actors.object_type))
        ids = torch.from_numpy(action)
        known = vocabulary.token_mask.cpu()[classes, ids].numpy()
        if not known.all():
            agent = int((~known).argmax())
            name = CLASS_NAMES[int(classes[agent])]
            count = int(vocabulary.token_mask[classes[agent]].sum())
            raise ConfigError(
                f"action of {actors.name_of(agent)}: class {name} has {count} tokens, none is {ids[agent]}."
            )
        poses = vocabulary.poses.cpu()[classes, ids].numpy().astype(np.float64)
        return Moves(with_velocity(placed(poses, actors.motion), actors.motion), np.zeros(len(action), bool))


def pursue(point: Float[np.ndarray, "*m 2"], length: Float[np.ndarray, "*#m"]) -> Float[np.ndarray, "*m"]:
    """Steering angle of the arc to a point, within the bounds of the bicycle: pure pursuit (Coulter, 1992), rad.

    Args:
        point: in the vehicle's own frame, m.
        length: of the vehicle, m.
    """
    squared = np.maximum((point * point).sum(-1), 0.01)
    steering = np.arctan(2 * WHEELBASE_PER_LENGTH * length * point[..., 1] / squared)
    return np.clip(steering, -STEERING_RAD, STEERING_RAD)


def pursuit_m(speed: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
    """Distance of the point that is steered for at a speed, m."""
    return np.maximum(LEAST_PURSUIT_M, PURSUIT_S * np.abs(speed))


def signed_speed(motion: Float[np.ndarray, "*m 5"]) -> Float[np.ndarray, "*m"]:
    """Speed, negative for an agent that moves backwards, m/s."""
    vx, vy = motion[..., 3], motion[..., 4]
    ahead = vx * np.cos(motion[..., 2]) + vy * np.sin(motion[..., 2])
    return np.where(ahead < 0, -1.0, 1.0) * np.hypot(vx, vy)


def placed(poses: Float[np.ndarray, "M h 3"], motion: Float[np.ndarray, "M 5"]) -> Float[np.ndarray, "M h 3"]:
    """Poses of the agents' own frames in the map frame.

    Args:
        poses: x, y, heading.
        motion: of the agents.
    """
    cos, sin = np.cos(motion[:, 2])[:, None], np.sin(motion[:, 2])[:, None]
    x, y = poses[..., 0], poses[..., 1]
    position = np.stack([cos * x - sin * y, sin * x + cos * y], -1) + motion[:, None, :2]
    heading = wrapped(motion[:, None, 2] + poses[..., 2])
    return np.concatenate([position, heading[..., None]], -1)


def with_velocity(poses: Float[np.ndarray, "M h 3"], before: Float[np.ndarray, "M 5"]) -> Float[np.ndarray, "M h 5"]:
    """Motion of poses, with the velocities that lead to them.

    Args:
        poses: map frame.
        before: motion one step before the first pose.
    """
    position = np.concatenate([before[:, None, :2], poses[..., :2]], 1)
    return np.concatenate([poses, np.diff(position, axis=1) / STEP_S], -1)


def _only_vehicles(actors: Actors, what: str) -> None:
    others = actors.object_type != ObjectType.VEHICLE
    if others.any():
        row = int(others.argmax())
        kind = ObjectType(int(actors.object_type[row])).name.lower()
        raise ConfigError(f"{actors.name_of(row)} is a {kind}, which does not act by {what}: take pose or trajectory.")
