"""The verb that samples goals for a whole data set: augment."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.evaluation.evaluate import check_jobs
from rlftsim.jobs.runner import Work, choose_runner
from rlftsim.policies.registry import Device, load_policy
from rlftsim.rollout.policy import get_device
from rlftsim.scenario.open import open_dataset
from rlftsim.training.augment import AugmentConfig, augment_goals


@dataclass(frozen=True)
class Augment:
    """Sample further goals for goal-conditioned fine-tuning: the endpoints of the most realistic of a model's rollouts.

    Writes a folder of Parquet files: scenario_id, object_id, x, y in the world frame. `rlftsim finetune` reads it with
    --finetune.goals.augmented FOLDER. An interrupted run continues when the same command is repeated.
    """

    model: Annotated[Positional[str], tyro.conf.arg(metavar="MODEL")]
    """Model to sample from, such as the one that fine-tuning starts from: a run, a model folder or a registered
    name."""
    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    out: Path
    """Folder for the goals."""
    split: str = "training"
    """Split of the data set."""
    device: Device = "auto"
    """auto: the GPU if torch has one; several processes (--jobs) need cpu."""
    jobs: int = 1
    """Processes, each with one thread. Changes no result."""
    config: Annotated[AugmentConfig, tyro.conf.arg(name="")] = field(default_factory=AugmentConfig)
    work: Annotated[Work, tyro.conf.arg(name="")] = field(default_factory=Work)

    def run(self) -> int:
        """Sample scenario by scenario, what is missing."""
        # The data set is opened first: a wrong path is found before weights are loaded.
        scenarios = open_dataset(self.data, self.split)
        policy = load_policy(self.model, self.device)
        check_jobs(self.jobs, get_device(policy), "jobs")
        runner = self.work.runner(self.jobs, self.work.on_error) or choose_runner(self.jobs, len(scenarios))
        count = augment_goals(policy, scenarios, self.out, self.config, runner=runner)
        print(f"{self.out}: goals for {count} scenarios.")
        return 0
