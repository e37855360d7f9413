"""A planner that follows its route and keeps its distance, with nuPlan's parameters."""

from typing import Any

import numpy as np
from jaxtyping import Float

from rlftsim.envs.actions import (
    ACCELERATION_MPS2,
    LEAST_PURSUIT_M,
    PURSUIT_S,
    STEERING_RAD,
    WHEELBASE_PER_LENGTH,
    ActionKind,
)
from rlftsim.envs.idm import LOOKAHEAD_M, IdmConfig, find_leaders, idm_acceleration
from rlftsim.envs.planners.view import View, read_view


class IdmPlanner:
    """The intelligent driver model along the route, steered by pure pursuit.

    Args:
        config: parameters; the wanted speed holds where no limit is known.
    """

    action: ActionKind = "bicycle"

    def __init__(self, config: IdmConfig | None = None):
        self.config = config or IdmConfig()

    def reset(self, info: dict[str, Any]) -> None:
        """Nothing: it has no memory."""

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "2"]:
        """Acceleration behind the leader, steering for the route."""
        view = read_view(observation)
        window = slice(0, LOOKAHEAD_M)
        others = np.ones((1, len(view.others)), bool)
        gap, lead = find_leaders(
            view.line[None, window], view.heading[None, window], view.size[None], view.others[None],
            view.other_size[None], others,
        )  # fmt: skip
        to_stop = np.maximum(view.stop_m - view.size[0] / 2, 0.0)
        gap, lead = np.minimum(gap, to_stop), np.where(to_stop < gap, 0.0, lead)
        wanted = np.array([view.limit_mps or self.config.speed_mps])
        acceleration = idm_acceleration(np.array([max(view.speed, 0.0)]), wanted, gap, lead, self.config)
        steering = pursue(view)
        return np.clip([acceleration[0] / ACCELERATION_MPS2, steering / STEERING_RAD], -1, 1).astype(np.float32)


def pursue(view: View) -> float:
    """Steering angle that leads to the route, by pure pursuit (Coulter, 1992), rad."""
    away = np.linalg.norm(view.line, axis=1)
    far = np.flatnonzero(away >= max(LEAST_PURSUIT_M, PURSUIT_S * view.speed))
    target = int(far[0]) if len(far) else len(away) - 1
    x, y = view.line[target]
    return float(np.arctan(2 * WHEELBASE_PER_LENGTH * view.size[0] * y / max(x * x + y * y, 0.01)))
