"""Who looks at whom: padded neighbour lists and the geometry of each relation.

R rows that look, K neighbours a row. A list is padded with index 0 where its mask is False.
"""

import itertools
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


def within(
    position: Float[Tensor, "R 2"],
    place: Int64[Tensor, "R"],
    candidates: Float[Tensor, "P C 2"],
    own: Int64[Tensor, "R"] | None,
    *,
    radius_m: float,
    limit: int | None,
) -> Neighbors:
    """Candidates nearer than a radius (strictly), the nearest of them where a limit binds; of equally near ones the first.

    Args:
        position: of the rows.
        place: where each row looks: an entry of the candidates' first axis.
        candidates: positions, infinite where there is nobody. Their flat index p * C + c is what neighbours are named by.
        own: the candidate of its place that a row is itself, and does not look at.
        radius_m: of their circle.
        limit: most neighbours a row has; None = all.
    """
    num_candidates = candidates.shape[1]
    x, y = candidates.unbind(-1)
    lists, counts = [], []
    piece = max(PAIRS_PER_PIECE // max(num_candidates, 1), 1)
    for at, p, o in zip(
        position.split(piece), place.split(piece), itertools.repeat(None) if own is None else own.split(piece)
    ):
        squared = (x[p] - at[:, :1]).square_().add_((y[p] - at[:, 1:]).square_())
        near = squared < radius_m**2
        if o is not None:
            near.scatter_(1, o[:, None], False)
        row, column = near.nonzero(as_tuple=True)
        lists.append(p[row] * num_candidates + column)
        counts.append(near.sum(-1))
    neighbors = _padded(torch.cat([*lists, place.new_zeros(1)]), torch.cat(counts) if counts else place)
    if limit is None or neighbors.index.shape[1] <= limit:
        return neighbors
    offset = candidates.flatten(0, 1)[neighbors.index] - position[:, None]
    squared = offset.square().sum(-1).masked_fill(~neighbors.mask, torch.inf)
    nearest, column = (part[:, :limit] for part in squared.sort(dim=-1, stable=True))
    return Neighbors(neighbors.index.gather(1, column), nearest < torch.inf)


def _padded(flat: Int64[Tensor, "E"], count: Int64[Tensor, "R"]) -> Neighbors:
    """Lists behind each other, the last entry being nobody's, below each other."""
    columns = torch.arange(max(int(count.max()) if len(count) else 0, 1), device=flat.device)
    mask = columns < count[:, None]
    entry = (count.cumsum(0) - count)[:, None] + columns
    return Neighbors(flat[torch.where(mask, entry, len(flat) - 1)], mask)


def relative_pose(row: Poses, other: Poses, *, seam_rad: float) -> Float[Tensor, "R K 3"]:
    """Distance, bearing in the row's frame, and difference of heading, from rows [R] to their neighbours [R, K].

    Angles lie in [seam_rad - pi, seam_rad + pi).
    """
    offset = other.position - row.position[:, None]
    bearing = angle_between(heading_vector(row.heading)[:, None].expand_as(offset), offset)
    angles = torch.stack([bearing, wrap_angle(other.heading - row.heading[:, None])], -1)
    angles = torch.where(angles < seam_rad - math.pi, angles + 2 * math.pi, angles)
    return torch.cat([offset.norm(dim=-1, keepdim=True), angles], -1)
