"""Errors that are a user's to mend: each message names the value, the cause and the way out."""

import math


class RlftsimError(Exception):
    """Base of every error this package raises on purpose; the command line prints it as one line without a traceback."""


class DataError(RlftsimError):
    """A file, record or scenario cannot be used: says which file, which record and why."""


class ConfigError(RlftsimError, ValueError):
    """A setting contradicts another one or lies outside its range: says which and what to set instead."""


class CheckpointError(RlftsimError):
    """A checkpoint or run folder is damaged or does not fit: says which key or file and what to do."""


def require_positive(config: object, names: tuple[str, ...]) -> None:
    """Check fields of a configuration.

    Raises:
        ConfigError: one of them is not above zero; names it and its value.
    """
    for name in names:
        if not getattr(config, name) > 0:
            raise ConfigError(f"{name} must be positive, got {getattr(config, name)}.")


def require_not_negative(config: object, names: tuple[str, ...]) -> None:
    """Check fields of a configuration.

    Raises:
        ConfigError: one of them is below zero or no number; names it and its value.
    """
    for name in names:
        if not getattr(config, name) >= 0:
            raise ConfigError(f"{name} must not be negative, got {getattr(config, name)}.")


def require_finite(config: object, names: tuple[str, ...]) -> None:
    """Check fields of a configuration.

    Raises:
        ConfigError: one of them is infinite or no number; names it and its value.
    """
    for name in names:
        if not math.isfinite(getattr(config, name)):
            raise ConfigError(f"{name} must be a finite number, got {getattr(config, name)}.")


def given(config: object, names: tuple[str, ...]) -> tuple[str, ...]:
    """Those of some optional fields that are not None."""
    return tuple(name for name in names if getattr(config, name) is not None)
