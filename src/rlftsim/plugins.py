"""Extension points: names that other packages and notebooks can add to, by one mechanism for every kind of thing.

Rewards, policies, features, training methods, data sources, recipes, experiments, planners, trackers and exporters are
each an `ExtensionPoint`. A name is looked for

1. among what was registered by a decorator, in a notebook or in an imported module,
2. among what this package ships, which is imported on first use,
3. among the entry points of installed packages. In the pyproject.toml of such a package:

    [project.entry-points."rlftsim.rewards"]
    on_the_road = "my_package.rewards:on_the_road"

A name that ships with this package cannot be taken. Any other name can be registered again, which replaces the earlier
thing with a warning: so a notebook's cell can be run twice. A package that cannot be imported stops only those who use
its names; `rlftsim plugins` says why.
"""

import difflib
import importlib
import sys
import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import Any, Generic, TypeVar

from rlftsim.errors import ConfigError, in_short, locate_error

Value = TypeVar("Value")
Registered = TypeVar("Registered")


class ExtensionPoint(Generic[Value]):
    """A table of named things of one kind.

    Args:
        kind: word for one of them in messages, such as "reward".
        group: entry-point group in which other packages announce theirs, such as "rlftsim.rewards". An entry
            point is the thing itself, or a module that registers things when it is imported.
        shipped: things of this package, name to "module:attribute"; imported on first use. Modules of this package may
            also register theirs.
        use: looks a name up as those who use it do, and raises ConfigError where the thing is none of this kind; None =
            anything is.
        more: Further forms that a name may have, such as "MODULE:CLASS", for the message on an unknown name.
    """

    def __init__(
        self,
        kind: str,
        group: str,
        shipped: Mapping[str, str] | None = None,
        *,
        use: Callable[[str], object] | None = None,
        more: str = "",
    ):
        self.kind = kind
        self.group = group
        self._shipped = dict(shipped or {})
        self._use = use
        self._more = f", or {more}" if more else ""
        self._registered: dict[str, Value] = {}

    def register(self, name: str) -> Callable[[Registered], Registered]:
        """Decorator that adds a thing under a name, see `add`."""

        def decorate(value: Registered) -> Registered:
            self.add(name, value, stacklevel=3)  # type: ignore[arg-type]
            return value

        return decorate

    def add(self, name: str, value: Value, *, stacklevel: int = 2) -> None:
        """Add a thing under a name, in place of an earlier one from outside this package.

        Args:
            name: Name to look the value up by.
            value: Function, class or other object to register.
            stacklevel: Number of frames up to the line that the warning points to, as in `warnings.warn`.

        Raises:
            ConfigError: The name is taken by a thing that ships with this package.
        """
        # A module of this package registers its things by the same decorator, and may be reloaded.
        known = self._registered.get(name)
        ships = name in self._shipped or (known is not None and is_ours(known))
        if ships and not is_ours(value):
            raise ConfigError(f"{self.kind} {name!r} ships with rlftsim: choose another name.")
        if known is not None and known is not value and not ships:
            message = f"{self.kind} {name!r} is registered again and replaces the earlier one."
            warnings.warn(message, stacklevel=stacklevel)
        self._registered[name] = value

    def remove(self, name: str) -> None:
        """Forget what was registered under a name, if anything was."""
        self._registered.pop(name, None)

    def get(self, name: str) -> Value:
        """The thing of a name.

        Raises:
            ConfigError: unknown, with the nearest known name; or the package that announces it cannot be imported.
        """
        found = self.find(name)
        if found is None:
            names = self.names()
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            known = f"known are {', '.join(names)}" if names else "there are none"
            raise ConfigError(f"unknown {self.kind} {in_short(name)}: {hint}{known}{self._more}.")
        return found

    def find(self, name: str) -> Value | None:
        """The thing of a name; None if there is none.

        Raises:
            ConfigError: the package that announces this name cannot be imported.
        """
        # Shipped things first: looking one up does not import other packages.
        if name not in self._registered and name in self._shipped:
            module, _, attribute = self._shipped[name].partition(":")
            return getattr(importlib.import_module(module), attribute)
        if name not in self._registered:
            self._load_entry_points(name)
        return self._registered.get(name)

    def names(self) -> list[str]:
        """All names in alphabetical order, those of installed packages included as far as these can be imported."""
        self._load_entry_points()
        return sorted({*self._shipped, *self._registered})

    def _load_entry_points(self, name: str | None = None) -> None:
        """Add what installed packages announce: the entry point of a name if there is one, else all of them.

        All, because a module that registers things by itself may have any of them. Then a package that cannot be
        imported is passed over with a warning: the others are none the worse.

        Raises:
            ConfigError: the package that announces the name cannot be imported.
        """
        entries = list(entry_points(group=self.group))
        announced = [one for one in entries if one.name == name]
        for entry in announced or entries:
            problem = self.describe_problem(entry)
            if problem and announced:
                raise ConfigError(problem)
            if problem:
                warnings.warn(problem, stacklevel=4)

    def describe_problem(self, entry: EntryPoint) -> str | None:
        """Add an entry point to the table unless it is there; one line about its failure, None = it works."""
        if entry.name in self._registered:
            return None
        # Any error, not only ImportError: the package runs code of its own, and may even end the program.
        try:
            value = entry.load()
        except (Exception, SystemExit) as error:
            package = f" of package {entry.dist.name} {entry.dist.version}" if entry.dist else ""
            return (
                f"{self.kind} {entry.name!r}{package} ({entry.value}) cannot be imported "
                f"({type(error).__name__}: {error}, {locate_error(error)}): repair or uninstall the package."
            )
        if value is None:
            return f"{self.kind} {entry.name!r} ({entry.value}) is None: name an object or a module."
        if not isinstance(value, ModuleType):  # a module has registered its things itself
            try:
                self.add(entry.name, value)
            except ConfigError as error:
                return str(error)
        return None

    def describe_refusal(self, name: str, use: Callable[[str], object] | None = None) -> str | None:
        """One line about a registered thing that is refused where users need the thing; None = no refusal.

        Args:
            name: Name of the thing.
            use: Trial by name; None = the look-up of a run.
        """
        use = use or self._use
        # An entry point that is a module has a name of its own, under which there may be nothing.
        if use is None or name not in self._registered:
            return None
        try:
            use(name)
        except ConfigError as error:
            return str(error)
        except (Exception, SystemExit) as error:
            return f"{self.kind} {name!r} fails ({type(error).__name__}: {error}, {locate_error(error)}): repair it."
        return None


def is_ours(value: object) -> bool:
    """True for functions and classes that are defined in this package, and for features and constraints of these."""
    return (getattr(value, "__module__", None) or "").partition(".")[0] == "rlftsim"


def import_object(title: str, location: str) -> Any:
    """Object of an importable module, or of a file in the current folder, as `python -m` finds modules.

    Args:
        title: Words for the object in messages, such as "planner".
        location: Module and name, "package.module:Class".

    Raises:
        ConfigError: No module, or one that cannot be imported or lacks the name.
    """
    module, _, attribute = location.partition(":")
    if not module or module.startswith("."):
        raise ConfigError(f"{title} {location!r} names no module: write package.module:Class.")
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (Exception, SystemExit) as error:  # a file of others may fail in any way
        raise ConfigError(
            f"{title} {location!r} cannot be imported ({type(error).__name__}: {error}): name package.module:Class."
        ) from error
