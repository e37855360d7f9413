"""Square roots rounded as IEEE 754 asks, which a CPU's vector library does not always do."""

import torch
from jaxtyping import Float
from torch import Tensor


def compute_sqrt(values: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Square root of float32 values, correctly rounded.

    `Tensor.sqrt` may be off by the last bit in one value of two hundred. Next to a state that jumps by kilometres, which
    the official metric does read, that bit is a millimetre per second of speed and a centimetre of acceleration.
    """
    # The root of a float32 number is never near enough to the middle of two float32 numbers to be rounded twice.
    return values.double().sqrt_().to(values.dtype)


def compute_largest_square(root: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """The largest float32 number whose correctly rounded square root is still `root`."""
    above = torch.nextafter(root, torch.full_like(root, torch.inf))
    bound = ((root.double() + above.double()) / 2).square_()
    square = bound.to(root.dtype)
    return torch.where(square.double() > bound, torch.nextafter(square, torch.zeros_like(square)), square)
