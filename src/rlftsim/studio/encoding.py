"""Rollouts as bytes: second differences of centimeters and hundredths of a radian, two bytes each.

Header: five little-endian uint32: magic, N rollouts, A agents, t steps, bytes of a value. Then [N, A, 3, t] signed
values of x, y and heading: first the difference to the current step's pose, then second differences. Reading is adding
up twice; `decode.js` does.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP

MAGIC = 0x31464C52
HUNDREDTHS = 100.0


def encode_poses(poses: Float[np.ndarray, "N A t 3"], current: Float[np.ndarray, "A 3"]) -> bytes:
    """Bytes of simulated poses.

    Args:
        poses: Simulated poses [N, A, t, 3] in the map frame: x and y in meters, heading in radians.
        current: Logged poses [A, 3] of the agents at the current step, same frame and units.

    Raises:
        DataError: A pose is not finite.
    """
    if not np.isfinite(poses).all():
        raise DataError("the model's rollouts have poses that are not finite numbers: it is not trained soundly.")
    start = np.broadcast_to(current[None, :, None], (*poses.shape[:2], 1, 3))
    path = np.concatenate([start, poses], axis=2).astype(np.float64)  # [N, A, 1 + t, 3]
    # Unwrapped: a jump by a full turn would cost two large differences.
    path[..., 2] = np.unwrap(path[..., 2], axis=2)
    steps = np.diff(np.rint(path * HUNDREDTHS).astype(np.int64), axis=2)  # [N, A, t, 3]
    second = np.diff(steps, axis=2, prepend=0).swapaxes(2, 3)  # [N, A, 3, t]
    # Two bytes hold 327 m in a tenth of a second; an untrained model may do more.
    dtype = np.dtype("<i2" if abs(second).max(initial=0) < 1 << 15 else "<i4")
    header = np.array([MAGIC, *poses.shape[:3], dtype.itemsize], "<u4")
    return header.tobytes() + np.ascontiguousarray(second, dtype=dtype).tobytes()


def encode_batch(poses: Float[Tensor, "B N A t 3"], batch: ScenarioBatch) -> bytes:
    """Bytes of the poses of a batch's only scenario, without padding.

    Args:
        poses: Simulated poses [1, N, A, t, 3] in the map frame: x and y in meters, heading in radians.
        batch: Batch of a single scenario, with the current poses and the mask of agents.

    Raises:
        DataError: A pose is not finite.
    """
    current = torch.cat([batch.position[0, :, CURRENT_STEP], batch.heading[0, :, CURRENT_STEP, None]], -1)
    is_agent = batch.agent_mask[0]
    return encode_poses(poses[0][:, is_agent].float().cpu().numpy(), current[is_agent].float().cpu().numpy())
