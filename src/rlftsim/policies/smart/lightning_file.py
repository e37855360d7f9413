"""Weights and settings of a Lightning checkpoint, without running code of the file.

Such files are pickles, read through torch's restricted unpickler. The few foreign classes that hold settings
(OmegaConf) are replaced by name with an inert stand-in, all further classes are refused.
"""

import collections
import typing
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rlftsim.errors import CheckpointError
from rlftsim.jobs.documents import first_line


class _Inert:
    """Stand-in for foreign classes: holds the state of an object and runs no code."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


_FOREIGN = (
    "omegaconf.dictconfig.DictConfig",
    "omegaconf.listconfig.ListConfig",
    "omegaconf.nodes.AnyNode",
    "omegaconf.base.ContainerMetadata",
    "omegaconf.base.Metadata",
)
_HARMLESS = {
    "typing.Any": typing.Any,
    "collections.defaultdict": collections.defaultdict,
    "builtins.list": list,
    "builtins.dict": dict,
    "builtins.int": int,
}


def read_lightning(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights of a Lightning checkpoint, and the file's `hyper_parameters` as plain dictionaries, lists and values.

    Raises:
        CheckpointError: No such file, not a checkpoint, no weights inside, or objects that would have to run code to
            be read.
    """
    content = _unpickle(path)
    weights = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(weights, dict) or not all(_is_weight(k, v) for k, v in weights.items()):
        raise CheckpointError(f"{path}: no weights under 'state_dict': is it a Lightning checkpoint of a model?")
    try:
        settings = _plain(content.get("hyper_parameters", {}))
    except RecursionError:
        raise CheckpointError(f"{path}: damaged, its settings hold themselves: get the file again.") from None
    return dict(weights), settings if isinstance(settings, dict) else {}


def find_group(settings: dict[str, Any], name: str) -> dict[str, Any]:
    """Group of settings of a name; empty where there is none."""
    group = settings.get(name)
    return group if isinstance(group, dict) else {}


def _is_weight(name: object, value: Any) -> bool:
    """True for a dense tensor on the CPU with all values stored: views may announce more than memory holds."""
    if not isinstance(name, str) or type(value) not in (Tensor, nn.Parameter) or value.layout != torch.strided:
        return False
    return value.device.type == "cpu" and value.numel() * value.element_size() <= value.untyped_storage().nbytes()


def _unpickle(path: Path) -> Any:
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file.")
    try:
        if not zipfile.is_zipfile(path):
            raise CheckpointError(f"{path}: neither safetensors nor a Lightning checkpoint (a zip file by torch.save).")
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise CheckpointError(f"{path}: packed, which torch.save never does: unpack it, or get the file again.")
        # list the classes that the pickle names before any is made
        named = torch.serialization.get_unsafe_globals_in_checkpoint(path)
        refused = sorted(set(named) - set(_FOREIGN) - set(_HARMLESS))
        if refused:
            raise CheckpointError(f"{path}: refused, it holds {', '.join(refused)}: save it again with weights only.")
        # then let torch's restricted unpickler make the harmless classes, and stand-ins for the foreign
        classes: Any = [(_Inert, name) for name in _FOREIGN] + [(value, name) for name, value in _HARMLESS.items()]
        with torch.serialization.safe_globals(classes):
            return torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except Exception as error:  # whatever damage makes of the code that reads it
        reason = first_line(error)
        raise CheckpointError(f"{path}: damaged or not a checkpoint ({reason}): get the file again.") from None


def _plain(value: Any) -> Any:
    """Settings as plain dictionaries, lists and values; values of other types become None."""
    if isinstance(value, _Inert):
        # OmegaConf keeps containers in `_content` and values in `_val`
        state = value.__dict__
        return _plain(state["_content"] if "_content" in state else state.get("_val"))
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value if isinstance(value, str | int | float | bool) else None
