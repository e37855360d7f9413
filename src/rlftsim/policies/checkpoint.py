"""Model folders of policies of any architecture: config.json, model.safetensors and README.md.

A policy class needs this much to be saved and loaded:

    def save_pretrained(self, folder, *, card=""):
        save_model(folder, self, {"width": self.width}, card=card)

    @classmethod
    def from_pretrained(cls, folder):
        return read_model(folder).load(cls)
"""

import difflib
import json
import os
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.jobs.arrays import read_tensors
from rlftsim.jobs.documents import printable, read_json
from rlftsim.jobs.files import save_tensors, write_text
from rlftsim.jobs.folder import check_folder

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"
SHIPPED_MODELS = Path(__file__).parent / "shipped"
"""A folder for each model in the box, by its registered name."""
_WRITE_AGAIN = "damaged model folder, write it again"
_WRAPPERS = ("_orig_mod.", "module.")
"""Prefixes that torch.compile and distributed training put before the names of all weights."""
_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
SHOWN_PROBLEMS = 6
"""Weights that a message names; a model of other sizes has a hundred that do not fit."""

Loaded = TypeVar("Loaded")


@dataclass(frozen=True, eq=False)
class StoredModel:
    """A model folder's settings; its weights are read on demand."""

    folder: Path
    architecture: str
    """Name of the policy class in `policies.registry.POLICIES`."""
    config: dict[str, Any]
    """Settings that were saved."""

    def read_weights(self) -> dict[str, Tensor]:
        """Weights by name, on the CPU.

        Raises:
            CheckpointError: the file is missing or damaged.
        """
        try:
            return read_tensors(self.folder / WEIGHTS, _WRITE_AGAIN, error=CheckpointError)[0]
        except FileNotFoundError:
            raise CheckpointError(f"{self.folder}: not a model folder, {WEIGHTS} is missing.") from None

    def build(self, make: Callable[..., Loaded]) -> Loaded:
        """Call a class with the stored settings as keyword arguments.

        Raises:
            CheckpointError: settings that it does not take, takes in other types, or cannot do without.
        """
        # JSON has lists where settings have tuples.
        settings = {name: tuple(v) if isinstance(v, list) else v for name, v in self.config.items()}
        kind: Any = make
        try:
            if is_dataclass(kind):
                _require_same_names(settings, kind)
            return make(**settings)
        except (ConfigError, TypeError) as error:
            # a wrong call, not a damaged file: the folder may be of a newer version, or was edited
            cause = " ".join(str(error).split())
            raise CheckpointError(f"{self.folder / CONFIG}: settings do not fit {make.__name__} ({cause}).") from error

    def load(self, make: Callable[..., Loaded]) -> Loaded:
        """Build a policy from the stored settings and load its weights, if it has any.

        Raises:
            CheckpointError: settings or weights that do not fit, or weights that are missing.
        """
        policy = self.build(make)
        if isinstance(policy, nn.Module):
            load_strictly(policy, self.read_weights(), source=str(self.folder))
        return policy


def _require_same_names(settings: Mapping[str, Any], kind: Any) -> None:
    """Refuse settings that a dataclass does not have or that are missing."""
    names = {one.name for one in fields(kind) if one.init}
    # A default in place of a value that is not there would make another model of the same weights.
    missing = sorted(names - settings.keys())
    unknown = sorted(settings.keys() - names)
    if missing or unknown:
        raise ConfigError(
            f"missing: {', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'}; upgrade rlftsim if the "
            "folder is of a newer version, else write it again"
        )


def save_model(
    folder: str | os.PathLike,
    policy: object,
    config: Mapping[str, Any],
    *,
    card: str = "",
    weights: Mapping[str, Tensor] | None = None,
) -> None:
    """Write a model folder.

    Args:
        folder: created where it is missing.
        policy: its class attribute `architecture` is the name it is registered under.
        config: settings it is built with again, values that JSON has.
        card: text of README.md.
        weights: by name; None = the policy's state dict, or no weights file if it is not an nn.Module.

    Raises:
        ConfigError: the policy declares no architecture.
        DataError: the folder cannot be written.
    """
    folder, architecture = Path(folder), getattr(policy, "architecture", None)
    check_folder(folder, "model")
    if not isinstance(architecture, str):
        kind = type(policy).__name__
        raise ConfigError(
            f'{kind} cannot be saved: give the class an attribute such as architecture = "{kind.lower()}".'
        )
    if weights is None and isinstance(policy, nn.Module):
        weights = policy.state_dict()
    if weights is not None:
        save_tensors(folder / WEIGHTS, weights)
    write_text(folder / CARD, card or f"A traffic model ({architecture}). Origin unknown.\n")
    # last, so that a folder with a config.json is complete
    write_text(folder / CONFIG, json.dumps({"architecture": architecture, **config}, indent=1) + "\n")


def read_model(folder: str | os.PathLike, *, architecture: str | None = None) -> StoredModel:
    """Settings of a model folder, or of the one inside a run's folder.

    Args:
        folder: the model's or the run's.
        architecture: refuse models of another one; None = any.

    Raises:
        ConfigError: there is no such folder.
        CheckpointError: it is not a model folder, is damaged, belongs to a run that has not finished, or holds
            another architecture.
    """
    path = find_model(folder)
    try:
        values = read_json(path / CONFIG, _WRITE_AGAIN, allow_nan=True, error=CheckpointError)
    except FileNotFoundError:
        inside = list_models(path)
        hint = f": did you mean {' or '.join(str(path / name) for name in inside)}?" if inside else "."
        raise CheckpointError(f"{path}: not a model folder, {CONFIG} is missing{hint}") from None
    stored = values.pop("architecture", None)
    if not isinstance(stored, str):
        # a run's folder has a config.json of its own beside its checkpoints
        is_run = (path / "environment.json").exists() or (path / "checkpoints").is_dir()
        raise CheckpointError(
            f"{path}: the run has not finished, it has no model folder yet: run its command again to go on."
            if is_run
            else f"{path / CONFIG}: names no architecture, so this is no model folder."
        )
    if architecture not in (None, stored):
        raise CheckpointError(f"{path}: not a {architecture} model, its architecture is {stored!r}.")
    return StoredModel(path, stored, values)


def find_model(name: str | os.PathLike) -> Path:
    """Model folder of a name: the folder itself, or the one inside a run's folder.

    Raises:
        ConfigError: there is no such folder.
    """
    folder = Path(name).expanduser()
    if folder.is_file():
        raise ConfigError(f"{str(name)!r} is a file: name its folder, {folder.parent}.")
    if (folder / "model" / CONFIG).exists():
        folder = folder / "model"
    if not folder.is_dir():
        if _ships(name):
            raise ConfigError(f"{str(name)!r} is no folder but a model in the box: rs.load_policy({name!r}) loads it.")
        near = similar_model(folder)
        raise ConfigError(
            f"{str(name)!r} is no model folder: there is none of that name"
            + (f", did you mean {near!r}?" if near else ".")
        )
    return folder


def read_card(name: str | os.PathLike, *, deeper: int = 2) -> str | None:
    """Card of a model; None where there is no such folder, or no card in it.

    Args:
        name: of a shipped model, a model folder or a run's folder.
        deeper: levels that its headings go down, to stand in another text.
    """
    try:
        folder = SHIPPED_MODELS / name if _ships(name) else find_model(name)
        text = (folder / CARD).read_text(encoding="utf-8", errors="replace")
    except (ConfigError, OSError):
        return None
    return re.sub(r"^#+", lambda found: "#" * min(len(found[0]) + deeper, 6), text.strip(), flags=re.MULTILINE)


def _ships(name: str | os.PathLike) -> bool:
    """True for the name of a model in the box; as in `load_policy`, "./demo-base" is a folder."""
    return isinstance(name, str) and Path(name).name == name and (SHIPPED_MODELS / name / CARD).is_file()


def list_models(folder: Path) -> list[str]:
    """Names of the model folders and finished runs directly in a folder; empty where there is no such folder."""
    if not folder.is_dir():
        return []
    places = (CONFIG, f"model/{CONFIG}")
    return sorted(path.name for path in folder.iterdir() if any((path / place).is_file() for place in places))


def similar_model(folder: Path) -> str | None:
    """A model folder or run beside a missing one, of a similar name; None if there is none."""
    near = difflib.get_close_matches(folder.name, list_models(folder.parent), n=1)
    return str(folder.parent / near[0]) if near else None


def load_strictly(module: nn.Module, weights: Mapping[str, Tensor], *, source: str) -> None:
    """Load weights; refuse missing or unknown keys, wrong shapes and NaN, and name the first of them.

    Args:
        module: receives the weights.
        weights: by name, as in the module's state dict.
        source: place they come from, for the message.

    Raises:
        CheckpointError: anything differs, or a weight is not finite.
    """
    own = module.state_dict()
    weights = strip_wrappers(weights, own)
    check_shapes(weights, own, source=source)
    # Buffers may hold infinities, such as a mask.
    parameters = {name for name, _ in module.named_parameters()}
    broken = [
        name for name in own if not (weights[name].isfinite() if name in parameters else ~weights[name].isnan()).all()
    ]
    if broken:
        shown = ", ".join(broken[:SHOWN_PROBLEMS]) + (" …" if len(broken) > SHOWN_PROBLEMS else "")
        raise CheckpointError(f"{source}: weights are not finite ({shown}): take an earlier checkpoint or train again.")
    module.load_state_dict(weights)


def strip_wrappers(weights: Mapping[str, Tensor], names: Collection[str]) -> Mapping[str, Tensor]:
    """Weights without the prefix that torch.compile or distributed training put before the names of all of them.

    Args:
        weights: Tensors by name, as a file has them.
        names: Names that are wanted; a prefix that begins one of them is a part of the name.
    """
    for prefix in (p for _ in _WRAPPERS for p in _WRAPPERS):
        if all(name.startswith(prefix) for name in weights) and not any(name.startswith(prefix) for name in names):
            weights = {name.removeprefix(prefix): value for name, value in weights.items()}
    return weights


def check_shapes(weights: Mapping[str, Tensor], own: Mapping[str, Tensor], *, source: str) -> None:
    """Check that weights have the names, shapes and kinds of numbers of a model, which may be on no device.

    Args:
        weights: Tensors by name, as a file has them.
        own: State dict of the model.
        source: Place the weights come from, for the message.

    Raises:
        CheckpointError: Anything differs; the message names the first few.
    """
    problems = [f"missing {k}" for k in sorted(own.keys() - weights.keys())]
    problems += [f"unknown {k[:100]}" for k in sorted(weights.keys() - own.keys())]
    problems += [
        f"{k} has shape {tuple(weights[k].shape)} instead of {tuple(own[k].shape)}"
        for k in sorted(own.keys() & weights.keys())
        if own[k].shape != weights[k].shape
    ]
    problems += [
        f"{k} holds {weights[k].dtype} instead of {own[k].dtype}"
        for k in sorted(own.keys() & weights.keys())
        if weights[k].dtype != own[k].dtype and not (weights[k].dtype in _FLOATS and own[k].dtype in _FLOATS)
    ]
    if problems:
        shown = "; ".join(problems[:SHOWN_PROBLEMS]) + (" …" if len(problems) > SHOWN_PROBLEMS else "")
        raise CheckpointError(f"{source}: {len(problems)} weights do not fit this model: {printable(shown)}.")


class _NoDraws(TorchFunctionMode):
    """Draws no normal numbers, and keeps sequences in memory: torch needs imports of seconds for either without."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        if func.__name__ == "normal_":
            return next(iter((*args, *kwargs.values())))
        return func(*args, **kwargs, **({"device": "cpu"} if func.__name__ in ("linspace", "logspace") else {}))


def outline(make: Callable[[], nn.Module]) -> dict[str, Tensor]:
    """State dict of a network that is built without memory: names, shapes and kinds of numbers.

    Args:
        make: Builds the network on torch's default device.
    """
    with torch.device("meta"), _NoDraws():
        return make().state_dict()


def check_fit(make: Callable[[], nn.Module], weights: Mapping[str, Tensor], *, source: str) -> None:
    """Check that weights fit a network before it is built: its settings may be damaged, and ask for any memory.

    Args:
        make: Builds the network on torch's default device, which is one without memory here.
        weights: Stored weights by name.
        source: Place the weights come from, for the message.

    Raises:
        CheckpointError: The weights have other names, shapes or kinds of numbers.
    """
    own = outline(make)
    check_shapes(strip_wrappers(weights, own), own, source=source)
