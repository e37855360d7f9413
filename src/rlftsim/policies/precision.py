"""Precision of network outputs that must not be as coarse as mixed precision makes them."""

import torch
from jaxtyping import Float
from torch import Tensor


def at_least_float32(x: Float[Tensor, "*g"]) -> Float[Tensor, "*g"]:
    """The same numbers, in float32 where autocast has made a coarser type of the input."""
    return x.to(torch.promote_types(x.dtype, torch.float32))
