"""Inputs of features: the agents of several scenes before each decision, and the lanes and edges of the roads.

B scenarios, N rollouts, A agents, L moments, S segments. Map frame, meters, radians and seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import heading_vector, wrap_angle
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


@dataclass(frozen=True, eq=False)
class Segments:
    """Straight segments of a scene's lanes, or of the road edges, which have the road on the left."""

    start: Float[Tensor, "S 2"]
    delta: Float[Tensor, "S 2"]

    def to(self, device: torch.device | str) -> "Segments":
        """Copy on a device."""
        return Segments(self.start.to(device), self.delta.to(device))

    def find_nearest(
        self, position: Float[Tensor, "R 2"], heading: Float[Tensor, "R"] | None = None
    ) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R 2"]]:
        """Vectors to the nearest segments, and along these.

        Args:
            position: Positions to look from, map frame, meters.
            heading: Headings at the positions, so that segments of different direction count as farther away; None =
                any direction.

        Returns:
            Vector from each position to the nearest point of the segment, and the segment's direction, a unit vector.
        """
        # 1. a few segments whose centers are nearest: the squared distance without the term that all share
        keys, queries = self._centers, position
        if heading is not None:
            keys = torch.cat([keys, METERS_PER_TURN * self._directions], -1)
            queries = torch.cat([queries, METERS_PER_TURN * heading_vector(heading)], -1)
        gaps = torch.addmm(keys.square().sum(-1) / 2, queries, keys.mT, alpha=-1)  # [R, S]
        index = gaps.topk(min(NUM_CANDIDATES, len(keys)), largest=False, sorted=False).indices.sort(-1).values
        # 2. the nearest of these; of two that are equally near, to the millimeter, always the first
        start, delta = self.start[index], self.delta[index]  # [R, 4, 2]
        fraction = ((position[:, None] - start) * delta).sum(-1) / delta.square().sum(-1)
        offset = start + fraction.clamp(0.0, 1.0)[..., None] * delta - position[:, None]
        distance = offset.square().sum(-1)
        if heading is not None:
            turned = self._directions[index] - heading_vector(heading)[:, None]
            distance = distance + METERS_PER_TURN**2 * turned.square().sum(-1)
        nearest = (1e3 * distance.sqrt()).round().argmin(-1, keepdim=True)[..., None].expand(-1, -1, 2)
        return offset.gather(1, nearest)[:, 0], self._directions[index].gather(1, nearest)[:, 0]

    @cached_property
    def _centers(self) -> Float[Tensor, "S 2"]:
        return self.start + self.delta / 2

    @cached_property
    def _directions(self) -> Float[Tensor, "S 2"]:
        return self.delta / self.delta.norm(dim=-1, keepdim=True)


@cached_on_scenario
def cut_segments(scenario: Scenario, types: tuple[int, ...], frame: Frame) -> Segments | None:
    """Segments of a scenario's map features; None where there are none.

    Args:
        scenario: Scenario with the map to cut, in the world frame.
        types: `MapFeatureType` numbers of the features to cut.
        frame: Frame of the segments, "map" or "world".
    """
    features, starts, deltas = scenario.map_features, [], []
    for index in features.find_indices(types):
        line = features.polyline(index)[:, :2].astype(np.float64) - compute_origin(scenario, frame)
        length = arc_length(line)[-1] if len(line) > 1 else 0.0
        if length > 0:
            # a little less, so that rounding of a length of whole segments adds none
            points = resample_to(line, int(np.ceil(length / SEGMENT_LENGTH_M - 1e-3)) + 1)
            steps = np.diff(points, axis=0)
            has_length = np.linalg.norm(steps, axis=1) > 0
            starts.append(points[:-1][has_length])
            deltas.append(steps[has_length])
    if not sum(map(len, starts)):
        return None
    return Segments(*(torch.from_numpy(np.concatenate(v).astype(np.float32)) for v in (starts, deltas)))


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
        velocity = (position - self.position) / seconds
        speed = (velocity * heading_vector(self.heading)).sum(-1)
        return Traffic(position, heading, velocity, speed, wrap_angle(heading - self.heading))


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
    lanes: tuple[Segments | None, ...]
    """Lanes of each scenario; None = a map without lanes."""
    edges: tuple[Segments | None, ...]

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

    def cut(types: tuple[int, ...]) -> tuple[Segments | None, ...]:
        maps = (cut_segments(scenario, types, batch.frame) for scenario in batch.scenarios)
        return tuple(segments and segments.to(batch.device) for segments in maps)

    return Scene(
        current=Traffic(position, heading, velocity, speed, torch.zeros_like(heading)),
        class_id=class_of_type(batch.object_type),
        size=batch.size[..., :2],
        agent_mask=batch.agent_mask,
        lanes=cut(LANE_TYPES),
        edges=cut(ROAD_EDGE_TYPES),
    )
