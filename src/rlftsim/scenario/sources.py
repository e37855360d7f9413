"""Data sources: readers that turn files of one origin into scenarios. `convert` makes a data set of these.

A source is an object (or a class without arguments) under a name in `SOURCES`. One file is enough for a new source:

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

Installed packages announce sources by the entry-point group `rlftsim.sources`.
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
"""Source of files that no source recognizes; the error names the damage."""
_SHIPPED = {
    DEFAULT_SOURCE: "rlftsim.scenario.womd:WomdSource",
    "av2": "rlftsim.scenario.av2:Av2Source",
    "tables": "rlftsim.scenario.tables:TablesSource",
    "gpudrive": "rlftsim.scenario.gpudrive:GpudriveSource",
}
SOURCES: ExtensionPoint[Any] = ExtensionPoint(
    "data source", "rlftsim.sources", _SHIPPED, use=lambda name: _load_source(name)
)


def find_source(reader: str, path: str | os.PathLike[str], options: Mapping[str, object] | None = None) -> DataSource:
    """Source of a name, or for "auto" the source that recognizes the files at a path.

    Args:
        reader: Name in `SOURCES`, or "auto".
        path: File, folder or glob to be converted.
        options: Arguments of the source's class, by name.

    Raises:
        ConfigError: The name is unknown, "auto" and several sources recognize the files, or the source does not take an
            option.
    """
    if reader != AUTO:
        return _load_source(reader, options)
    # Shipped sources come first: then further packages are not even imported.
    names = _detecting(_SHIPPED, path) or _detecting(SOURCES.names(), path)
    if len(names) > 1:
        raise ConfigError(f"{path} could be read as {' or '.join(names)}: name the data source.")
    return _load_source(names[0] if names else DEFAULT_SOURCE, options)


def _detecting(names: Iterable[str], path: str | os.PathLike[str]) -> list[str]:
    return [name for name in names if getattr(_load_source(name), "detects", lambda _: False)(path)]


def find_attribution(source: str) -> str:
    """Line that pictures of a data source's scenarios carry; empty for most, and for sources of further packages."""
    return getattr(SOURCES.find(source), "attribution", "") if source in _SHIPPED else ""


def guessed_note(sources: Iterable[str], guessed: Iterable[str]) -> str:
    """Sentence on the values that are guessed in scenarios; empty without guessed values.

    Args:
        sources: Names of the scenarios' data sources, with repeats.
        guessed: Words of `Scenario.guessed`, with repeats.
    """
    words, names = sorted(set(guessed)), sorted(set(sources))
    if not words:
        return ""
    data = f"Data of {', '.join(names)} with guessed {', '.join(words)}"
    return f"{data}: scores compare with others on the same data only."


def _load_source(name: str, options: Mapping[str, object] | None = None) -> DataSource:
    """Source of a name, made if the name stands for a class.

    Raises:
        ConfigError: The name is unknown, or not of a data source, or the source does not take an option.
    """
    source = SOURCES.get(name)
    parameters = inspect.signature(source).parameters if isinstance(source, type) else {}
    for option in options or {}:
        if option not in parameters:
            choices = f"it takes {', '.join(parameters)}" if parameters else "it takes none"
            raise ConfigError(f"data source {name!r} has no option {option!r}: {choices}.")
    source = source(**(options or {})) if isinstance(source, type) else source
    missing = [member for member in ("license_note", "find", "read", "describe") if not hasattr(source, member)]
    if missing:
        raise ConfigError(f"data source {name!r} has no {', '.join(missing)}: see rlftsim.scenario.sources.")
    return source
