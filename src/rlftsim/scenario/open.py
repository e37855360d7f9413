"""Data sets by name, and scenarios in all the forms that public functions take."""

import os
from collections.abc import Mapping
from typing import Any, TypeAlias

from rlftsim.errors import ConfigError, DataError, in_short, whole_number
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.shards import check_scenario
from rlftsim.scenario.types import Scenario, Scenarios

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


Name: TypeAlias = str | os.PathLike[str]
AnyScenarios: TypeAlias = Scenario | ScenarioBatch | Scenarios | Name
"""One scenario, several, a batch, a data set, or the name of a data set for the split that a function is about:
training to train, validation else, as on the command line."""


def to_scenarios(scenarios: Any, split: str | None = "validation", limit: int | None = None) -> Scenarios:
    """Scenarios by position, in whatever form they were handed over.

    Args:
        scenarios: Scenario, list of scenarios, batch, data set, or the name of a data set.
        split: Split that is opened of a data set handed over by name; None = all splits.
        limit: Number of scenarios, the first ones; None = all.

    Raises:
        ConfigError: No scenario, no positive limit, or a value of another type was handed over.
        DataError: No data set of this name, or without this split, or a scenario made in Python is unsound.
    """
    # A string has a length and items too, so names are looked at first.
    if isinstance(scenarios, str | os.PathLike):
        sequence: Any = open_dataset(scenarios, split)
    elif isinstance(scenarios, Scenario):
        sequence = (scenarios,)
    else:
        sequence = scenarios.scenarios if isinstance(scenarios, ScenarioBatch) else scenarios
    remedy = "hand over one, a list of them, a batch or a data set."
    if not isinstance(sequence, Scenarios) or isinstance(sequence, Mapping):
        raise ConfigError(f"{in_short(scenarios)}: not scenarios: {remedy}")
    if limit is not None:
        limit = min(whole_number("limit", limit, 1), len(sequence))
        if isinstance(sequence, ScenarioDataset):
            sequence = ScenarioDataset(sequence.folder, sequence.split, cache_size=sequence.cache_size, limit=limit)
        else:
            sequence = [sequence[position] for position in range(limit)]
    # Scenarios of a data set were checked when they were written.
    for position in range(0 if isinstance(sequence, ScenarioDataset) else len(sequence)):
        scenario = sequence[position]
        if not isinstance(scenario, Scenario):
            raise ConfigError(f"{type(scenarios).__name__} with {in_short(scenario)}: not scenarios: {remedy}")
        check_scenario(scenario)
    if not len(sequence):
        raise ConfigError("no scenario: hand over at least one.")
    return sequence
