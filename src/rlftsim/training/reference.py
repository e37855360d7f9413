"""The reference of fine-tuning: a frozen copy of the policy, the KL penalty towards the copy, and the slow sync."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from rlftsim.errors import ConfigError, check_positive, check_types
from rlftsim.training.alarms import Alarms
from rlftsim.training.goals import StoredGoals
from rlftsim.training.method import Learner


@dataclass(frozen=True)
class KlConfig:
    """Adaptive KL penalty (Ziegler et al., 2020), and how the reference follows the policy."""

    target: float = 0.01
    """KL that the penalty is adapted to, nats per decision."""
    horizon: float = 5.0
    """Updates; the larger, the slower the penalty adapts."""
    initial_beta: float = 0.1
    """Strength of the penalty at the start."""
    min_beta: float = 1e-3
    """Lower bound of the strength."""
    max_beta: float = 1e3
    """Upper bound of the strength."""
    condition_reference: bool = True
    """With goals: the reference has the same goals as the policy. False = none, so that it stays goal-free even
    if it is goal-conditioned."""
    reference_sync_every: int = 500
    """Updates between two syncs of the reference with the policy; 0 = never."""
    reference_ema: float = 0.005
    """Alpha: weight of the policy in a sync, reference = alpha * policy + (1 - alpha) * reference."""

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(self, ("target", "horizon"))
        if not 0 <= self.reference_ema <= 1 or self.reference_sync_every < 0:
            raise ConfigError(f"need 0 <= kl.reference_ema <= 1 and kl.reference_sync_every >= 0, got {self}.")
        if not 0 < self.min_beta <= self.initial_beta <= self.max_beta:
            raise ConfigError(f"need 0 < min_beta <= initial_beta <= max_beta, got {self}.")


@dataclass(eq=False, kw_only=True)
class RewardLearner(Learner):
    """A policy in fine-tuning with the frozen reference, the KL penalty's strength and the alarms."""

    reference: Any
    beta: float
    augmented_goals: StoredGoals | None = None
    """Goals beside the logged endpoints."""
    alarms: Alarms = field(default_factory=Alarms)
    warned_terms: set[str] = field(default_factory=set)
    """Terms of the reward that a message has called not finite."""

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Modules that a checkpoint holds: the policy and the reference."""
        return {"policy": self.policy, "reference": self.reference}

    def to_numbers(self) -> dict[str, float]:
        """Beta and the alarms' running means."""
        return {"beta": self.beta, **self.alarms.to_numbers()}

    def load_numbers(self, numbers: Mapping[str, float]) -> None:
        """Take back beta and the alarms' running means."""
        self.beta = numbers["beta"]
        self.alarms.load_numbers(numbers)


def adapt_beta(beta: float, kl: float, config: KlConfig) -> float:
    """Strength of the penalty after an update, within bounds: beta (1 + clip(KL/target - 1, -0.2, 0.2) / horizon).

    Args:
        beta: strength during the update.
        kl: KL of the update, nats per decision.
        config: target, horizon and bounds.
    """
    # Clipped, so that one wild update moves beta by at most 0.2 / horizon.
    error = min(max(kl / config.target - 1.0, -0.2), 0.2)
    return min(max(beta * (1.0 + error / config.horizon), config.min_beta), config.max_beta)


@torch.no_grad()
def sync_reference(reference: nn.Module, policy: nn.Module, alpha: float) -> None:
    """Move the reference's weights towards the policy's, in place: alpha * policy + (1 - alpha) * reference.

    Args:
        reference: Reference, moved in place towards the policy.
        policy: has the same parameters in the same order.
        alpha: Weight of the policy, in [0, 1].
    """
    for old, new in zip(reference.parameters(), policy.parameters()):
        old.lerp_(new, alpha)
