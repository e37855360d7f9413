"""Values of the elements of a mask, as rows, and back.

Selecting rows by a mask makes the host wait for a device, which must count them first. Where all elements have a row,
as on a device they do, both directions are views.
"""

from functools import lru_cache

import torch
from jaxtyping import Bool, Int64
from torch import Tensor


def find_rows(mask: Bool[Tensor, "*batch"], is_dense: bool) -> tuple[Int64[Tensor, "R"], ...]:
    """Index of each row along each axis of a mask, as `nonzero(as_tuple=True)`.

    Args:
        mask: True = the element has a row.
        is_dense: all elements have one, and the mask is not read.
    """
    return _all_rows(mask.shape, mask.device) if is_dense else mask.nonzero(as_tuple=True)


@lru_cache(maxsize=4)
def _all_rows(shape: torch.Size, device: torch.device) -> tuple[Int64[Tensor, "R"], ...]:
    """Indices of all elements; kept, because they are the same at every decision of a rollout."""
    places = torch.meshgrid(*(torch.arange(size, device=device) for size in shape), indexing="ij")
    return tuple(place.flatten() for place in places)


def pick_rows(values: Tensor, mask: Bool[Tensor, "*batch"], is_dense: bool) -> Tensor:
    """Values [*batch, ...] of the elements whose mask is True, as rows [R, ...].

    Args:
        values: of all elements.
        mask: True = the element has a row.
        is_dense: all elements have one, and the mask is not read.
    """
    return values.flatten(0, mask.dim() - 1) if is_dense else values[mask]


def place_rows(rows: Tensor, mask: Bool[Tensor, "*batch"]) -> Tensor:
    """Rows [R, ...] at the places of a mask, [*batch, ...]; zeros elsewhere.

    Args:
        rows: of the elements whose mask is True, or of all elements.
        mask: not read if all elements have a row.
    """
    shape = (*mask.shape, *rows.shape[1:])
    if len(rows) == mask.numel():
        return rows.view(shape)
    return rows.new_zeros(shape).masked_scatter(mask.view(*mask.shape, *[1] * (rows.dim() - 1)), rows)
