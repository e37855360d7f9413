"""Folder of `rlftsim simulate`: the description that keeps two models out of it, and the files that are finished."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.rollout_files import find_rollouts, read_states
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import write_text
from rlftsim.jobs.folder import check_folder
from rlftsim.jobs.progress import log

ABOUT = "rollouts.json"
"""Model and settings of the rollouts in a folder."""


def claim_folder(folder: Path, about: Mapping[str, Any]) -> None:
    """Write the description of rollouts into their folder.

    Args:
        folder: created where it is missing.
        about: model, data and settings, as JSON has them. The entry "model" is a name and may change.

    Raises:
        ConfigError: the folder holds rollouts of another model or other settings.
        DataError: its description is damaged.
    """
    check_folder(folder, "set of rollouts")
    path = folder / ABOUT
    rollouts = sorted(folder.glob("*.npz"))
    way_out = "name another --out"
    if rollouts and not path.exists():
        raise ConfigError(f"{folder} holds {rollouts[0].name} but no {ABOUT}, so their model is unknown: {way_out}.")
    old = read_json(path, way_out) if path.exists() else dict(about)
    names = [name for name in {**about, **old} if name != "model"]
    differing = [name for name in names if old.get(name) != about.get(name)]
    if differing and rollouts:
        raise ConfigError(
            f"{folder} holds rollouts of {old.get('model')} with another {', '.join(differing)}: name another --out."
        )
    write_text(path, json.dumps(about, indent=1) + "\n")


def left_to_simulate(folder: Path, scenario_ids: Sequence[str], num_rollouts: int) -> list[str]:
    """Scenarios whose rollouts are missing, or in a file that is damaged or cut off, which a warning names.

    Args:
        folder: Folder of the rollouts.
        scenario_ids: All scenarios that are to be simulated.
        num_rollouts: Rollouts that each file must hold.
    """
    return [name for name in scenario_ids if not _is_whole(folder / f"{name}.npz", name, num_rollouts)]


def _is_whole(path: Path, scenario_id: str, num_rollouts: int) -> bool:
    """True if a file is there whose arrays have the right checksums, types and shapes."""
    if not path.exists():
        return False
    cause = f"it holds other rollouts than {num_rollouts} of its scenario"
    try:
        states = [read_states(entry) for entry in find_rollouts(path) if entry.scenario_id == scenario_id]
        if [len(one.x) for one in states] == [num_rollouts]:
            return True
    except DataError as error:
        cause = str(error).removeprefix(f"{path} ").rstrip(".")
    log.warning(f"{path} is simulated again: {cause}.")
    return False
