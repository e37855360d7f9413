"""Which weights a fine-tuning trains."""

from typing import Literal

from torch import nn

TrainedParts = Literal["decoder", "all"]


def freeze_untrained(policy: nn.Module, trained: TrainedParts) -> None:
    """Under "decoder" only the parts that a policy names for fine-tuning stay trainable; one that names none is trained whole."""
    parts = getattr(policy, "fine_tuned_parts", None)
    policy.requires_grad_(trained == "all" or parts is None)
    for part in parts() if parts and trained == "decoder" else ():
        part.requires_grad_(True)
