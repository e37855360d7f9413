"""The weights that a training method trains, and the learning rates."""

import copy
from typing import Any, Literal

from torch import nn
from torch.optim import Optimizer

from rlftsim.errors import ConfigError
from rlftsim.rollout.noise import draw_noise
from rlftsim.rollout.policy import PolicyWithHead, get_device, is_goal_conditioned
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import Scenario
from rlftsim.training.goals import not_conditioned

TrainedModules = Literal["decoder", "head", "goals", "all"]


def select_trained_modules(policy: nn.Module, trained: TrainedModules) -> tuple[nn.Module, ...]:
    """The parts of a policy that are trained.

    Args:
        policy: Policy that may name its modules for fine-tuning.
        trained: "decoder" = the parts that the policy names in `fine_tuned_modules`, the whole policy where no modules
            are named. "head" = the last layers, which the policy names in `head_modules`. "goals" = the goal encoder
            only, so that agents without a goal go on deciding as before. "all" = the whole policy.

    Raises:
        ConfigError: the policy is not goal-conditioned, has no part that only goals use, or names no head.
    """
    if trained == "goals":
        modules = _goal_modules(policy)
        if not modules and is_goal_conditioned(policy):
            raise ConfigError(
                f"trained=goals, but {type(policy).__name__} has no part that only goals use: set trained=all."
            )
        if not modules:
            raise ConfigError(f"trained=goals, but {not_conditioned(policy)}")
    elif trained == "head":
        if not isinstance(policy, PolicyWithHead):
            raise ConfigError(f"trained=head, but {type(policy).__name__} names no head_modules: set trained=decoder.")
        modules = policy.head_modules()
    else:
        named = getattr(policy, "fine_tuned_modules", None)
        modules = (policy,) if trained == "all" or named is None else named()
    return modules


def freeze_untrained(policy: nn.Module, trained: TrainedModules) -> None:
    """Require a gradient of the weights that are trained, and of no other weights.

    Args:
        policy: Policy whose weights are frozen or released in place.
        trained: see `select_trained_modules`.

    Raises:
        ConfigError: of `select_trained_modules`.
    """
    modules = select_trained_modules(policy, trained)
    # First nothing, then the parts: a run that trained other parts before leaves no trace.
    policy.requires_grad_(False)
    for module in modules:
        module.requires_grad_(True)


def check_entropy(policy: nn.Module, scenario: Scenario, trained: TrainedModules) -> None:
    """Refuse an entropy bonus for a policy with an entropy that no trained weight moves, such as one with fixed noise.

    Args:
        policy: Policy to try, of which a copy decides.
        scenario: Scenario in which the policy decides once.
        trained: see `select_trained_modules`.

    Raises:
        ConfigError: the entropy of the decisions has no gradient.
    """
    tried: Any = copy.deepcopy(policy).eval()
    freeze_untrained(tried, trained)
    batch = collate([scenario]).to(get_device(tried))
    context = tried.encode(batch)
    noise = draw_noise(batch, range(1), seed=0, purpose="begin", per_agent=tried.initial_noise_size)
    if not tried.decide(context, tried.begin(context, 1, None, noise)).entropy().requires_grad:
        raise ConfigError(
            "finetune.entropy_bonus has no effect: the entropy of this policy's decisions depends on no trained "
            "weight, set it to 0."
        )


def parameter_groups(model: nn.Module, goal_scale: float) -> list[dict[str, Any]]:
    """The weights that require a gradient, as groups for an optimizer: the goal encoder apart from all other weights.

    Args:
        model: Model whose untrained weights `freeze_untrained` has frozen.
        goal_scale: learning rate of the goal encoder over the rate of all other weights.
    """
    goal_weights = [p for module in _goal_modules(model) for p in module.parameters() if p.requires_grad]
    # By identity: comparing tensors would compare their values.
    ids = {id(p) for p in goal_weights}
    base_weights = [p for p in model.parameters() if p.requires_grad and id(p) not in ids]
    groups = [{"params": base_weights, "scale": 1.0}, {"params": goal_weights, "scale": goal_scale}]
    # AdamW refuses a group without parameters.
    return [group for group in groups if group["params"]]


def _goal_modules(model: nn.Module) -> tuple[nn.Module, ...]:
    return model.goal_modules() if hasattr(model, "goal_modules") else ()  # type: ignore[operator]


def set_learning_rate(optimizer: Optimizer, value: float) -> None:
    """Set the learning rate of the next step.

    Args:
        optimizer: Groups may have a "scale", see `parameter_groups`; the default is 1.
        value: learning rate of a group with scale 1.
    """
    for group in optimizer.param_groups:
        group["lr"] = value * group.get("scale", 1.0)
