"""`field=value` on the command line changes a recipe."""

import ast
import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, get_args, get_type_hints

from rlftsim.errors import ConfigError

Config = TypeVar("Config")
Override = str


def configure(config: Config, overrides: Sequence[Override]) -> Config:
    """A configuration with some fields changed.

    Args:
        config: a frozen dataclass, nested ones inside.
        overrides: such as "finetune.kl.target=0.02"; "-" and "_" are the same in names.

    Raises:
        ConfigError: no such field (the known ones are listed), or a value of the wrong kind or range.
    """
    for override in overrides:
        name, separator, text = override.partition("=")
        if not separator:
            raise ConfigError(f"{override!r} is not field=value, such as pretrain.epochs=2.")
        config = _changed(config, name.replace("-", "_").split("."), text, name)
    return config


def _changed(config: Config, path: list[str], text: str, whole: str) -> Config:
    known = [f.name for f in dataclasses.fields(config)]  # type: ignore[arg-type]
    if path[0] not in known:
        raise ConfigError(f"{whole}: no field {path[0]!r} here, known are {', '.join(known)}.")
    old = getattr(config, path[0])
    if len(path) > 1:
        if not dataclasses.is_dataclass(old):
            raise ConfigError(f"{whole}: {path[0]!r} has no fields of its own.")
        new: Any = _changed(old, path[1:], text, whole)
    elif dataclasses.is_dataclass(old):
        inner = ", ".join(f.name for f in dataclasses.fields(old))
        raise ConfigError(f"{whole}: name one of its fields: {inner}.")
    else:
        new = _parse(text, get_type_hints(type(config))[path[0]], whole)
    return dataclasses.replace(config, **{path[0]: new})  # type: ignore[type-var]


def _parse(text: str, kind: Any, whole: str) -> Any:
    """A value of the annotated kind: bool, int, float, str, None, a choice, or a tuple of them."""
    allowed = [a for a in (get_args(kind) or (kind,)) if a is not Ellipsis]
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        value = {"none": None, "true": True, "false": False}.get(text.lower(), text)
    if float in allowed and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if isinstance(value, tuple) and isinstance(kind, type(tuple[int])):
        return tuple(float(v) if float in allowed else v for v in value)
    types = tuple(a for a in allowed if isinstance(a, type))
    is_bool_for_number = isinstance(value, bool) and bool not in allowed
    if value in [a for a in allowed if not isinstance(a, type)] or (
        types and isinstance(value, types) and not is_bool_for_number
    ):
        return value
    wanted = ", ".join(a.__name__ if isinstance(a, type) else repr(a) for a in allowed)
    raise ConfigError(f"{whole}={text}: expected {wanted}.")
