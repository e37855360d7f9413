"""Scenarios in all the forms that public functions take."""

import os
from collections.abc import Mapping
from typing import Any, TypeAlias

from rlftsim.errors import ConfigError, in_short
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.open import open_dataset
from rlftsim.scenario.shards import check_shard
from rlftsim.scenario.types import Scenario, Scenarios

Name: TypeAlias = str | os.PathLike[str]
AnyScenarios: TypeAlias = Scenario | ScenarioBatch | Scenarios | Name
"""One scenario, several, a batch, a data set, or the name of a data set for the split that a function is about:
training to train, validation else, as on the command line."""


def to_scenarios(scenarios: Any, split: str | None = "validation") -> Scenarios:
    """Scenarios by position, in whatever form they were handed over.

    Args:
        scenarios: in any form.
        split: opened of a data set that is given by its name; None = all.

    Raises:
        ConfigError: there is none, or something else was handed over.
        DataError: no data set of this name, it has no such split, or a scenario that was made in Python is unsound.
    """
    # A string has a length and items too, so names are looked at first.
    if isinstance(scenarios, str | os.PathLike):
        found: Any = open_dataset(scenarios, split)
    elif isinstance(scenarios, Scenario):
        found = (scenarios,)
    else:
        found = scenarios.scenarios if isinstance(scenarios, ScenarioBatch) else scenarios
    wanted = "hand over one, a list of them, a batch or a data set."
    if not isinstance(found, Scenarios) or isinstance(found, Mapping):
        raise ConfigError(f"{in_short(scenarios)}: not scenarios: {wanted}")
    # A data set reads its scenarios from files, and has nothing else: they were checked when they were written.
    items = () if isinstance(found, ScenarioDataset) else (found[position] for position in range(len(found)))
    for one in items:
        if not isinstance(one, Scenario):
            raise ConfigError(f"{type(scenarios).__name__} with {in_short(one)}: not scenarios: {wanted}")
        check_shard(one)
    if not len(found):
        raise ConfigError("no scenario: hand over at least one.")
    return found
