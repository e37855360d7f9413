"""Data sets and policies by name, and the forms in which public functions take scenarios and policies."""

import os
from typing import Any

import torch

from rlftsim.errors import ConfigError, in_short
from rlftsim.policies import registry
from rlftsim.policies.registry import Device
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.any_form import Name, to_scenarios
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.open import open_dataset


def load_dataset(name: Name, split: str | None = None) -> ScenarioDataset:
    """Open a converted data set, or the one that ships with the package.

    Args:
        name: folder of a data set that `rlftsim convert` or `write_dataset` wrote, or "synthetic".
        split: such as "training" or "validation"; None opens all splits.

    Returns:
        Scenarios by position; `by_id` finds one by its id.

    Raises:
        DataError: no data set there, or none of its scenarios is in the split; the message lists its splits.
    """
    return open_dataset(require_name(name, "data set", "synthetic"), split)


def load_policy(name: Name, device: Device = "auto") -> Policy:
    """Load a policy that is ready to simulate: no dropout, no gradients.

    Args:
        name: folder of a run or of a model, or the name of a policy such as "constant_velocity".
        device: "cpu", "cuda", or "auto" for the GPU where torch sees one.

    Raises:
        ConfigError: neither a known name nor a folder, or no such device.
        CheckpointError: a folder that is damaged or holds something else.
    """
    return registry.load_policy(require_name(name, "policy", "constant_velocity"), device)


def require_name(name: Any, thing: str, example: str) -> Any:
    """A name or path as it is.

    Args:
        name: anything.
        thing: the kind of thing that has the name, for the message.
        example: a name that there is.

    Raises:
        ConfigError: neither text nor a path.
    """
    if not isinstance(name, str | os.PathLike):
        raise ConfigError(f"{in_short(name)} is no name of a {thing}: give one, such as {example!r}.")
    return name


def policy_of(policy: Any) -> Policy:
    """The policy itself, or the one of a name.

    Raises:
        ConfigError: neither a policy nor a name of one.
    """
    if isinstance(policy, str | os.PathLike):
        return load_policy(policy)
    # A class has the methods of its policies, so it would pass for one.
    if isinstance(policy, type):
        raise ConfigError(
            f"{policy.__name__} is a class, not a policy: make one, or load one with rs.load_policy(name)."
        )
    if not isinstance(policy, Policy):
        raise ConfigError(f"{in_short(policy)} is not a policy: hand over one, or a name for rs.load_policy.")
    return policy


def batch_of(scenarios: Any, device: torch.device | str = "cpu") -> ScenarioBatch:
    """Batch of scenarios; a batch stays as it is but for the device.

    Args:
        scenarios: in any form.
        device: place of the tensors.

    Raises:
        ConfigError: there is none, or something else was handed over.
        DataError: no data set of this name, or an unsound scenario.
    """
    found = to_scenarios(scenarios)
    if not isinstance(scenarios, ScenarioBatch):
        scenarios = collate([found[position] for position in range(len(found))])
    return scenarios.to(device)
