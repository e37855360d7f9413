"""Candidates: pairs of an agent that is about to decide and a token that it may well choose.

A token counts as a candidate if it is more than `exp(-SUPPORT_NATS)` times as likely as the likeliest one. All others
together have next to no probability, and there are fifty times as many of them. Features fade in over the least likely
candidates, so that a token just above the limit is as good as one just below it. Agents with a single candidate, such
as parked cars, have nothing to choose and are left out.

R agents with a choice, P pairs, O others near an agent. Map frame unless said, meters, radians and seconds.
"""

from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

from rlftsim.geometry import heading_vector, rotate, wrap_angle
from rlftsim.policies.calibrated.traffic import Pieces, Scene, Traffic

SUPPORT_NATS = 9.2
"""Log of the ratio between the likeliest token and the least likely candidate: 10,000."""
FADE_NATS = 2.3
"""Candidates whose features count in part: those this far above the limit."""
MOVING_MPS = 0.5
MAX_OTHERS = 6
"""Nearest agents that overlaps are looked for with."""
OTHERS_REACH_M = 40.0
EDGE_REACH_M = 12.0
MARGIN_M = 0.5
"""Distance from a box or an edge at which overlap begins to count."""
CORRIDOR_M = 1.8
"""Largest lateral distance of a leader."""
LEAST_AHEAD_M = 0.5
"""Least distance ahead of its center."""
NO_GAP_M = 200.0
"""Gap of an agent without a leader."""


@dataclass(frozen=True, eq=False)
class _Others:
    """Agents near each of the R agents, in its frame."""

    position: Float[Tensor, "R O 2"]
    velocity: Float[Tensor, "R O 2"]
    turn: Float[Tensor, "R O"]
    """Heading minus that of the agent."""
    half_size: Float[Tensor, "R O 2"]
    reach: Float[Tensor, "R O"]
    """Distance of the centers at which an overlap becomes possible; minus infinity for agents too far away."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs of agents and tokens, and what can be asked of them. Each answer is computed once, when asked for."""

    scene: Scene
    traffic: Traffic
    place: tuple[Int64[Tensor, "R"], ...]
    """Indices of the agents along the axes of the traffic: scenario, rollout, agent, moment."""
    row: Int64[Tensor, "P"]
    """Agent of each pair, an index into the R."""
    end: Float[Tensor, "P 3"]
    """Where the token leads: x, y, heading in the agent's frame."""
    log_ratio: Float[Tensor, "P"]
    """Log of the token's probability over that of the agent's likeliest token, in the policy that is calibrated."""
    seconds: float
    """Duration of a decision."""
    _answers: dict[tuple[str, float], Tensor] = field(default_factory=dict)
    """Overlaps and edges by time, which several features ask for."""

    @property
    def weight(self) -> Float[Tensor, "P"]:
        """Part in which features of a pair count: 1 but for the least likely candidates."""
        return ((self.log_ratio + SUPPORT_NATS) / FADE_NATS).clamp(max=1.0)

    def of_pairs(self, values: Shaped[Tensor, "R *more"]) -> Shaped[Tensor, "P *more"]:
        """Values of the agents, for each of their pairs."""
        return values.index_select(0, self.row)

    def where(self, condition: Bool[Tensor, "R"]) -> Float[Tensor, "P"]:
        """1 for the pairs of agents that a condition holds for, 0 for others."""
        return self.of_pairs(condition.float())

    # ---- the agent ------------------------------------------------------------------------------------------------

    @cached_property
    def is_vehicle(self) -> Bool[Tensor, "R"]:
        """True for vehicles, False for pedestrians and cyclists."""
        return self.scene.class_id[self.place[0], self.place[2]] == 0

    @cached_property
    def is_moving(self) -> Bool[Tensor, "R"]:
        """True for vehicles of at least 0.5 m/s."""
        return self.is_vehicle & (self.speed >= MOVING_MPS)

    @cached_property
    def speed(self) -> Float[Tensor, "R"]:
        """Speed of the last decision, m/s."""
        return self.traffic.speed[self.place]

    @cached_property
    def time_gap(self) -> Float[Tensor, "R"]:
        """Seconds to the box of the nearest agent ahead within a corridor of 1.8 m to each side; large without any."""
        ahead, side = self._relative.unbind(-1)  # [R, A]
        length = self.scene.size[self.place[0], :, 0]  # [R, A]
        gap = ahead - (self._size[:, :1] + length) / 2
        leads = (ahead > LEAST_AHEAD_M) & (side.abs() < CORRIDOR_M) & self._is_other
        return torch.where(leads, gap, NO_GAP_M).amin(-1) / self.speed.clamp(min=1.0)

    @cached_property
    def lane_turn(self) -> Float[Tensor, "R"]:
        """Direction of the nearest lane relative to the heading, within ±1 rad; 0 without a lane."""
        return self._lane[1]

    @cached_property
    def lane_offset(self) -> Float[Tensor, "R"]:
        """Lateral position of that lane's center, left positive, within ±5 m; 0 without a lane."""
        return self._lane[0]

    # ---- the token ------------------------------------------------------------------------------------------------

    @cached_property
    def speed_change(self) -> Float[Tensor, "P"]:
        """Mean speed of the token minus that of the last decision, within ±1.5 m/s."""
        return (self.end[:, 0] / self.seconds - self.of_pairs(self.speed)).clamp(-1.5, 1.5)

    @cached_property
    def turn_change(self) -> Float[Tensor, "P"]:
        """Turn of the token minus that of the last decision, within ±0.2 rad."""
        return (self.end[:, 2] - self.of_pairs(self.traffic.turn[self.place])).clamp(-0.2, 0.2)

    def overlap(self, seconds: float) -> Float[Tensor, "P"]:
        """Overlap of the box at a time, the token's motion going on, with boxes of the six nearest agents that keep
        their velocity: 0 from 0.5 m apart, 1 at contact, 2 from 0.5 m inside.

        Args:
            seconds: Time from now.
        """
        if ("overlap", seconds) not in self._answers:
            self._answers["overlap", seconds] = self._overlap(seconds)
        return self._answers["overlap", seconds]

    def road_edge(self, seconds: float) -> Float[Tensor, "P"]:
        """Nearness of the box to the road edge at a time, the token's motion going on: 0 from 0.5 m inside the road, 1
        where a side touches the edge, 3 from 1 m beyond; 0 farther than 12 m from any edge.

        Args:
            seconds: Time from now.
        """
        if ("edge", seconds) not in self._answers:
            self._answers["edge", seconds] = self._road_edge(seconds)
        return self._answers["edge", seconds]

    # ---- parts ----------------------------------------------------------------------------------------------------

    def _overlap(self, seconds: float) -> Float[Tensor, "P"]:
        others = self._others
        position = others.position + others.velocity * seconds  # [R, O, 2]
        scale = seconds / self.seconds  # of the token's way, which goes on along the same line
        # 1. pairs whose token can get near one of the others, [Q]: first by the longest of the agent's tokens
        is_near = position.norm(dim=-1) < others.reach + self._longest[:, None] * scale
        pair, other = self.of_pairs(is_near).nonzero(as_tuple=True)
        row = self.row.index_select(0, pair)
        other += row * is_near.shape[1]  # among the R x O
        end = self.end.index_select(0, pair) * scale
        offset = position.flatten(0, 1).index_select(0, other) - end[:, :2]
        x, y = offset.unbind(-1)
        touches = x.square() + y.square() < others.reach.flatten().index_select(0, other).square()
        pair, other, row, offset, end = (values[touches] for values in (pair, other, row, offset, end))
        # 2. separation along and across the token's heading, of the boxes that enclose the others there
        heading = end[:, 2]
        along, across = rotate(offset, -heading).abs().unbind(-1)
        cos, sin = heading_vector(others.turn.flatten().index_select(0, other) - heading).abs().unbind(-1)
        length, width = others.half_size.flatten(0, 1).index_select(0, other).unbind(-1)
        own_length, own_width = self._size.index_select(0, row).unbind(-1)
        along = along - own_length / 2 - cos * length - sin * width
        across = across - own_width / 2 - sin * length - cos * width
        depth = (1 - torch.maximum(along, across) / MARGIN_M).clamp(0.0, 2.0)
        return torch.zeros_like(self.log_ratio).detach().scatter_reduce(0, pair, depth, "amax")

    def _road_edge(self, seconds: float) -> Float[Tensor, "P"]:
        inside, way = self._edge_motion
        inside = self.of_pairs(inside) - way * (seconds / self.seconds)
        return (1 - inside / MARGIN_M).clamp(0.0, 3.0)

    @cached_property
    def _edge_motion(self) -> tuple[Float[Tensor, "R"], Float[Tensor, "P"]]:
        """Distance of the agent's side to the nearest road edge, positive inside the road, and what a token takes off
        it."""
        to_edge, _, sign = self._edge
        distance = to_edge.norm(dim=-1)
        inside = sign * distance - self._size[:, 1] / 2
        toward = self.of_pairs(rotate(to_edge * (sign / distance.clamp(min=1e-3))[:, None], -self._heading))  # [P, 2]
        way = self.end[:, 0] * toward[:, 0] + self.end[:, 1] * toward[:, 1]
        return torch.where(distance < EDGE_REACH_M, inside, torch.inf), way

    @cached_property
    def _heading(self) -> Float[Tensor, "R"]:
        return self.traffic.heading[self.place]

    @cached_property
    def _size(self) -> Float[Tensor, "R 2"]:
        return self.scene.size[self.place[0], self.place[2]]

    @cached_property
    def _relative(self) -> Float[Tensor, "R A 2"]:
        """Positions of all agents of the scene in the agent's frame."""
        b, n, _, moment = self.place
        offset = self.traffic.position[b, n, :, moment] - self.traffic.position[self.place][:, None]
        return rotate(offset, -self._heading[:, None])

    @cached_property
    def _is_other(self) -> Bool[Tensor, "R A"]:
        b, _, a, _ = self.place
        present = self.scene.agent_mask[b]
        return present & (torch.arange(present.shape[1], device=a.device) != a[:, None])

    @cached_property
    def _longest(self) -> Float[Tensor, "R"]:
        """Longest way of a candidate token."""
        return torch.zeros_like(self._heading).scatter_reduce(0, self.row, self.end[:, :2].norm(dim=-1), "amax")

    @cached_property
    def _others(self) -> "_Others":
        """The nearest agents, in the agent's frame."""
        b, n, _, moment = self.place
        distance = self._relative.square().sum(-1).masked_fill(~self._is_other, torch.inf)
        near, index = distance.topk(min(MAX_OTHERS, distance.shape[1]), largest=False)  # [R, O]
        agent = (b[:, None], n[:, None], index, moment[:, None])
        half_size = self.scene.size[agent[0], index] / 2
        reach = half_size.norm(dim=-1) + (self._size.norm(dim=-1) / 2 + MARGIN_M)[:, None]
        return _Others(
            position=self._relative.gather(1, index[..., None].expand(-1, -1, 2)),
            velocity=rotate(self.traffic.velocity[agent], -self._heading[:, None]),
            turn=self.traffic.heading[agent] - self._heading[:, None],
            half_size=half_size,
            reach=torch.where(near < OTHERS_REACH_M**2, reach, -torch.inf),
        )

    @cached_property
    def _lane(self) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
        """Lateral offset and turn of the nearest lane of moving vehicles."""
        to_lane, direction, _ = self._nearest(self.scene.lanes, self.is_moving, by_heading=True)
        offset = rotate(to_lane, -self._heading)[:, 1].clamp(-5.0, 5.0)
        turn = wrap_angle(torch.atan2(direction[:, 1], direction[:, 0]) - self._heading).clamp(-1.0, 1.0)
        has_lane = direction.any(-1)
        return torch.where(has_lane, offset, 0.0), torch.where(has_lane, turn, 0.0)

    @cached_property
    def _edge(self) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R 2"], Float[Tensor, "R"]]:
        """Vector to the nearest road edge, its direction, and 1 on the road, -1 off it."""
        return self._nearest(self.scene.edges, torch.ones_like(self.is_moving), by_heading=False)

    def _nearest(
        self, pieces: tuple[Pieces | None, ...], asked: Bool[Tensor, "R"], *, by_heading: bool
    ) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R 2"], Float[Tensor, "R"]]:
        """Vector to the nearest piece, its direction, and 1 left of it, -1 right of it; far away where not asked."""
        position, heading = self.traffic.position[self.place], self._heading
        to_piece, direction = torch.full_like(position, 1e3), torch.zeros_like(position)
        for scenario, some in enumerate(pieces):
            rows = (asked & (self.place[0] == scenario)).nonzero()[:, 0]
            if some is not None and len(rows):
                vectors = some.nearest(position[rows], heading[rows] if by_heading else None)
                to_piece[rows], direction[rows] = vectors
        # left of a piece: the way to it turns right
        side = direction[:, 1] * to_piece[:, 0] - direction[:, 0] * to_piece[:, 1]
        return to_piece, direction, torch.where(side > 0, 1.0, -1.0)
