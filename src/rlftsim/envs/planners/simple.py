"""Planners without observations: the log itself, and constant velocity."""

from typing import Any

import numpy as np
from jaxtyping import Float

from rlftsim.envs.actions import ActionType, to_heading_frame
from rlftsim.errors import DataError
from rlftsim.geometry import wrapped


class Replay:
    """Drives as logged. With replayed traffic the result is the log, which tests the whole loop."""

    action: ActionType = "pose"

    def __init__(self) -> None:
        self._steps = np.zeros((0, 3), np.float32)
        self._num_steps = 0

    def reset(self, info: dict[str, Any]) -> None:
        """Take the logged poses.

        Raises:
            DataError: the log's future is withheld.
        """
        logged = info["logged"]
        if np.isnan(logged[1:]).all():
            raise DataError(f"scenario {info['scenario']} has no logged future: the replay planner needs one.")
        has_state = np.isfinite(logged).all(1)
        # where the log has a gap, the agent waits at the last pose
        poses = logged[np.maximum.accumulate(np.where(has_state, np.arange(len(logged)), 0))]
        # each pose in the frame of the pose before
        offset = np.diff(poses[:, :2], axis=0)
        x, y = to_heading_frame(offset[:, 0], offset[:, 1], poses[:-1, 2])
        self._steps, self._num_steps = np.stack([x, y, wrapped(np.diff(poses[:, 2]))], -1).astype(np.float32), 0

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "3"]:
        """The next logged pose in the frame of the present pose."""
        self._num_steps += 1
        return self._steps[self._num_steps - 1]


class ConstantVelocityPlanner:
    """Keeps speed and heading, backwards too: the floor."""

    action: ActionType = "bicycle"
    reverse = True

    def reset(self, info: dict[str, Any]) -> None:
        """Do nothing: constant velocity needs no memory."""

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "2"]:
        """No acceleration, no steering."""
        return np.zeros(2, np.float32)
