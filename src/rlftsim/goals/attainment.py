"""Who gets where it was asked to go. Frame: that of positions and goals alike, metres.

Three ways to ask, from hard to soft:

* *reached*: within `NEAR_M` of the goal in the end.
* *passed*: within `NEAR_M` of the goal at any simulated step.
* *missed in passing*: outside the goal's box at every simulated step. The box is the miss definition of the Waymo motion prediction
  challenge: along and across the heading at the goal, larger for long horizons, smaller for slow agents.

Who gets there is a truth value per (scenario, rollout, agent), False where there is no goal; `rate` takes the mean over those that have
one, `outcome_of` over the rollouts of a single goal.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.goals.types import Goals

NEAR_M = 2.0
TOLERANCE_HORIZON_S = (3.0, 5.0, 8.0)
SIDEWAYS_M = (1.0, 1.8, 3.0)
ALONG_M = (2.0, 3.6, 6.0)
"""Tolerances at these horizons; linear between, constant before and beyond."""
SLOW_MPS, FAST_MPS = 1.4, 11.0
SLOW_FACTOR = 0.5
"""Of agents at most that slow at the current step; 1 from the fast speed on, linear between."""


def is_reached(position: Float[Tensor, "B N A T 2"], goals: Goals) -> Bool[Tensor, "B N A"]:
    """Who ends within `NEAR_M` of its goal."""
    return goals.goal_mask & (final_m(position, goals) <= NEAR_M)


def is_passed(position: Float[Tensor, "B N A T 2"], goals: Goals) -> Bool[Tensor, "B N A"]:
    """Who is within `NEAR_M` of its goal at some step."""
    return goals.goal_mask & (closest_m(position, goals) <= NEAR_M)


def final_m(position: Float[Tensor, "B N A T 2"], goals: Goals) -> Float[Tensor, "B N A"]:
    """Distance to the goal in the end, m; meaningless without a goal."""
    return (position[..., -1, :] - goals.position).norm(dim=-1)


def closest_m(position: Float[Tensor, "B N A T 2"], goals: Goals) -> Float[Tensor, "B N A"]:
    """Distance to the goal at the step at which it is least, m; meaningless without a goal."""
    return (position - goals.position[..., None, :]).norm(dim=-1).amin(-1)


@dataclass(frozen=True)
class Outcome:
    """What became of a single goal in some rollouts."""

    reached: float
    """Share of the rollouts that end within `NEAR_M`."""
    passed: float
    """Share of the rollouts that come within `NEAR_M` at some step."""
    best_m: float
    """Least distance in the rollout that comes nearest."""
    median_m: float
    """Median over rollouts of the least distance."""


def outcome_of(position: Float[Tensor, "N T 2"], goal: tuple[float, float]) -> Outcome:
    """What became of an agent's goal. Both may be far from (0, 0), as in the world frame: they are subtracted in float64.

    Args:
        position: where the agent was simulated.
        goal: where it should have gone.
    """
    away = (position.double() - torch.tensor(goal, dtype=torch.float64, device=position.device)).float()
    away = away[None, :, None]  # [1, N, 1, T, 2]
    here = Goals(torch.zeros_like(away[..., 0, :]), torch.ones_like(away[..., 0, 0], dtype=torch.bool))
    shares = (float(met.double().mean()) for met in (is_reached(away, here), is_passed(away, here)))
    closest = closest_m(away, here).double()
    return Outcome(*shares, best_m=float(closest.min()), median_m=float(closest.quantile(0.5)))


def is_missed_in_passing(
    position: Float[Tensor, "B N A T 2"],
    goals: Goals,
    heading: Float[Tensor, "B #N A #T"],
    speed: Float[Tensor, "B A"],
    horizon_s: Float[Tensor, "B A"],
) -> Bool[Tensor, "B N A"]:
    """Who never enters the box of its goal.

    Args:
        position: where the agents were simulated.
        goals: where they should have gone.
        heading: of the boxes, rad: as recorded at the goal; or as simulated at each step, for a goal that nobody has driven to.
        speed: at the current step, m/s.
        horizon_s: time from the current step to the goal.
    """
    tolerance = tolerance_m(speed, horizon_s)[:, None, :, None]
    offset = position - goals.position[..., None, :]
    return goals.goal_mask & ~is_within(offset, heading, tolerance).any(-1)


def rate(met: Bool[Tensor, "B N A"], mask: Bool[Tensor, "B N A"]) -> Float[Tensor, "B N"]:
    """Share of the agents of a mask; NaN for a rollout in which there is none."""
    return (met & mask).sum(-1) / mask.sum(-1)


def tolerance_m(speed: Float[Tensor, "*shape"], horizon_s: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape 2"]:
    """How far along the heading and sideways an agent may be from its goal, m.

    Args:
        speed: at the current step, m/s.
        horizon_s: time from the current step to the goal.
    """
    factor = _interpolate(speed, (SLOW_MPS, FAST_MPS), (SLOW_FACTOR, 1.0))
    widths = [_interpolate(horizon_s, TOLERANCE_HORIZON_S, sizes) for sizes in (ALONG_M, SIDEWAYS_M)]
    return factor[..., None] * torch.stack(widths, -1)


def is_within(
    offset: Float[Tensor, "*shape 2"], heading: Float[Tensor, "*#shape"], tolerance: Float[Tensor, "*#shape 2"]
) -> Bool[Tensor, "*shape"]:
    """Whether offsets from a goal lie inside its box.

    Args:
        offset: position minus goal, m.
        heading: of the box, rad.
        tolerance: half its length and half its width.
    """
    cos, sin = heading.cos(), heading.sin()
    along = offset[..., 0] * cos + offset[..., 1] * sin
    sideways = offset[..., 1] * cos - offset[..., 0] * sin
    return (along.abs() <= tolerance[..., 0]) & (sideways.abs() <= tolerance[..., 1])


def _interpolate(
    value: Float[Tensor, "*shape"], knots: tuple[float, ...], heights: tuple[float, ...]
) -> Float[Tensor, "*shape"]:
    """Piecewise linear through the knots, constant outside."""
    result = torch.full_like(value, heights[0])
    for (left, low), (right, high) in zip(zip(knots, heights), zip(knots[1:], heights[1:])):
        result = result + ((value - left) / (right - left)).clamp(0, 1) * (high - low)
    return result
