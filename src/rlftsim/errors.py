"""User errors, from bad input or configuration: each message names the value, the cause and the way out."""

import math
import operator
import os
import re
import traceback
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from types import UnionType
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints


class RlftsimError(Exception):
    """Base of every error that this package raises on purpose; the command line prints it as one line without a
    traceback. Its text is short and on one line, whatever a user's text in it holds."""

    exit_status: ClassVar[int] = 2
    """Of a command line that it ends: 2 = the command has to be changed."""

    def __str__(self) -> str:
        return shorten(super().__str__())

    def _render_traceback_(self) -> list[str]:
        """What a notebook shows: one line. `traceback.print_last()` in the next cell shows all frames."""
        return [f"{type(self).__name__}: {self}"]


class DataError(RlftsimError):
    """A file, record or scenario that cannot be used; the message names the file, the record and the reason."""


class EpisodeFailure(DataError):
    """An episode that cannot be driven to the end, by a fault of the planner, the traffic or the log."""


class BadRecordError(DataError):
    """A damaged record in a conversion that stops at the first one; the message names file, record and cause."""

    exit_status = 1


class NotYetError(DataError):
    """Work of other processes that has to end first; the same command does it later."""

    exit_status = 1


class ConfigError(RlftsimError, ValueError):
    """A setting that contradicts another one or lies outside its range; the message says what to set instead."""


class CheckpointError(RlftsimError):
    """A checkpoint or run folder that is damaged or does not fit; the message names the key or file and what to do."""


class PackageError(RlftsimError):
    """An error in code of an installed package, such as a reward; the message names package, error and line."""

    exit_status = 1


PERMISSION_WAY_OUT = "give yourself permission (chmod u+rwX), or name another file or folder"
"""End of a message about a file or folder that is closed to the user."""
MAX_VALUE, MAX_MESSAGE = 100, 800
"""Characters of a value in a message, and of a message."""


def in_short(value: object) -> str:
    """A value for a message: numbers, texts and lists, without the middle of long ones, all else by its type."""
    if not isinstance(value, str | int | float | list | tuple | None):
        return type(value).__name__
    if isinstance(value, int) and value.bit_length() > 4 * MAX_VALUE:  # Python writes no number of 5000 digits
        return f"a number of {value.bit_length()} bits"
    return shorten(repr(value), MAX_VALUE)


def shorten(text: str, most: int = MAX_MESSAGE) -> str:
    """A text on one line, without control characters, and without its middle, from word to word, where it is long.

    Args:
        text: Any text, such as a message that carries what a user wrote.
        most: Characters that are left of it; those left out are counted in their place.
    """
    if len(text) > most:
        gap = f" ... {len(text) - most} characters and more ... "
        half = (most - len(gap)) // 2
        # a word of more than 40 characters, such as a path, is cut all the same
        text = re.sub(r"\s\S{,40}$", "", text[:half]) + gap + re.sub(r"^\S{,40}\s", "", text[-half:])
    return printable(text)


def printable(text: str) -> str:
    """A text with a space in place of each sign that no terminal shows, such as an end of line."""
    return "".join(sign if sign.isprintable() else " " for sign in text)


def locate_error(error: BaseException) -> str:
    """File, line and function where an error that was raised began; torch's code and Python's import are left out."""
    # A wrong shape is noticed inside torch, but made by the code that called it.
    foreign = (f"{os.sep}site-packages{os.sep}torch{os.sep}", "<frozen ")
    frames = traceback.extract_tb(error.__traceback__)
    frame = [frame for frame in frames if not any(folder in frame.filename for folder in foreign)][-1]
    return f"{os.path.basename(frame.filename)}:{frame.lineno} in {frame.name}"


def find_package_error(error: BaseException) -> PackageError | None:
    """One line in place of an error that code of an installed package raised; None for other errors."""
    from importlib.metadata import distributions  # not at the top: it takes longer than all else that is imported here

    packages = {
        re.split(r"[.:]", entry.value)[0]: distribution
        for distribution in distributions()
        for entry in distribution.entry_points
        if entry.group.startswith("rlftsim.")
    }
    frames = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    roots = [name.partition(".")[0] for name in reversed(frames)]
    # a wrong shape is noticed inside torch: the innermost line counts that is of this package or of one that extends it
    innermost = next((root for root in roots if root == "rlftsim" or root in packages), "rlftsim")
    if innermost == "rlftsim":
        return None
    package = packages[innermost]
    cause = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return PackageError(
        f"package {package.name} {package.version} fails ({cause}, {locate_error(error)}): repair it; --debug shows "
        "more."
    )


def whole_number(name: str, value: object, least: int | None = None) -> int:
    """A whole number as a plain int; numpy's integers are whole numbers, True and 2.0 are not.

    Args:
        name: of the argument, for the message.
        value: anything.
        least: lowest number that is taken; None takes all.

    Raises:
        ConfigError: something else, or a lower number; the message has both names and value.
    """
    number = _fitted(value, int)
    if number is _MISFIT or (least is not None and number < least):
        limit = "" if least is None else f" of at least {least}"
        raise ConfigError(f"{name} must be a whole number{limit}, got {in_short(value)}.")
    return number


def check_types(config: Any) -> None:
    """Require that each field of a configuration has a value of its type, and a choice one of its words.

    Numbers of numpy become plain ones, so that every configuration can be stored as JSON.

    Args:
        config: a dataclass; fields of other types than numbers, text, choices and dataclasses are not checked.

    Raises:
        ConfigError: a field has another value; the message names it and what it takes.
    """
    hints = get_type_hints(type(config))
    for one in fields(config):
        value, hint = getattr(config, one.name), hints[one.name]
        fitted = _fitted(value, hint)
        if fitted is _MISFIT:
            raise ConfigError(f"{one.name} must be {_in_words(hint)}, got {in_short(value)}.")
        if fitted is not value:
            object.__setattr__(config, one.name, fitted)  # the dataclasses are frozen


def check_positive(config: object, names: tuple[str, ...]) -> None:
    """Require that fields of a configuration are above zero.

    Args:
        config: a dataclass.
        names: its fields to check.

    Raises:
        ConfigError: one of them is not above zero; the message names it and its value.
    """
    _check_fields(config, names, lambda value: value > 0, "be positive")


def check_not_negative(config: object, names: tuple[str, ...]) -> None:
    """Require that fields of a configuration are zero or more.

    Args:
        config: a dataclass.
        names: its fields to check.

    Raises:
        ConfigError: one of them is negative or not a number; the message names it and its value.
    """
    _check_fields(config, names, lambda value: value >= 0, "not be negative")


def check_finiteness(config: object, names: tuple[str, ...]) -> None:
    """Require that fields of a configuration are finite numbers.

    Args:
        config: a dataclass.
        names: its fields to check.

    Raises:
        ConfigError: one of them is infinite or not a number; the message names it and its value.
    """
    _check_fields(config, names, math.isfinite, "be a finite number")


def _check_fields(config: object, names: tuple[str, ...], is_fit: Callable[[Any], bool], rule: str) -> None:
    for name in names:
        if not is_fit(getattr(config, name)):
            raise ConfigError(f"{name} must {rule}, got {getattr(config, name)}.")


def check_limits(config: object, limits: Mapping[Any, int]) -> None:
    """Check that fields of a configuration are not above their limits, which keep a slip from filling the memory.

    Args:
        config: a dataclass; fields that are None have no limit.
        limits: Highest value of a field, by its name.

    Raises:
        ConfigError: A value is above its limit; the message names both.
    """
    for name, limit in limits.items():
        value = getattr(config, name)
        if value is not None and not value <= limit:
            raise ConfigError(f"{name} must be at most {limit}, got {str(value)[:40]}.")


def given(config: object, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of optional fields that are not None.

    Args:
        config: a dataclass.
        names: fields that may be None.
    """
    return tuple(name for name in names if getattr(config, name) is not None)


_MISFIT: Any = object()
_WORDS = {int: "a whole number", float: "a number", bool: "True or False", str: "text", type(None): "None"}


def _fitted(value: Any, hint: Any) -> Any:
    """A value as a type has it, or `_MISFIT`; the value itself for types that are not checked."""
    if get_origin(hint) in (Union, UnionType):
        options = (_fitted(value, option) for option in get_args(hint))
        return next((option for option in options if option is not _MISFIT), _MISFIT)
    if get_origin(hint) is Literal:
        return value if isinstance(value, str) and value in get_args(hint) else _MISFIT
    if get_origin(hint) is tuple:
        if not isinstance(value, tuple | list):
            return _MISFIT
        kinds = get_args(hint)
        if ... in kinds:
            kinds = kinds[:1] * len(value)
        is_fit = len(value) == len(kinds) and all(_fitted(p, k) is not _MISFIT for p, k in zip(value, kinds))
        # A list of a stored config.json becomes what it was, so that configurations are equal.
        return (value if isinstance(value, tuple) else tuple(value)) if is_fit else _MISFIT
    if hint is int:
        return _MISFIT if isinstance(value, bool) else _converted(value, operator.index)
    if hint is float:
        # An int stays an int: settings are stored as they were written.
        if isinstance(value, int | float):
            return _MISFIT if isinstance(value, bool) else value
        return _MISFIT if isinstance(value, str) else _converted(value, float)
    if hint is str:
        # A year is text: metric=2025 is "2025".
        return str(value) if isinstance(value, int) and not isinstance(value, bool) else _if_kind(value, str)
    if hint in (bool, type(None)) or (isinstance(hint, type) and is_dataclass(hint)):
        return _if_kind(value, hint)
    return value


def _if_kind(value: Any, kind: type) -> Any:
    return value if isinstance(value, kind) else _MISFIT


def _converted(value: Any, convert: Any) -> Any:
    """A number as a plain one; truth values of numpy and arrays of several numbers do not fit."""
    try:
        return convert(value)
    except (TypeError, ValueError):
        return _MISFIT


def _in_words(hint: Any) -> str:
    """The values of a type, for a message."""
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(_in_words(option) for option in get_args(hint))
    if get_origin(hint) is Literal:
        return f"one of {', '.join(get_args(hint))}"
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        if get_origin(kinds[0]) is Literal:
            return f"{_in_words(kinds[0])}, or several of them in a list"
        return f"a list, each {_in_words(kinds[0])}" if ... in kinds else f"{len(kinds)} numbers"
    return _WORDS.get(hint) or f"a {hint.__name__}"
