"""Square roots rounded as IEEE 754 requires, which a CPU's vector library does not always do."""

import torch
from jaxtyping import Float
from torch import Tensor


def compute_sqrt(values: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Square root of float32 values, correctly rounded.

    `Tensor.sqrt` may be off by the last bit once in two hundred values. Next to a state that jumps by kilometers,
    which the official metric does read, that bit is 1 mm/s of speed and 1 cm/s² of acceleration.
    """
    # The root of a float32 number is never near enough to the middle of two float32 numbers to be rounded twice.
    return values.double().sqrt_().to(values.dtype)


def compute_largest_square(root: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """The largest float32 number with a correctly rounded square root equal to `root`."""
    # Roots up to the midpoint of `root` and the next float32 number round to `root`; its square is exact in float64.
    next_number = torch.nextafter(root, torch.full_like(root, torch.inf))
    bound = ((root.double() + next_number.double()) / 2).square_()
    square = bound.to(root.dtype)
    return torch.where(square.double() > bound, torch.nextafter(square, torch.zeros_like(square)), square)
