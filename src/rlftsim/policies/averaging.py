"""Averages of policies that were trained from the same base.

    runs = [load_policy(f"runs/mloo-{seed}") for seed in range(3)]
    average_policies(runs).save_pretrained("runs/average")

Fine-tuning runs with different seeds learn the same from the reward and differ by the noise of the gradients. The mean
of the weights has less of this noise, about as little as with a batch as many times larger.
"""

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from rlftsim.errors import ConfigError
from rlftsim.policies.calibrated.policy import CalibratedPolicy, add_features, average_calibrations
from rlftsim.rollout.fingerprint import fingerprint_policy


def average_policies(policies: Sequence[Any], *, base: Any = None, scale: float = 1.0) -> Any:
    """A new policy with the mean weights of policies: base + scale (mean - base).

    Args:
        policies: Policies of a single architecture, with the same settings and vocabulary; left unchanged.
        base: Policy that all were fine-tuned from; only needed with a scale.
        scale: Length of the step from the base to the mean; above 1 goes further than the policies did, in the
            direction that all share.

    Raises:
        ConfigError: There are no policies, or policies that differ in more than the weights; a scale without a base, or
            a scale with which a weight is not finite.

    Source: model soups, arXiv 2203.05482; with a scale task arithmetic, arXiv 2212.04089.
    """
    if not policies:
        raise ConfigError("an average needs at least one policy.")
    if not math.isfinite(scale):
        raise ConfigError(f"scale is a finite number, got {scale}.")
    if scale != 1.0 and base is None:
        raise ConfigError(f"scale={scale:g} needs the base that the policies were fine-tuned from.")
    first = policies[0]
    if isinstance(first, CalibratedPolicy) and base is not None and not isinstance(base, CalibratedPolicy):
        base = add_features(base, first.features).to(first.eta.device)  # with weights of 0
    for number, policy in enumerate(policies, 1):
        _check_same_settings(first, policy, f"policy {number} of {len(policies)}")
    if base is not None:
        _check_same_settings(first, base, "the base")
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
    if isinstance(average, CalibratedPolicy):
        accounts = [policy.calibration for policy in policies]
        average.set_calibration(average.eta, average_calibrations(accounts, scale, average.eta.tolist()))
    return average


def _check_same_settings(first: Any, policy: Any, name: str) -> None:
    """Check that a policy, under a name for the message, differs from the first in no more than the weights."""
    if not isinstance(policy, nn.Module):
        raise ConfigError(f"{name} is a {type(policy).__name__} and has no weights to average.")
    expected_shapes, shapes = ({k: v.shape for k, v in p.state_dict().items()} for p in (first, policy))
    if shapes == expected_shapes:
        # with the same weights only settings, vocabulary, buffers and class are left to differ
        twin = copy.deepcopy(policy)
        twin.load_state_dict(dict(first.named_parameters()), strict=False)
        if fingerprint_policy(twin) == fingerprint_policy(first):
            return
    raise ConfigError(
        f"{name}, a {type(policy).__name__}, differs from the first in more than its weights: averages are of policies "
        "with one architecture, the same settings and the same vocabulary."
    )
