"""Data sets and policies by name, the forms in which verbs take both, and wrong arguments refused in one line."""

import difflib
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch

from rlftsim.errors import ConfigError, in_short
from rlftsim.evaluation.evaluate import evaluation_name
from rlftsim.policies import registry
from rlftsim.policies.registry import Device
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, Sampling
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.open import Name, open_dataset, to_scenarios
from rlftsim.training.config import FinetuneConfig, PretrainConfig
from rlftsim.verbs.commands import UNCHECKED

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")

SECTIONS = {"finetune": FinetuneConfig, "pretrain": PretrainConfig}
"""Settings that a verb takes as `config`, by the name of verb and section."""
LOADED = "_loaded"
"""Attribute of a loaded policy: its name, and its fingerprint then."""


def with_checked_arguments(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Decorator of a function `rs.NAME`: wrong names and numbers of arguments are refused by a ConfigError.

    Args:
        function: Function that users call.
    """
    expected = inspect.signature(function)

    @wraps(function)
    def call(*arguments: Parameters.args, **options: Parameters.kwargs) -> Returned:
        try:
            expected.bind(*arguments, **options)
        except TypeError as error:
            unknown = next((name for name in options if name not in expected.parameters), None)
            cause = str(error) if unknown is None else f"no argument {unknown!r}"
            way_out = _find_way_out(function.__name__, unknown or "", expected.parameters)
            raise ConfigError(f"rs.{function.__name__}: {cause}: {way_out}") from None
        return function(*arguments, **options)

    UNCHECKED[call] = function
    return call


def _find_way_out(verb: str, name: str, parameters: Mapping[str, Any]) -> str:
    """What to write in place of an unknown argument."""
    is_sampling = name in {field.name for field in fields(Sampling)}
    if is_sampling and "sampling" in parameters:
        return f"write sampling=rs.Sampling({name}=...)."
    if is_sampling and "policy" in parameters:
        return f"set policy.sampling = rs.Sampling({name}=...) before."
    if verb in SECTIONS and name in {field.name for field in fields(SECTIONS[verb])}:
        return f"write config=dataclasses.replace(rs.recipe('smart-demo').{verb}, {name}=...)."
    near = difflib.get_close_matches(name, parameters, n=1)
    return f"did you mean {near[0]}?" if near else f"the arguments are {', '.join(parameters)}."


@with_checked_arguments
def load_dataset(name: Name, split: str | None = None) -> ScenarioDataset:
    """Open a converted data set, or the one that ships with the package.

    Args:
        name: Folder of a data set that `rlftsim convert` or `write_dataset` wrote, or "synthetic".
        split: Split to open, such as "training" or "validation"; None opens all splits.

    Returns:
        Scenarios by position; `by_id` finds one by its id.

    Raises:
        DataError: No data set there, or none of its scenarios is in the split; the message lists its splits.
    """
    return open_dataset(validate_name(name, "data set", "synthetic"), split)


@with_checked_arguments
def load_policy(name: Name, device: Device = "auto") -> Policy:
    """Load a policy that is ready to simulate: no dropout, no gradients.

    Args:
        name: Folder of a run or of a model, or name of a policy such as "constant_velocity".
        device: Device of the weights: "cpu", "cuda", or "auto" for the GPU where torch sees one.

    Raises:
        ConfigError: Neither a registered name nor a folder, or no such device.
        CheckpointError: A folder that is damaged or holds something else.
    """
    policy = registry.load_policy(validate_name(name, "policy", "constant_velocity"), device)
    remember_name(policy, name)
    return policy


def remember_name(policy: Policy, name: Name) -> None:
    """Keep the name that a policy can be loaded by, for `find_policy_name`.

    Args:
        policy: Policy as it is loaded.
        name: Folder or registered name.
    """
    with suppress(AttributeError):  # some classes take no further attributes
        setattr(policy, LOADED, (evaluation_name(name), fingerprint_policy(policy)))


def find_policy_name(policy: Policy) -> str:
    """Name that a policy was loaded by; of any other, and of one that changed since, class and fingerprint."""
    fingerprint = fingerprint_policy(policy)
    name, loaded_fingerprint = getattr(policy, LOADED, ("", ""))
    return name if fingerprint == loaded_fingerprint else f"{type(policy).__name__}-{fingerprint[:8]}"


def validate_name(name: Any, subject: str, example: str) -> Any:
    """The name or path as it is.

    Args:
        name: Name of a data set, policy or recipe, as a user hands it over.
        subject: Word for what has the name in the message, such as "data set".
        example: Valid name, for the message.

    Raises:
        ConfigError: The name is neither text nor a path.
    """
    if not isinstance(name, str | os.PathLike):
        raise ConfigError(f"{in_short(name)} is no name of a {subject}: give one, such as {example!r}.")
    return name


def to_policy(policy: Any, device: Device = "auto") -> Policy:
    """The policy itself, or the policy of a name.

    Args:
        policy: Policy, or a name for `load_policy`.
        device: Device of a policy that is loaded by its name.

    Raises:
        ConfigError: Neither a policy nor the name of one, or a device for a policy that is loaded already.
    """
    if isinstance(policy, str | os.PathLike):
        return load_policy(policy, device)
    if device != "auto":
        raise ConfigError(
            f"device={device!r} has no effect on a loaded policy: load it with rs.load_policy(name, {device!r})."
        )
    # A class has the methods of its policies, so it would pass for one.
    if isinstance(policy, type):
        raise ConfigError(
            f"{policy.__name__} is a class, not a policy: make one, or load one with rs.load_policy(name)."
        )
    if not isinstance(policy, Policy):
        raise ConfigError(f"{in_short(policy)} is not a policy: hand over one, or a name for rs.load_policy.")
    return policy


def read_result(result: Any, result_type: Any) -> Any:
    """A result as it is, or from its file.

    Args:
        result: Evaluation or result of a drive, or path of a file.
        result_type: Class of the result, `Evaluation` or `DriveResult`.

    Raises:
        ConfigError: Neither a result of this class nor a path.
        DataError: No such file, or a file of something else.
    """
    if isinstance(result, str | os.PathLike):
        return result_type.read(result)
    if not isinstance(result, result_type):
        raise ConfigError(f"{type(result).__name__}: not an evaluation: hand over one of rs.evaluate, or its file.")
    return result


def to_dataset(scenarios: Any, split: str | None) -> ScenarioDataset | None:
    """An opened data set as it is, or the data set of a name; None for scenarios in any other form.

    Args:
        scenarios: Scenarios in any form that public functions take.
        split: Split of a data set that is opened by its name; None = all.

    Raises:
        DataError: No data set of this name, or none of its scenarios is in the split.
    """
    if isinstance(scenarios, str | os.PathLike):
        return open_dataset(scenarios, split)
    return scenarios if isinstance(scenarios, ScenarioDataset) else None


def to_batch(scenarios: Any, device: torch.device | str = "cpu", split: str | None = "validation") -> ScenarioBatch:
    """Batch of scenarios; a batch stays as it is but for the device.

    Args:
        scenarios: Scenarios in any form that public functions take.
        device: Device of the batch's tensors.
        split: Split of a data set that is named; None = all.

    Raises:
        ConfigError: No scenario, or something else was handed over.
        DataError: No data set of this name, or an unsound scenario.
    """
    loaded = to_scenarios(scenarios, split)
    if not isinstance(scenarios, ScenarioBatch):
        scenarios = collate([loaded[position] for position in range(len(loaded))])
    return scenarios.to(device)


def to_sampling(sampling: Any) -> Sampling:
    """Temperature and truncation; the whole distribution for None.

    Args:
        sampling: Settings, or None.

    Raises:
        ConfigError: Neither settings nor None.
    """
    if not isinstance(sampling, Sampling | None):
        raise ConfigError(f"sampling must be rs.Sampling(temperature, top_k) or None, got {sampling!r}.")
    return sampling or Sampling()


def check_sampling(policy: Policy | str, sampling: Sampling) -> None:
    """Check that temperature and truncation have an effect.

    Args:
        policy: Policy that decides, or the name of the log.
        sampling: Temperature and truncation of the decisions.

    Raises:
        ConfigError: Either is set, and the policy samples no decisions.
    """
    if not sampling.is_full and (isinstance(policy, str) or not policy.noise_size):
        option = "top_k" if sampling.temperature == 1.0 else "temperature"
        name = policy if isinstance(policy, str) else type(policy).__name__
        raise ConfigError(
            f"{option} {getattr(sampling, option):g} has no effect, as {name} samples no decisions: leave it out."
        )


def to_recipe(recipe: Any) -> Recipe:
    """The recipe itself, or the recipe of a name.

    Args:
        recipe: Recipe, or the name of one.

    Raises:
        ConfigError: No such recipe.
    """
    return recipe if isinstance(recipe, Recipe) else recipe_by_name(validate_name(recipe, "recipe", "smart-demo"))


def check_config(config: object, section: str, *classes: type) -> None:
    """Check that settings are of a kind that a verb takes, not a whole recipe.

    Args:
        config: Settings, or None.
        section: Section of a recipe, for the message.
        classes: Classes of settings.

    Raises:
        ConfigError: Settings of no such kind.
    """
    if not isinstance(config, (*classes, type(None))):
        *class_names, last_name = (settings_class.__name__ for settings_class in classes)
        names = f"{', '.join(class_names)} or {last_name}" if class_names else last_name
        raise ConfigError(
            f"config must be a {names}, got {type(config).__name__}: pass rs.recipe(name).{section} or make one."
        )


def check_left_out(verb: Callable[..., Any], values: Mapping[str, Any], names: Sequence[str], reason: str) -> None:
    """Check that arguments without effect have the default values.

    Args:
        verb: Function with the defaults.
        values: Values of the call by argument.
        names: Names of the arguments without effect.
        reason: Rest of the message, behind the argument.

    Raises:
        ConfigError: An argument has a different value.
    """
    for name in names:
        if values[name] != inspect.signature(verb).parameters[name].default:
            raise ConfigError(f"{name} {reason}")
