"""Data sets by name: a folder, or "synthetic" for the one that ships with the package."""

import os

from rlftsim.errors import DataError
from rlftsim.scenario.dataset import SYNTHETIC, ScenarioDataset, dataset_folder

__all__ = ["CACHED_SCENARIOS", "SYNTHETIC", "check_splits", "dataset_folder", "list_splits", "open_dataset"]
CACHED_SCENARIOS = 1024
"""About a megabyte each; their tokens stay in memory with them."""


def list_splits(name: str | os.PathLike[str]) -> list[str]:
    """Splits in which a data set has scenarios."""
    return sorted(set(ScenarioDataset(name).index["split"].to_pylist()))


def open_dataset(
    name: str | os.PathLike[str], split: str | None = None, *, cache_size: int = CACHED_SCENARIOS
) -> ScenarioDataset:
    """Open a data set, or one split of it.

    Args:
        name: folder of a data set, or "synthetic".
        split: such as "training" or "validation"; None opens all splits.
        cache_size: scenarios kept in memory.

    Raises:
        DataError: no data set there, or none of its scenarios is in the split; the message lists its splits.
    """
    scenarios = ScenarioDataset(name, split, cache_size=cache_size)
    if split is not None and not len(scenarios):
        known = ", ".join(list_splits(name)) or "none at all"
        raise DataError(f"{name} has no scenarios in split {split!r}: it has {known}.")
    return scenarios


def check_splits(scenarios: ScenarioDataset, scenario_id: str, name: str, place: object) -> None:
    """Refuse a scenario id that a data set, or its split, does not have.

    Args:
        scenarios: the scenarios of a split, or all.
        scenario_id: as a user or a file wrote it.
        name: name of the data set as the user wrote it.
        place: origin of the id, for the message: a flag, or an entry of a file.

    Raises:
        DataError: names the split that has it, or else an id that exists.
    """
    if scenario_id in scenarios:
        return
    split = f"split {scenarios.split!r} of " if scenarios.split else ""
    known = ScenarioDataset(scenarios.folder)
    # the likeliest mistakes in turn: another data set, another split
    some = ", ".join(scenarios.scenario_ids[:2])
    hint = f"it has {len(scenarios)} others, such as {some}; --data names another data set."
    if scenario_id in known:
        other = known.index["split"][known.scenario_ids.index(scenario_id)]
        hint = f"it is in split {str(other)!r}, add --split {other}."
    raise DataError(f"{place}: no scenario {scenario_id} in {split}{name}: {hint}")
