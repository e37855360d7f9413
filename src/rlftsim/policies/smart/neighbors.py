"""Who looks at whom: padded neighbour lists and the geometry of each relation.

R rows that look, K neighbours a row. A list is padded with index 0 where its mask is False.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import angle_between, heading_vector, wrap_angle


@dataclass(frozen=True, eq=False)
class Neighbors:
    """For each row the rows of some source it attends to."""

    index: Int64[Tensor, "R K"]
    mask: Bool[Tensor, "R K"]


def nearest_within(
    targets: Float[Tensor, "... n 2"],
    sources: Float[Tensor, "... m 2"],
    allowed: Bool[Tensor, "... n m"],
    *,
    radius_m: float,
    limit: int | None,
) -> tuple[Int64[Tensor, "... n K"], Bool[Tensor, "... n K"]]:
    """Sources nearer than a radius (strictly), nearest first where a limit binds.

    K is the limit, or the largest number of neighbours that occurs; at least 1.
    """
    difference = targets[..., :, None, :] - sources[..., None, :, :]
    squared = difference.square().sum(-1).masked_fill(~allowed, torch.inf)
    within = squared < radius_m**2
    width = max(int(within.sum(-1).amax()) if within.numel() else 0, 1)
    width = min(width, limit or width, squared.shape[-1])
    nearest = squared.topk(width, dim=-1, largest=False, sorted=False)
    return nearest.indices, nearest.values < radius_m**2


def relative_pose(
    position: Float[Tensor, "R 2"],
    heading: Float[Tensor, "R"],
    other_position: Float[Tensor, "R K 2"],
    other_heading: Float[Tensor, "R K"],
) -> Float[Tensor, "R K 3"]:
    """Distance, bearing in the row's frame, and difference of heading, from rows to their neighbours."""
    offset = other_position - position[:, None]
    bearing = angle_between(heading_vector(heading)[:, None].expand_as(offset), offset)
    return torch.stack([offset.norm(dim=-1), bearing, wrap_angle(other_heading - heading[:, None])], -1)


def pad_lists(lists: list[Neighbors]) -> Neighbors:
    """Lists of different widths below each other."""
    width = max(part.index.shape[1] for part in lists)
    pad = [(0, width - part.index.shape[1]) for part in lists]
    return Neighbors(
        torch.cat([torch.nn.functional.pad(part.index, p) for part, p in zip(lists, pad)]),
        torch.cat([torch.nn.functional.pad(part.mask, p) for part, p in zip(lists, pad)]),
    )
