"""What the policy is held to: a frozen copy, the strength of the hold, and its slow drift after the policy."""

from dataclasses import dataclass

import torch
from torch import nn

from rlftsim.errors import ConfigError, require_positive


@dataclass(frozen=True)
class KlConfig:
    """Adaptive KL penalty (Ziegler et al., 2020) and the reference's drift."""

    target: float = 0.01
    """Nats per decision."""
    horizon: float = 5.0
    """Updates; the larger, the slower the penalty adapts."""
    initial_beta: float = 0.1
    min_beta: float = 1e-3
    max_beta: float = 1e3
    reference_asked: bool = True
    """With goals: the reference is asked what the policy is asked. False = nothing, so that it stays goal-free whatever it has learned."""
    reference_every: int = 500
    """Updates between two moves of the reference; 0 = never."""
    reference_share: float = 0.005
    """Alpha: how far the reference moves towards the policy."""

    def __post_init__(self) -> None:
        require_positive(self, ("target", "horizon"))
        if not 0 <= self.reference_share <= 1 or self.reference_every < 0:
            raise ConfigError(f"kl.reference_share is a share and kl.reference_every not negative, got {self}.")
        if not 0 < self.min_beta <= self.initial_beta <= self.max_beta:
            raise ConfigError(f"need 0 < min_beta <= initial_beta <= max_beta, got {self}.")


def adapt_beta(beta: float, kl: float, config: KlConfig) -> float:
    """The penalty after an update with this KL: beta (1 + clip(KL / target - 1, -0.2, 0.2) / horizon), within its bounds."""
    error = min(max(kl / config.target - 1.0, -0.2), 0.2)
    return min(max(beta * (1.0 + error / config.horizon), config.min_beta), config.max_beta)


@torch.no_grad()
def move_reference(reference: nn.Module, policy: nn.Module, share: float) -> None:
    """Move the reference's weights towards the policy's, in place: share * policy + (1 - share) * reference."""
    for kept, new in zip(reference.parameters(), policy.parameters()):
        kept.lerp_(new, share)
