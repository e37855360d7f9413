"""Distance to the nearest object and time to collision, as the official evaluator defines both.

Both are a minimum over all other agents at every step of every rollout. A cheap bound on center distances leaves the
few pairs that can decide the minimum. Only these are computed exactly, so the result does not depend on the bound.
Coordinates stay in the world frame in float32: box corners are rounded there by about 5e-4 m, and a local frame would
flip a borderline collision now and then.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.realism.rounding import compute_sqrt

FAR_M = 1e10
"""Distance reported where no other object is valid."""
CORNER_ROUNDING = 0.7
"""Radius of the rounded corners over half the smaller side of the box."""
TIME_HORIZON_S = 5.0
"""Largest time to collision, also where no agent is followed or approached."""
MAX_HEADING_DIFFERENCE = math.radians(75.0)
SMALL_HEADING_DIFFERENCE = math.radians(10.0)
SMALL_OVERLAP_M = 0.5
BOUND_SLACK_M = 0.05
"""Far above the rounding of float32 world coordinates: bounds may be loose, never wrong."""
Corners = tuple[Float[Tensor, "4 P"], Float[Tensor, "4 P"]]
"""x and y of the corners of P rectangles, counter-clockwise."""


class PlanarAgents(NamedTuple):
    """Boxes of all simulated agents in the plane over time, and the indices of the evaluated agents."""

    x: Float[Tensor, "N A T"]
    y: Float[Tensor, "N A T"]
    heading: Float[Tensor, "N A T"]
    length: Float[Tensor, "#N A #T"]
    width: Float[Tensor, "#N A #T"]
    evaluated: Int64[Tensor, "E"]
    valid: Bool[Tensor, "N A T"] | None = None
    """None: all agents are valid at every step."""
    neighbors: Int64[Tensor, "E K"] | None = None
    """Agents that each evaluated agent may meet. None: all; then K is A."""
    neighbor_mask: Bool[Tensor, "E K"] | None = None
    """False for padding of `neighbors` and for the evaluated agent itself."""

    def to_neighbors(self, values: Tensor) -> Tensor:
        """Values of each evaluated agent's neighbors at each step: [N, A, T] to [N, E, K, T]; E = 1 if shared."""
        return values[:, None] if self.neighbors is None else values[:, self.neighbors]

    def mask_pairs(self, values: Tensor, fill: float | bool) -> None:
        """Fill values [N, E, K, T] in place where no pair exists: of an agent and the agent itself, and of padding."""
        if self.neighbor_mask is None:
            values[:, torch.arange(len(self.evaluated), device=values.device), self.evaluated] = fill
        else:
            values.masked_fill_(~self.neighbor_mask[..., None], fill)


class _Pairs(NamedTuple):
    """P pairs of an evaluated agent (ego) and a neighbor, each at a step of a rollout."""

    row: Int64[Tensor, "P"]
    """Flat index of (rollout, evaluated agent, step)."""
    ego: Int64[Tensor, "P"]
    """Flat index of (rollout, agent, step) of the evaluated agent."""
    neighbor: Int64[Tensor, "P"]
    """Flat index of (rollout, agent, step) of the neighbor."""
    neighbor_agent: Int64[Tensor, "P"]


def _list_pairs(mask: Bool[Tensor, "N E K T"], agents: PlanarAgents) -> _Pairs:
    # Flat indices, so that later gathers need one index instead of three.
    _, num_agents, num_steps = agents.x.shape
    num_evaluated = len(agents.evaluated)
    rollout, rank, neighbor, step = mask.nonzero().unbind(-1)
    neighbor = neighbor if agents.neighbors is None else agents.neighbors[rank, neighbor]
    return _Pairs(
        row=(rollout * num_evaluated + rank) * num_steps + step,
        ego=(rollout * num_agents + agents.evaluated[rank]) * num_steps + step,
        neighbor=(rollout * num_agents + neighbor) * num_steps + step,
        neighbor_agent=neighbor,
    )


def _find_nearest_candidates(agents: PlanarAgents) -> _Pairs:
    """Pairs that may have the smallest distance of a row (rollout, evaluated agent, step).

    A rounded box contains the disc of half the smaller side and lies in the disc of half the diagonal, so with center
    distance c the distance of i and j lies between c - outer_i - outer_j and c - inner_i - inner_j.
    """
    # 1. Distances of centers; in place, because [N, E, K, T] is the largest tensor of the metric.
    inner = torch.minimum(agents.length, agents.width) / 2
    outer = torch.hypot(agents.length, agents.width) / 2
    dx = agents.to_neighbors(agents.x) - agents.x[:, agents.evaluated, None]  # [N, E, K, T]
    dy = agents.to_neighbors(agents.y) - agents.y[:, agents.evaluated, None]
    center_distance = dx.square_().add_(dy.square_()).sqrt_()
    # 2. An agent with itself, and with invalid neighbors, is no pair.
    agents.mask_pairs(center_distance, torch.inf)
    if agents.valid is not None:
        center_distance.masked_fill_(~agents.to_neighbors(agents.valid), torch.inf)
    # 3. Candidates: their lower bound does not exceed the smallest upper bound of the row.
    slack = (outer - inner)[:, agents.evaluated] + BOUND_SLACK_M
    # A row without any pair is all infinite, and inf <= inf must not pass: its bound becomes the largest finite number.
    bound = (center_distance - agents.to_neighbors(inner)).amin(2) + slack  # [N, E, T]
    bound.clamp_(max=torch.finfo(bound.dtype).max)
    mask = (center_distance - agents.to_neighbors(outer)) <= bound[:, :, None]
    if agents.valid is not None:
        mask &= agents.valid[:, agents.evaluated, None]
    return _list_pairs(mask, agents)


def _compute_core_corners(
    agents: PlanarAgents, state: Int64[Tensor, "P"]
) -> tuple[Float[Tensor, "4 P"], Float[Tensor, "4 P"], Float[Tensor, "P"]]:
    """World x and y of the corners of the cores (boxes less the rounding), counter-clockwise, and the rounding."""
    length, width = (values.expand_as(agents.x).reshape(-1)[state] for values in (agents.length, agents.width))
    rounding = CORNER_ROUNDING * torch.minimum(length, width) / 2
    half_length, half_width = (length - 2 * rounding) / 2, (width - 2 * rounding) / 2
    heading = agents.heading.reshape(-1)[state]
    cos, sin = heading.cos(), heading.sin()
    # The order of operations and of corners is that of the official code, for equal rounding.
    box_x = torch.stack([half_length, -half_length, -half_length, half_length])  # [4, P]
    box_y = torch.stack([half_width, half_width, -half_width, -half_width])
    x = cos * box_x - sin * box_y + agents.x.reshape(-1)[state]
    y = sin * box_x + cos * box_y + agents.y.reshape(-1)[state]
    return x, y, rounding


def _start_at_lowest(x: Float[Tensor, "4 P"], y: Float[Tensor, "4 P"]) -> Corners:
    """The corners, rotated until the lowest corner comes first."""
    first = y.argmin(0, keepdim=True)
    order = (first + torch.arange(4, device=x.device)[:, None]) % 4
    return x.gather(0, order), y.gather(0, order)


def _add_rectangles(a: Corners, b: Corners) -> tuple[Float[Tensor, "8 P"], Float[Tensor, "8 P"]]:
    """Vertices of the Minkowski sum of two rectangles, counter-clockwise.

    The rectangle with the first edge is chosen once, at the lowest corners, as in the official evaluator. Between
    nearly parallel boxes with rounded corners the other edges may disagree, which moves a vertex by millimeters: an
    exact sum would differ from the official distance by as much.
    """
    (ax, ay), (bx, by) = _start_at_lowest(*a), _start_at_lowest(*b)
    a_edge_x, a_edge_y, b_edge_x, b_edge_y = ax[1] - ax[0], ay[1] - ay[0], bx[1] - bx[0], by[1] - by[0]
    a_leads = a_edge_x * b_edge_y - a_edge_y * b_edge_x >= 0
    # From vertex to vertex the two rectangles advance by a corner in turns.
    turn = torch.arange(8, device=ax.device)
    leading, trailing = (turn + 1) // 2 % 4, turn // 2
    x = torch.where(a_leads, ax[leading] + bx[trailing], ax[trailing] + bx[leading])
    y = torch.where(a_leads, ay[leading] + by[trailing], ay[trailing] + by[leading])
    return x, y


def _compute_origin_distance(x: Float[Tensor, "8 P"], y: Float[Tensor, "8 P"]) -> Float[Tensor, "P"]:
    """Signed distance of the origin to a convex polygon with counter-clockwise vertices, negative inside."""
    edge_x, edge_y = x.roll(-1, 0) - x, y.roll(-1, 0) - y
    squared_length = edge_x * edge_x + edge_y * edge_y
    squared_length = torch.where(squared_length > 0, squared_length, 1.0)
    projection = (-(x * edge_x + y * edge_y) / squared_length).clamp_(0.0, 1.0)
    offset_x, offset_y = x + projection * edge_x, y + projection * edge_y
    distance = compute_sqrt((offset_x * offset_x + offset_y * offset_y).amin(0))
    outward = y * edge_x - x * edge_y  # [8, P], positive where the origin is beyond an edge's line
    # Inside, too, the distance is to edges and not to their lines: between parallel boxes an edge may be 1 mm of noise.
    return torch.where((outward <= 0).all(0), -distance, distance)


def _compute_box_distance(agents: PlanarAgents, pairs: _Pairs) -> Float[Tensor, "P"]:
    """Signed distance between rounded boxes, m, negative for overlap."""
    # Two rounded boxes are as far apart as their cores, less both roundings. The distance of two convex shapes is that
    # of the origin to their Minkowski difference.
    ego_x, ego_y, ego_rounding = _compute_core_corners(agents, pairs.ego)
    x, y, rounding = _compute_core_corners(agents, pairs.neighbor)
    return _compute_origin_distance(*_add_rectangles((ego_x, ego_y), (-x, -y))) - ego_rounding - rounding


def compute_distance_to_nearest_object(agents: PlanarAgents) -> Float[Tensor, "N E T"]:
    """Signed distance of each evaluated agent to the nearest other valid agent, m; negative for overlap.

    Boxes have corners rounded by 0.35 of the smaller side; height is ignored. `FAR_M` where the evaluated agent or all
    other agents are invalid.
    """
    num_rollouts, _, num_steps = agents.x.shape
    pairs = _find_nearest_candidates(agents)
    distance = agents.x.new_full((num_rollouts * len(agents.evaluated) * num_steps,), FAR_M)
    distance.scatter_reduce_(0, pairs.row, _compute_box_distance(agents, pairs), "amin")
    return distance.view(num_rollouts, len(agents.evaluated), num_steps)


def _find_follow_candidates(agents: PlanarAgents, speed: Float[Tensor, "N A T"]) -> _Pairs:
    """Pairs with a neighbor that may be followed and reached within the horizon.

    An agent farther ahead than the ego drives within the horizon gives 5 s anyway, and never hides a nearer agent:
    leaving such pairs out changes no result.
    """
    outer = torch.hypot(agents.length, agents.width) / 2
    heading = agents.heading[:, agents.evaluated, None]
    cos, sin = heading.cos(), heading.sin()
    dx = agents.to_neighbors(agents.x) - agents.x[:, agents.evaluated, None]  # [N, E, K, T]
    dy = agents.to_neighbors(agents.y) - agents.y[:, agents.evaluated, None]
    forward = dx * cos + dy * sin
    lateral = dy.mul_(cos).sub_(dx.mul_(sin)).abs_()
    reach = TIME_HORIZON_S * speed[:, agents.evaluated] * 1.001 + (outer[:, agents.evaluated] + BOUND_SLACK_M)
    half_width = agents.width[:, agents.evaluated] / 2 + BOUND_SLACK_M
    # A speed of NaN (first and last step of a log) fails the comparison, as it does in the official rule.
    mask = (forward - agents.to_neighbors(outer) <= reach[:, :, None]) & (forward > 0)
    mask &= lateral < half_width[:, :, None] + agents.to_neighbors(outer)
    agents.mask_pairs(mask, False)
    if agents.valid is not None:
        mask &= agents.to_neighbors(agents.valid)
    return _list_pairs(mask, agents)


def _compute_gaps(agents: PlanarAgents, pairs: _Pairs) -> tuple[Float[Tensor, "P"], Bool[Tensor, "P"]]:
    """Free space between ego and neighbor along the ego's heading, m, and True where the neighbor is followed."""
    x, y, heading = (values.reshape(-1) for values in (agents.x, agents.y, agents.heading))
    ego_heading = heading[pairs.ego]
    # Not wrapped: headings near 2 pi apart are "not following" in the official rule too.
    turn = (heading[pairs.neighbor] - ego_heading).abs()
    cos, sin = ego_heading.cos(), ego_heading.sin()
    dx, dy = x[pairs.neighbor] - x[pairs.ego], y[pairs.neighbor] - y[pairs.ego]
    half_length, half_width = ((v / 2).expand_as(agents.x).reshape(-1) for v in (agents.length, agents.width))
    # Half extent of the neighbor's box along and across the ego's heading.
    turn_cos, turn_sin = turn.cos().abs(), turn.sin().abs()
    half_depth = half_length[pairs.neighbor] * turn_cos + half_width[pairs.neighbor] * turn_sin
    half_breadth = half_length[pairs.neighbor] * turn_sin + half_width[pairs.neighbor] * turn_cos
    gap = (dx * cos + dy * sin) - half_length[pairs.ego] - half_depth
    lateral_gap = (dy * cos - dx * sin).abs() - half_width[pairs.ego] - half_breadth
    is_followed = (gap > 0) & (turn <= MAX_HEADING_DIFFERENCE) & (lateral_gap < 0)
    is_followed &= (lateral_gap < -SMALL_OVERLAP_M) | (turn <= SMALL_HEADING_DIFFERENCE)
    return gap, is_followed


def compute_time_to_collision(agents: PlanarAgents, speed: Float[Tensor, "N A T"]) -> Float[Tensor, "N E T"]:
    """Time until each evaluated agent reaches the followed agent at the current speeds of both, s, at most 5.

    An agent follows the nearest of the agents ahead that overlap laterally and have about the same heading. The
    validity of the evaluated agent is ignored, as officially. Full boxes, without rounding.

    Args:
        agents: Boxes of all simulated agents over the same T steps as the speeds.
        speed: Speed in the plane, m/s; NaN counts as not approaching.
    """
    num_rollouts, num_agents, num_steps = agents.x.shape
    shape = (num_rollouts, len(agents.evaluated), num_steps)
    pairs = _find_follow_candidates(agents, speed)
    gap, is_followed = _compute_gaps(agents, pairs)
    gap = torch.where(is_followed, gap, torch.inf)
    smallest_gap = gap.new_full((math.prod(shape),), torch.inf)
    smallest_gap.scatter_reduce_(0, pairs.row, gap, "amin")
    # The followed agent (leader) is the one with the smallest gap; ties go to the first agent in track order.
    candidates = torch.where(is_followed & (gap == smallest_gap[pairs.row]), pairs.neighbor_agent, num_agents)
    leader = candidates.new_full((math.prod(shape),), num_agents)
    leader.scatter_reduce_(0, pairs.row, candidates, "amin")
    leader = leader.view(shape)  # [N, E, T], A where there is none
    approach = speed[:, agents.evaluated] - speed.gather(1, leader.clamp(max=num_agents - 1))
    seconds = (smallest_gap.view(shape) / approach).clamp_(max=TIME_HORIZON_S)
    return torch.where((leader < num_agents) & (approach > 0), seconds, TIME_HORIZON_S)
