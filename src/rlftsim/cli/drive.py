"""The verb that measures a planner: drive."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.evaluation.drive_results import format_drives
from rlftsim.jobs.progress import print_wide


@dataclass(frozen=True)
class Drive:
    """Let a planner drive the ego of every scenario, and score the planner and the traffic around it.

    Writes OUT/PLANNER-TRAFFIC.parquet for each kind of traffic, a row per scenario. `rlftsim compare` reads two of
    them. An interrupted drive continues when the same command is repeated. Needs the extra env: pip install
    'rlftsim[env]'.
    """

    planner: Annotated[Positional[str], tyro.conf.arg(metavar="PLANNER")]
    """replay, constant_velocity, idm, pdm, a planner of another package, or package.module:Class."""
    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    out: Path
    """Folder for the results."""
    model: str = "demo-base"
    """Traffic model: a run, a model folder or a registered name."""
    split: str = "validation"
    """Split of the data set."""
    traffic: str = "policy,replay"
    """Drivers of the other agents, separated by commas: policy, replay, constant_velocity, idm."""
    scenario: list[str] | None = None
    """Only the scenarios with these ids."""
    limit: int | None = None
    """Only the first LIMIT scenarios."""
    num_rollouts: int = 1
    """Episodes of each scenario; the realism of the others is defined for 32."""
    seed: int = 0
    """Seed of the traffic. The same seed gives every planner the same dice."""
    jobs: int = 1
    """Processes, each with one thread. Changes no result."""
    film: bool = False
    """Write OUT/SCENARIO.webp: the first scenario, its kinds of traffic side by side."""

    def run(self) -> int:
        """Drive, print the table."""
        # Imported late: the environments need packages of an extra, and help does not.
        from rlftsim.envs.drive import DriveConfig, drive, film

        # As `python -m` does, so that a planner in a file of this folder is found.
        sys.path.insert(0, "")
        traffic = tuple(kind.strip() for kind in self.traffic.split(","))
        config = DriveConfig(
            planner=self.planner, data=self.data, split=self.split, model=self.model,
            traffic=traffic, num_rollouts=self.num_rollouts, seed=self.seed, limit=self.limit,
            scenarios=tuple(self.scenario) if self.scenario else None, jobs=self.jobs,
        )  # fmt: skip
        results = drive(config, self.out)
        print_wide(format_drives(*results))
        for scenario_id, why in results[0].missing.items():
            print(f"  {scenario_id}: {'; '.join(f'no {name}, {reason}' for name, reason in why.items())}")
        if self.film:
            print(film(config, self.out))
        print(f"{self.out}: {self.planner} in {self.traffic}, {len(results[0].table)} scenarios.")
        return 0
