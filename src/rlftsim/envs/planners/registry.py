"""Planners by name, or as `package.module:Class`. A package of your own adds a name with an entry point:

[project.entry-points."rlftsim.planners"]
mine = "my_package:MyPlanner"
"""

import ast
import inspect
import secrets
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, Protocol, get_args, runtime_checkable

from rlftsim.envs.actions import MIN_HORIZON, ActionType
from rlftsim.errors import ConfigError, EpisodeFailure, RlftsimError, in_short, locate_error
from rlftsim.plugins import ExtensionPoint, import_object
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
    more="MODULE:CLASS, sb3:FILE.zip",
)
"""Name -> class of a planner, or a function from observation to action."""

SB3 = "sb3:"
"""Beginning of the name of a planner in a file of Stable-Baselines3."""


@runtime_checkable
class Planner(Protocol):
    """Drives an agent. Attribute `action` names the type of action; the default is "bicycle".

    Attribute `horizon` is the number of poses of a "trajectory"; the default is 5. A bicycle drives backwards where
    attribute `reverse` is True.
    """

    def reset(self, info: dict[str, Any]) -> None:
        """Begin an episode.

        Args:
            info: Information of the environment's reset; "logged" has the agent's logged poses from "now" on, [81, 3]
                in an episode of 8 s.
        """
        ...

    def act(self, observation: dict[str, Any]) -> Any:
        """Action for an observation."""
        ...


class CallablePlanner:
    """A plain function from observation to action, as a planner.

    Args:
        function: Function that is called with an observation and returns an action.
    """

    def __init__(self, function: Callable[[dict[str, Any]], Any]):
        self.function = function
        for name, value in read_action_settings(function).items():
            setattr(self, name, value)

    def reset(self, info: dict[str, Any]) -> None:
        """Do nothing: a function has no memory."""

    def act(self, observation: dict[str, Any]) -> Any:
        """Result of the function."""
        return self.function(observation)


def load_planner(name: str) -> Planner:
    """Planner of a name.

    Args:
        name: Registered name, or "package.module:Class" (or ":function") of code that can be imported; options are
            written behind either, "careful:Careful(headway=1.0)". Or "sb3:FILE" of Stable-Baselines3.

    Raises:
        ConfigError: Unknown, not importable, neither an object with `reset` and `act` nor a function, with other
            arguments than these, without such an option, or with an unknown type of action.
    """
    if name.startswith(SB3):
        try:
            from rlftsim.envs.learned_planner import Sb3Planner  # a package of its own, which few have
        except ModuleNotFoundError as error:
            raise ConfigError(f"planner {name}: {error.name} is missing: pip install stable-baselines3.") from None
        return Sb3Planner(name.removeprefix(SB3))
    location, options = _split_options(name)
    loaded = import_object("planner", location) if ":" in location else PLANNERS.get(location)
    try:
        if options and not isinstance(loaded, type):
            inspect.signature(loaded).bind_partial(**options)
            loaded = partial(loaded, **options)
        planner = loaded(**options) if isinstance(loaded, type) else loaded
    except SystemExit as stop:
        raise ConfigError(
            f"planner {name!r} calls exit({stop.code!r}) when it is made: let it raise an error."
        ) from stop
    except Exception as error:
        way = f"with {', '.join(options)}" if options else "without arguments"
        raise ConfigError(f"planner {name!r} cannot be made {way} ({type(error).__name__}: {error}).") from error
    if not isinstance(planner, Planner):
        if callable(planner):
            _check_argument(f"planner {name!r}", planner, "observation")
        planner = to_planner(planner, f"planner {name!r}")
    _check_argument(f"reset of planner {name!r}", planner.reset, "info")
    _check_argument(f"act of planner {name!r}", planner.act, "observation")
    read_action_settings(planner)  # an unknown action ends here, not in the first episode
    return planner


def _split_options(name: str) -> tuple[str, dict[str, Any]]:
    """Name without options, and the options: numbers, texts and other literals by keyword.

    Raises:
        ConfigError: What stands in brackets are no such options.
    """
    location, bracket, _ = name.partition("(")
    if not bracket:
        return name, {}
    try:
        call: Any = ast.parse(f"planner{name[len(location) :]}", mode="eval").body
        options = {keyword.arg: ast.literal_eval(keyword.value) for keyword in call.keywords if keyword.arg}
        if call.args or len(options) < len(call.keywords):
            raise ValueError(name)
    except (SyntaxError, ValueError, AttributeError, RecursionError, MemoryError):
        raise ConfigError(
            f"planner {in_short(name)} cannot be read: write options by keyword, 'careful:Careful(headway=1.0)'."
        ) from None
    return location, options


def to_planner(planner: Any, name: str = "planner") -> Planner:
    """A planner, of a name, a function from observation to action, or itself.

    Args:
        planner: Name that `load_planner` takes, function, or object with `reset` and `act`.
        name: Name of the planner at the beginning of the message.

    Raises:
        ConfigError: None of these.
    """
    if isinstance(planner, str):
        return load_planner(planner)
    if isinstance(planner, Planner) and not isinstance(planner, type):
        return planner
    if not callable(planner) or isinstance(planner, type):
        raise ConfigError(f"{name} is of type {type(planner).__name__}: give it reset(info) and act(observation).")
    return CallablePlanner(planner)


class PlannerFailure(EpisodeFailure):
    """A planner cannot drive a scenario."""


@contextmanager
def guard_planner(
    planner: Planner,
    scenario_id: str,
    read_step: Callable[[], int],
    errors: tuple[type[BaseException], ...] = (Exception, SystemExit),
) -> Iterator[None]:
    """Turn any error of a planner, and exit(), which would end the command as if all were done, into one line.

    Args:
        planner: Planner that is called within.
        scenario_id: Scenario for the message.
        read_step: Function that tells the step of the episode for the message.
        errors: Errors that are the planner's; others pass.

    Raises:
        PlannerFailure: The planner raises an error, calls exit(), or wants what its type of action does not allow.
    """
    try:
        yield
    except MemoryError:  # no fault of the planner
        raise
    except errors as error:
        cause = f"exit({error.code!r})" if isinstance(error, SystemExit) else f"{type(error).__name__}: {error}"
        # messages of ours say all that a user needs
        cause = str(error) if isinstance(error, RlftsimError) else f"{cause} ({locate_error(error)})"
        name = type(planner.function if isinstance(planner, CallablePlanner) else planner).__name__
        raise PlannerFailure(
            f"planner {name} fails at step {read_step()} of scenario {scenario_id}: {cause}"
        ) from error


def _check_argument(name: str, function: Callable[..., Any], argument: str) -> None:
    """Raise ConfigError for a function that cannot be called with a single value; unreadable signatures pass."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(argument)
    except TypeError as error:
        raise ConfigError(f"{name} cannot be called with {argument} alone ({error}): let it take that.") from None


def hash_code(name: str) -> str:
    """SHA-256 of the file that defines a planner, and of the module in the planner's name where that is a second file.

    A planner without a file, as in a notebook, has a new value each time.

    Args:
        name: Name of the planner, as `load_planner` takes it.
    """
    planner = load_planner(name)
    if name.startswith(SB3):
        return hash_file(name.removeprefix(SB3))
    code: Any = planner.function if isinstance(planner, CallablePlanner) else planner
    code = code.func if isinstance(code, partial) else code
    sources: list[Any] = [code if inspect.isroutine(code) else type(code)]
    location, _ = _split_options(name)
    if ":" in location:
        sources.append(sys.modules[location.partition(":")[0]])
    hashes = dict.fromkeys(filter(None, map(hash_source, sources)))
    # without a file it may be other code than the last time
    return "-".join(hashes) or secrets.token_hex(32)


@cache
def hash_source(code: Any) -> str | None:
    """SHA-256 of the file of some code when this process first sees the code: a later edit does not drive.

    Args:
        code: Module, class or function; None is returned where it has no file, as in a notebook.
    """
    try:
        return hash_file(inspect.getfile(code))
    except (TypeError, OSError):
        return None


def read_action_settings(planner: Planner | Callable[..., Any]) -> dict[str, Any]:
    """Settings `action`, `horizon` and `reverse` of the environment that a planner drives in, by its attributes.

    Raises:
        ConfigError: The attribute `action` names no type of action.
    """
    action: Any = getattr(planner, "action", "bicycle")
    if action not in get_args(ActionType):
        choices = ", ".join(get_args(ActionType))
        name = getattr(planner, "__name__", type(planner).__name__)
        raise ConfigError(f"planner {name} has action = {action!r}: known are {choices}.")
    horizon, reverse = getattr(planner, "horizon", MIN_HORIZON), getattr(planner, "reverse", False)
    return {"action": action, "horizon": horizon, "reverse": reverse}
