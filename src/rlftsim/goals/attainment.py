"""Goal attainment: reached, passed, inside the tolerance box. Frame: any that positions and goals share, m.

From strict to lenient:

* *reached*: within `NEAR_M` of the goal at the last step.
* *passed*: within `NEAR_M` of the goal at any simulated step.
* *missed in passing*: outside the goal's box at every simulated step (`realism.miss`). The box is the miss definition
  of the Waymo motion prediction challenge: along and across the heading at the goal, larger for long horizons, smaller
  for slow agents.

Truth values are per (scenario, rollout, agent), False without a goal. `rate` averages over the agents with a goal,
`measure_outcome` over the rollouts of a single goal.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.goals.types import Goals

NEAR_M = 2.0
"""Distance that counts as at the goal (RLFTSim, section 4.2)."""
TOLERANCE_HORIZON_S = (3.0, 5.0, 8.0)
SIDEWAYS_M = (1.0, 1.8, 3.0)
ALONG_M = (2.0, 3.6, 6.0)
"""Tolerances at these horizons; linear between, constant before and beyond."""
SLOW_MPS, FAST_MPS = 1.4, 11.0
SLOW_FACTOR = 0.5
"""Factor on the tolerances up to the slow speed; 1 from the fast speed on, linear between."""


def is_reached(position: Float[Tensor, "B N A T 2"], goals: Goals) -> Bool[Tensor, "B N A"]:
    """True for agents that end within `NEAR_M` of the goal.

    Args:
        position: Simulated centers of the agents, m.
        goals: Goals in the same frame; the result is False for agents without a goal.
    """
    return goals.goal_mask & (compute_final_distance(position, goals) <= NEAR_M)


def is_passed(position: Float[Tensor, "B N A T 2"], goals: Goals) -> Bool[Tensor, "B N A"]:
    """True for agents that come within `NEAR_M` of the goal at any step.

    Args:
        position: Simulated centers of the agents, m.
        goals: Goals in the same frame; the result is False for agents without a goal.
    """
    return goals.goal_mask & (compute_closest_distance(position, goals) <= NEAR_M)


def compute_final_distance(position: Float[Tensor, "B N A T 2"], goals: Goals) -> Float[Tensor, "B N A"]:
    """Distance to the goal at the last step, m; undefined without a goal.

    Args:
        position: Simulated centers of the agents, m.
        goals: Goals in the same frame as the positions.
    """
    return (position[..., -1, :] - goals.position).norm(dim=-1)


def compute_closest_distance(position: Float[Tensor, "B N A T 2"], goals: Goals) -> Float[Tensor, "B N A"]:
    """Smallest distance to the goal over all steps, m; undefined without a goal.

    Args:
        position: Simulated centers of the agents, m.
        goals: Goals in the same frame as the positions.
    """
    return (position - goals.position[..., None, :]).norm(dim=-1).amin(-1)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a single goal over some rollouts."""

    reached: float
    """Fraction of the rollouts that end within `NEAR_M`."""
    passed: float
    """Fraction of the rollouts that come within `NEAR_M` at some step."""
    best_m: float
    """Closest distance of all rollouts."""
    median_m: float
    """Median over rollouts of the closest distance."""


def measure_outcome(position: Float[Tensor, "N T 2"], goal: tuple[float, float]) -> Outcome:
    """Outcome of an agent's goal. Works far from (0, 0), as in the world frame: the difference is taken in float64.

    Args:
        position: Simulated centers of the agent in N rollouts, m.
        goal: x and y of the goal in the same frame, m.
    """
    offset = (position.double() - torch.tensor(goal, dtype=torch.float64, device=position.device)).float()
    offset = offset[None, :, None]  # [1, N, 1, T, 2]
    origin = Goals(torch.zeros_like(offset[..., 0, :]), torch.ones_like(offset[..., 0, 0], dtype=torch.bool))
    fractions = (float(is_met.double().mean()) for is_met in (is_reached(offset, origin), is_passed(offset, origin)))
    closest = compute_closest_distance(offset, origin).double()  # [1, N, 1]
    return Outcome(*fractions, best_m=float(closest.min()), median_m=float(closest.quantile(0.5)))


def rate(is_met: Bool[Tensor, "B N A"], mask: Bool[Tensor, "B N A"]) -> Float[Tensor, "B N"]:
    """Fraction of the masked agents of each rollout; NaN where the mask is empty.

    Args:
        is_met: True = the agent attains the goal, by any of the definitions.
        mask: True = the agent counts, such as one with a goal.
    """
    return (is_met & mask).sum(-1) / mask.sum(-1)


def compute_tolerance(speed: Float[Tensor, "*shape"], horizon_s: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape 2"]:
    """Distance along the heading and sideways that an agent may be off the goal, m (Waymo motion challenge).

    Args:
        speed: Speed at the current step, m/s; slow agents have smaller tolerances.
        horizon_s: Time from the current step to the goal, s; longer times have larger tolerances.
    """
    factor = _interpolate(speed, (SLOW_MPS, FAST_MPS), (SLOW_FACTOR, 1.0))
    widths = [_interpolate(horizon_s, TOLERANCE_HORIZON_S, sizes) for sizes in (ALONG_M, SIDEWAYS_M)]
    return factor[..., None] * torch.stack(widths, -1)


def is_within(
    offset: Float[Tensor, "*shape 2"], heading: Float[Tensor, "*#shape"], tolerance: Float[Tensor, "*#shape 2"]
) -> Bool[Tensor, "*shape"]:
    """True for offsets that lie inside the box of a goal.

    Args:
        offset: Position minus goal, m.
        heading: Heading of the box, rad, in the frame of the offset.
        tolerance: Half the length and half the width of the box, m.
    """
    cos, sin = heading.cos(), heading.sin()
    box_x = offset[..., 0] * cos + offset[..., 1] * sin
    box_y = offset[..., 1] * cos - offset[..., 0] * sin
    return (box_x.abs() <= tolerance[..., 0]) & (box_y.abs() <= tolerance[..., 1])


def _interpolate(
    value: Float[Tensor, "*shape"], knots: tuple[float, ...], heights: tuple[float, ...]
) -> Float[Tensor, "*shape"]:
    """Piecewise linear through the knots, constant outside."""
    height = torch.full_like(value, heights[0])
    for (start, low), (end, high) in zip(zip(knots, heights), zip(knots[1:], heights[1:])):
        height = height + ((value - start) / (end - start)).clamp(0, 1) * (high - low)
    return height
