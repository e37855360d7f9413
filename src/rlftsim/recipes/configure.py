"""`field=value` on the command line changes a recipe."""

import dataclasses
from collections.abc import Mapping, Sequence
from types import NoneType
from typing import Any, Literal, NoReturn, TypeVar, get_args, get_origin, get_type_hints

from rlftsim.errors import ConfigError

Config = TypeVar("Config")
Override = str


def configure(config: Config, overrides: Sequence[Override], *, sections: Sequence[str] | None = None) -> Config:
    """A configuration with some fields changed.

    Args:
        config: a frozen dataclass, nested ones inside.
        overrides: such as "finetune.kl.target=0.02"; "-" and "_" are the same in names.
        sections: the top fields that have an effect; None = all.

    Raises:
        ConfigError: no such field (the known ones are listed), or a value of the wrong kind or range.
    """
    changes: dict[str, Any] = {}
    for override in overrides:
        name, separator, text = override.partition("=")
        if not separator:
            raise ConfigError(f"{override!r} is not field=value, such as pretrain.epochs=2.")
        if sections is not None and name.split(".")[0] not in sections:
            raise ConfigError(f"{name} has no effect here: only fields of {' and '.join(sections)} can be set.")
        *above, field = name.replace("-", "_").split(".")
        value = _value(config, [*above, field], text, name)
        inner = changes
        for part in above:
            inner = inner.setdefault(part, {})
        inner[field] = value
    return _changed(config, changes)


def _value(config: Any, path: list[str], text: str, whole: str) -> Any:
    """A text as the value of the field at a path."""
    known = [f.name for f in dataclasses.fields(config)]
    if path[0] not in known:
        raise ConfigError(f"{whole}: no field {path[0]!r} here, known are {', '.join(known)}.")
    old = getattr(config, path[0])
    if len(path) > 1:
        if not dataclasses.is_dataclass(old):
            raise ConfigError(f"{whole}: {path[0]!r} has no fields of its own.")
        return _value(old, path[1:], text, whole)
    if dataclasses.is_dataclass(old):
        inner = ", ".join(f.name for f in dataclasses.fields(old))
        raise ConfigError(f"{whole}: name one of its fields: {inner}.")
    return _parse(text, get_type_hints(type(config))[path[0]], whole)


def _changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """All changes at once: fields that depend on each other may be given in any order."""
    new = {n: _changed(getattr(config, n), v) if isinstance(v, Mapping) else v for n, v in changes.items()}
    return dataclasses.replace(config, **new)  # type: ignore[type-var]


def _parse(text: str, kind: Any, whole: str) -> Any:
    """A value of the annotated kind."""
    try:
        return _as(text.strip(), kind)
    except ValueError:
        raise ConfigError(f"{whole}={text}: expected {_words(kind)}.") from None


def _as(text: str, kind: Any) -> Any:
    """A text as bool, int, float, str, None, one of a choice, a tuple, or the first of several kinds that fits; else ValueError."""
    inner = get_args(kind)
    if get_origin(kind) is Literal:
        return {str(choice): choice for choice in inner}[text] if text in map(str, inner) else _refuse(text)
    if get_origin(kind) is tuple:
        parts = [part.strip() for part in text.strip("()[] ").split(",") if part.strip()]
        kinds = [inner[0]] * len(parts) if inner[-1] is Ellipsis else list(inner)
        return tuple(_as(part, k) for part, k in zip(parts, kinds)) if len(parts) == len(kinds) else _refuse(text)
    if inner:
        return _first_that_fits(text, sorted(inner, key=lambda k: k is not NoneType))
    if kind in (NoneType, bool):
        known = {"none": None} if kind is NoneType else {"true": True, "false": False}
        return known[text.lower()] if text.lower() in known else _refuse(text)
    return kind(text)


def _first_that_fits(text: str, kinds: Sequence[Any]) -> Any:
    for kind in kinds:
        try:
            return _as(text, kind)
        except ValueError:
            continue
    return _refuse(text)


def _refuse(text: str) -> NoReturn:
    raise ValueError(text)


def _words(kind: Any) -> str:
    """A kind as a person would say it."""
    inner = get_args(kind)
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(str, inner))
    if get_origin(kind) is tuple:
        return "(" + ", ".join("..." if k is Ellipsis else _words(k) for k in inner) + ")"
    if inner:
        return " or ".join(_words(k) for k in inner)
    return "none" if kind is NoneType else kind.__name__
