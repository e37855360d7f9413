"""Values of the elements of a mask, as rows, and back.

Selecting rows by a mask makes the host wait for a device, which must count the rows first. Where all elements have a
row, as on a device, both directions are views.
"""

from functools import lru_cache

import torch
from jaxtyping import Bool, Int64
from torch import Tensor


def find_rows(mask: Bool[Tensor, "*batch"], is_dense: bool) -> tuple[Int64[Tensor, "R"], ...]:
    """Index of each row along each axis of a mask, as `nonzero(as_tuple=True)`.

    Args:
        mask: Elements with a row, in row-major order; not read if `is_dense`.
        is_dense: True = all elements have a row, so that the host does not wait for a count.
    """
    return _index_elements(mask.shape, mask.device) if is_dense else mask.nonzero(as_tuple=True)


@lru_cache(maxsize=4)
def _index_elements(shape: torch.Size, device: torch.device) -> tuple[Int64[Tensor, "R"], ...]:
    """Indices of all elements; cached, because all decisions of a rollout have the same."""
    axes = torch.meshgrid(*(torch.arange(size, device=device) for size in shape), indexing="ij")
    return tuple(axis.flatten() for axis in axes)


def pick_rows(values: Tensor, mask: Bool[Tensor, "*batch"], is_dense: bool) -> Tensor:
    """Values of the elements with a True mask, as rows [R, ...].

    Args:
        values: Values of all elements, [*batch, ...].
        mask: Elements with a row, in row-major order; only the number of axes is read if `is_dense`.
        is_dense: True = all elements have a row, so that the rows are a view of the values.
    """
    return values.flatten(0, mask.dim() - 1) if is_dense else values[mask]


def place_rows(rows: Tensor, mask: Bool[Tensor, "*batch"]) -> Tensor:
    """Rows at the True elements of a mask, [*batch, ...]; zeros elsewhere.

    Args:
        rows: Values [R, ...] of the elements with a True mask, or of all elements.
        mask: Elements with a row, in row-major order; only the shape is read if all elements have a row.
    """
    shape = (*mask.shape, *rows.shape[1:])
    if len(rows) == mask.numel():
        return rows.view(shape)
    return rows.new_zeros(shape).masked_scatter(mask.view(*mask.shape, *[1] * (rows.dim() - 1)), rows)
