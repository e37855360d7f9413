"""Golden numbers of TrafficBots V1.5 and the scenarios and weights that they were computed with.

Everything here needs the official material.
"""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rlftsim.scenario.types import Scenario
from rlftsim.scenario.womd import read_scenarios

FILES = {"A": "motion_data_one_scenario.tfrecord", "B": "converted/eb4b91b10ca94ff2.tfrecord"}


@dataclass(frozen=True)
class Golden:
    """The golden files."""

    folder: Path

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        with np.load(self.folder / f"{name}.npz") as file:
            return dict(file)

    def scalars(self, name: str) -> dict:
        return json.loads((self.folder / "scalars.json").read_text())[name]


@pytest.fixture(scope="session")
def golden(shared) -> Golden:
    return Golden(shared / "golden" / "trafficbots")


@pytest.fixture(scope="session")
def records(shared):
    """Scenarios "A" and "B" by name."""

    @cache
    def read(name: str) -> Scenario:
        return next(iter(read_scenarios(shared / "data" / "womd" / FILES[name])))

    return read
