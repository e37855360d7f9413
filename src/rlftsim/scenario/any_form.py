"""Scenarios in all the forms that public functions take."""

import os
from collections.abc import Mapping
from typing import Any, TypeAlias

from rlftsim.errors import ConfigError, in_short
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.open import open_dataset
from rlftsim.scenario.shards import check_scenario
from rlftsim.scenario.types import Scenario, Scenarios

Name: TypeAlias = str | os.PathLike[str]
AnyScenarios: TypeAlias = Scenario | ScenarioBatch | Scenarios | Name
"""One scenario, several, a batch, a data set, or the name of a data set for the split that a function is about:
training to train, validation else, as on the command line."""


def to_scenarios(scenarios: Any, split: str | None = "validation") -> Scenarios:
    """Scenarios by position, in whatever form they were handed over.

    Args:
        scenarios: Scenario, list of scenarios, batch, data set, or the name of a data set.
        split: Split that is opened of a data set handed over by name; None = all splits.

    Raises:
        ConfigError: No scenario, or a value of another type was handed over.
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
    # Scenarios of a data set were checked when they were written.
    for position in range(0 if isinstance(sequence, ScenarioDataset) else len(sequence)):
        scenario = sequence[position]
        if not isinstance(scenario, Scenario):
            raise ConfigError(f"{type(scenarios).__name__} with {in_short(scenario)}: not scenarios: {remedy}")
        check_scenario(scenario)
    if not len(sequence):
        raise ConfigError("no scenario: hand over at least one.")
    return sequence
