"""Packages of other people, as pip would have installed them, for tests of extension points."""

import importlib
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


def install(folder: Path, name: str, source: str, entry_points: Mapping[str, Mapping[str, str]]) -> Path:
    """Write a package of one file and its metadata; the folder that is to be on sys.path (or PYTHONPATH).

    Args:
        folder: site directory to be, created where it is missing. Several packages may share one.
        name: name of the package, a valid module name that no other module has.
        source: text of its `__init__.py`.
        entry_points: group -> name -> "module:attribute" or "module", such as
            {"rlftsim.policies": {"cruise": "cruise_package:Cruise"}}.
    """
    package, metadata = folder / name, folder / f"{name}-0.1.0.dist-info"
    package.mkdir(parents=True)
    metadata.mkdir()
    (package / "__init__.py").write_text(source)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    lines = [
        line
        for group, entries in entry_points.items()
        for line in (f"[{group}]", *(f"{key} = {value}" for key, value in entries.items()))
    ]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


@contextmanager
def installed(folder: Path, name: str, source: str, entry_points: Mapping[str, Mapping[str, str]]) -> Iterator[Path]:
    """`install` for this process: the folder is on sys.path inside the `with`, and the module is forgotten after it.

    A process started inside (a command-line run) needs the folder on PYTHONPATH, too.
    """
    install(folder, name, source, entry_points)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        yield folder
    finally:
        sys.path.remove(str(folder))
        for module in [m for m in sys.modules if m == name or m.startswith(f"{name}.")]:
            del sys.modules[module]
        importlib.invalidate_caches()
