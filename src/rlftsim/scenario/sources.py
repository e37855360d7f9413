"""Data sources: readers that turn files of one origin into scenarios. `convert` makes a data set of what they read.

A source is an object (or a class without arguments) under a name in `SOURCES`. One file is enough for a new one:

    from rlftsim.scenario.source import units_of_files
    from rlftsim.scenario.sources import SOURCES

    @SOURCES.register("my_logs")
    class MyLogs:
        license_note = "CC0-1.0"

        def find(self, path):
            return units_of_files(sorted(Path(path).glob("*.mylog")))

        def read(self, unit):
            for record in parse(unit.files[0]):
                yield Scenario(...)

        def describe(self):
            return {"source": "my_logs", "guessed": ["size"]}

Installed packages announce theirs by the entry-point group `rlftsim.sources`.
"""

import inspect
import os
from collections.abc import Iterable, Mapping
from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint
from rlftsim.scenario.source import DataSource

AUTO = "auto"
DEFAULT_SOURCE = "womd"
"""Reads what no source recognizes, and says what is wrong with it."""
_SHIPPED = {
    DEFAULT_SOURCE: "rlftsim.scenario.womd:WomdSource",
    "av2": "rlftsim.scenario.av2:Av2Source",
    "tables": "rlftsim.scenario.tables:TablesSource",
}
SOURCES: ExtensionPoint[Any] = ExtensionPoint(
    "data source", "rlftsim.sources", _SHIPPED, use=lambda name: _source(name)
)


def find_source(reader: str, path: str | os.PathLike[str], options: Mapping[str, object] | None = None) -> DataSource:
    """Source of a name, or for "auto" the one that recognizes the files at a path.

    Args:
        reader: a name in `SOURCES`, or "auto".
        path: file, folder or glob to be converted.
        options: arguments of the source's class.

    Raises:
        ConfigError: the name is unknown, "auto" and several sources recognize the files, or the source does not take an
            option.
    """
    if reader != AUTO:
        return _source(reader, options)
    # Those that ship come first: then packages of other people are not even imported.
    found = _detecting(_SHIPPED, path) or _detecting(SOURCES.names(), path)
    if len(found) > 1:
        raise ConfigError(f"{path} could be read as {' or '.join(found)}: name the data source.")
    return _source(found[0] if found else DEFAULT_SOURCE, options)


def _detecting(names: Iterable[str], path: str | os.PathLike[str]) -> list[str]:
    return [name for name in names if getattr(_source(name), "detects", lambda _: False)(path)]


def find_attribution(source: str) -> str:
    """Line that pictures of a data source's scenarios carry; empty for most, and for those of other packages."""
    return getattr(SOURCES.find(source), "attribution", "") if source in _SHIPPED else ""


def guessed_note(sources: Iterable[str], guessed: Iterable[str]) -> str:
    """A sentence on the values that are guessed in some scenarios; empty where none is.

    Args:
        sources: names of the data sources.
        guessed: words of `Scenario.guessed`.
    """
    words, names = sorted(set(guessed)), sorted(set(sources))
    if not words:
        return ""
    return (
        f"Data of {', '.join(names)} with guessed {', '.join(words)}: scores compare with others on the same data only."
    )


def _source(name: str, options: Mapping[str, object] | None = None) -> DataSource:
    """Source of a name, made if it is a class.

    Raises:
        ConfigError: the name is unknown, or not that of a data source, or it does not take an option.
    """
    found = SOURCES.get(name)
    taken = inspect.signature(found).parameters if isinstance(found, type) else {}
    for option in options or {}:
        if option not in taken:
            known = f"it takes {', '.join(taken)}" if taken else "it takes none"
            raise ConfigError(f"data source {name!r} has no option {option!r}: {known}.")
    source = found(**(options or {})) if isinstance(found, type) else found
    missing = [part for part in ("license_note", "find", "read", "describe") if not hasattr(source, part)]
    if missing:
        raise ConfigError(f"data source {name!r} has no {', '.join(missing)}: see rlftsim.scenario.sources.")
    return source
