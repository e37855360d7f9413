"""What features look at: the agents of several scenes before their decisions, and the lanes and edges of their roads.

B scenarios, N rollouts, A agents, L moments, S pieces. Map frame, meters, radians and seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import heading_vector, wrap_angle
from rlftsim.scenario.batch import Frame, ScenarioBatch, compute_origin
from rlftsim.scenario.derived import cached_on_scenario
from rlftsim.scenario.polylines import arc_length, resample_to
from rlftsim.scenario.types import CURRENT_STEP, LANE_TYPES, ROAD_EDGE_TYPES, Scenario
from rlftsim.tokens.vocabulary import class_of_type

PIECE_M = 5.0
"""Longest straight piece that lanes and edges are cut into; SMART reads maps in pieces of this length, too."""
METERS_PER_TURN = 3.0
"""Distance that weighs as much as a turn by one radian, when the lane of a pose is looked for."""
NEAR_PIECES = 4
"""Pieces of nearest centers that the nearest one is looked for among."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Straight pieces of a scene's lanes, or of its road edges, which have the road on their left."""

    start: Float[Tensor, "S 2"]
    delta: Float[Tensor, "S 2"]

    def to(self, device: torch.device | str) -> "Pieces":
        """The same pieces on another device."""
        return Pieces(self.start.to(device), self.delta.to(device))

    def nearest(
        self, position: Float[Tensor, "R 2"], heading: Float[Tensor, "R"] | None = None
    ) -> tuple[Float[Tensor, "R 2"], Float[Tensor, "R 2"]]:
        """Vectors to the nearest pieces, and along them.

        Args:
            position: Places to look from, map frame.
            heading: Headings in them, so that pieces of another direction count as farther away; None = any direction.

        Returns:
            From the position to the nearest point of its piece, and the piece's direction (a unit vector).
        """
        # 1. a few pieces whose centers are nearest: the squared distance without its part that is the same for all
        keys, queries = self._centers, position
        if heading is not None:
            keys = torch.cat([keys, METERS_PER_TURN * self._directions], -1)
            queries = torch.cat([queries, METERS_PER_TURN * heading_vector(heading)], -1)
        gaps = torch.addmm(keys.square().sum(-1) / 2, queries, keys.mT, alpha=-1)  # [R, S]
        index = gaps.topk(min(NEAR_PIECES, len(keys)), largest=False, sorted=False).indices.sort(-1).values
        # 2. the nearest of them; of two that are equally near, to the millimeter, always the same one
        start, delta = self.start[index], self.delta[index]  # [R, few, 2]
        along = ((position[:, None] - start) * delta).sum(-1) / delta.square().sum(-1)
        to_piece = start + along.clamp(0.0, 1.0)[..., None] * delta - position[:, None]
        distance = to_piece.square().sum(-1)
        if heading is not None:
            turned = self._directions[index] - heading_vector(heading)[:, None]
            distance = distance + METERS_PER_TURN**2 * turned.square().sum(-1)
        nearest = (1e3 * distance.sqrt()).round().argmin(-1, keepdim=True)[..., None].expand(-1, -1, 2)
        return to_piece.gather(1, nearest)[:, 0], self._directions[index].gather(1, nearest)[:, 0]

    @cached_property
    def _centers(self) -> Float[Tensor, "S 2"]:
        return self.start + self.delta / 2

    @cached_property
    def _directions(self) -> Float[Tensor, "S 2"]:
        return self.delta / self.delta.norm(dim=-1, keepdim=True)


@cached_on_scenario
def cut_pieces(scenario: Scenario, types: tuple[int, ...], frame: Frame) -> Pieces | None:
    """Pieces of a scenario's map features; None where there are none.

    Args:
        scenario: Its map is in the world frame.
        types: `MapFeatureType` numbers of the features to cut.
        frame: Frame of the pieces.
    """
    features, starts, deltas = scenario.map_features, [], []
    for index in features.find_indices(types):
        line = features.polyline(index)[:, :2].astype(np.float64) - compute_origin(scenario, frame)
        length = arc_length(line)[-1] if len(line) > 1 else 0.0
        if length > 0:
            # a little less, so that rounding of a length of whole pieces does not cut it in another way
            points = resample_to(line, int(np.ceil(length / PIECE_M - 1e-3)) + 1)
            has_length = np.linalg.norm(np.diff(points, axis=0), axis=1) > 0
            starts.append(points[:-1][has_length])
            deltas.append(np.diff(points, axis=0)[has_length])
    if not sum(map(len, starts)):
        return None
    start, delta = (torch.from_numpy(np.concatenate(parts).astype(np.float32)) for parts in (starts, deltas))
    return Pieces(start, delta)


@dataclass(frozen=True, eq=False)
class Traffic:
    """Agents of several scenes at one or more moments before their decisions, with the motion that led there."""

    position: Float[Tensor, "B N A L 2"]
    heading: Float[Tensor, "B N A L"]
    velocity: Float[Tensor, "B N A L 2"]
    """Mean over the last decision, m/s; at first as logged."""
    speed: Float[Tensor, "B N A L"]
    """Velocity along the heading before the last decision, as tokens have it, m/s."""
    turn: Float[Tensor, "B N A L"]
    """Change of the heading in the last decision; at first 0."""

    def after(self, poses: Float[Tensor, "B N A t 3"], seconds: float) -> "Traffic":
        """The traffic after a decision.

        Args:
            poses: Steps of the decision; the last one counts.
            seconds: Duration of the decision.
        """
        position, heading = poses[..., -1:, :2], poses[..., -1:, 2]
        velocity = (position - self.position) / seconds
        speed = (velocity * heading_vector(self.heading)).sum(-1)
        return Traffic(position, heading, velocity, speed, wrap_angle(heading - self.heading))


def join_moments(moments: Sequence[Traffic]) -> Traffic:
    """Traffic of several moments, one behind the other along the axis L."""
    return Traffic(*(torch.cat([getattr(one, f.name) for one in moments], 3) for f in fields(Traffic)))


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same during the rollouts of a batch."""

    now: Traffic
    """At the current step, of a single rollout."""
    class_id: Int64[Tensor, "B A"]
    size: Float[Tensor, "B A 2"]
    """Length and width."""
    agent_mask: Bool[Tensor, "B A"]
    lanes: tuple[Pieces | None, ...]
    """Of each scenario; None = its map has none."""
    edges: tuple[Pieces | None, ...]

    def begin(self, num_rollouts: int) -> Traffic:
        """The current step, N times; no copies."""
        values = (getattr(self.now, f.name) for f in fields(Traffic))
        return Traffic(*(value.expand(-1, num_rollouts, *value.shape[2:]) for value in values))


def build_scene(batch: ScenarioBatch) -> Scene:
    """The scene of a batch: history, boxes and map. The logged future is not read.

    Args:
        batch: Scenarios to decide in.
    """
    logged = (batch.position, batch.heading, batch.velocity)
    position, heading, velocity = (values[:, None, :, CURRENT_STEP, None] for values in logged)  # [B, 1, A, 1, ...]
    speed = (velocity * heading_vector(heading)).sum(-1)

    def cut(types: tuple[int, ...]) -> tuple[Pieces | None, ...]:
        pieces = [cut_pieces(scenario, types, batch.frame) for scenario in batch.scenarios]
        return tuple(None if one is None else one.to(batch.device) for one in pieces)

    return Scene(
        now=Traffic(position, heading, velocity, speed, torch.zeros_like(heading)),
        class_id=class_of_type(batch.object_type),
        size=batch.size[..., :2],
        agent_mask=batch.agent_mask,
        lanes=cut(LANE_TYPES),
        edges=cut(ROAD_EDGE_TYPES),
    )
