"""Averages of policies that were trained from one base.

    runs = [load_policy(f"runs/mloo-{seed}") for seed in range(3)]
    average_policies(runs).save_pretrained("runs/average")

Fine-tuning runs with different seeds share what their reward teaches and differ by the noise of their gradients, which
the mean of their weights has less of: about what a batch as many times larger would give.
"""

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from rlftsim.errors import ConfigError
from rlftsim.rollout.fingerprint import fingerprint_policy


def average_policies(policies: Sequence[Any], *, base: Any = None, scale: float = 1.0) -> Any:
    """A new policy with the mean weights of others: base + scale (mean - base).

    Args:
        policies: of one architecture, with the same settings and vocabulary; they are left as they are.
        base: policy that they were fine-tuned from; only needed with a scale.
        scale: above 1 goes further from the base than the policies did, along what they share.

    Raises:
        ConfigError: none, or policies that differ in more than their weights; a scale without a base, or with which a
            weight is not finite.

    Source: model soups, arXiv 2203.05482; with a scale task arithmetic, arXiv 2212.04089.
    """
    if not policies:
        raise ConfigError("an average needs at least one policy.")
    if not math.isfinite(scale):
        raise ConfigError(f"scale is a finite number, got {scale}.")
    if scale != 1.0 and base is None:
        raise ConfigError(f"scale={scale:g} needs the base that the policies were fine-tuned from.")
    first = policies[0]
    for place, other in enumerate(policies, 1):
        _require_same_kind(first, other, f"policy {place} of {len(policies)}")
    if base is not None:
        _require_same_kind(first, base, "the base")
    average = copy.deepcopy(first)
    originals = [dict(policy.named_parameters()) for policy in policies]
    start = dict((first if base is None else base).named_parameters())
    with torch.no_grad():
        for name, weight in average.named_parameters():
            # in float64, so that the mean of equal weights is that weight
            mean = torch.stack([weights[name].double() for weights in originals]).mean(0)
            origin = start[name].double()
            weight.copy_(mean if scale == 1.0 else origin + scale * (mean - origin))
            if not weight.isfinite().all():
                raise ConfigError(f"{name} is not finite in the average with scale={scale:g}.")
    return average


def _require_same_kind(first: Any, other: Any, name: str) -> None:
    """Refuse a policy that differs from the first one in more than its weights, under its name in the message."""
    if not isinstance(other, nn.Module):
        raise ConfigError(f"{name} is a {type(other).__name__} and has no weights to average.")
    shapes, found = ({k: v.shape for k, v in policy.state_dict().items()} for policy in (first, other))
    if shapes == found:
        # with the same weights only settings, vocabulary, buffers and class are left to differ
        twin = copy.deepcopy(other)
        twin.load_state_dict(dict(first.named_parameters()), strict=False)
        if fingerprint_policy(twin) == fingerprint_policy(first):
            return
    raise ConfigError(
        f"{name}, a {type(other).__name__}, differs from the first in more than its weights: averages are of policies "
        "with one architecture, the same settings and the same vocabulary."
    )
