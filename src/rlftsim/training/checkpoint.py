"""Checkpoints: all that a run resumes from, in files without code.

A folder `update-00000120` has safetensors and a JSON file. It is written under a temporary name and renamed when whole,
so a folder of that name is never half-written.
"""

import json
import math
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torch.optim import Optimizer

from rlftsim.errors import CheckpointError
from rlftsim.jobs.arrays import find_misfits, read_tensors
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import errors_name, remove_folder, save_tensors, write_text

PREFIX = "update-"
NUM_CHECKPOINTS = 2
"""Number of checkpoints that are kept; older ones are removed."""


@dataclass(frozen=True)
class Progress:
    """Position of a run."""

    update: int = 0
    """Updates done."""
    numbers: dict[str, float] = field(default_factory=dict)
    """Further state that changes from update to update, such as beta."""


def write_checkpoint(folder: Path, progress: Progress, modules: dict[str, nn.Module], optimizer: Optimizer) -> Path:
    """Write a checkpoint of a run into `folder` and remove all but the newest.

    Args:
        folder: Folder of the run's checkpoints.
        progress: Position of the run.
        modules: Weights by file name, such as policy and reference.
        optimizer: Optimizer with the moments to store, too.

    Raises:
        DataError: A file cannot be written, such as on a full disk; names it. Older checkpoints are untouched.
    """
    target = folder / f"{PREFIX}{progress.update:08d}"
    partial = folder / f".partial-{target.name}"
    files = (*(f"{name}.safetensors" for name in (*modules, "optimizer")), "progress.json")
    with errors_name(target):
        remove_folder(partial, files)  # left by a run that was killed
        partial.mkdir(parents=True, exist_ok=True)
        for name, module in modules.items():
            save_tensors(partial / f"{name}.safetensors", module.state_dict())
        # "0.exp_avg" = the first moment of the first parameter, in the order of the optimizer's groups.
        states = optimizer.state_dict()["state"]
        tensors = {f"{i}.{name}": value.detach().cpu() for i, state in states.items() for name, value in state.items()}
        save_tensors(partial / "optimizer.safetensors", tensors)
        write_text(partial / "progress.json", json.dumps({"update": progress.update, "numbers": progress.numbers}))
        remove_folder(target, files)
        partial.rename(target)
        # Only now is an older one expendable.
        remove_old_checkpoints(folder)
    return target


def remove_old_checkpoints(folder: Path) -> None:
    """Remove all checkpoints of a run but the newest, and half checkpoints of a killed run."""
    # Names are padded with zeros, so their order is that of the updates.
    for old in list_checkpoints(folder)[:-NUM_CHECKPOINTS]:
        remove_folder(old, [*(path.name for path in old.glob("*.safetensors")), "progress.json"])
    for partial in folder.glob(f".partial-{PREFIX}*"):
        shutil.rmtree(partial, ignore_errors=True)


def newest_checkpoint(folder: Path) -> Path | None:
    """The latest whole checkpoint of a run; None if there is none yet."""
    return max(list_checkpoints(folder), default=None)


def list_checkpoints(folder: Path) -> list[Path]:
    """Whole checkpoints of a run, the latest last; other files of a similar name belong to a user."""
    return sorted(path for path in folder.glob(f"{PREFIX}*") if path.name.removeprefix(PREFIX).isdecimal())


def parse_update(path: Path) -> int:
    """Updates that a run had done at a checkpoint."""
    return int(path.name.removeprefix(PREFIX))


def read_checkpoint(
    path: Path, modules: dict[str, nn.Module], optimizer: Optimizer, names: Collection[str] = ()
) -> Progress:
    """Load weights and moments in place.

    Args:
        path: Folder of the checkpoint, named after the update.
        modules: Modules by the names that `write_checkpoint` got; weights are loaded in place.
        optimizer: Optimizer with the same parameters in the same order; the learning rate stays.
        names: Names of the numbers that the progress must have.

    Returns:
        The position of the run.

    Raises:
        CheckpointError: damaged, or of a different model.
    """
    way_out = "cannot go on from it, delete this folder to go on from an older one"
    try:
        values = read_json(path / "progress.json", way_out, error=CheckpointError)
        # everything is checked before anything is loaded
        *files, moments = (
            read_tensors(path / f"{name}.safetensors", way_out, error=CheckpointError)[0]
            for name in (*modules, "optimizer")
        )
        weights = dict(zip(modules, files))
        _check_progress(values, parse_update(path), names)
        for name, module in modules.items():
            check_weights(name, weights[name], module)
        state = _parse_moments(moments, optimizer)
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: {Path(error.filename or '').name or 'a file'} is missing: {way_out}.") from None
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}: {way_out}.") from None
    for name, module in modules.items():
        module.load_state_dict(weights[name])
    # The groups are the new optimizer's own: learning rate and scales follow the settings, not the file.
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return Progress(values["update"], values["numbers"])


def _check_progress(values: Mapping[str, Any], update: int, names: Collection[str]) -> None:
    """Check the position of a run against the name of the folder.

    Raises:
        ValueError: A position of a different update, or a number that is missing or not finite.
    """
    if type(values.get("update")) is not int or values["update"] != update:
        raise ValueError(f"its update is {str(values.get('update'))[:40]!r}, not {update}")
    numbers = values.get("numbers")
    if not isinstance(numbers, dict) or not all(type(v) in (int, float) and math.isfinite(v) for v in numbers.values()):
        raise ValueError("its numbers are not finite numbers by name")
    if missing := [name for name in names if name not in numbers]:
        raise ValueError(f"its progress lacks the number {missing[0]}")


def check_weights(name: str, weights: Mapping[str, Tensor], module: nn.Module) -> None:
    """Check that weights are those of a module, number for number.

    Raises:
        ValueError: A wrong name, shape or dtype, or a weight that is not finite.
    """
    state = module.state_dict()
    if misfits := find_misfits(weights, state):
        raise ValueError(f"{name}: {misfits[0]}")
    for key in state.keys() & dict(module.named_parameters()).keys():
        if not weights[key].isfinite().all():
            raise ValueError(f"{key} of {name} is not finite")


def _parse_moments(moments: Mapping[str, Tensor], optimizer: Optimizer) -> dict[int, dict[str, Tensor]]:
    """State of an optimizer by number of the parameter.

    Raises:
        ValueError: A moment of no parameter, of a wrong shape, or not finite.
    """
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in moments.items():
        number, _, name = key.partition(".")
        index = int(number) if number.isdecimal() and name else -1
        if not 0 <= index < len(parameters):
            raise ValueError(f"{key[:40]!r} is no moment of its {len(parameters)} weights")
        if value.dim() and value.shape != parameters[index].shape:
            raise ValueError(f"{key[:80]!r} has shape {tuple(value.shape)}, not {tuple(parameters[index].shape)}")
        if not value.is_floating_point() or not value.isfinite().all():
            raise ValueError(f"{key[:80]!r} is not finite, or no number")
        state.setdefault(index, {})[name] = value
    names = {frozenset(moments_by_name) for moments_by_name in state.values()}
    if len(names) > 1:
        raise ValueError("some weights lack moments that others have")
    return state
