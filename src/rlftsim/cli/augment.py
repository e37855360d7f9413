"""The verb that samples goals for a whole data set: augment."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.policies.registry import Device, load_policy
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
    """auto: the GPU if torch has one."""
    config: Annotated[AugmentConfig, tyro.conf.arg(name="")] = field(default_factory=AugmentConfig)

    def run(self) -> int:
        """Sample scenario by scenario."""
        # The data set is opened first: a wrong path is found before weights are loaded.
        scenarios = open_dataset(self.data, self.split)
        count = augment_goals(load_policy(self.model, self.device), scenarios, self.out, self.config)
        print(f"{self.out}: goals for {count} scenarios.")
        return 0
