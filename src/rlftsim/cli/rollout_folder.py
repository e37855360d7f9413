"""Folder of `rlftsim simulate`: the description that keeps two models out of it, and the files that are finished."""

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlftsim.atomic_io import write_text
from rlftsim.errors import ConfigError
from rlftsim.jobs.files import read_json
from rlftsim.progress import log

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


def left_to_simulate(folder: Path, scenario_ids: Sequence[str]) -> list[str]:
    """Scenarios whose rollouts are missing, or in a file that is cut off, which a warning names.

    Args:
        folder: of the rollouts.
        scenario_ids: all scenarios that are to be simulated.
    """
    return [scenario_id for scenario_id in scenario_ids if not _is_whole(folder / f"{scenario_id}.npz")]


def _is_whole(path: Path) -> bool:
    """True if a file is there with its list of contents, which is at its end."""
    try:
        zipfile.ZipFile(path).close()
    except FileNotFoundError:
        return False
    except (zipfile.BadZipFile, ValueError, RuntimeError):  # the latter: versions and names that zipfile cannot read
        log.warning(f"{path} is no npz archive, or cut off: it is simulated again.")
        return False
    return True
