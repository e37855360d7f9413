"""Neighbor search: padded lists of sources within a radius, and the geometry of each relation.

R rows that attend, K neighbors of a row, P places with C candidates each. A list is padded with index 0 where its
mask is False. A place is a scenario, or a scenario, rollout and step: rows attend to candidates of their own place
only.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional

from rlftsim.geometry import angle_between, heading_vector, wrap_angle

PAIRS_PER_BLOCK = {"cpu": 1 << 18}
"""Distances that are computed together: on a processor they fit its cache."""
PAIRS_PER_BLOCK_ELSEWHERE = 1 << 26
WIDTH_STEP = 8
"""Off the CPU widths of lists are multiples of it: fused attention wants masks that are aligned."""
MANY_CANDIDATES, ROWS_PER_PATCH = 256, 64
"""On a processor, rows that choose among so many candidates are sorted by where they are, and so many rows beside
each other look only at what lies around them."""
MARGIN_M = 0.01
"""Added to the bounds of a patch, so that rounding excludes no candidate that is within the radius."""
CELLS_PER_RADIUS, CELLS_PER_SIDE = 8, 256
"""Cells of the grid on which candidates are counted to bound the number of neighbors."""


@dataclass(frozen=True, eq=False)
class Neighbors:
    """The sources that each row attends to."""

    index: Int64[Tensor, "R K"]
    mask: Bool[Tensor, "R K"]


@dataclass(frozen=True, eq=False)
class Poses:
    """Positions (meters) and headings (radians)."""

    position: Float[Tensor, "*shape 2"]
    heading: Float[Tensor, "*shape"]

    def __getitem__(self, index: Any) -> "Poses":
        """Poses at an index, as of the tensors."""
        return Poses(self.position[index], self.heading[index])


@dataclass(frozen=True, eq=False)
class RowGroups:
    """Rows in groups that share a list of neighbors."""

    rows: Int64[Tensor, "R"]
    """Group after group."""
    sizes: np.ndarray
    """Rows of each group [G], at least one."""

    @property
    def first(self) -> Int64[Tensor, "G"]:
        """The first row of each group."""
        return self.rows[torch.from_numpy(self.sizes.cumsum() - self.sizes)]


def group_rows(place: Int64[Tensor, "R"], poses: Poses) -> RowGroups:
    """Groups of rows whose place and pose are equal to the last bit; on the CPU.

    Args:
        place: of the rows.
        poses: [R].
    """
    values = (place, *poses.position.unbind(-1), poses.heading)
    keys = np.stack([v.numpy().view(f"i{v.itemsize}").astype(np.int64) for v in values])  # [4, R]
    order = np.lexsort(keys)
    starts = np.flatnonzero((np.diff(keys[:, order], prepend=-1) != 0).any(0) | (np.arange(len(order)) == 0))
    return RowGroups(torch.from_numpy(order), np.diff(starts, append=len(order)))


def within(
    position: Float[Tensor, "R 2"],
    place: Int64[Tensor, "R"],
    candidates: Float[Tensor, "P C 2"],
    own: Int64[Tensor, "R"] | None,
    *,
    radius_m: float,
    limit: int | None,
    most: int | None = None,
) -> Neighbors:
    """Candidates nearer than a radius (strictly), or the nearest of them where a limit binds.

    Of equally near ones the first counts. Lists have at least one entry (K >= 1), padding where no row has a neighbor.

    Args:
        position: of the rows, finite.
        place: the place of each row, an entry of the candidates' first axis.
        candidates: positions, infinite for padding. Neighbors are named by their flat index p * C + c.
        own: the candidate of its place that is the row itself, and is no neighbor; None = rows are no candidates.
        radius_m: of the circle around a row.
        limit: most neighbors of a row; None = all.
        most: no row has more candidates within the radius, see `most_within`. Off the CPU lists are then as wide, and
            the host need not wait for their width.
    """
    if position.device.type != "cpu":
        return _within_fixed(position, place, candidates, own, radius_m, limit, most)
    _, num_candidates, _ = candidates.shape
    cut = _patches if num_candidates >= MANY_CANDIDATES else _blocks
    found = []
    for view in cut(position, place, candidates, radius_m):
        squared = _squared_distances(view, position, own)
        near = _all_near(squared, radius_m) if limit is None else _nearest(squared, radius_m, limit)
        found.append((view.rows, view.columns[near.index] if len(view.columns) else near.index, near.mask))
    # lists of all views, padded to the longest [R, K]
    width = max([1, *(mask.shape[1] for _, _, mask in found)])
    index, is_near = place.new_zeros(len(place), width), place.new_zeros(len(place), width, dtype=torch.bool)
    for rows, columns, mask in found:
        index[:, : mask.shape[1]].index_copy_(0, rows, columns.masked_fill_(~mask, 0))
        is_near[:, : mask.shape[1]].index_copy_(0, rows, mask)
    return Neighbors(index + place[:, None] * num_candidates, is_near)


def _within_fixed(
    position: Float[Tensor, "R 2"],
    place: Int64[Tensor, "R"],
    candidates: Float[Tensor, "P C 2"],
    own: Int64[Tensor, "R"] | None,
    radius_m: float,
    limit: int | None,
    most: int | None,
) -> Neighbors:
    """`within` in lists of a width that depends on no position, if `limit` or `most` is given."""
    found = []
    for view in _blocks(position, place, candidates, radius_m):
        squared = _squared_distances(view, position, own)
        if limit is not None:
            near = _nearest(squared, radius_m, limit)
        else:
            near = _first_near(squared, radius_m, most)
        found.append((near.index, near.mask))
    index, mask = (torch.cat(values) for values in zip(*found))
    index = index.masked_fill(~mask, 0) + place[:, None] * candidates.shape[1]
    padding = (0, -mask.shape[1] % WIDTH_STEP)
    return (
        Neighbors(functional.pad(index, padding), functional.pad(mask, padding))
        if padding[1]
        else Neighbors(index, mask)
    )


def most_within(candidates: Float[Tensor, "P C 2"], radius_m: float) -> int:
    """A number that no point has more candidates of a place than within the radius: the most in a disc of cells.

    It exceeds the largest number by about a third, where candidates lie everywhere.

    Args:
        candidates: positions, infinite for padding.
        radius_m: of the circle around a point.
    """
    # 1. Candidates of each cell. Cells repeat after CELLS_PER_SIDE, which can only raise a sum.
    cell_m = radius_m / CELLS_PER_RADIUS
    exists = candidates.isfinite().all(-1)  # [P, C]
    cell = (torch.where(exists[..., None], candidates, 0.0) / cell_m).floor().long() % CELLS_PER_SIDE
    counts = candidates.new_zeros(len(candidates), CELLS_PER_SIDE**2)
    counts.scatter_add_(1, cell[..., 0] * CELLS_PER_SIDE + cell[..., 1], exists.to(counts.dtype))
    # 2. Sums over the cells that the circle around a point of the middle one may touch.
    farthest, reach = CELLS_PER_RADIUS + 1, CELLS_PER_RADIUS * (1 + MARGIN_M / radius_m)
    gap = (torch.arange(-farthest, farthest + 1, device=counts.device).abs() - 1).clamp(min=0)  # in cells, between two
    disc = (gap[:, None].square() + gap.square() < reach**2).to(counts.dtype)
    padded = functional.pad(counts.view(-1, 1, CELLS_PER_SIDE, CELLS_PER_SIDE), (farthest,) * 4, mode="circular")
    return int(functional.conv2d(padded, disc[None, None]).max())


@dataclass(frozen=True, eq=False)
class View:
    """Rows that are searched together, and their candidates: positions [r, c], or [1, c] if shared by all rows."""

    rows: Int64[Tensor, "r"]
    columns: Int64[Tensor, "c"]
    x: Float[Tensor, "_ c"]
    y: Float[Tensor, "_ c"]


def _squared_distances(
    view: View, position: Float[Tensor, "R 2"], own: Int64[Tensor, "R"] | None
) -> Float[Tensor, "r c"]:
    """Squared distances of a view's rows to its candidates, infinite to a row's own."""
    # plain differences: torch.cdist goes through a matrix product, which loses digits far from the origin
    squared = (view.x - position[view.rows, :1]).square_()
    squared += (view.y - position[view.rows, 1:]).square_()
    if own is not None:
        squared.masked_fill_(view.columns == own[view.rows, None], torch.inf)
    return squared


def _blocks(
    position: Float[Tensor, "R 2"], place: Int64[Tensor, "R"], candidates: Float[Tensor, "P C 2"], radius_m: float
) -> Iterator[View]:
    """Views of all candidates of each row's place."""
    columns = torch.arange(candidates.shape[1], device=place.device)
    x, y = candidates[..., 0].contiguous(), candidates[..., 1].contiguous()
    pairs = PAIRS_PER_BLOCK.get(place.device.type, PAIRS_PER_BLOCK_ELSEWHERE)
    for rows in torch.arange(len(place), device=place.device).split(max(pairs // max(len(columns), 1), 1)):
        yield View(rows, columns, x.index_select(0, place[rows]), y.index_select(0, place[rows]))


def _patches(
    position: Float[Tensor, "R 2"], place: Int64[Tensor, "R"], candidates: Float[Tensor, "P C 2"], radius_m: float
) -> Iterator[View]:
    """Views of rows that lie beside each other in the same place, and the candidates around them.

    A row's circle is much smaller than a map, so most candidates need no distance.
    """
    # 1. order rows by place, then by square of a grid as wide as the circle
    squares = (position / (2 * radius_m)).floor()
    order = np.lexsort((squares[:, 0].numpy(), squares[:, 1].numpy(), place.numpy()))
    starts = np.flatnonzero(np.diff(place.numpy()[order], prepend=-1))
    # 2. some rows in this order at a time, and the candidates in their bounding box plus the radius
    for rows in np.split(order, starts[1:]) if len(order) else ():
        x, y = candidates[place[rows[0]]].unbind(-1)
        for patch in torch.from_numpy(rows).split(ROWS_PER_PATCH):
            (left, bottom), (right, top) = torch.aminmax(position[patch], dim=0)
            reach = radius_m + MARGIN_M
            is_around = (x > left - reach) & (x < right + reach) & (y > bottom - reach) & (y < top + reach)
            columns = is_around.nonzero()[:, 0]
            yield View(patch, columns, x[None, columns], y[None, columns])


def _nearest(squared: Float[Tensor, "r C"], radius_m: float, limit: int) -> Neighbors:
    """The `limit` nearest candidates, of equally near ones the first.

    `topk` of the distances themselves takes any of equally near ones, depending on how many candidates there are,
    padding included.
    """
    columns = torch.arange(squared.shape[1], device=squared.device)
    # distance in the upper 32 bits, column in the lower: floats that are not negative sort as their bits do
    key = (squared.float().view(torch.int32).long() << 32) | columns
    index = key.topk(min(limit, squared.shape[1]), dim=-1, largest=False).values & 0xFFFFFFFF
    return Neighbors(index, squared.gather(1, index) < radius_m**2)


def _all_near(squared: Float[Tensor, "r C"], radius_m: float) -> Neighbors:
    """All candidates within the radius, in the order of their columns."""
    near = squared < radius_m**2
    count = near.sum(-1, keepdim=True)
    column = near.nonzero()[:, 1]  # of all rows, one row after the other
    columns = torch.arange(max(int(count.max()) if len(count) else 0, 1), device=near.device)
    mask = columns < count
    # place of each list's entries among these; padding repeats any
    entry = (count.cumsum(0) - count + columns).clamp(max=max(len(column) - 1, 0))
    index = column[entry] if len(column) else torch.zeros_like(entry)
    return Neighbors(index.masked_fill_(~mask, 0), mask)


def _first_near(squared: Float[Tensor, "r C"], radius_m: float, most: int | None) -> Neighbors:
    """As `_all_near`, in lists of `most` entries; the host waits only where that is not known."""
    near = squared < radius_m**2
    columns = torch.arange(squared.shape[1], device=near.device).expand(near.shape)
    most = int(near.sum(-1).max()) if most is None else most
    if most >= squared.shape[1]:
        return Neighbors(columns, near)
    place = near.cumsum(-1)
    # the first neighbor goes to the first entry, and so on; all others to one more entry, which is cut off
    index = columns.new_zeros(len(near), most + 1)
    index.scatter_(1, torch.where(near, place - 1, most), columns)
    return Neighbors(index[:, :most], columns[:, :most] < place[:, -1:])


def relative_pose(row: Poses, other: Poses, *, seam_rad: float) -> Float[Tensor, "R K 3"]:
    """Distance, bearing in the row's frame, and difference of heading, of each row's neighbors.

    Args:
        row: poses [R].
        other: poses of the neighbors [R, K].
        seam_rad: angles lie in [seam_rad - pi, seam_rad + pi), see `SmartConfig.seam_rad`.
    """
    offset = other.position - row.position[:, None]
    bearing = angle_between(heading_vector(row.heading)[:, None].expand_as(offset), offset)
    angles = torch.stack([bearing, wrap_angle(other.heading - row.heading[:, None])], -1)
    angles = torch.where(angles < seam_rad - math.pi, angles + 2 * math.pi, angles)
    return torch.cat([offset.norm(dim=-1, keepdim=True), angles], -1)
