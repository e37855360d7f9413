"""Calls of public functions with arguments that do not exist, refused in one line that names what works."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar

from rlftsim.errors import ConfigError
from rlftsim.rollout.policy import Sampling
from rlftsim.training.config import FinetuneConfig, PretrainConfig

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")
SECTIONS = {"finetune": FinetuneConfig, "pretrain": PretrainConfig}
"""Settings that a verb takes as `config`, by the name of verb and section."""


def with_checked_arguments(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Decorator of a function `rs.NAME`: wrong names and numbers of arguments are refused by a ConfigError.

    Args:
        function: Function that users call.
    """
    expected = signature(function)

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
