"""Average displacement error (ADE) of rollouts; reported beside the meta-metric, without a weight there."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.realism.agents import Trajectories
from rlftsim.realism.rounding import compute_sqrt


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
