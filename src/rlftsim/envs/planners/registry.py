"""Planners by name. A package of your own adds one with an entry point, or names it as `package.module:Class`:

[project.entry-points."rlftsim.planners"]
mine = "my_package:MyPlanner"
"""

import importlib
import inspect
import secrets
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, Protocol, get_args, runtime_checkable

from rlftsim.envs.actions import LEAST_HORIZON, ActionKind
from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint
from rlftsim.scenario.shards import hash_file

PLANNERS: ExtensionPoint[Callable[..., Any]] = ExtensionPoint(
    "planner",
    "rlftsim.planners",
    {
        "replay": "rlftsim.envs.planners.simple:Replay",
        "constant_velocity": "rlftsim.envs.planners.simple:ConstantVelocityPlanner",
        "idm": "rlftsim.envs.planners.idm:IdmPlanner",
        "pdm": "rlftsim.envs.planners.pdm:PdmPlanner",
    },
    use=lambda name: load_planner(name),
)
"""Name -> class of a planner, or a function from observation to action."""


@runtime_checkable
class Planner(Protocol):
    """Drives one agent. Attribute `action` names its kind of action; without it that is "bicycle".

    Attribute `horizon` is the number of poses of a "trajectory"; without it that is 5. A bicycle drives backwards where
    attribute `reverse` is True.
    """

    def reset(self, info: dict[str, Any]) -> None:
        """Begin an episode.

        Args:
            info: of the environment's reset; "logged" holds the agent's logged poses.
        """
        ...

    def act(self, observation: dict[str, Any]) -> Any:
        """Action for an observation."""
        ...


class CallablePlanner:
    """A plain function from observation to action, as a planner.

    Args:
        function: called with an observation.
    """

    def __init__(self, function: Callable[[dict[str, Any]], Any]):
        self.function = function
        self.action = action_of(function)
        self.horizon = horizon_of(function)
        self.reverse = may_reverse(function)

    def reset(self, info: dict[str, Any]) -> None:
        """Nothing: a function has no memory."""

    def act(self, observation: dict[str, Any]) -> Any:
        """Result of the function."""
        return self.function(observation)


def load_planner(name: str) -> Planner:
    """Planner of a name.

    Args:
        name: a registered name, or "package.module:Class" (or ":function").

    Raises:
        ConfigError: unknown, not importable, neither an object with `reset` and `act` nor a function, with other
            arguments than these, or with an unknown kind of action.
    """
    if ":" in name:
        module, _, attribute = name.partition(":")
        if not module or module.startswith("."):
            raise ConfigError(f"planner {name!r} names no module: write package.module:Class.")
        try:
            found = getattr(importlib.import_module(module), attribute)
        except (Exception, SystemExit) as error:  # a file of others may fail in any way
            raise ConfigError(
                f"planner {name!r} cannot be imported ({type(error).__name__}: {error}): name package.module:Class."
            ) from error
    else:
        found = PLANNERS.get(name)
    try:
        planner = found() if isinstance(found, type) else found
    except TypeError as error:
        raise ConfigError(f"planner {name!r} cannot be made without arguments ({error}).") from None
    except SystemExit as stop:
        raise ConfigError(
            f"planner {name!r} calls exit({stop.code!r}) when it is made: let it raise an error."
        ) from stop
    if not isinstance(planner, Planner):
        if not callable(planner):
            kind = type(planner).__name__
            raise ConfigError(f"planner {name!r} is of type {kind}: give it reset(info) and act(observation).")
        _require_one_argument(f"planner {name!r}", planner, "observation")
        planner = CallablePlanner(planner)
    _require_one_argument(f"reset of planner {name!r}", planner.reset, "info")
    _require_one_argument(f"act of planner {name!r}", planner.act, "observation")
    action_of(planner)  # refuses an unknown kind now, not in the first episode
    return planner


def _require_one_argument(what: str, function: Callable[..., Any], argument: str) -> None:
    """Refuse a function that cannot be called with one value; one without a readable signature passes."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(argument)
    except TypeError as error:
        raise ConfigError(f"{what} cannot be called with {argument} alone ({error}): let it take that.") from None


def hash_code(name: str) -> str:
    """SHA-256 of the file that defines a planner, and of the module in its name if that is another one.

    Of a planner without a file, as in a notebook, it is another value each time.

    Args:
        name: as for `load_planner`.
    """
    planner = load_planner(name)
    made = planner.function if isinstance(planner, CallablePlanner) else planner
    places: list[Any] = [made if inspect.isroutine(made) else type(made)]
    if ":" in name:
        places.append(sys.modules[name.partition(":")[0]])
    hashes = dict.fromkeys(found for found in map(_hash_source, places) if found)
    # without a file it may be other code than the last time
    return "-".join(hashes) or secrets.token_hex(32)


@cache
def _hash_source(code: Any) -> str | None:
    """Hash of the file of a module, class or function, as it is when this process first sees it: one that is edited
    afterwards is not the one that drives. None = there is no file."""
    try:
        return hash_file(inspect.getfile(code))
    except (TypeError, OSError):
        return None


def action_of(planner: Planner | Callable[..., Any]) -> ActionKind:
    """Kind of action that a planner takes.

    Raises:
        ConfigError: there is no such kind.
    """
    action: Any = getattr(planner, "action", "bicycle")
    if action not in get_args(ActionKind):
        known = ", ".join(get_args(ActionKind))
        name = getattr(planner, "__name__", type(planner).__name__)
        raise ConfigError(f"planner {name} has action = {action!r}: known are {known}.")
    return action


def horizon_of(planner: Planner | Callable[..., Any]) -> int:
    """Number of poses of a planner's trajectories."""
    return getattr(planner, "horizon", LEAST_HORIZON)


def may_reverse(planner: Planner | Callable[..., Any]) -> bool:
    """True = the planner's bicycle may drive backwards."""
    return getattr(planner, "reverse", False)
