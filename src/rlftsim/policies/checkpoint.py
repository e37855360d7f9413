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
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from rlftsim.errors import CheckpointError, ConfigError, printable
from rlftsim.jobs.arrays import find_misfits, read_tensors
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import new_folder, save_tensors, write_text
from rlftsim.jobs.folder import check_folder
from rlftsim.policies.hub import is_hub_url, pull_model

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"
SHIPPED_MODELS = Path(__file__).parent / "shipped"
"""A folder for each model in the box, by its registered name."""
_REPAIR = "damaged model folder, write it again"
_WRAPPERS = ("_orig_mod.", "module.")
"""Prefixes that torch.compile and distributed training put before the names of all weights."""
SHOWN_PROBLEMS = 6
"""Number of weights that a message names; in a model of other sizes a hundred do not fit."""

Loaded = TypeVar("Loaded")


@dataclass(frozen=True, eq=False)
class StoredModel:
    """A model folder's settings; the weights are read on demand."""

    folder: Path
    architecture: str
    """Name of the policy class in `policies.registry.POLICIES`."""
    config: dict[str, Any]
    """Settings that were saved."""

    def read_weights(self) -> dict[str, Tensor]:
        """Weights by name, on the CPU.

        Raises:
            CheckpointError: The file is missing or damaged.
        """
        missing = f"{self.folder}: not a model folder, {WEIGHTS} is missing."
        return read_tensors(self.folder / WEIGHTS, _REPAIR, error=CheckpointError, missing=missing)[0]

    def build(self, make: Callable[..., Loaded]) -> Loaded:
        """Result of a call with the stored settings as keyword arguments.

        Args:
            make: Class, such as the dataclass of the settings, or function.

        Raises:
            CheckpointError: Settings are unknown, of wrong types, or missing.
        """
        # JSON has lists where settings have tuples.
        settings = {name: tuple(v) if isinstance(v, list) else v for name, v in self.config.items()}
        try:
            settings_type: Any = make
            if is_dataclass(settings_type):
                _check_names(settings, {field.name for field in fields(settings_type) if field.init})
            return make(**settings)
        except (ConfigError, TypeError) as error:
            # a wrong call, not a damaged file: the folder may be of a newer version, or was edited
            cause = " ".join(str(error).split())
            raise CheckpointError(f"{self.folder / CONFIG}: settings do not fit {make.__name__} ({cause}).") from error

    def pop(self, name: str, make: Callable[..., Loaded]) -> Loaded:
        """Take out of the settings those of a section, which may be missing, and build what they describe.

        Args:
            name: Name of the section, an object in config.json.
            make: Dataclass of the settings; with its defaults where the section is missing.

        Raises:
            CheckpointError: The section is no object, or its settings are unknown or of wrong types.
        """
        section = self.config.pop(name, None)
        if section is None:
            return make()
        if not isinstance(section, dict):
            raise CheckpointError(f"{self.folder / CONFIG}: {name} has to be an object: write the folder again.")
        return replace(self, config=section).build(make)

    def load(self, make: Callable[..., Loaded]) -> Loaded:
        """Policy built from the stored settings, with the stored weights if there are any.

        Args:
            make: Class of the policy, called with the settings as keyword arguments.

        Raises:
            CheckpointError: Settings or weights do not fit, or weights are missing.
        """
        policy = self.build(make)
        if isinstance(policy, nn.Module):
            load_strictly(policy, self.read_weights(), source=str(self.folder))
        return policy


def _check_names(settings: Mapping[str, Any], names: set[str]) -> None:
    """Check that the settings are those of a dataclass: a default for a missing value would make a different model."""
    missing, extra = (", ".join(sorted(s)) or "none" for s in (names - settings.keys(), settings.keys() - names))
    if settings.keys() != names:
        raise ConfigError(
            f"missing: {missing}; unknown: {extra}; upgrade rlftsim if the folder is of a newer version, else write it "
            "again"
        )


def save_model(
    folder: str | os.PathLike,
    policy: object,
    config: Mapping[str, Any],
    *,
    card: str = "",
    weights: Mapping[str, Tensor] | None = None,
    extra: Mapping[str, Callable[[Path], object]] | None = None,
) -> None:
    """Write a model folder.

    Args:
        folder: Folder of the model, created where it is missing.
        policy: Policy with the registered name as class attribute `architecture`.
        config: Settings that the policy is built with when loaded, values that JSON has.
        card: Text of README.md; empty = a line that says that the origin is unknown.
        weights: Tensors by name; None = the policy's state dict, or no weights file for a policy that is no nn.Module.
        extra: Functions that write further files, by name of the file; None = no more files.

    Raises:
        ConfigError: The policy declares no architecture.
        DataError: The folder cannot be written.
    """
    folder, architecture = Path(folder), getattr(policy, "architecture", None)
    check_folder(folder, "model")
    if not isinstance(architecture, str):
        name = type(policy).__name__
        raise ConfigError(
            f'{name} cannot be saved: give the class an attribute such as architecture = "{name.lower()}".'
        )
    if weights is None and isinstance(policy, nn.Module):
        weights = policy.state_dict()
    folder.mkdir(parents=True, exist_ok=True)
    for name, write in (extra or {}).items():
        write(folder / name)
    if weights is not None:
        save_tensors(folder / WEIGHTS, weights)
    write_text(folder / CARD, card or f"A traffic model ({architecture}). Origin unknown.\n")
    # last, so that a folder with a config.json is complete
    write_text(folder / CONFIG, json.dumps({"architecture": architecture, **config}, indent=1) + "\n")


def save_new_model(policy: Any, folder: Path, *, card: str) -> None:
    """Write a model to a folder, whole or not at all.

    Args:
        policy: Policy with a method `save_pretrained`.
        folder: Folder of the model; missing or empty.
        card: Text of the model's README.md.

    Raises:
        DataError: The folder cannot be written, such as on a full disk, or is not empty.
    """
    with new_folder(folder) as partial:
        policy.save_pretrained(partial, card=card)


def read_model(folder: str | os.PathLike, *, architecture: str | None = None) -> StoredModel:
    """Settings of a model folder, or of the model folder inside a run's folder.

    Args:
        folder: Model folder, or folder of a finished run.
        architecture: Registered name that the model must have; None = any.

    Raises:
        ConfigError: There is no such folder.
        CheckpointError: The folder holds no model, is damaged, belongs to a run that has not finished, or holds
            a different architecture.
    """
    path = find_model(folder)
    try:
        values = read_json(path / CONFIG, _REPAIR, allow_nan=True, error=CheckpointError)
    except FileNotFoundError:
        names = list_models(path)
        hint = f": did you mean {' or '.join(str(path / name) for name in names)}?" if names else "."
        raise CheckpointError(f"{path}: not a model folder, {CONFIG} is missing{hint}") from None
    stored = values.pop("architecture", None)
    if not isinstance(stored, str):
        # a run's folder has a config.json, too, beside the checkpoints
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
    """Path of a model folder.

    Args:
        name: Model folder, or folder of a finished run, which has a model folder inside, or hf://USER/NAME[@REVISION].

    Raises:
        ConfigError: There is no such folder.
    """
    folder = pull_model(name) if is_hub_url(name) else Path(name).expanduser()
    if folder.is_file():
        is_foreign = folder.suffix == ".ckpt"
        way_out = "import it, rlftsim model import --from catk" if is_foreign else f"name its folder, {folder.parent}"
        raise ConfigError(f"{str(name)!r} is a file: {way_out}.")
    if (folder / "model" / CONFIG).exists():
        folder = folder / "model"
    if not folder.is_dir():
        if _ships(name):
            raise ConfigError(f"{str(name)!r} is no folder but a model in the box: rs.load_policy({name!r}) loads it.")
        match = find_similar_model(folder)
        hint = f", did you mean {match!r}?" if match else "."
        raise ConfigError(f"{str(name)!r} is no model folder: there is none of that name{hint}")
    return folder


def read_card(name: str | os.PathLike, *, heading_shift: int = 2) -> str | None:
    """Card of a model; None where there is no such folder, or no card.

    Args:
        name: Name of a shipped model, a model folder or a run's folder.
        heading_shift: Number of levels that headings go down, for a card inside a longer text.
    """
    try:
        folder = SHIPPED_MODELS / name if _ships(name) else find_model(name)
        text = (folder / CARD).read_text(encoding="utf-8", errors="replace")
        text = re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)  # the header of a hub
    except (ConfigError, OSError):
        return None
    return re.sub(r"^#+", lambda match: "#" * min(len(match[0]) + heading_shift, 6), text.strip(), flags=re.MULTILINE)


def _ships(name: str | os.PathLike) -> bool:
    """True for the name of a model in the box; as in `load_policy`, "./demo-base" is a folder."""
    return isinstance(name, str) and Path(name).name == name and (SHIPPED_MODELS / name / CARD).is_file()


def list_models(folder: Path) -> list[str]:
    """Names of the model folders and finished runs directly in a folder; empty where there is no such folder."""
    if not folder.is_dir():
        return []
    files = (CONFIG, f"model/{CONFIG}")
    return sorted(path.name for path in folder.iterdir() if any((path / file).is_file() for file in files))


def find_similar_model(folder: Path) -> str | None:
    """Model folder or run beside a missing folder, of a similar name; None without such a name."""
    matches = difflib.get_close_matches(folder.name, list_models(folder.parent), n=1)
    return str(folder.parent / matches[0]) if matches else None


def load_strictly(module: nn.Module, weights: Mapping[str, Tensor], *, source: str) -> None:
    """Load weights; missing or unknown keys, wrong shapes and NaN are refused.

    Args:
        module: Module that receives the weights.
        weights: Tensors by name, as in the module's state dict.
        source: File or folder of the weights, which the message of an error names.

    Raises:
        CheckpointError: A name, shape or type differs, or a weight is not finite; the message names the first few.
    """
    expected = module.state_dict()
    weights = strip_wrappers(weights, expected)
    check_shapes(weights, expected, source=source)
    parameters = dict(module.named_parameters())
    # Buffers may hold infinities, such as a mask.
    is_valid = {name: weights[name].isfinite() if name in parameters else ~weights[name].isnan() for name in expected}
    broken = [name for name, valid in is_valid.items() if not valid.all()]
    if broken:
        names = join_first(broken, ", ")
        raise CheckpointError(f"{source}: weights are not finite ({names}): take an earlier checkpoint or train again.")
    module.load_state_dict(weights)


def strip_wrappers(weights: Mapping[str, Tensor], names: Collection[str]) -> Mapping[str, Tensor]:
    """Weights without the prefixes that torch.compile and distributed training put before all names.

    Args:
        weights: Tensors by name, as in a file.
        names: Expected names; a prefix that begins an expected name stays.
    """
    for prefix in (p for _ in _WRAPPERS for p in _WRAPPERS):
        if all(name.startswith(prefix) for name in weights) and not any(name.startswith(prefix) for name in names):
            weights = {name.removeprefix(prefix): value for name, value in weights.items()}
    return weights


def check_shapes(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor], *, source: str) -> None:
    """Check that weights have the names, shapes and number types of a model, which may be on no device.

    Args:
        weights: Tensors by name, as in a file.
        expected: State dict of the model; only names, shapes and types are read.
        source: File or folder of the weights, which the message of an error names.

    Raises:
        CheckpointError: A name, shape or type differs; the message names the first few.
    """
    if problems := find_misfits(weights, expected, may_convert=True):
        text = printable(join_first(problems, "; "))
        raise CheckpointError(f"{source}: {len(problems)} weights do not fit this model: {text}.")


def join_first(problems: list[str], separator: str) -> str:
    """The first few of some problems as a text, followed by an ellipsis where there are more.

    Args:
        problems: Problems in the order to be shown.
        separator: Text between two problems.
    """
    return separator.join(problems[:SHOWN_PROBLEMS]) + (" …" if len(problems) > SHOWN_PROBLEMS else "")


class _NoDraws(TorchFunctionMode):
    """Mode without normal draws, and with sequences in memory: on the meta device torch would import for seconds."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        if func.__name__ == "normal_":
            return next(iter((*args, *kwargs.values())))
        return func(*args, **kwargs, **({"device": "cpu"} if func.__name__ in ("linspace", "logspace") else {}))


def outline(make: Callable[[], nn.Module]) -> dict[str, Tensor]:
    """State dict of a network that is built without memory: names, shapes and number types.

    Args:
        make: Function that builds the network on torch's default device.
    """
    with torch.device("meta"), _NoDraws():
        return make().state_dict()


def load_network(make: Callable[[], Loaded], weights: Mapping[str, Tensor], *, source: Path) -> Loaded:
    """Policy whose `network` has the given weights.

    The weights are compared with an outline before the policy is built: damaged settings may ask for any memory.

    Args:
        make: Function that builds the policy on torch's default device.
        weights: Stored weights of the network by name.
        source: Folder of the weights, which the message of an error names.

    Raises:
        ConfigError: The policy refuses its settings.
        CheckpointError: The weights have other names, shapes or number types, or are not finite.
    """
    try:
        expected = outline(lambda: cast(Any, make()).network)
    except ConfigError as error:
        raise ConfigError(f"{source / CONFIG}: {error}") from error
    check_shapes(strip_wrappers(weights, expected), expected, source=str(source))
    policy: Any = make()
    load_strictly(policy.network, weights, source=str(source))
    return policy


def are_frozen_alike(weights: Iterable[Tensor], reference: Iterable[Tensor]) -> bool:
    """True if the weights of two models are equal, and no weight requires a gradient.

    Args:
        weights: Weights of the first model.
        reference: Weights of the second model, in the same order and of the same shapes.
    """
    pairs = list(zip(weights, reference, strict=True))
    if any(weight.requires_grad for pair in pairs for weight in pair):
        return False
    # a single tensor, which the host waits for once
    differs = [(weight != counterpart).any() for weight, counterpart in pairs if weight is not counterpart]
    return not differs or not bool(torch.stack(differs).any())
