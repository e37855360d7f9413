"""Neighbor search: padded lists of sources within a radius, and the geometry of each relation.

R rows that attend, K neighbors of a row, P sets of C candidates each. Lists are padded where the mask is False. A
set holds the candidates of a scenario, or of a scenario, rollout and step: a row has neighbors in a single set.
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
"""Off the CPU lists have a multiple of this width: fused attention wants aligned masks."""
MANY_CANDIDATES, ROWS_PER_PATCH = 256, 64
"""On a processor, rows that choose among so many candidates are sorted by position, and patches of so many rows are
compared with the candidates around the patch alone."""
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
        """Poses at an index, as for tensors."""
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


def group_rows(set_index: Int64[Tensor, "R"], poses: Poses) -> RowGroups:
    """Groups of rows with candidate set and pose equal to the last bit; on the CPU.

    Args:
        set_index: Candidate set of each row, an index into the first axis of the candidates.
        poses: Poses [R] of the rows, in the frame of the candidates.
    """
    values = (set_index, *poses.position.unbind(-1), poses.heading)
    keys = np.stack([v.numpy().view(f"i{v.itemsize}").astype(np.int64) for v in values])  # [4, R]
    order = np.lexsort(keys)
    starts = np.flatnonzero((np.diff(keys[:, order], prepend=-1) != 0).any(0) | (np.arange(len(order)) == 0))
    return RowGroups(torch.from_numpy(order), np.diff(starts, append=len(order)))


def find_neighbors(
    position: Float[Tensor, "R 2"],
    set_index: Int64[Tensor, "R"],
    candidates: Float[Tensor, "P C 2"],
    self_index: Int64[Tensor, "R"] | None,
    *,
    radius_m: float,
    limit: int | None,
    max_neighbors: int | None = None,
) -> Neighbors:
    """Candidates nearer than a radius (strictly), or the nearest where a limit binds.

    Of equally near candidates the first counts. Lists have entries (K >= 1), padding where no row has a
    neighbor.

    Args:
        position: Finite positions of the rows, meters, in the frame of the candidates.
        set_index: Candidate set of each row, an index into the first axis of the candidates.
        candidates: Positions, meters, infinite for padding. Neighbors are named by the flat index p * C + c.
        self_index: Candidate of the set that is the row, and no neighbor; None = no row is a candidate.
        radius_m: Radius of the circle around a row in which neighbors lie, meters.
        limit: Largest number of neighbors of a row, the nearest candidates; None = all within the radius.
        max_neighbors: Bound on the candidates within the radius of a row, see `bound_neighbors`. Off the CPU lists are
            then as wide, and the host need not wait for the width.
    """
    num_candidates, is_on_cpu = candidates.shape[1], position.device.type == "cpu"
    cut = _patches if is_on_cpu and num_candidates >= MANY_CANDIDATES else _blocks
    lists = []
    for view in cut(position, set_index, candidates, radius_m):
        # plain differences: torch.cdist goes through a matrix product, which loses digits far from the origin
        squared = (view.x - position[view.rows, :1]).square_()
        squared += (view.y - position[view.rows, 1:]).square_()
        if self_index is not None:
            squared.masked_fill_(view.columns == self_index[view.rows, None], torch.inf)
        if limit is not None:
            neighbors = _select_nearest(squared, radius_m, limit)
        elif is_on_cpu:
            neighbors = _select_within(squared, radius_m)
        else:
            neighbors = _select_bounded(squared, radius_m, max_neighbors)
        # a block has all candidates, so a position in it is the candidate's own
        columns = view.columns[neighbors.index] if cut is _patches and len(view.columns) else neighbors.index
        lists.append((view.rows, columns.masked_fill(~neighbors.mask, 0), neighbors.mask))
    # lists of all views, padded to the longest [R, K]
    width = max([1, *(mask.shape[1] for _, _, mask in lists)])
    width += 0 if is_on_cpu else -width % WIDTH_STEP
    index = set_index.new_zeros(len(set_index), width)
    is_neighbor = torch.zeros_like(index, dtype=torch.bool)
    for rows, columns, mask in lists:
        index[:, : mask.shape[1]].index_copy_(0, rows, columns)
        is_neighbor[:, : mask.shape[1]].index_copy_(0, rows, mask)
    return Neighbors(index + set_index[:, None] * num_candidates, is_neighbor)


def bound_neighbors(candidates: Float[Tensor, "P C 2"], radius_m: float) -> int:
    """Bound on the candidates of a set that lie within a radius of any point: the most in a disc of cells.

    The bound exceeds the largest number by about a third, where candidates lie everywhere.

    Args:
        candidates: Positions, meters, infinite for padding.
        radius_m: Radius of the circle around a point, meters.
    """
    # 1. Candidates of each cell. Cells repeat after CELLS_PER_SIDE, which can only raise a sum.
    cell_m = radius_m / CELLS_PER_RADIUS
    exists = candidates.isfinite().all(-1)  # [P, C]
    cell = (torch.where(exists[..., None], candidates, 0.0) / cell_m).floor().long() % CELLS_PER_SIDE
    counts = candidates.new_zeros(len(candidates), CELLS_PER_SIDE**2)
    counts.scatter_add_(1, cell[..., 0] * CELLS_PER_SIDE + cell[..., 1], exists.to(counts.dtype))
    # 2. Sums over the cells that the circle around a point of the middle one may touch.
    max_offset, reach = CELLS_PER_RADIUS + 1, CELLS_PER_RADIUS * (1 + MARGIN_M / radius_m)
    gap = (torch.arange(-max_offset, max_offset + 1, device=counts.device).abs() - 1).clamp(min=0)  # in cells
    disc = (gap[:, None].square() + gap.square() < reach**2).to(counts.dtype)
    padded = functional.pad(counts.view(-1, 1, CELLS_PER_SIDE, CELLS_PER_SIDE), (max_offset,) * 4, mode="circular")
    return int(functional.conv2d(padded, disc[None, None]).max())


@dataclass(frozen=True, eq=False)
class View:
    """Rows that are searched together, and the candidates: positions [r, c], or [1, c] if shared by all rows."""

    rows: Int64[Tensor, "r"]
    columns: Int64[Tensor, "c"]
    x: Float[Tensor, "_ c"]
    y: Float[Tensor, "_ c"]


def _blocks(
    position: Float[Tensor, "R 2"], set_index: Int64[Tensor, "R"], candidates: Float[Tensor, "P C 2"], radius_m: float
) -> Iterator[View]:
    """Views of all candidates in the sets of the rows."""
    columns = torch.arange(candidates.shape[1], device=set_index.device)
    x, y = candidates[..., 0].contiguous(), candidates[..., 1].contiguous()
    pairs = PAIRS_PER_BLOCK.get(set_index.device.type, PAIRS_PER_BLOCK_ELSEWHERE)
    for rows in torch.arange(len(set_index), device=set_index.device).split(max(pairs // max(len(columns), 1), 1)):
        yield View(rows, columns, x.index_select(0, set_index[rows]), y.index_select(0, set_index[rows]))


def _patches(
    position: Float[Tensor, "R 2"], set_index: Int64[Tensor, "R"], candidates: Float[Tensor, "P C 2"], radius_m: float
) -> Iterator[View]:
    """Views of adjacent rows with the same candidate set, and the candidates around these rows.

    A row's circle is much smaller than a map, so most candidates need no distance.
    """
    # 1. order rows by candidate set, then by square of a grid as wide as the circle
    squares = (position / (2 * radius_m)).floor()
    order = np.lexsort((squares[:, 0].numpy(), squares[:, 1].numpy(), set_index.numpy()))
    starts = np.flatnonzero(np.diff(set_index.numpy()[order], prepend=-1))
    # 2. some rows in this order at a time, and the candidates in their bounding box plus the radius
    for rows in np.split(order, starts[1:]) if len(order) else ():
        x, y = candidates[set_index[rows[0]]].unbind(-1)
        for patch in torch.from_numpy(rows).split(ROWS_PER_PATCH):
            (left, bottom), (right, top) = torch.aminmax(position[patch], dim=0)
            reach = radius_m + MARGIN_M
            is_in_box = (x > left - reach) & (x < right + reach) & (y > bottom - reach) & (y < top + reach)
            columns = is_in_box.nonzero()[:, 0]
            yield View(patch, columns, x[None, columns], y[None, columns])


def _select_nearest(squared: Float[Tensor, "r C"], radius_m: float, limit: int) -> Neighbors:
    """The `limit` nearest candidates, of equally near candidates the first.

    `topk` of the distances alone takes any of equally near candidates, depending on the number of all, padding
    included.
    """
    columns = torch.arange(squared.shape[1], device=squared.device)
    # distance in the upper 32 bits, column in the lower: floats that are not negative sort as their bits do
    key = (squared.float().view(torch.int32).long() << 32) | columns
    index = key.topk(min(limit, squared.shape[1]), dim=-1, largest=False).values & 0xFFFFFFFF
    return Neighbors(index, squared.gather(1, index) < radius_m**2)


def _select_within(squared: Float[Tensor, "r C"], radius_m: float) -> Neighbors:
    """All candidates within the radius, in the order of columns."""
    is_inside = squared < radius_m**2
    count = is_inside.sum(-1, keepdim=True)
    column = is_inside.nonzero()[:, 1]  # of all rows, one row after the other
    columns = torch.arange(max(int(count.max()) if len(count) else 0, 1), device=is_inside.device)
    mask = columns < count
    # position of each list's entries among these; padding repeats any
    entry = (count.cumsum(0) - count + columns).clamp(max=max(len(column) - 1, 0))
    return Neighbors(column[entry] if len(column) else torch.zeros_like(entry), mask)


def _select_bounded(squared: Float[Tensor, "r C"], radius_m: float, max_neighbors: int | None) -> Neighbors:
    """As `_select_within`, in lists of `max_neighbors` entries; without that bound the host waits for the count."""
    is_inside = squared < radius_m**2
    columns = torch.arange(squared.shape[1], device=is_inside.device).expand(is_inside.shape)
    width = int(is_inside.sum(-1).max()) if max_neighbors is None else max_neighbors
    if width >= squared.shape[1]:
        return Neighbors(columns, is_inside)
    count = is_inside.cumsum(-1)
    # the first neighbor goes to the first entry, and so on; all others to one more entry, which is cut off
    index = columns.new_zeros(len(is_inside), width + 1)
    index.scatter_(1, torch.where(is_inside, count - 1, width), columns)
    return Neighbors(index[:, :width], columns[:, :width] < count[:, -1:])


def relative_pose(row: Poses, neighbor: Poses, *, seam_rad: float) -> Float[Tensor, "R K 3"]:
    """Distance, bearing in the row's frame, and difference of heading, of each row's neighbors.

    Args:
        row: Poses [R] of the rows, which become the origin of the relation.
        neighbor: Poses [R, K] of the neighbors, in the same frame as the rows.
        seam_rad: Width of the seam: angles lie in [seam_rad - pi, seam_rad + pi), see `SmartConfig.seam_rad`.
    """
    offset = neighbor.position - row.position[:, None]
    bearing = angle_between(heading_vector(row.heading)[:, None].expand_as(offset), offset)
    angles = torch.stack([bearing, wrap_angle(neighbor.heading - row.heading[:, None])], -1)
    angles = torch.where(angles < seam_rad - math.pi, angles + 2 * math.pi, angles)
    return torch.cat([offset.norm(dim=-1, keepdim=True), angles], -1)
