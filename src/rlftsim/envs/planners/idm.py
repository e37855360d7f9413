"""A planner that follows the route and keeps a distance, with nuPlan's parameters."""

import numpy as np
from jaxtyping import Float

from rlftsim.envs.actions import ACCELERATION_MPS2, STEERING_RAD, ActionType, steer_along
from rlftsim.envs.idm import LOOKAHEAD_M, IdmConfig, compute_idm_acceleration, find_leaders
from rlftsim.envs.planners.batch import BatchPlanner, Observe
from rlftsim.envs.planners.view import View, read_view


class IdmPlanner(BatchPlanner):
    """The intelligent driver model along the route, steered by pure pursuit.

    Args:
        config: Parameters of the driver model; `speed_mps` holds where the route has no speed limit.
    """

    action: ActionType = "bicycle"
    config = IdmConfig()

    def act_batch(self, observe: Observe) -> Float[np.ndarray, "M 2"]:
        """Acceleration behind the leader, steering for the route."""
        view = read_view(observe())
        gap, lead = find_view_leaders(view)
        to_stop = np.maximum(view.stop_m - view.size[:, 0] / 2, 0.0)
        gap, lead = np.minimum(gap, to_stop), np.where(to_stop < gap, 0.0, lead)
        free_speed = np.where(view.limit_mps > 0, view.limit_mps, self.config.speed_mps)
        speed = np.maximum(view.speed, 0.0)
        acceleration = compute_idm_acceleration(speed, free_speed, gap, lead, self.config)
        steering = steer_along(view.line, speed, view.size[:, 0])
        action = np.stack([acceleration / ACCELERATION_MPS2, steering / STEERING_RAD], -1)
        return np.clip(action, -1, 1).astype(np.float32)


def find_view_leaders(view: View) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    """Gap to the first box on the next 40 m of each route, and the box's speed along it, see `find_leaders`."""
    ahead = slice(0, LOOKAHEAD_M)
    return find_leaders(view.line[:, ahead], view.heading[:, ahead], view.size, view.boxes, view.box_size, view.is_box)
