"""Actions of planners: meanings of the numbers, and the motion that follows.

M agents, h steps of 0.1 s. Motion: x, y, heading, vx, vy; meters, seconds, radians. An agent's own frame has the origin
in the center of the box and x ahead.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64

from rlftsim.envs.compiled import compiled
from rlftsim.errors import ConfigError
from rlftsim.geometry import wrapped
from rlftsim.rollout.policy import Policy, TokenPolicy
from rlftsim.scenario.types import STEP_S, ObjectType
from rlftsim.tokens.vocabulary import CLASS_NAMES, STEPS_PER_TOKEN, class_of_type

ActionType = Literal["bicycle", "bicycle_discrete", "pose", "trajectory", "token"]
Tracker = Literal["perfect", "bicycle"]

STEERING_RAD = 0.55
ACCELERATION_MPS2 = 4.0
MAX_BRAKING_MPS2 = 8.0
WHEELBASE_PER_LENGTH = 0.6
ACCELERATIONS, STEERINGS = 7, 13
"""Levels of the discrete bicycle; actions count steering fastest."""
POSE_LIMITS = np.array([4.0, 1.5, 0.35])
"""Largest |dx|, |dy| (m) and |dheading| (rad) of a step."""
TRAJECTORY_LIMITS = np.array([400.0, 400.0, math.pi])
MIN_HORIZON, MAX_HORIZON = 5, 80
PURSUIT_S, MIN_PURSUIT_M = 0.8, 3.0
"""The bicycle that tracks a trajectory steers for the point so far ahead in time, at least so far away."""


@dataclass(frozen=True, eq=False)
class Actors:
    """Planner-driven agents before an action."""

    agent_name: Callable[[int], str]
    """Name of an agent in messages: object id and scenario."""
    motion: Float[np.ndarray, "M 5"]
    size: Float[np.ndarray, "M 2"]
    object_type: Int64[np.ndarray, "M"]


@dataclass(frozen=True, eq=False)
class Moves:
    """Motion that actions lead to."""

    motion: Float[np.ndarray, "M h 5"]
    is_clipped: Bool[np.ndarray, "M"]
    """True = the action was out of bounds and has been cut to them."""


class Controls(ABC):
    """Meaning of actions: numbers from a planner become motion."""

    steps: int = 1
    """Steps of 0.1 s that an action lasts."""
    num_choices: int = 0
    """Number of discrete actions; 0 where actions are numbers."""
    limits: np.ndarray = np.zeros(())
    """Largest absolute values of an action, in the action's shape; of shape () for discrete ones."""

    @abstractmethod
    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion that an action of each agent leads to.

        Args:
            action: Numbers in shape [M, *limits.shape], or whole numbers [M] below `num_choices`.
            actors: The M agents before the action, in the same order.
        """


def build_controls(
    action_type: ActionType,
    policy: Policy | None = None,
    *,
    horizon: int = MIN_HORIZON,
    tracker: Tracker = "perfect",
    reverse: bool = False,
    hard_braking: bool = False,
) -> Controls:
    """Controls by the name of an action.

    Args:
        action_type: Name of the action, as the setting `action` has it.
        policy: Traffic model with the motion tokens that a "token" chooses from; not used otherwise.
        horizon: Number of poses of a "trajectory", 5 to 80.
        tracker: Execution of a trajectory: "perfect" puts the agent on the pose, "bicycle" steers for the pose.
        reverse: True = a bicycle may drive backwards.
        hard_braking: True = a bicycle's lowest action brakes with 8 m/s² in place of 4.

    Raises:
        ConfigError: No such action, or an action that the policy has no tokens for.
    """
    bicycle = Bicycle(reverse=reverse, max_braking=MAX_BRAKING_MPS2 if hard_braking else ACCELERATION_MPS2)
    simple = {"bicycle": bicycle, "bicycle_discrete": DiscreteBicycle(bicycle), "pose": PoseControls()}
    if action_type in simple:
        return simple[action_type]
    if action_type == "trajectory":
        if not MIN_HORIZON <= horizon <= MAX_HORIZON or tracker not in ("perfect", "bicycle"):
            raise ConfigError(
                f"a trajectory has {MIN_HORIZON} to {MAX_HORIZON} poses and the tracker perfect or bicycle, got "
                f"{horizon} and {tracker!r}."
            )
        return TrajectoryControls(horizon, bicycle if tracker == "bicycle" else None)
    if action_type == "token":
        if not isinstance(policy, TokenPolicy):
            raise ConfigError("action 'token' needs a traffic model with motion tokens: take another action or model.")
        return TokenControls(policy)
    raise ConfigError(f"action {action_type!r}: known are bicycle, bicycle_discrete, pose, trajectory, token.")


def validate_actions(action: Any, controls: Controls, agent_name: Callable[[int], str], count: int) -> np.ndarray:
    """Actions of several agents as an array of the right shape and type.

    Args:
        action: Numbers in shape [count, *limits.shape], or whole numbers [count] for discrete controls.
        controls: Controls that the actions are meant for; shape, bounds and number type come from the controls.
        agent_name: Name of the agent in a row, for messages.
        count: Number of agents, the length of the first axis.

    Raises:
        ConfigError: No numbers, a wrong shape, a NaN, or no such discrete action; names agent and entry.
    """
    shape = (count, *controls.limits.shape)
    try:
        array = np.asarray(action, np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"action of {agent_name(0)} must be numbers in shape {shape[1:]}.") from None
    if array.shape != shape and array.shape[1:] == shape[1:]:
        raise ConfigError(f"actions have shape {array.shape}, they must have {shape}: one for each of {count}.")
    if array.shape != shape:
        raise ConfigError(f"action of {agent_name(0)} has shape {array.shape[1:]}, it must have {shape[1:]}.")
    if controls.num_choices:
        is_valid, dtype = (array >= 0) & (array < controls.num_choices) & (array == np.floor(array)), np.int64
        requirement = f"a whole number below {controls.num_choices}"
    else:
        is_valid, dtype, requirement = np.isfinite(array), np.float64, "finite"
    if not is_valid.all():
        agent, *entry = np.argwhere(~is_valid)[0].tolist()
        location = f" at entry {', '.join(map(str, entry))}" if entry else ""
        number = f"{array[(agent, *entry)]:g}"
        raise ConfigError(f"action of {agent_name(agent)}{location} is {number}, it must be {requirement}.")
    return array.astype(dtype)


@dataclass(frozen=True)
class Bicycle(Controls):
    """Kinematic bicycle about the center of the box: acceleration × 4 m/s², steering × 0.55 rad."""

    reverse: bool = False
    max_braking: float = ACCELERATION_MPS2
    """Deceleration at the lowest action, m/s²."""

    limits = np.ones(2)

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion of vehicles after 0.1 s by actions [M, 2]."""
        _check_vehicles(actors, "bicycle")
        bounded = action.clip(-1.0, 1.0)
        is_braking = (bounded[:, 0] < 0) & (signed_speed(actors.motion) > 0)
        acceleration = bounded[:, 0] * np.where(is_braking, self.max_braking, ACCELERATION_MPS2)
        motion = self.drive(actors.motion, acceleration, bounded[:, 1] * STEERING_RAD, actors.size[:, 0])
        return Moves(motion[:, None], (bounded != action).any(1))

    def drive(
        self,
        motion: Float[np.ndarray, "*m 5"],
        acceleration: Float[np.ndarray, "*m"],
        steering: Float[np.ndarray, "*m"],
        length: Float[np.ndarray, "*#m"],
    ) -> Float[np.ndarray, "*m 5"]:
        """Motion after 0.1 s at constant acceleration and steering; the turn is integrated exactly.

        A bicycle that may not drive backwards but does so at first brakes with 4 m/s² to a standstill.

        Args:
            motion: Motion of the vehicles before, map frame.
            acceleration: Acceleration along the heading, m/s².
            steering: Angle of the front wheel, rad, positive to the left.
            length: Length of the vehicles, m; the wheelbase is 0.6 of the length.
        """
        rows = np.empty((*np.shape(acceleration), 8))
        rows[..., :5], rows[..., 5], rows[..., 6], rows[..., 7] = motion, acceleration, steering, length
        return _drive_bicycles(rows.reshape(-1, 8), self.reverse).reshape(*rows.shape[:-1], 5)


@compiled
@no_type_check
def wrap(angle):
    """The same angle in [-pi, pi), as `geometry.wrapped`."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


@compiled
@no_type_check
def sign_speed(vx, vy, cos, sin):
    """Speed, negative for an agent that moves backwards, m/s, as `signed_speed`; cosine and sine are the heading's."""
    speed = np.hypot(vx, vy)
    return -speed if vx * cos + vy * sin < 0 else speed


@compiled
@no_type_check
def _drive_bicycles(rows, reverse):
    """Motion [n, 5] of bicycles with x, y, heading, vx, vy, acceleration, steering and length [n, 8]."""
    motion = np.empty((len(rows), 5))
    for i in range(len(rows)):
        x, y, heading, vx, vy, acceleration, steering, length = rows[i]
        speed = sign_speed(vx, vy, math.cos(heading), math.sin(heading))
        new_speed = speed + acceleration * STEP_S
        if not reverse:
            # a vehicle that backs up already brakes until it stands: nothing stops at once
            new_speed = max(new_speed, min(speed + ACCELERATION_MPS2 * STEP_S, 0.0))
        mean_speed = (speed + new_speed) / 2
        # the center lies between the axles, so it moves at an angle to the heading
        slip = math.atan(math.tan(steering) / 2)
        turn = mean_speed * math.cos(slip) * math.tan(steering) / (WHEELBASE_PER_LENGTH * length) * STEP_S
        chord = mean_speed * STEP_S * (math.sin(turn / 2) / (turn / 2) if turn else 1.0)  # of the arc
        chord_direction = heading + slip + turn / 2
        new_heading = wrap(heading + turn)
        direction = new_heading + slip
        motion[i, 0] = x + chord * math.cos(chord_direction)
        motion[i, 1] = y + chord * math.sin(chord_direction)
        motion[i, 2] = new_heading
        motion[i, 3], motion[i, 4] = new_speed * math.cos(direction), new_speed * math.sin(direction)
    return motion


@dataclass(frozen=True)
class DiscreteBicycle(Controls):
    """7 accelerations from -4 to 4 m/s² times 13 steering angles."""

    bicycle: Bicycle

    num_choices = ACCELERATIONS * STEERINGS

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion of vehicles after 0.1 s by actions [M] below 91."""
        acceleration, steering = np.divmod(action, STEERINGS)
        levels = np.linspace(-1, 1, ACCELERATIONS)[acceleration], np.linspace(-1, 1, STEERINGS)[steering]
        return self.bicycle.move(np.stack(levels, -1), actors)


class PoseControls(Controls):
    """dx, dy, dheading in the agent's own frame, cut to 4 m, 1.5 m, 0.35 rad."""

    limits = POSE_LIMITS

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion of agents of any type after 0.1 s by actions [M, 3]."""
        poses = np.clip(action, -POSE_LIMITS, POSE_LIMITS)[:, None]
        # a float32 action rounds its bounds
        return move_to_poses(poses, actors, np.any(np.abs(action) > POSE_LIMITS + 1e-6, axis=1))


class TrajectoryControls(Controls):
    """H future poses in the agent's own frame, of which the first is carried out.

    Args:
        horizon: Number H of poses.
        tracker: Bicycle that steers for the poses; None = the agent is put there.
    """

    def __init__(self, horizon: int, tracker: Bicycle | None):
        self.tracker = tracker
        self.limits = np.tile(TRAJECTORY_LIMITS, (horizon, 1))

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion of agents after 0.1 s by actions [M, H, 3]; the bicycle moves vehicles alone."""
        poses = np.clip(action, -TRAJECTORY_LIMITS, TRAJECTORY_LIMITS)
        is_clipped = np.any(poses != action, axis=(1, 2))
        if self.tracker is None:
            first = np.clip(poses[:, :1], -POSE_LIMITS, POSE_LIMITS)
            return move_to_poses(first, actors, is_clipped | np.any(first != poses[:, :1], axis=(1, 2)))
        _check_vehicles(actors, "trajectory with the bicycle")
        # Steers for the point ahead; has the speed of the first pose, so that errors along do not remain.
        speed = signed_speed(actors.motion)
        steering = steer_along(poses[..., :2], speed, actors.size[:, 0])
        acceleration = (poses[:, 0, 0] / STEP_S - speed) / STEP_S
        lowest = -np.where(speed > 0, self.tracker.max_braking, ACCELERATION_MPS2)
        acceleration = np.clip(acceleration, lowest, ACCELERATION_MPS2)
        motion = self.tracker.drive(actors.motion, acceleration, steering, actors.size[:, 0])
        return Moves(motion[:, None], is_clipped)


class TokenControls(Controls):
    """A motion token of the traffic model, carried out for half a second.

    Args:
        policy: Traffic model with the vocabulary that the actions count through.
    """

    steps = STEPS_PER_TOKEN

    def __init__(self, policy: TokenPolicy):
        self.vocabulary = policy.vocabulary
        self.num_choices = policy.vocabulary.num_tokens

    def move(self, action: np.ndarray, actors: Actors) -> Moves:
        """Motion of agents of any type over half a second by token ids [M].

        Raises:
            ConfigError: The agent's class has no such token.
        """
        classes = class_of_type(torch.from_numpy(actors.object_type))
        ids = torch.from_numpy(action)
        class_tokens = self.vocabulary.token_mask.cpu()[classes]  # [M, V]
        is_token = class_tokens[torch.arange(len(ids)), ids].numpy()
        if not is_token.all():
            agent = int(is_token.argmin())
            name, count = CLASS_NAMES[int(classes[agent])], int(class_tokens[agent].sum())
            raise ConfigError(
                f"action of {actors.agent_name(agent)}: class {name} has {count} tokens, none is {ids[agent]}."
            )
        poses = self.vocabulary.poses.cpu()[classes, ids].numpy().astype(np.float64)
        return move_to_poses(poses, actors, np.zeros(len(action), bool))


def pursue(point: Float[np.ndarray, "*m 2"], length: Float[np.ndarray, "*#m"]) -> Float[np.ndarray, "*m"]:
    """Steering angle of the arc to a point, within the bounds of the bicycle: pure pursuit (Coulter, 1992), rad.

    Args:
        point: Point to steer for, in the vehicle's own frame, m.
        length: Length of the vehicle, m; the wheelbase is 0.6 of the length.
    """
    squared = np.maximum((point * point).sum(-1), 0.01)
    steering = np.arctan(2 * WHEELBASE_PER_LENGTH * length * point[..., 1] / squared)
    return np.clip(steering, -STEERING_RAD, STEERING_RAD)


def pursuit_m(speed: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
    """Distance of the point that is steered for at a speed, m."""
    return np.maximum(MIN_PURSUIT_M, PURSUIT_S * np.abs(speed))


def signed_speed(motion: Float[np.ndarray, "*m 5"]) -> Float[np.ndarray, "*m"]:
    """Speed, negative for an agent that moves backwards, m/s."""
    vx, vy = motion[..., 3], motion[..., 4]
    forward = vx * np.cos(motion[..., 2]) + vy * np.sin(motion[..., 2])
    return np.where(forward < 0, -1.0, 1.0) * np.hypot(vx, vy)


def steer_along(
    line: Float[np.ndarray, "M P 2"], speed: Float[np.ndarray, "M"], length: Float[np.ndarray, "M"]
) -> Float[np.ndarray, "M"]:
    """Steering angle of pure pursuit of lines, rad: of the first point that is far enough ahead, else of the last.

    Args:
        line: Points in each vehicle's own frame, m.
        speed: Speed of the vehicles, m/s.
        length: Length of the vehicles, m.
    """
    is_far = np.linalg.norm(line, axis=-1) >= pursuit_m(speed)[:, None]  # [M, P]
    target = np.where(is_far.any(1), is_far.argmax(1), -1)
    return pursue(line[np.arange(len(line)), target], length)


def to_heading_frame(
    x: Float[np.ndarray, "*m"], y: Float[np.ndarray, "*m"], heading: Float[np.ndarray, "*#m"]
) -> tuple[Float[np.ndarray, "*m"], Float[np.ndarray, "*m"]]:
    """Components of vectors along headings and to the left of the headings.

    Args:
        x: First components in the map frame, in the unit of the result.
        y: Second components in the map frame, in the same unit.
        heading: Directions of the new x axes in the map frame, rad; broadcast against the components.
    """
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * x + sin * y, cos * y - sin * x


def move_to_poses(poses: Float[np.ndarray, "M h 3"], actors: Actors, is_clipped: Bool[np.ndarray, "M"]) -> Moves:
    """Moves of agents that are put at poses, with the velocities that lead there.

    Args:
        poses: x, y, heading in each agent's own frame before the move.
        actors: The agents before the move.
        is_clipped: True = the action was out of bounds.
    """
    cos, sin = np.cos(actors.motion[:, 2])[:, None], np.sin(actors.motion[:, 2])[:, None]
    x, y, origin = poses[..., 0], poses[..., 1], actors.motion[:, None, :2]
    position = np.stack([cos * x - sin * y, sin * x + cos * y], -1) + origin
    heading = wrapped(actors.motion[:, None, 2] + poses[..., 2])
    velocity = np.diff(np.concatenate([origin, position], 1), axis=1) / STEP_S
    return Moves(np.concatenate([position, heading[..., None], velocity], -1), is_clipped)


def _check_vehicles(actors: Actors, action_type: str) -> None:
    is_vehicle = actors.object_type == ObjectType.VEHICLE
    if not is_vehicle.all():
        row = int(is_vehicle.argmin())
        name, object_type = actors.agent_name(row), ObjectType(int(actors.object_type[row])).name.lower()
        raise ConfigError(f"{name} is a {object_type}, which does not act by {action_type}: take pose or trajectory.")
