"""Parts that two models compute alike, so that one result serves both."""

from collections.abc import Iterable

import torch
from torch import Tensor


def are_frozen_alike(own: Iterable[Tensor], others: Iterable[Tensor]) -> bool:
    """True if the weights of two models are equal, and none of them requires a gradient.

    Args:
        own: weights of one model.
        others: those of the other, in the same order and of the same shapes.
    """
    pairs = list(zip(own, others, strict=True))
    if any(weight.requires_grad for pair in pairs for weight in pair):
        return False
    # one answer, which the host waits for once
    differs = [(mine != theirs).any() for mine, theirs in pairs if mine is not theirs]
    return not differs or not bool(torch.stack(differs).any())
