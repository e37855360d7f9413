"""Who looks at whom: padded neighbour lists and the geometry of each relation.

R rows that look, K neighbours a row. A list is padded with index 0 where its mask is False.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import angle_between, heading_vector, wrap_angle

PAIRS_PER_PIECE = 1 << 18
"""Distances that are looked at together: they fit the processor's cache."""


@dataclass(frozen=True, eq=False)
class Neighbors:
    """For each row the rows of some source it attends to."""

    index: Int64[Tensor, "R K"]
    mask: Bool[Tensor, "R K"]


@dataclass(frozen=True, eq=False)
class Poses:
    """Where something is and which way it points."""

    position: Float[Tensor, "*shape 2"]
    heading: Float[Tensor, "*shape"]

    def __getitem__(self, index: Any) -> "Poses":
        """Some of them."""
        return Poses(self.position[index], self.heading[index])


def nearest_within(
    targets: Float[Tensor, "... n 2"],
    sources: Float[Tensor, "... m 2"],
    allowed: Bool[Tensor, "... n m"] | None,
    *,
    radius_m: float,
    limit: int | None,
) -> tuple[Int64[Tensor, "... n K"], Bool[Tensor, "... n K"]]:
    """Sources nearer than a radius (strictly), nearest first where a limit binds; `allowed` None = all of them.

    K is the limit, or the largest number of neighbours that occurs; at least 1.
    """
    rows = max(PAIRS_PER_PIECE // max(sources.shape[-2], 1), 1)
    pieces = targets.split(rows) if targets.dim() == 2 and allowed is None else (targets,)
    squared = [_squared_distance(piece, sources, allowed) for piece in pieces]
    if limit is None:
        limit = max(int((s < radius_m**2).sum(-1).amax()) if s.numel() else 0 for s in squared)
    width = min(max(limit, 1), sources.shape[-2])
    nearest = [s.topk(width, dim=-1, largest=False, sorted=False) for s in squared]
    return torch.cat([n.indices for n in nearest]), torch.cat([n.values for n in nearest]) < radius_m**2


def _squared_distance(
    targets: Float[Tensor, "... n 2"], sources: Float[Tensor, "... m 2"], allowed: Bool[Tensor, "... n m"] | None
) -> Float[Tensor, "... n m"]:
    """Squared distances, infinite where not allowed; each axis in place, since memory traffic is all the cost."""
    squared = (targets[..., :, None, 0] - sources[..., None, :, 0]).square_()
    squared += (targets[..., :, None, 1] - sources[..., None, :, 1]).square_()
    return squared if allowed is None else squared.masked_fill_(~allowed, torch.inf)


def relative_pose(row: Poses, other: Poses, *, seam_rad: float) -> Float[Tensor, "R K 3"]:
    """Distance, bearing in the row's frame, and difference of heading, from rows [R] to their neighbours [R, K].

    Angles lie in [seam_rad - pi, seam_rad + pi).
    """
    offset = other.position - row.position[:, None]
    bearing = angle_between(heading_vector(row.heading)[:, None].expand_as(offset), offset)
    angles = torch.stack([bearing, wrap_angle(other.heading - row.heading[:, None])], -1)
    angles = torch.where(angles < seam_rad - math.pi, angles + 2 * math.pi, angles)
    return torch.cat([offset.norm(dim=-1, keepdim=True), angles], -1)


def pad_lists(lists: list[Neighbors]) -> Neighbors:
    """Lists of different widths below each other."""
    width = max(part.index.shape[1] for part in lists)
    pad = [(0, width - part.index.shape[1]) for part in lists]
    return Neighbors(
        torch.cat([torch.nn.functional.pad(part.index, p) for part, p in zip(lists, pad)]),
        torch.cat([torch.nn.functional.pad(part.mask, p) for part, p in zip(lists, pad)]),
    )
