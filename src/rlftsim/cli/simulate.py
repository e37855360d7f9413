"""The verb that rolls scenarios out: simulate."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from rlftsim.cli.data import open_split
from rlftsim.errors import ConfigError, DataError
from rlftsim.files import write_text
from rlftsim.progress import progress_bar
from rlftsim.recipes.models import Device, load_policy
from rlftsim.rollout.files import write_rollouts
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, Sampling, device_of
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset

ABOUT = "rollouts.json"
"""Whose rollouts are in the folder."""


@dataclass(frozen=True)
class Simulate:
    """Simulate futures of scenarios: every agent, the ego included, moves by the model for 8 seconds.

    Writes one npz a scenario: scenario_id, object_ids [A], x y z heading [N, A, 80], world frame. Files that are there are kept,
    so an interrupted run goes on where it was.
    """

    model: Positional[str]
    """Model folder, or "constant_velocity"."""
    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """Folder for the rollouts."""
    split: str = "validation"
    scenario: list[str] | None = None
    """Only these scenario ids."""
    num_rollouts: int = 32
    seed: int = 0
    temperature: float = 1.0
    """Below 1 likely motions become likelier; 0 always takes the most likely one."""
    top_k: int | None = None
    """Sample among this many of the most likely motions only."""
    device: Device = "auto"

    def run(self) -> int:
        """Simulate scenario by scenario."""
        if self.num_rollouts < 1:
            raise ConfigError(f"--num-rollouts must be at least 1, got {self.num_rollouts}.")
        policy, sampling = load_policy(self.model, self.device), Sampling(self.temperature, self.top_k)
        scenarios = open_split(self.data, self.split)
        ids = self.scenario or scenarios.scenario_ids
        unknown = [i for i in ids if i not in scenarios]
        if unknown:
            raise ConfigError(f"no scenario {', '.join(unknown)} in split {self.split!r} of {self.data}.")
        self._claim(policy, sampling, scenarios)
        left = [i for i in ids if not (self.out / f"{i}.npz").exists()]
        with progress_bar("simulate", len(ids), len(ids) - len(left)) as advance:
            for scenario_id in left:
                batch = collate([scenarios.by_id(scenario_id)]).to(device_of(policy))
                rollouts = simulate(policy, batch, num_rollouts=self.num_rollouts, seed=self.seed, sampling=sampling)
                write_rollouts(self.out, batch, rollouts)
                advance()
        print(f"{self.out}: {self.num_rollouts} rollouts of {len(ids)} scenarios.")
        return 0

    def _claim(self, policy: Policy, sampling: Sampling, scenarios: ScenarioDataset) -> None:
        """Write down whose rollouts these are; refuse a folder that holds others.

        Raises:
            ConfigError: it does.
        """
        about = {
            "model": self.model,
            "policy": fingerprint_policy(policy),
            "data": scenarios.manifest.index_sha256,
            "seed": self.seed,
            "num_rollouts": self.num_rollouts,
            "sampling": asdict(sampling),
        }
        path = self.out / ABOUT
        old = _read_about(path) if path.exists() else about
        differing = [name for name, value in about.items() if name != "model" and old.get(name) != value]
        if differing and any(self.out.glob("*.npz")):
            raise ConfigError(
                f"{self.out} holds rollouts of {old.get('model')} with another {', '.join(differing)}: name another --out."
            )
        write_text(path, json.dumps(about, indent=1) + "\n")


def _read_about(path: Path) -> dict[str, Any]:
    """What `Simulate` wrote down.

    Raises:
        DataError: it is damaged.
    """
    try:
        return dict(json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise DataError(
            f"{path}: damaged ({error}), so nobody knows whose rollouts {path.parent} holds: name another --out."
        ) from None
