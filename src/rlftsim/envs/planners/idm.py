"""A planner that follows the route and keeps a distance, with nuPlan's parameters."""

from typing import Any

import numpy as np
from jaxtyping import Float

from rlftsim.envs.actions import ACCELERATION_MPS2, STEERING_RAD, ActionType, pursue, pursuit_m
from rlftsim.envs.idm import LOOKAHEAD_M, IdmConfig, compute_idm_acceleration, find_leaders
from rlftsim.envs.planners.view import read_view


class IdmPlanner:
    """The intelligent driver model along the route, steered by pure pursuit.

    Args:
        config: Parameters of the driver model; `speed_mps` holds where the route has no speed limit.
    """

    action: ActionType = "bicycle"
    config = IdmConfig()

    def reset(self, info: dict[str, Any]) -> None:
        """Do nothing: an IDM planner has no memory."""

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "2"]:
        """Acceleration behind the leader, steering for the route."""
        view = read_view(observation)
        window = slice(0, LOOKAHEAD_M)
        is_box = np.ones((1, len(view.boxes)), bool)
        gap, lead = find_leaders(
            view.line[None, window], view.heading[None, window], view.size[None], view.boxes[None],
            view.box_size[None], is_box,
        )  # fmt: skip
        to_stop = np.maximum(view.stop_m - view.size[0] / 2, 0.0)
        gap, lead = np.minimum(gap, to_stop), np.where(to_stop < gap, 0.0, lead)
        free_speed, speed = np.array([view.limit_mps or self.config.speed_mps]), np.array([max(view.speed, 0.0)])
        acceleration = compute_idm_acceleration(speed, free_speed, gap, lead, self.config)
        far_points = np.flatnonzero(np.linalg.norm(view.line, axis=1) >= pursuit_m(speed))
        steering = pursue(view.line[None, far_points[0] if len(far_points) else -1], view.size[:1])
        return np.clip([acceleration[0] / ACCELERATION_MPS2, steering[0] / STEERING_RAD], -1, 1).astype(np.float32)
