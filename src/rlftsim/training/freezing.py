"""Which weights a fine-tuning trains."""

from typing import Literal

from torch import nn

from rlftsim.errors import ConfigError

TrainedParts = Literal["decoder", "goals", "all"]


def freeze_untrained(policy: nn.Module, trained: TrainedParts) -> None:
    """Under "decoder" only the parts that a policy names for fine-tuning stay trainable; one that names none is trained whole. Under
    "goals" only the weights that see goals, so that whoever is asked nothing goes on deciding as before.

    Raises:
        ConfigError: no weights see goals.
    """
    if trained == "goals":
        parts = policy.goal_parts() if hasattr(policy, "goal_parts") else ()  # type: ignore[operator]
        if not parts:
            raise ConfigError(
                "trained=goals, but this model does not see goals: add --goal concat or --goal indication."
            )
    else:
        named = getattr(policy, "fine_tuned_parts", None)
        parts = (policy,) if trained == "all" or named is None else named()
    policy.requires_grad_(False)
    for part in parts:
        part.requires_grad_(True)
