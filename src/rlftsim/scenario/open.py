"""Data sets by name: a folder, or "synthetic" for the data set that ships with the package."""

import os

from rlftsim.errors import DataError
from rlftsim.scenario.dataset import SYNTHETIC, ScenarioDataset, dataset_folder

__all__ = ["CACHED_SCENARIOS", "SYNTHETIC", "check_membership", "dataset_folder", "list_splits", "open_dataset"]
CACHED_SCENARIOS = 1024
"""About a megabyte each; the tokens of a scenario stay in memory as long."""


def list_splits(name: str | os.PathLike[str]) -> list[str]:
    """Splits in which a data set has scenarios."""
    return sorted(set(ScenarioDataset(name).index["split"].to_pylist()))


def open_dataset(
    name: str | os.PathLike[str], split: str | None = None, *, cache_size: int = CACHED_SCENARIOS
) -> ScenarioDataset:
    """Open a data set, or one split of it.

    Args:
        name: Folder of a data set, or "synthetic" for the data set that ships with the package.
        split: Name of the split, such as "training" or "validation"; None opens all splits.
        cache_size: Number of decoded scenarios in memory, about 1 MB each.

    Raises:
        DataError: No data set in the folder, or no scenario in the split; the message lists the splits.
    """
    scenarios = ScenarioDataset(name, split, cache_size=cache_size)
    if split is not None and not len(scenarios):
        splits = ", ".join(list_splits(name)) or "none at all"
        raise DataError(f"{name} has no scenarios in split {split!r}: it has {splits}.")
    return scenarios


def check_membership(scenarios: ScenarioDataset, scenario_id: str, name: str, origin: object) -> None:
    """Check that a data set, or the split that was opened of it, has a scenario.

    Args:
        scenarios: Scenarios of a split, or of all splits.
        scenario_id: Scenario id as a user or a file wrote it.
        name: Name of the data set as the user wrote it.
        origin: Origin of the id for the message: a flag, or an entry of a file.

    Raises:
        DataError: The id is missing; the message names the split that has it, or else ids that exist.
    """
    if scenario_id in scenarios:
        return
    split = f"split {scenarios.split!r} of " if scenarios.split else ""
    dataset = ScenarioDataset(scenarios.folder)
    # the likeliest mistakes in turn: another data set, another split
    examples = ", ".join(scenarios.scenario_ids[:2])
    hint = f"it has {len(scenarios)} others, such as {examples}; --data names another data set."
    if scenario_id in dataset:
        actual_split = dataset.index["split"][dataset.scenario_ids.index(scenario_id)]
        hint = f"it is in split {str(actual_split)!r}, add --split {actual_split}."
    raise DataError(f"{origin}: no scenario {scenario_id} in {split}{name}: {hint}")
