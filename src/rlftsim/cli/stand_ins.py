"""Imports without the libraries that take seconds to load, for help texts.

A help text needs the names, types and docstrings of settings, not torch. Meanwhile slow libraries are
replaced by stand-ins that accept whatever a module does with a library while it is imported: subclass,
annotate, decorate, call. (Sphinx documents packages in the same way: `autodoc_mock_imports`.)
"""

import importlib.abc
import importlib.machinery
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

KEPT = {*sys.stdlib_module_names}
"""Packages that cannot hold a stand-in: they import no slow library. numpy also refuses to be loaded twice."""
ENGINES = (
    *("realism", "viewer", "scenario.womd_pb2", "evaluation.submission_pb2", "evaluation.explain", "training.run"),
    *("policies.smart.policy", "policies.trafficbots.policy", "evaluation.learning_curve", "rollout.simulate"),
    *("training.trackers", "evaluation.evaluate", "evaluation.compare", "evaluation.explain_page", "recipes.train"),
    *("evaluation.scenario_source", "evaluation.rollout_files", "evaluation.resumable", "scenario.inspect"),
    "policies.calibrated.policy",
)
"""Modules of this package that do the work, and have no setting and no flag."""
SLOW = (
    *("torch", "numpy", "jaxtyping", "google", "lightning_fabric", "scipy", "matplotlib", "pyarrow", "safetensors"),
    *("PIL", "imageio_ffmpeg", *(f"rlftsim.{name}" for name in ENGINES)),
)


class _StandIn:
    """Stands for a class or a value: any attribute, an empty sequence."""

    def __getattr__(self: Any, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Anything

    def __iter__(self) -> Iterator[Any]:
        return iter(())

    def __len__(self) -> int:
        return 0


class _AnyClass(_StandIn, type):
    """Class of a stand-in, with attributes and unions that are stand-ins, too."""


class _Anything(_StandIn, metaclass=_AnyClass):
    """Stands for any class, function, constant or decorator of a slow library."""

    def __new__(cls, *arguments: Any, **options: Any) -> Any:
        # A decorator without arguments hands back what it decorates, so that docstrings and signatures survive.
        if cls is _Anything and len(arguments) == 1 and callable(arguments[0]) and not options:
            return arguments[0]
        return super().__new__(cls)

    def __init__(self, *arguments: Any, **options: Any) -> None:
        pass

    def __class_getitem__(cls, item: object) -> type:
        return cls

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return _Anything(*arguments, **options)

    def __getitem__(self, item: object) -> Any:
        return self

    def __float__(self) -> float:
        return 0.0


for _operation in ("mul", "truediv", "floordiv", "sub", "add", "or"):
    for _name in (f"__{_operation}__", f"__r{_operation}__"):
        setattr(_AnyClass, _name, lambda self, other: _Anything)
        setattr(_Anything, _name, lambda self, other: self)


class _EmptyModule(ModuleType):
    __path__: Sequence[str] = ()
    __getattr__ = _StandIn.__getattr__


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds an empty module for every slow library and submodule."""

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> Any:
        is_slow = any(fullname == name or fullname.startswith(f"{name}.") for name in SLOW)
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True) if is_slow else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        return _EmptyModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


@contextmanager
def stand_ins() -> Iterator[None]:
    """Replace slow libraries in imports inside the `with`; modules imported inside are forgotten afterwards.

    Does nothing where torch is loaded already: then there is no time to save.
    """
    if "torch" in sys.modules:
        yield
        return
    finder, before = _Finder(), set(sys.modules)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        # All, those of other packages included: any of them may hold a stand-in by name, base class or default.
        for name in set(sys.modules) - before:
            if name.partition(".")[0] not in KEPT:
                _forget(name)


def _forget(name: str) -> None:
    """Remove a module, also from its package: `from package import module` would find it there."""
    module = sys.modules.pop(name)
    package, _, last = name.rpartition(".")
    if getattr(sys.modules.get(package), last, None) is module:
        delattr(sys.modules[package], last)
