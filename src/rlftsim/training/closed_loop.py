"""Imitation in closed loop: what a policy says along its own rollouts beside what it should have said. CAT-K and `gcsl` share it."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.rollout.policy import Policy
from rlftsim.rollout.types import Rollouts
from rlftsim.tokens.vocabulary import Vocabulary


@runtime_checkable
class TokenPolicy(Policy, Protocol):
    """A policy whose decisions are tokens of a vocabulary."""

    vocabulary: Vocabulary


@runtime_checkable
class TokenLogits(Protocol):
    """What imitation needs of a distribution over tokens (a dataclass): logits of the R elements where the mask is True, in the mask's
    order."""

    logits: Float[Tensor, "R V"]
    mask: Bool[Tensor, "B N A *L"]


@dataclass(frozen=True, eq=False)
class TargetedRollouts:
    """Rollouts and what should have been decided in them."""

    rollouts: Rollouts
    target: Int64[Tensor, "B N A L"]
    target_mask: Bool[Tensor, "B N A L"]
    """True = there is something to be learned."""
    class_id: Int64[Tensor, "B A"]
    """Whose tokens an agent takes."""


@dataclass(frozen=True, eq=False)
class ClosedLoopPrediction:
    """What a policy says along its own rollouts, and what it should have said."""

    logits: Float[Tensor, "R V"]
    target: Int64[Tensor, "R"]
    target_mask: Bool[Tensor, "R"]
    class_id: Int64[Tensor, "R"]


def predict_along(
    policy: TokenPolicy, context: Any, rolled: TargetedRollouts, trained: Bool[Tensor, "B A"]
) -> ClosedLoopPrediction:
    """Predictions along rollouts: differentiable, one parallel pass.

    Args:
        policy: the policy that rolled out.
        context: its view of the same scenarios.
        rolled: the rollouts and their targets.
        trained: True = the agent's decisions count.
    """
    scored: TokenLogits = policy.score(context, rolled.rollouts)  # type: ignore[assignment]
    counts = rolled.target_mask & rolled.rollouts.decision_mask & trained[:, None, :, None]
    class_id = rolled.class_id[:, None, :, None].expand(counts.shape)
    parts = (values[scored.mask] for values in (rolled.target, counts, class_id))
    return ClosedLoopPrediction(scored.logits, *parts)
