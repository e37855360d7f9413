"""Who looks at whom: padded neighbour lists and the geometry of each relation.

R rows that look, K neighbours a row. A list is padded with index 0 where its mask is False.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import angle_between, heading_vector, wrap_angle

PAIRS_PER_PIECE = {"cpu": 1 << 18}
"""Distances that are looked at together: on a processor they fit its cache."""
PAIRS_PER_PIECE_ELSEWHERE = 1 << 26
MANY_CANDIDATES, ROWS_PER_PATCH = 256, 64
"""On a processor, rows that choose among so many candidates are sorted by where they are, and so many rows beside each other look only
at what lies around them."""
MARGIN_M = 0.01


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

    Lists have at least one entry (K >= 1), padding where nobody has a neighbour.

    Args:
        position: of the rows, finite.
        place: where each row looks: an entry of the candidates' first axis.
        candidates: positions, infinite where there is nobody. Their flat index p * C + c is what neighbours are named by.
        own: the candidate of its place that a row is itself, and does not look at.
        radius_m: of their circle.
        limit: most neighbours a row has; None = all.
    """
    on_processor, (_, num_candidates, _) = position.device.type == "cpu", candidates.shape
    cut = _patches if on_processor and num_candidates >= MANY_CANDIDATES else _pieces
    found = []
    for view in cut(position, place, candidates, radius_m):
        squared = (view.x - position[view.rows, :1]).square_()
        squared += (view.y - position[view.rows, 1:]).square_()
        if own is not None:
            squared.masked_fill_(view.columns == own[view.rows, None], torch.inf)
        near = _all_near(squared, radius_m) if limit is None else _nearest(squared, radius_m, limit)
        found.append((view.rows, view.columns[near.index] if len(view.columns) else near.index, near.mask))
    width = max([1, *(mask.shape[1] for _, _, mask in found)])
    index, is_near = place.new_zeros(len(place), width), place.new_zeros(len(place), width, dtype=torch.bool)
    for rows, columns, mask in found:
        index[:, : mask.shape[1]].index_copy_(0, rows, columns.masked_fill_(~mask, 0))
        is_near[:, : mask.shape[1]].index_copy_(0, rows, mask)
    return Neighbors(index + place[:, None] * num_candidates, is_near)


@dataclass(frozen=True, eq=False)
class View:
    """Rows that look together, and what they look at: positions [r, c], or [1, c] where it is the same for all."""

    rows: Int64[Tensor, "r"]
    columns: Int64[Tensor, "c"]
    x: Float[Tensor, "_ c"]
    y: Float[Tensor, "_ c"]


def _pieces(
    position: Float[Tensor, "R 2"], place: Int64[Tensor, "R"], candidates: Float[Tensor, "P C 2"], radius_m: float
) -> Iterator[View]:
    """All candidates of each row's place."""
    columns = torch.arange(candidates.shape[1], device=place.device)
    x, y = candidates[..., 0].contiguous(), candidates[..., 1].contiguous()
    pairs = PAIRS_PER_PIECE.get(place.device.type, PAIRS_PER_PIECE_ELSEWHERE)
    for rows in torch.arange(len(place), device=place.device).split(max(pairs // max(len(columns), 1), 1)):
        yield View(rows, columns, x.index_select(0, place[rows]), y.index_select(0, place[rows]))


def _patches(
    position: Float[Tensor, "R 2"], place: Int64[Tensor, "R"], candidates: Float[Tensor, "P C 2"], radius_m: float
) -> Iterator[View]:
    """Of each row's place what lies around some rows beside each other, in squares as wide as the circle."""
    squares = (position / (2 * radius_m)).floor()
    order = np.lexsort((squares[:, 0].numpy(), squares[:, 1].numpy(), place.numpy()))
    starts = np.flatnonzero(np.diff(place.numpy()[order], prepend=-1))
    for rows in np.split(order, starts[1:]) if len(order) else ():
        x, y = candidates[place[rows[0]]].unbind(-1)
        for patch in torch.from_numpy(rows).split(ROWS_PER_PATCH):
            (left, bottom), (right, top) = torch.aminmax(position[patch], dim=0)
            reach = radius_m + MARGIN_M
            is_around = (x > left - reach) & (x < right + reach) & (y > bottom - reach) & (y < top + reach)
            columns = is_around.nonzero()[:, 0]
            yield View(patch, columns, x[None, columns], y[None, columns])


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


def relative_pose(row: Poses, other: Poses, *, seam_rad: float) -> Float[Tensor, "R K 3"]:
    """Distance, bearing in the row's frame, and difference of heading, from rows [R] to their neighbours [R, K].

    Angles lie in [seam_rad - pi, seam_rad + pi).
    """
    offset = other.position - row.position[:, None]
    bearing = angle_between(heading_vector(row.heading)[:, None].expand_as(offset), offset)
    angles = torch.stack([bearing, wrap_angle(other.heading - row.heading[:, None])], -1)
    angles = torch.where(angles < seam_rad - math.pi, angles + 2 * math.pi, angles)
    return torch.cat([offset.norm(dim=-1, keepdim=True), angles], -1)
