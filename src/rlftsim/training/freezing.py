"""Which weights a training trains, and how fast."""

from typing import Any, Literal

from torch import nn
from torch.optim import Optimizer

from rlftsim.errors import ConfigError

TrainedParts = Literal["decoder", "goals", "all"]


def freeze_untrained(policy: nn.Module, trained: TrainedParts) -> None:
    """Under "decoder" only the parts that a policy names for fine-tuning stay trainable; one that names none is trained whole. Under
    "goals" only the weights that see goals, so that whoever is asked nothing goes on deciding as before.

    Raises:
        ConfigError: no weights see goals.
    """
    if trained == "goals":
        parts = _goal_parts(policy)
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


def parameter_groups(model: nn.Module, goal_scale: float) -> list[dict[str, Any]]:
    """What is trained, as an optimiser takes it: the weights that see goals apart, their learning rate is scaled."""
    sight = [p for part in _goal_parts(model) for p in part.parameters() if p.requires_grad]
    ids = {id(p) for p in sight}
    others = [p for p in model.parameters() if p.requires_grad and id(p) not in ids]
    groups = [{"params": others, "scale": 1.0}, {"params": sight, "scale": goal_scale}]
    return [group for group in groups if group["params"]]


def _goal_parts(model: nn.Module) -> tuple[nn.Module, ...]:
    return model.goal_parts() if hasattr(model, "goal_parts") else ()  # type: ignore[operator]


def set_learning_rate(optimizer: Optimizer, value: float) -> None:
    """The learning rate of the next step: each group's by its scale, which is 1 where the optimiser was not built of `parameter_groups`."""
    for group in optimizer.param_groups:
        group["lr"] = value * group.get("scale", 1.0)
