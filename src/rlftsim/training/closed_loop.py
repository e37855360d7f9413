"""Imitation in closed loop: predictions along rollouts, with a target for each decision (CAT-K, goal relabelling)."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.rollout.policy import TokenPolicy
from rlftsim.rollout.rows import find_rows
from rlftsim.rollout.types import Rollouts


@runtime_checkable
class TokenLogits(Protocol):
    """The part of a distribution over tokens that imitation needs."""

    logits: Float[Tensor, "R V"]
    """Of the R elements where the mask is True, in the mask's order."""
    mask: Bool[Tensor, "B N A *L"]


@dataclass(frozen=True, eq=False)
class TargetedRollouts:
    """Rollouts with a target for each decision."""

    rollouts: Rollouts
    target: Int64[Tensor, "B N A L"]
    """Token that should have been chosen."""
    target_mask: Bool[Tensor, "B N A L"]
    """True = there is a target."""
    class_id: Int64[Tensor, "B A"]
    """Agent class that the token ids refer to."""


@dataclass(frozen=True, eq=False)
class ClosedLoopPrediction:
    """A policy's predictions along rollouts, as `imitation.Prediction`."""

    logits: Float[Tensor, "R V"]
    target: Int64[Tensor, "R"]
    target_mask: Bool[Tensor, "R"]
    class_id: Int64[Tensor, "R"]


def predict_targets(
    policy: TokenPolicy, context: Any, targeted: TargetedRollouts, trained: Bool[Tensor, "B A"]
) -> ClosedLoopPrediction:
    """Predictions along rollouts: differentiable, in a single parallel pass.

    Args:
        policy: the policy that rolled out.
        context: the policy's encoding of the same scenarios.
        targeted: the rollouts with targets.
        trained: True = the agent's decisions count.
    """
    dist: TokenLogits = policy.score(context, targeted.rollouts)  # type: ignore[assignment]
    counts = targeted.target_mask & targeted.rollouts.decision_mask & trained[:, None, :, None]  # [B, N, A, L]
    class_id = targeted.class_id[:, None, :, None].expand(counts.shape)
    # The distribution has a row for each element of its mask only: pick the same ones, in the same order.
    rows = find_rows(dist.mask, is_dense=len(dist.logits) == dist.mask.numel())
    return ClosedLoopPrediction(dist.logits, *(values[rows] for values in (targeted.target, counts, class_id)))
