"""Candidates: pairs of an agent that is about to decide and a token that the agent may well choose.

A token is a candidate if more than `exp(-SUPPORT_NATS)` times as likely as the likeliest token. All further tokens
together have next to no probability, and are fifty times as many. Features fade in over the least likely candidates, so
that a token just above the limit is as good as a token just below. Agents with a single candidate, such as parked cars,
have no choice and are left out. Where decisions are continuous, actions take the place of tokens: `calibrated.actions`.

Candidates are read off a scene: the agents of several scenarios before each decision, and the lanes and edges of the
roads.

B scenarios, N rollouts, A agents, L moments, S segments, R agents with a choice, P pairs, O agents nearby. Map frame
unless said, meters, radians and seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor
from torch.nn import functional

from rlftsim.geometry import heading_vector, rotate, square_norm, wrap_angle
from rlftsim.rollout.types import FARTHEST_STEP_M
from rlftsim.scenario.batch import Frame, ScenarioBatch, compute_origin
from rlftsim.scenario.polylines import arc_length, resample_to
from rlftsim.scenario.types import CURRENT_STEP, LANE_TYPES, ROAD_EDGE_TYPES, Scenario, cached_on_scenario
from rlftsim.tokens.vocabulary import class_of_type

SEGMENT_LENGTH_M = 5.0
"""Longest segment that lanes and edges are cut into; SMART reads maps in segments of this length, too."""
METERS_PER_TURN = 3.0
"""Distance that weighs as much as a turn by one radian, when the lane of a pose is looked for."""
NUM_CANDIDATES = 4
"""Segments of nearest centers, among which the nearest segment is looked for."""
SUPPORT_NATS = 9.2
"""Log of the ratio between the likeliest token and the least likely candidate: 10,000."""
FADE_NATS = 2.3
"""Distance above the limit over which the features of candidates fade in."""
FAR_M = 1e6
"""Where padding lies, in both coordinates."""
MOVING_MPS = 0.5
MAX_NEIGHBORS = 6
"""Nearest agents that overlaps are looked for with."""
NEIGHBOR_REACH_M = 40.0
EDGE_REACH_M = 12.0
MARGIN_M = 0.5
"""Distance from a box or an edge at which overlap begins to count."""
CORRIDOR_M = 1.8
"""Largest lateral distance of a leader."""
MIN_LEAD_M = 0.5
"""Smallest distance of the leader's center ahead."""
NO_GAP_M = 200.0
"""Gap of an agent without a leader."""


class Segments:
    """Straight segments of the lanes, or of the road edges, of several scenarios; edges have the road on the left.

    Args:
        maps: Start and vector [s, 2, 2] of the segments of each scenario.
    """

    def __init__(self, maps: Sequence[Float[Tensor, "_ 2 2"]]):
        # padding lies far from any agent; among less than 64 k values topk would look three times as long for k
        length = max(64 * NUM_CANDIDATES, *map(len, maps))
        padding = maps[0].new_tensor([[FAR_M, FAR_M], [1.0, 0.0]])
        padded = torch.stack([torch.cat([part, padding.expand(length - len(part), 2, 2)]) for part in maps])
        start, delta = padded.unbind(2)  # [B, S, 2]
        center, direction = start + delta / 2, delta / delta.norm(dim=-1, keepdim=True)
        keys = center, torch.cat([center, METERS_PER_TURN * direction], -1)
        self._centers, self._poses = ((key, key.square().sum(-1) / 2) for key in keys)
        self._table = torch.cat([start, delta, direction], -1).flatten(0, 1)

    def find_nearest(
        self, scenario: Int64[Tensor, "R"], position: Float[Tensor, "R 2"], heading: Float[Tensor, "R"] | None = None
    ) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R 2"]]:
        """Vectors to the nearest segments, and along these.

        Args:
            scenario: Scenario of each position, in increasing order.
            position: Positions to look from, map frame, meters.
            heading: Headings at the positions, so that segments of different direction count as farther away; None =
                any direction.

        Returns:
            Vector from each position to the nearest point of the segment, of at least 100 km where there are no
            segments, and the segment's direction, a unit vector.
        """
        # 1. a few segments whose centers are nearest: the squared distance without the term that all share
        (keys, half_squares), queries = self._centers, position
        if heading is not None:
            (keys, half_squares), turns = self._poses, METERS_PER_TURN * heading_vector(heading)
            queries = torch.cat([queries, turns], -1)
        num_rows = torch.bincount(scenario, minlength=len(keys)).tolist()
        indices = []
        for half_square, of_map, rows in zip(half_squares, keys, queries.split(num_rows)):
            gaps = torch.addmm(half_square, rows, of_map.mT, alpha=-1)  # [r, S]
            indices.append(gaps.topk(NUM_CANDIDATES, largest=False, sorted=False).indices)
        index = torch.cat(indices).sort(-1).values + (scenario * keys.shape[1])[:, None]  # [R, 4]
        # 2. the nearest of these; of two that are equally near, to the millimeter, always the first
        start, delta, direction = functional.embedding(index, self._table).split(2, -1)  # [R, 4, 2]
        along = (position[:, None] - start) * delta
        fraction = (along[..., 0] + along[..., 1]) / square_norm(delta)
        offset = start + fraction.clamp(0.0, 1.0)[..., None] * delta - position[:, None]
        distance = square_norm(offset)
        if heading is not None:
            distance = distance + METERS_PER_TURN**2 * square_norm(direction - heading_vector(heading)[:, None])
        nearest = (1e3 * distance.sqrt()).round().argmin(-1)[:, None, None].expand(-1, -1, 2)
        return offset.gather(1, nearest)[:, 0], direction.gather(1, nearest)[:, 0]


@cached_on_scenario
def cut_segments(scenario: Scenario, types: tuple[int, ...], frame: Frame) -> Float[Tensor, "s 2 2"]:
    """Start and vector of each segment of a scenario's map features; none where there are no such features.

    Args:
        scenario: Scenario with the map to cut, in the world frame.
        types: `MapFeatureType` numbers of the features to cut.
        frame: Frame of the segments, "map" or "world".
    """
    features, segments = scenario.map_features, [np.empty((0, 2, 2))]
    for index in features.find_indices(types):
        line = features.polyline(index)[:, :2].astype(np.float64) - compute_origin(scenario, frame)
        length = arc_length(line)[-1] if len(line) > 1 else 0.0
        if length > 0:
            # a little less, so that rounding of a length of whole segments adds none
            points = resample_to(line, int(np.ceil(length / SEGMENT_LENGTH_M - 1e-3)) + 1)
            steps = np.diff(points, axis=0)
            has_length = np.linalg.norm(steps, axis=1) > 0
            segments.append(np.stack([points[:-1], steps], 1)[has_length])
    return torch.from_numpy(np.concatenate(segments).astype(np.float32))


@dataclass(frozen=True, eq=False)
class Traffic:
    """Agents of several scenes at one or more moments before decisions, with the motion that led there."""

    position: Float[Tensor, "B N A L 2"]
    heading: Float[Tensor, "B N A L"]
    velocity: Float[Tensor, "B N A L 2"]
    """Mean over the last decision, m/s; at first as logged."""
    speed: Float[Tensor, "B N A L"]
    """Velocity along the heading before the last decision, as tokens have it, m/s."""
    turn: Float[Tensor, "B N A L"]
    """Change of the heading in the last decision; at first 0."""

    def advance(self, poses: Float[Tensor, "B N A t 3"], seconds: float) -> "Traffic":
        """The traffic after a decision.

        Args:
            poses: Poses (x, y, heading) of the decision's steps, of which the last counts.
            seconds: Duration of the decision, over which velocities are means.
        """
        position, heading = poses[..., -1:, :2], poses[..., -1:, 2]
        before, before_heading = self.position, self.heading
        if poses.shape[3] > 1:  # somebody who is put elsewhere has moved within the decision alone
            is_elsewhere = (poses[..., :1, :2] - before).norm(dim=-1, keepdim=True) > FARTHEST_STEP_M
            before = torch.where(is_elsewhere, 2 * poses[..., :1, :2] - poses[..., 1:2, :2], before)
            before_heading = torch.where(is_elsewhere[..., 0], poses[..., :1, 2], before_heading)
        velocity = (position - before) / seconds
        speed = (velocity * heading_vector(before_heading)).sum(-1)
        return Traffic(position, heading, velocity, speed, wrap_angle(heading - before_heading))


def join_moments(moments: Sequence[Traffic]) -> Traffic:
    """Traffic of several moments in a row along the axis L."""
    return Traffic(*(torch.cat(values, 3) for values in zip(*(vars(moment).values() for moment in moments))))


@dataclass(frozen=True, eq=False)
class Scene:
    """Current step, boxes and map of a batch, which all rollouts share."""

    current: Traffic
    """At the current step, of a single rollout."""
    class_id: Int64[Tensor, "B A"]
    size: Float[Tensor, "B A 2"]
    """Length and width."""
    agent_mask: Bool[Tensor, "B A"]
    lanes: Segments
    edges: Segments

    def begin(self, num_rollouts: int) -> Traffic:
        """The current step, N times; no copies."""
        return Traffic(*(v.expand(-1, num_rollouts, *v.shape[2:]) for v in vars(self.current).values()))


def build_scene(batch: ScenarioBatch) -> Scene:
    """The scene of a batch: history, boxes and map. The logged future is not read.

    Args:
        batch: Scenarios in a common frame, with history, boxes and maps.
    """
    logged = (batch.position, batch.heading, batch.velocity)
    position, heading, velocity = (values[:, None, :, CURRENT_STEP, None] for values in logged)  # [B, 1, A, 1, ...]
    speed = (velocity * heading_vector(heading)).sum(-1)

    def cut(types: tuple[int, ...]) -> Segments:
        return Segments([cut_segments(scenario, types, batch.frame).to(batch.device) for scenario in batch.scenarios])

    return Scene(
        current=Traffic(position, heading, velocity, speed, torch.zeros_like(heading)),
        class_id=class_of_type(batch.object_type),
        size=batch.size[..., :2],
        agent_mask=batch.agent_mask,
        lanes=cut(LANE_TYPES),
        edges=cut(ROAD_EDGE_TYPES),
    )


@dataclass(frozen=True, eq=False)
class _Neighbors:
    """Agents near each of the R agents, in the frame of that agent."""

    position: Float[Tensor, "R O 2"]
    velocity: Float[Tensor, "R O 2"]
    turn: Float[Tensor, "R O"]
    """Heading minus that of the agent."""
    half_size: Float[Tensor, "R O 2"]
    reach: Float[Tensor, "R O"]
    """Distance of the centers at which an overlap becomes possible; 0 for agents too far away."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs of agents and tokens, with values that features read. Each value is computed once, at the first use."""

    scene: Scene
    traffic: Traffic
    agent_index: tuple[Int64[Tensor, "R"], ...]
    """Indices of the agents along the axes of the traffic: scenario, rollout, agent, moment."""
    row: Int64[Tensor, "P"]
    """Agent of each pair, an index into the R."""
    end: Float[Tensor, "P 3"]
    """Where the token leads: x, y, heading in the agent's frame."""
    log_ratio: Float[Tensor, "P"]
    """Log of the token's probability over that of the agent's likeliest token, in the policy that is calibrated."""
    seconds: float
    """Duration of a token."""
    _memo: dict[tuple[str, float], Tensor] = field(default_factory=dict)
    """Overlaps and edges by time, which several features read."""

    @property
    def weight(self) -> Float[Tensor, "P"]:
        """Weight in which features of a pair count: 1 but for the least likely candidates."""
        return ((self.log_ratio + SUPPORT_NATS) / FADE_NATS).clamp(max=1.0)

    def of_pairs(self, values: Shaped[Tensor, "R *more"]) -> Shaped[Tensor, "P *more"]:
        """Values of the agents, for each pair."""
        return values.index_select(0, self.row)

    def where(self, condition: Bool[Tensor, "R"]) -> Float[Tensor, "P"]:
        """1 for the pairs of agents that a condition holds for, else 0."""
        return self.of_pairs(condition.float())

    # ---- the agent ------------------------------------------------------------------------------------------------

    @cached_property
    def is_vehicle(self) -> Bool[Tensor, "R"]:
        """True for vehicles, False for pedestrians and cyclists."""
        return self.scene.class_id[self.agent_index[0], self.agent_index[2]] == 0

    @cached_property
    def of_vehicles(self) -> Float[Tensor, "P"]:
        """1 for the pairs of vehicles, 0 for those of pedestrians and cyclists."""
        return self.where(self.is_vehicle)

    @cached_property
    def is_moving(self) -> Bool[Tensor, "R"]:
        """True for vehicles of at least 0.5 m/s."""
        return self.is_vehicle & (self.speed >= MOVING_MPS)

    @cached_property
    def speed(self) -> Float[Tensor, "R"]:
        """Speed of the last decision, m/s."""
        return self.traffic.speed[self.agent_index]

    @cached_property
    def time_gap(self) -> Float[Tensor, "R"]:
        """Seconds to the box of the nearest agent ahead within a corridor of 1.8 m to each side; large without any."""
        longitudinal, lateral = self._relative.unbind(-1)  # [R, A]
        length = self.scene.size[self.agent_index[0], :, 0]  # [R, A]
        gap = longitudinal - (self._size[:, :1] + length) / 2
        is_leader = (longitudinal > MIN_LEAD_M) & (lateral.abs() < CORRIDOR_M) & self._is_distinct
        return torch.where(is_leader, gap, NO_GAP_M).amin(-1) / self.speed.clamp(min=1.0)

    @property
    def lane_turn(self) -> Float[Tensor, "R"]:
        """Direction of the nearest lane relative to the heading, within ±1 rad; 0 without a lane."""
        return self._lane[1]

    @property
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
        return (self.end[:, 2] - self.of_pairs(self.traffic.turn[self.agent_index])).clamp(-0.2, 0.2)

    def overlap(self, seconds: float) -> Float[Tensor, "P"]:
        """Overlap of the box at a time, the token's motion going on, with boxes of the six nearest agents at constant
        velocity: 0 from 0.5 m apart, 1 at contact, 2 from 0.5 m inside.

        Args:
            seconds: Time from now, seconds.
        """
        if (key := ("overlap", seconds)) in self._memo:
            return self._memo[key]
        neighbors = self._neighbors
        position = neighbors.position + neighbors.velocity * seconds  # [R, O, 2]
        scale = seconds / self.seconds  # of the token's motion, which goes on along the same line
        # 1. pairs whose token gets near a neighbor, [Q]: first by the rectangle around the ends of the agent's tokens
        low, high = (bound[:, None] * scale for bound in self._bounds)
        row, neighbor = _is_near(position - position.clamp(low, high), neighbors.reach).nonzero(as_tuple=True)  # [E]
        count = self._counts.index_select(0, row)
        first = (self._counts.cumsum(0) - self._counts).index_select(0, row)  # pair of the agent
        edge = torch.repeat_interleave(count)
        pair = torch.arange(len(edge), device=edge.device) + (first - count.cumsum(0) + count).index_select(0, edge)
        row, neighbor = row.index_select(0, edge), (row * position.shape[1] + neighbor).index_select(0, edge)
        end = self.end.index_select(0, pair) * scale
        offset = position.flatten(0, 1).index_select(0, neighbor) - end[:, :2]
        touches = _is_near(offset, neighbors.reach.flatten().index_select(0, neighbor)).nonzero()[:, 0]
        values = (pair, neighbor, row, offset, end)
        pair, neighbor, row, offset, end = (value.index_select(0, touches) for value in values)
        # 2. separation along and across the token's heading, of the boxes that enclose the neighbors there
        heading = end[:, 2]
        longitudinal, lateral = rotate(offset, -heading).abs().unbind(-1)
        cos, sin = heading_vector(neighbors.turn.flatten().index_select(0, neighbor) - heading).abs().unbind(-1)
        length, width = neighbors.half_size.flatten(0, 1).index_select(0, neighbor).unbind(-1)
        agent_length, agent_width = self._size.index_select(0, row).unbind(-1)
        longitudinal = longitudinal - agent_length / 2 - cos * length - sin * width
        lateral = lateral - agent_width / 2 - sin * length - cos * width
        depth = (1 - torch.maximum(longitudinal, lateral) / MARGIN_M).clamp(0.0, 2.0)
        self._memo[key] = torch.zeros_like(self.log_ratio).detach().scatter_reduce(0, pair, depth, "amax")
        return self._memo[key]

    def road_edge(self, seconds: float) -> Float[Tensor, "P"]:
        """Nearness of the box to the road edge at a time, the token's motion going on: 0 from 0.5 m inside the road, 1
        where a side touches the edge, 3 from 1 m beyond; 0 farther than 12 m from any edge.

        Args:
            seconds: Time from now, seconds.
        """
        if (key := ("edge", seconds)) not in self._memo:
            inside, approach = self._find_edge(seconds)
            self._memo[key] = (1 - (self.of_pairs(inside) - approach) / MARGIN_M).clamp(0.0, 3.0)
        return self._memo[key]

    # ---- geometry -------------------------------------------------------------------------------------------------

    def _find_edge(self, seconds: float) -> tuple[Float[Tensor, "R"], Float[Tensor, "P"]]:
        """Distance between the agent's side and the nearest road edge where the agent gets if it goes on as now,
        positive inside the road, and the distance that a token's steering subtracts.

        The edge at the agent's side says little where roads bend: a fast vehicle gets 20 m farther in a second. And the
        nearest edge of a junction may lie ahead or behind, so braking is no way to or from an edge.

        Args:
            seconds: Time from now, seconds.
        """
        steps = seconds / self.seconds
        turn = self.traffic.turn[self.agent_index] * steps / 2  # of the chord: [R]
        ahead = rotate(heading_vector(turn), self._heading)
        points = self._position + ahead * (self.speed * seconds)[:, None]
        to_edge, direction = self.scene.edges.find_nearest(self.agent_index[0], points)
        distance = to_edge.norm(dim=-1)
        # left of an edge, on the road, the vector to the edge points to the right
        sign = torch.where(direction[:, 1] * to_edge[:, 0] - direction[:, 0] * to_edge[:, 1] > 0, 1.0, -1.0)
        inside = sign * distance - self._size[:, 1] / 2
        # how far the edge lies to the left of the way, over its distance, and how far the token leads to the left
        edge_left = sign * (ahead[:, 0] * to_edge[:, 1] - ahead[:, 1] * to_edge[:, 0]) / distance.clamp(min=1e-3)
        angle = self.end[:, 2] * (steps - 1) / 2 - self.of_pairs(turn)
        left = angle.sin() * (self.end[:, 0] * steps) + angle.cos() * (self.end[:, 1] * steps)
        return torch.where(distance < EDGE_REACH_M, inside, torch.inf), left * self.of_pairs(edge_left)

    @cached_property
    def _position(self) -> Float[Tensor, "R 2"]:
        return self.traffic.position[self.agent_index]

    @cached_property
    def _heading(self) -> Float[Tensor, "R"]:
        return self.traffic.heading[self.agent_index]

    @cached_property
    def _size(self) -> Float[Tensor, "R 2"]:
        return self.scene.size[self.agent_index[0], self.agent_index[2]]

    @cached_property
    def _relative(self) -> Float[Tensor, "R A 2"]:
        """Positions of all agents of the scene in the agent's frame."""
        b, n, _, moment = self.agent_index
        _, num_rollouts, _, num_moments, _ = self.traffic.position.shape
        of_all = self.traffic.position.transpose(2, 3).flatten(0, 2)  # [B N L, A, 2], in simulations a view
        of_all = of_all.index_select(0, (b * num_rollouts + n) * num_moments + moment)
        offset = of_all - self._position[:, None]
        return rotate(offset, -self._heading[:, None])

    @cached_property
    def _is_distinct(self) -> Bool[Tensor, "R A"]:
        """True for the agents of the scene that are present and not the agent itself."""
        b, _, a, _ = self.agent_index
        is_present = self.scene.agent_mask[b]
        return is_present & (torch.arange(is_present.shape[1], device=a.device) != a[:, None])

    @cached_property
    def _counts(self) -> Int64[Tensor, "R"]:
        """Number of each agent's pairs, which follow one another."""
        return torch.bincount(self.row, minlength=len(self._heading))

    @cached_property
    def _bounds(self) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R 2"]]:
        """Least and greatest x and y of the ends of each agent's tokens."""
        ends, row = self.end[:, :2], self.row[:, None].expand(-1, 2)
        infinite = torch.full_like(self._position, torch.inf)
        return infinite.scatter_reduce(0, row, ends, "amin"), (-infinite).scatter_reduce(0, row, ends, "amax")

    @cached_property
    def _neighbors(self) -> "_Neighbors":
        """The nearest agents, in the agent's frame."""
        b, n, _, moment = self.agent_index
        squared = square_norm(self._relative).masked_fill(~self._is_distinct, torch.inf)
        squared, index = squared.topk(min(MAX_NEIGHBORS, squared.shape[1]), largest=False)  # [R, O]
        neighbor = (b[:, None], n[:, None], index, moment[:, None])
        half_size = self.scene.size[b[:, None], index] / 2
        reach = half_size.norm(dim=-1) + (self._size.norm(dim=-1) / 2 + MARGIN_M)[:, None]
        return _Neighbors(
            position=self._relative.gather(1, index[..., None].expand(-1, -1, 2)),
            velocity=rotate(self.traffic.velocity[neighbor], -self._heading[:, None]),
            turn=self.traffic.heading[neighbor] - self._heading[:, None],
            half_size=half_size,
            reach=torch.where(squared < NEIGHBOR_REACH_M**2, reach, 0.0),
        )

    @cached_property
    def _lane(self) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
        """Lateral offset and turn of the nearest lane of moving vehicles."""
        moving = self.is_moving.nonzero()[:, 0]
        scenario, heading = self.agent_index[0][moving], self._heading[moving]
        to_lane, direction = self.scene.lanes.find_nearest(scenario, self._position[moving], heading)
        offset = rotate(to_lane, -heading)[:, 1].clamp(-5.0, 5.0)
        turn = wrap_angle(torch.atan2(direction[:, 1], direction[:, 0]) - heading).clamp(-1.0, 1.0)
        has_lane, nothing = to_lane[:, 0] < FAR_M / 2, torch.zeros_like(self._heading)
        offset, turn = (torch.where(has_lane, values, 0.0) for values in (offset, turn))
        return nothing.index_copy(0, moving, offset), nothing.index_copy(0, moving, turn)


def _is_near(offset: Float[Tensor, "*shape 2"], reach: Float[Tensor, "*shape"]) -> Bool[Tensor, "*shape"]:
    return square_norm(offset) < reach.square()
