"""Policies by name: from a registered name, a model folder or a run's folder to a policy.

Another package adds an architecture with an entry point, and then all commands take folders of that architecture:

    [project.entry-points."rlftsim.policies"]
    cruise = "cruise_package:Cruise"
"""

import difflib
import inspect
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import nn

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint
from rlftsim.policies import SHIPPED_POLICIES
from rlftsim.policies.checkpoint import find_similar_model, read_model
from rlftsim.policies.hub import is_hub_url
from rlftsim.rollout.policy import LoadablePolicy, Policy

POLICIES: ExtensionPoint[Callable[..., Any]] = ExtensionPoint(
    "policy",
    "rlftsim.policies",
    SHIPPED_POLICIES,
    use=lambda name: load_policy(name) if needs_no_arguments(POLICIES.get(name)) else _loadable(name),
)
"""Architecture name -> policy class. A class that can be called without arguments is a policy by its name alone."""

Device = Literal["auto", "cpu", "cuda"]
"""auto = the GPU where torch sees a GPU."""


def load_policy(name: str | os.PathLike, device: Device = "cpu") -> Policy:
    """Policy of a name, in evaluation mode and with frozen weights.

    Args:
        name: Registered name ("constant_velocity"), model folder as `save_pretrained` writes, a run's folder, or
            hf://USER/NAME[@REVISION].
            Where a folder is named like a registered policy, "./name" is the folder.
        device: Device of the weights; a policy without weights takes the batch's device.

    Raises:
        ConfigError: The name is neither registered nor a folder, the policy of the name needs weights, or there is no
            such device.
        CheckpointError: The folder is damaged or holds no policy.
    """
    return _load(name, device)


def load_policy_or_oracle(name: str | os.PathLike, device: Device = "cpu") -> Policy | Literal["oracle"]:
    """As `load_policy`; "oracle" stands for the logged futures themselves.

    Args:
        name: "oracle", or a registered name, model folder or run's folder.
        device: Device of the weights; the log has none.

    Raises:
        ConfigError: The name stands for no policy, the policy of the name needs weights, or there is no such device.
        CheckpointError: The folder is damaged or holds no policy.
    """
    return "oracle" if name == "oracle" else _load(name, device, "oracle")


def _load(name: str | os.PathLike, device: Device, *extra_names: str) -> Policy:
    """`load_policy`, offering `extra_names` where a name is unknown."""
    torch_device = find_device(device)  # first, so that a policy without weights refuses a wrong word, too
    # anything with a separator is a path: no entry point of another package is imported for it
    registered = POLICIES.find(name) if isinstance(name, str) and Path(name).name == name else None
    if registered is not None and needs_no_arguments(registered):
        try:
            policy = registered()
        except SystemExit as stop:  # it would end the command, with exit() even as if all were done
            raise ConfigError(f"policy {name!r} calls exit({stop.code!r}) when it is made: let it raise.") from stop
    elif is_hub_url(name) or Path(name).expanduser().exists():
        # a folder; a file is refused by name
        stored = read_model(name)
        policy = _loadable(stored.architecture).from_pretrained(stored.folder)
    elif registered is not None:
        raise ConfigError(f"policy {name!r} needs its weights: name a model folder or a run's folder instead.")
    elif name == "oracle" and not extra_names:
        raise ConfigError("'oracle' stands for the log itself and is no policy: only evaluate takes it.")
    else:
        # names that are policies by themselves: an architecture that needs weights is no answer
        names = [name for name in POLICIES.names() if needs_no_arguments(POLICIES.get(name))]
        names += extra_names
        matches = difflib.get_close_matches(str(name), names, n=1)
        match = matches[0] if matches else find_similar_model(Path(name).expanduser())
        is_hub_id = re.fullmatch(r"\w[\w.-]*/[\w.-]+", str(name)) and not Path(name).parent.exists()
        if match == str(name):
            raise ConfigError(f"{match!r} is no folder: write one, rs.load_policy({match!r}).save_pretrained(FOLDER).")
        hint = f": did you mean {match!r}?" if match else f": on Hugging Face it is hf://{name}" if is_hub_id else "."
        raise ConfigError(f"{str(name)!r} is neither a model folder nor one of {', '.join(names)}{hint}")
    # A class has its instances' attributes, so a function that returns one would pass for a policy.
    if not isinstance(policy, Policy) or isinstance(policy, type):
        cls = policy if isinstance(policy, type) else type(policy)
        raise ConfigError(
            f"policy {str(name)!r} is a {cls.__name__} without what a policy needs: five methods and three numbers, "
            "see rlftsim.rollout.policy.Policy."
        )
    if isinstance(policy, nn.Module):
        policy.eval().requires_grad_(False).to(torch_device)
    return policy


def _loadable(architecture: str) -> LoadablePolicy:
    """Class that reads the model folders of an architecture."""
    cls = POLICIES.get(architecture)
    if not isinstance(cls, LoadablePolicy):
        raise ConfigError(
            f"policy {architecture!r} cannot be read from a folder: "
            "give its class an attribute architecture and a classmethod from_pretrained(folder)."
        )
    return cls


def needs_no_arguments(make: Any) -> bool:
    """True for what makes a policy without a folder: a policy by its name alone."""
    try:
        inspect.signature(make).bind()
    except (TypeError, ValueError):  # ValueError: built-in classes and functions may have no signature
        return False
    return True


def with_guidance(policy: Policy | Literal["oracle"], scale: float) -> Any:
    """Copy of a policy that follows goals more closely than was learned; the same policy at 1.

    Args:
        policy: Policy of any class, or "oracle"; a scale other than 1 needs a method `with_guidance`.
        scale: Factor of the pull towards goals, as in `SmartPolicy.with_guidance`.

    Raises:
        ConfigError: The policy has nothing that could be scaled, or `scale` is no number of 0 or more.
    """
    if scale == 1.0:
        return policy
    guided = getattr(policy, "with_guidance", None)
    if guided is None:
        raise ConfigError(f"guidance_scale={scale:g} has no effect: this model has no goal logit bias, leave it out.")
    return guided(scale)


def find_device(device: Device) -> torch.device:
    """Device that a name stands for on this machine.

    Args:
        device: Name "cpu", "cuda", or "auto" for the GPU where torch sees a GPU.

    Raises:
        ConfigError: There is no such name, or "cuda" where there is no CUDA device.
    """
    if device not in get_args(Device):
        raise ConfigError(f"device must be one of {', '.join(get_args(Device))}, got {device!r}.")
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device=cuda, but torch sees no CUDA device: use cpu, or install a CUDA build of torch.")
    return torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
