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


def load_policy(name: str, device: Device = "cpu") -> Policy:
    """A baseline by name, or a model folder as `save_pretrained` writes it (a run's folder will do).

    Raises:
        ConfigError: neither a known name nor a folder, or no such device.
        CheckpointError: a folder that is damaged or holds something else.
    """
    if name in NAMED:
        return NAMED[name]()
    if not Path(name).is_dir():
        raise ConfigError(f"{name!r} is neither a model folder nor one of {', '.join(NAMED)}.")
    return SmartPolicy.from_pretrained(find_model(name)).eval().requires_grad_(False).to(find_device(device))


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


def load_policy_or_oracle(name: str, device: Device = "cpu") -> Policy | Literal["oracle"]:
    """As `load_policy`; "oracle" stands for the record itself."""
    if name == "oracle":
        return "oracle"
    if name not in NAMED and not Path(name).is_dir():
        raise ConfigError(f"{name!r} is neither a model folder nor one of {', '.join([*NAMED, 'oracle'])}.")
    return load_policy(name, device)


def find_device(device: Device) -> torch.device:
    """What a name stands for on this machine.

    Raises:
        ConfigError: a GPU is asked for where there is none.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device cuda, but torch sees no CUDA device: use cpu, or install a CUDA build of torch.")
    return torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
