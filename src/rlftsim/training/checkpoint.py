"""Checkpoints: everything that a run resumes from, in files that execute nothing.

A checkpoint is a folder `update-00000120` with safetensors and a JSON file. It is written under another name and
renamed when it is whole, so a folder of that name is never half-written.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.optim import Optimizer

from rlftsim.atomic_io import errors_name, remove_folder, save_tensors, write_text
from rlftsim.errors import CheckpointError

PREFIX = "update-"
KEPT = 2
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
        folder: the run's folder of checkpoints.
        progress: position of the run.
        modules: weights by file name, such as policy and reference.
        optimizer: its moments are kept too.

    Raises:
        DataError: a file cannot be written, such as on a full disk; names it. Older checkpoints are untouched.
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
        # Names are padded with zeros, so their order is that of the updates. Only now is an older one expendable.
        for old in _checkpoints(folder)[:-KEPT]:
            remove_folder(old, files)
    return target


def newest_checkpoint(folder: Path) -> Path | None:
    """The latest whole checkpoint of a run; None if it has none yet."""
    return max(_checkpoints(folder), default=None)


def _checkpoints(folder: Path) -> list[Path]:
    """Whole checkpoints of a run, the latest last; anything else of a similar name is a user's."""
    return sorted(path for path in folder.glob(f"{PREFIX}*") if path.name.removeprefix(PREFIX).isdecimal())


def update_of(path: Path) -> int:
    """Updates that a run had done at a checkpoint."""
    return int(path.name.removeprefix(PREFIX))


def read_checkpoint(path: Path, modules: dict[str, nn.Module], optimizer: Optimizer) -> Progress:
    """Load weights and moments in place.

    Args:
        path: of the checkpoint.
        modules: as they were given to `write_checkpoint`.
        optimizer: of the same parameters in the same order; keeps its own learning rate.

    Returns:
        The position of the run.

    Raises:
        CheckpointError: damaged, or of another model.
    """
    try:
        for name, module in modules.items():
            module.load_state_dict(load_file(path / f"{name}.safetensors"))
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in load_file(path / "optimizer.safetensors").items():
            index, name = key.split(".", 1)
            state.setdefault(int(index), {})[name] = value
        # The groups are the new optimizer's own: learning rate and scales follow the settings, not the file.
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": state, "param_groups": groups})
        values = json.loads((path / "progress.json").read_text())
        return Progress(values["update"], values["numbers"])
    except (OSError, SafetensorError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{path}: cannot go on from it ({error}): delete this folder to go on from an older one."
        ) from None
