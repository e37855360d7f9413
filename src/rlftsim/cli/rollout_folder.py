"""Description of the rollouts in a folder of `rlftsim simulate`, which keeps two models out of one folder."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlftsim.atomic_io import write_text
from rlftsim.errors import ConfigError, DataError

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
    unknown = "model and settings of its rollouts are unknown: name another --out."
    if rollouts and not path.exists():
        raise ConfigError(f"{folder} holds {rollouts[0].name} but no {ABOUT}, so {unknown}")
    try:
        old = dict(json.loads(path.read_text())) if path.exists() else dict(about)
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: damaged ({error}), so {unknown}") from None
    names = [name for name in {**about, **old} if name != "model"]
    differing = [name for name in names if old.get(name) != about.get(name)]
    if differing and rollouts:
        raise ConfigError(
            f"{folder} holds rollouts of {old.get('model')} with another {', '.join(differing)}: name another --out."
        )
    write_text(path, json.dumps(about, indent=1) + "\n")
