"""Checkpoints: everything a run needs to go on, in files that execute nothing.

A checkpoint is a folder `update-00000120` with safetensors and a JSON file. It is written under another name and renamed when it is
whole, so what carries the name is never half-written.
"""

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.optim import Optimizer

from rlftsim.errors import CheckpointError
from rlftsim.files import save_tensors, write_text

PREFIX = "update-"
KEPT = 2
"""Checkpoints that are kept; older ones are removed."""


@dataclass(frozen=True)
class Progress:
    """Where a run is."""

    update: int = 0
    """Updates done."""
    numbers: dict[str, float] = field(default_factory=dict)
    """What else changes from update to update, such as beta."""


def write_checkpoint(folder: Path, progress: Progress, modules: dict[str, nn.Module], optimizer: Optimizer) -> Path:
    """Write a checkpoint of a run into `folder` and remove all but the newest.

    Args:
        folder: the run's folder of checkpoints.
        progress: where the run is.
        modules: weights by file name, such as policy and reference.
        optimizer: its moments are kept too.
    """
    target = folder / f"{PREFIX}{progress.update:08d}"
    partial = folder / f".partial-{target.name}"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for name, module in modules.items():
        save_tensors(partial / f"{name}.safetensors", module.state_dict())
    save_tensors(partial / "optimizer.safetensors", _optimizer_tensors(optimizer))
    write_text(partial / "progress.json", json.dumps({"update": progress.update, "numbers": progress.numbers}))
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)
    for old in sorted(folder.glob(f"{PREFIX}*"))[:-KEPT]:
        shutil.rmtree(old)
    return target


def newest_checkpoint(folder: Path) -> Path | None:
    """The latest whole checkpoint of a run; None = it has none yet."""
    return max(folder.glob(f"{PREFIX}*"), default=None)


def read_checkpoint(path: Path, modules: dict[str, nn.Module], optimizer: Optimizer) -> Progress:
    """Load weights and moments in place and say where the run was.

    Raises:
        CheckpointError: damaged, or of another model.
    """
    try:
        for name, module in modules.items():
            module.load_state_dict(load_file(path / f"{name}.safetensors"))
        _load_optimizer(optimizer, load_file(path / "optimizer.safetensors"))
        values = json.loads((path / "progress.json").read_text())
        return Progress(values["update"], values["numbers"])
    except (OSError, SafetensorError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{path}: cannot go on from it ({error}): delete this folder to go on from an older one."
        ) from None


def _optimizer_tensors(optimizer: Optimizer) -> dict[str, Tensor]:
    states = optimizer.state_dict()["state"]
    return {f"{i}.{name}": value.detach().cpu().contiguous() for i, s in states.items() for name, value in s.items()}


def _load_optimizer(optimizer: Optimizer, tensors: dict[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = value
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})
