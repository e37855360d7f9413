"""Planners with a flaw each, so that planners from good to bad can be compared: the IDM planner with a changed view."""

import numpy as np
from jaxtyping import Float

from rlftsim.envs.planners.batch import Observe
from rlftsim.envs.planners.idm import IdmPlanner, find_view_leaders
from rlftsim.envs.planners.view import read_view

CONTACT_S = 1.0
"""Time to contact at which the late braker brakes."""
STANDS_MPS = 0.3


class Timid(IdmPlanner):
    """Drives at half the speed limit."""

    speed_factor = 0.5

    def act_batch(self, observe: Observe) -> Float[np.ndarray, "M 2"]:
        """Actions of the IDM planner for other speed limits."""
        observation = observe()
        route = observation["route"] * np.array([1.0, 1.0, self.speed_factor], np.float32)
        return super().act_batch(lambda: {**observation, "route": route})


class Rush(Timid):
    """Drives at 1.3 times the speed limit, and sees neither road users nor lights."""

    speed_factor = 1.3

    def act_batch(self, observe: Observe) -> Float[np.ndarray, "M 2"]:
        """Actions without anything in view."""
        observation = observe()
        blind = {name: np.zeros_like(observation[name]) for name in ("neighbors_mask", "lights_mask")}
        return super().act_batch(lambda: {**observation, **blind})


class LateBraker(IdmPlanner):
    """Sees lights, but no road user until 1 s before contact; then brakes with all there is."""

    def act_batch(self, observe: Observe) -> Float[np.ndarray, "M 2"]:
        """Actions without road users in view, with full braking where one is too near."""
        observation = observe()
        view = read_view(observation)
        gap, lead = find_view_leaders(view)
        unseen = {"neighbors_mask": np.zeros_like(observation["neighbors_mask"])}
        action = super().act_batch(lambda: {**observation, **unseen})
        action[gap < CONTACT_S * np.maximum(view.speed - lead, 0.0), 0] = -1.0
        return action


class HardBraker(IdmPlanner):
    """Brakes at once with all there is, for no reason, and stands: after 3 s in a city."""

    def act_batch(self, observe: Observe) -> Float[np.ndarray, "M 2"]:
        """Full braking, steered along the route."""
        observation = observe()
        action = super().act_batch(lambda: observation)
        action[:, 0] = np.where(observation["ego"][:, 0] > STANDS_MPS, -1.0, 0.0)
        return action
