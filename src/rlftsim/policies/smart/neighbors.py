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
from torch.nn import functional

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
    """Candidates nearer than a radius (strictly), the nearest of them where a limit binds, of equally near ones the first.

    Args:
        position: of the rows.
        place: where each row looks: an entry of the candidates' first axis.
        candidates: positions, infinite where there is nobody. Their flat index p * C + c is what neighbours are named by.
        own: the candidate of its place that a row is itself, and does not look at.
        radius_m: of their circle.
        limit: most neighbours a row has; None = all.
    """
    num_candidates = candidates.shape[1]
    x, y = candidates[..., 0].contiguous(), candidates[..., 1].contiguous()
    rows = max(PAIRS_PER_PIECE // max(num_candidates, 1), 1)
    lists = []
    for at, p, o in zip(
        position.split(rows), place.split(rows), itertools.repeat(None) if own is None else own.split(rows)
    ):
        squared = x.index_select(0, p).sub_(at[:, :1]).square_()
        squared += y.index_select(0, p).sub_(at[:, 1:]).square_()
        if o is not None:
            squared.scatter_(1, o[:, None], torch.inf)
        lists.append(_all_near(squared, radius_m) if limit is None else _nearest(squared, radius_m, limit))
    near = _below_each_other(lists)
    return Neighbors(near.index + place[:, None] * num_candidates, near.mask)


def _nearest(squared: Float[Tensor, "r C"], radius_m: float, limit: int) -> Neighbors:
    """Of equally near ones the first. (Which of them `topk` itself takes depends on how many candidates there are, padding included.)"""
    columns = torch.arange(squared.shape[1], device=squared.device)
    key = (
        squared.float().view(torch.int32).long() << 32
    ) | columns  # floats that are not negative sort as their bits do
    index = key.topk(min(limit, squared.shape[1]), dim=-1, largest=False).values & 0xFFFFFFFF
    return Neighbors(index, squared.gather(1, index) < radius_m**2)


def _all_near(squared: Float[Tensor, "r C"], radius_m: float) -> Neighbors:
    near = squared < radius_m**2
    count = near.sum(-1, keepdim=True)
    column = near.nonzero()[:, 1]
    columns = torch.arange(max(int(count.max()) if len(count) else 0, 1), device=near.device)
    mask = columns < count
    entry = (count.cumsum(0) - count + columns).clamp(max=max(len(column) - 1, 0))
    index = column[entry] if len(column) else torch.zeros_like(entry)
    return Neighbors(index.masked_fill_(~mask, 0), mask)


def _below_each_other(lists: list[Neighbors]) -> Neighbors:
    """Lists of different widths below each other."""
    width = max(part.index.shape[1] for part in lists)
    pad = [(0, width - part.index.shape[1]) for part in lists]
    return Neighbors(
        torch.cat([functional.pad(part.index, p) for part, p in zip(lists, pad)]),
        torch.cat([functional.pad(part.mask, p) for part, p in zip(lists, pad)]),
    )


def relative_pose(row: Poses, other: Poses, *, seam_rad: float) -> Float[Tensor, "R K 3"]:
    """Distance, bearing in the row's frame, and difference of heading, from rows [R] to their neighbours [R, K].

    Angles lie in [seam_rad - pi, seam_rad + pi).
    """
    offset = other.position - row.position[:, None]
    bearing = angle_between(heading_vector(row.heading)[:, None].expand_as(offset), offset)
    angles = torch.stack([bearing, wrap_angle(other.heading - row.heading[:, None])], -1)
    angles = torch.where(angles < seam_rad - math.pi, angles + 2 * math.pi, angles)
    return torch.cat([offset.norm(dim=-1, keepdim=True), angles], -1)
