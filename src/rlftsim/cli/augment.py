"""The verb that draws goals for a whole data set: augment."""

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import Positional

from rlftsim.cli.data import open_split
from rlftsim.recipes.configure import Override, configure
from rlftsim.recipes.models import Device, load_policy
from rlftsim.training.augment import AugmentConfig, augment_goals


@dataclass(frozen=True)
class Augment:
    """Draw further goals for fine-tuning with goals: where the most realistic of a model's rollouts takes each agent.

    Writes a folder of Parquet files: scenario_id, object_id, x, y, world frame. Fine-tuning takes it by
    --set finetune.goals.augmented=FOLDER. Interrupted, the same command goes on where it was.
    """

    model: Positional[str]
    """Model folder to sample from, such as the one that fine-tuning starts from."""
    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """Folder for the goals."""
    split: str = "training"
    device: Device = "auto"
    set: list[Override] = field(default_factory=list)
    """Other values for the fields of AugmentConfig, e.g. num-rollouts=8 top-k=16 seed=1."""

    def run(self) -> int:
        """Scenario by scenario."""
        config = configure(AugmentConfig(), self.set)
        scenarios = open_split(self.data, self.split)
        count = augment_goals(load_policy(self.model, self.device), scenarios, self.out, config)
        print(f"{self.out}: goals for {count} scenarios.")
        return 0
