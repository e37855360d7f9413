"""A feature extractor for Stable-Baselines3: the view of a driver, in the units of the action "bicycle".

PPO("MultiInputPolicy", env, policy_kwargs={"features_extractor_class": DriverView})
"""

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor

from rlftsim.envs.actions import ACCELERATION_MPS2, STEERING_RAD

ROUTE_STEP_M = 2.0
FAR_M = 60.0
"""Distance of a leader or light where there is none."""


class DriverView(BaseFeaturesExtractor):
    """Nine numbers for a planner, each clipped to 2: steering of pure pursuit, braking that leader and red light need,
    headway, speed over the limit, speed, lateral and longitudinal acceleration, 1.

    Args:
        space: Space of observations of the form "dict".
    """

    def __init__(self, space: spaces.Dict) -> None:
        super().__init__(space, 9)

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Numbers [n, 9] of n observations."""
        ego, route, neighbors, lights = (observation[name] for name in ("ego", "route", "neighbors", "lights"))
        speed, acceleration, length, limit = ego[:, 0], ego[:, 1], ego[:, 4], ego[:, 9]
        has_point = observation["route_mask"].bool()
        last = has_point.sum(1).long().sub(1).clamp(min=0)
        # pure pursuit of the route point that is reached in 0.8 s, at least 3 m ahead
        index = torch.minimum((torch.clamp(0.8 * speed, min=3.0) / ROUTE_STEP_M).round().long(), last)
        point = route[torch.arange(len(ego)), index, :2]
        curvature = 2 * point[:, 1] / point.square().sum(-1).clamp(min=4.0)
        steering = torch.where(last > 0, torch.atan(0.6 * length * curvature) / STEERING_RAD, 0.0)

        line = torch.where(has_point[..., None], route[..., :2], torch.full_like(route[..., :2], 1e4))
        is_red = observation["lights_mask"].bool() & (lights[..., 2:4].sum(-1) > 0)
        distance = _measure_along_route(neighbors[..., :2], observation["neighbors_mask"], line)
        gap, leader = (distance - neighbors[..., 6] / 2 - length[:, None] / 2).min(-1)
        stop = _measure_along_route(lights[..., :2], is_red, line).amin(-1) - length / 2
        gap, stop = gap.clamp(1.0, FAR_M), stop.clamp(1.0, FAR_M)
        closing = (speed - neighbors[torch.arange(len(ego)), leader, 4]) * (gap < FAR_M)
        limit = torch.where(limit > 0, limit, 13.0)
        numbers = [
            steering,
            closing * closing.abs() / (2 * gap) / ACCELERATION_MPS2,
            1.5 * speed / gap,
            speed.square() / (2 * stop) / ACCELERATION_MPS2 * (stop < FAR_M),
            (speed - limit) / 10,
            speed / 10,
            speed.square() * curvature.abs() / 4,
            acceleration / 4,
            torch.ones_like(speed),
        ]
        return torch.stack(numbers, -1).clamp(-2, 2)


def _measure_along_route(points: Tensor, mask: Tensor, line: Tensor) -> Tensor:
    """Distance along the route (m) to points ahead that lie within 2 m of the route; 1000 m for the rest."""
    nearest, index = torch.cdist(points, line).min(-1)
    is_on_route = mask.bool() & (nearest < 2.0) & (points[..., 0] > 0)
    return torch.where(is_on_route, ROUTE_STEP_M * index, torch.full_like(nearest, 1e3))
