"""Planners with a flaw each, so that planners from good to bad can be compared: the IDM planner with a changed view."""

from typing import Any

import numpy as np
from jaxtyping import Float

from rlftsim.envs.idm import LOOKAHEAD_M, find_leaders
from rlftsim.envs.planners.idm import IdmPlanner
from rlftsim.envs.planners.view import read_view

CONTACT_S = 1.0
"""Time to contact at which the late braker brakes."""
STANDS_MPS = 0.3


class Timid(IdmPlanner):
    """Drives at half the speed limit."""

    speed_factor = 0.5

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "2"]:
        """Action of the IDM planner for other speed limits."""
        route = observation["route"].copy()
        route[:, 2] *= self.speed_factor
        return super().act({**observation, "route": route})


class Rush(Timid):
    """Drives at 1.3 times the speed limit, and sees neither road users nor lights."""

    speed_factor = 1.3

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "2"]:
        """Action without anything in view."""
        blind = {name: np.zeros_like(observation[name]) for name in ("neighbors_mask", "lights_mask")}
        return super().act({**observation, **blind})


class LateBraker(IdmPlanner):
    """Sees lights, but no road user until 1 s before contact; then brakes with all there is."""

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "2"]:
        """Action without road users in view, with full braking where one is too near."""
        view = read_view(observation)
        ahead, is_box = slice(0, LOOKAHEAD_M), np.ones((1, len(view.boxes)), bool)
        gap, lead = find_leaders(
            view.line[None, ahead], view.heading[None, ahead], view.size[None], view.boxes[None], view.box_size[None],
            is_box,
        )  # fmt: skip
        acceleration, steering = super().act(
            {**observation, "neighbors_mask": np.zeros_like(observation["neighbors_mask"])}
        )
        is_late = gap[0] < CONTACT_S * max(view.speed - lead[0], 0.0)
        return np.array([-1.0 if is_late else acceleration, steering], np.float32)


class HardBraker(IdmPlanner):
    """Brakes at once with all there is, for no reason, and stands: after 3 s in a city."""

    def act(self, observation: dict[str, Any]) -> Float[np.ndarray, "2"]:
        """Full braking, steered along the route."""
        _, steering = super().act(observation)
        return np.array([-1.0 if observation["ego"][0] > STANDS_MPS else 0.0, steering], np.float32)
