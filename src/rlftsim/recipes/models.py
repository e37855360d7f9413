"""From a name or a folder to a policy."""

from pathlib import Path
from typing import Literal

import torch

from rlftsim.errors import ConfigError
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.policy import Policy

NAMED = {"constant_velocity": ConstantVelocity}

Device = Literal["auto", "cpu", "cuda"]
"""auto = the GPU where torch sees one."""


def load_policy(name: str, device: Device = "cpu", *, goal_guidance: float = 1.0) -> Policy:
    """A baseline by name, or a model folder as `save_pretrained` writes it (a run's folder will do).

    Args:
        name: of a baseline or a folder.
        device: where it is to be.
        goal_guidance: how many times its aim counts, see `SmartPolicy.guided`.

    Raises:
        ConfigError: neither a known name nor a folder, no such device, or guidance for who has no aim.
        CheckpointError: a folder that is damaged or holds something else.
    """
    if name in NAMED and goal_guidance != 1.0:
        raise ConfigError(f"goal_guidance={goal_guidance:g} has no effect: {name} does not aim at goals, leave it out.")
    if name in NAMED:
        return NAMED[name]()
    if not Path(name).is_dir():
        raise ConfigError(f"{name!r} is neither a model folder nor one of {', '.join(NAMED)}.")
    policy = SmartPolicy.from_pretrained(find_model(name)).guided(goal_guidance)
    return policy.eval().requires_grad_(False).to(find_device(device))


def find_model(name: str) -> Path:
    """The model folder of a name: itself, or the one inside a run's folder.

    Raises:
        ConfigError: there is no such folder.
    """
    folder = Path(name)
    if (folder / "model" / "config.json").exists():
        folder = folder / "model"
    if not folder.is_dir():
        raise ConfigError(f"{name!r} is no model folder: there is none of that name.")
    return folder


def load_policy_or_oracle(
    name: str, device: Device = "cpu", *, goal_guidance: float = 1.0
) -> Policy | Literal["oracle"]:
    """As `load_policy`; "oracle" stands for the record itself."""
    if name == "oracle" and goal_guidance != 1.0:
        raise ConfigError(
            f"goal_guidance={goal_guidance:g} has no effect: the record does not aim at goals, leave it out."
        )
    if name == "oracle":
        return "oracle"
    if name not in NAMED and not Path(name).is_dir():
        raise ConfigError(f"{name!r} is neither a model folder nor one of {', '.join([*NAMED, 'oracle'])}.")
    return load_policy(name, device, goal_guidance=goal_guidance)


def find_device(device: Device) -> torch.device:
    """What a name stands for on this machine.

    Raises:
        ConfigError: a GPU is asked for where there is none.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device cuda, but torch sees no CUDA device: use cpu, or install a CUDA build of torch.")
    return torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
