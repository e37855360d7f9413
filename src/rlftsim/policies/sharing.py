"""Networks that two models have in common, so that a single result serves both models."""

from collections.abc import Iterable

import torch
from torch import Tensor


def are_frozen_alike(weights: Iterable[Tensor], reference: Iterable[Tensor]) -> bool:
    """True if the weights of two models are equal, and no weight requires a gradient.

    Args:
        weights: Weights of the first model.
        reference: Weights of the second model, in the same order and of the same shapes.
    """
    pairs = list(zip(weights, reference, strict=True))
    if any(weight.requires_grad for pair in pairs for weight in pair):
        return False
    # a single tensor, which the host waits for once
    differs = [(weight != counterpart).any() for weight, counterpart in pairs if weight is not counterpart]
    return not differs or not bool(torch.stack(differs).any())
