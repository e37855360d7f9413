"""Speeds, accelerations and displacement by the rules of the official evaluator.

Speeds and accelerations are central differences that ignore validity. The average displacement error (ADE) is reported
beside the meta-metric, without a weight there.

Source: Waymo Open Sim Agents Challenge, evaluator of 2025. All values are float32; the step is 0.1 s. A difference at
    step t needs t - 1 and t + 1 and is NaN where either is missing: speeds lose a step at each end, accelerations
    two.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.geometry import wrap_angle
from rlftsim.realism.agents import Trajectories
from rlftsim.realism.rounding import compute_sqrt
from rlftsim.scenario.types import STEP_S


def compute_central_difference(values: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
    """Half the difference between the next and the last step, per step; NaN at both ends."""
    difference = torch.full_like(values, float("nan"))
    difference[..., 1:-1] = (values[..., 2:] - values[..., :-2]) / 2
    return difference


def _compute_turn(angle: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
    # The two-step difference is wrapped, not the one-step one, as officially: at most pi/2 per step is representable.
    return wrap_angle(2 * compute_central_difference(angle)) / 2


def compute_kinematics(
    position: tuple[Float[Tensor, "... T"], Float[Tensor, "... T"], Float[Tensor, "... T"]],
    heading: Float[Tensor, "... T"],
) -> dict[str, Float[Tensor, "... T"]]:
    """Linear and angular speed and acceleration of trajectories, m/s, m/s² (signed), rad/s, rad/s², by name.

    Args:
        position: x, y and z of the box center, m; the height counts, as officially.
        heading: Heading of the box, rad; differences are wrapped.
    """
    dx, dy, dz = (compute_central_difference(axis) for axis in position)
    linear_speed = compute_sqrt(dx * dx + dy * dy + dz * dz) / STEP_S
    turn = _compute_turn(heading)
    # Angular acceleration wraps the difference of the turns once more; it is not the difference of the angular speeds.
    return {
        "linear_speed": linear_speed,
        "linear_acceleration": compute_central_difference(linear_speed) / STEP_S,
        "angular_speed": turn / STEP_S,
        "angular_acceleration": _compute_turn(turn) / STEP_S**2,
    }


def compute_ground_speed(x: Float[Tensor, "... T"], y: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
    """Speed in the plane, m/s, NaN at both ends; for time to collision, which ignores height.

    Args:
        x: First coordinate of the box center over time, m.
        y: Second coordinate of the box center over time, m.
    """
    dx, dy = compute_central_difference(x), compute_central_difference(y)
    return compute_sqrt(dx * dx + dy * dy) / STEP_S


def shrink_validity(valid: Bool[Tensor, "... T"]) -> Bool[Tensor, "... T"]:
    """True where both neighboring steps are valid, even if the step between is not; False at both ends.

    Applied to the future's validity once, the result is the mask of speeds; applied twice, that of accelerations.
    """
    shrunk = torch.zeros_like(valid)
    shrunk[..., 1:-1] = valid[..., 2:] & valid[..., :-2]
    return shrunk


def compute_displacement_error(
    rollout: Trajectories, log: Trajectories, valid: Bool[Tensor, "E S"]
) -> Float[Tensor, "N E"]:
    """Mean distance (3D, m) between rollout and log over the valid steps of the whole scenario.

    The history is the same on both sides: valid steps of the history count in the denominator only, so the value is
    about 80/91 of the error over the future (a rule of the official evaluator).

    Args:
        rollout: Simulated states [N, E, T] at the T future steps.
        log: Logged states [E, T] at the same steps.
        valid: Log validity at all S steps; the last T of the S steps are the future.
    """
    # Written out: the float32 sum of three squares in this order, without a reduction over a tiny axis.
    dx, dy, dz = rollout.x - log.x, rollout.y - log.y, rollout.z - log.z
    distance = compute_sqrt(dx * dx + dy * dy + dz * dz)  # [N, E, T]
    future_valid = valid[:, -distance.shape[-1] :]
    # where, not a product: an invalid logged state may be anything.
    return torch.where(future_valid, distance, 0.0).sum(-1) / valid.sum(-1)
