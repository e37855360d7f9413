"""The verb that answers a question of the paper: experiment."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from rlftsim.cli.data import SYNTHETIC, data_folder
from rlftsim.errors import ConfigError
from rlftsim.experiments.catalogue import EXPERIMENTS, experiment_by_name
from rlftsim.experiments.contestants import VARIED
from rlftsim.experiments.evaluate import EvaluateConfig
from rlftsim.experiments.findings import run_experiment
from rlftsim.experiments.workshop import Workshop
from rlftsim.progress import print_wide
from rlftsim.recipes.configure import Override, configure
from rlftsim.recipes.models import Device, find_device
from rlftsim.recipes.smart import RECIPES, RecipeName, smart_synthetic
from rlftsim.workers import usable_cores

ExperimentRecipe = Literal["synthetic", RecipeName]
QUESTIONS = "; ".join(f"{name}: {experiment.question}" for name, experiment in EXPERIMENTS.items())


@dataclass(frozen=True)
class RunExperiment:
    """Answer one of the paper's questions: train and measure what it takes, write a table, verdicts and a figure.

    Interrupted in any way, the same command goes on where it was. Experiments in one OUT share what they have trained.
    """

    name: Annotated[Positional[str], tyro.conf.arg(help=QUESTIONS)]
    out: Path = Path("runs/experiments")
    """Folder for everything: OUT/NAME.md, OUT/NAME.json and a figure, the runs and evaluations they are made of."""
    recipe: ExperimentRecipe = SYNTHETIC
    """synthetic: a small model on the scenarios that ship with the package. The others need DATA."""
    data: str | None = None
    """Folder of a data set with the splits training and validation."""
    base_model: str | None = None
    """Model folder to fine-tune. Left out, the recipe builds a vocabulary and pre-trains one."""
    seeds: int | None = None
    """Runs of every fine-tuning. Left out, what the experiment needs to be worth its table: 3 for benchmark and credit, else 1."""
    num_rollouts: int = 32
    """Of every scenario in evaluations."""
    metric: str = "2025"
    """Year of the meta-metric in evaluations."""
    limit: int | None = None
    """Only the first so many held-out scenarios."""
    jobs: int | None = None
    """Processes that evaluate, each with one thread. Left out, as many as there are cores, or one on a GPU."""
    device: Device = "auto"
    """Where evaluations run; training has its own in the recipe (e.g. finetune.device.accelerator)."""
    set: list[Override] = field(default_factory=list)
    """Other values for fields of the recipe, e.g. finetune.epochs=1."""

    def run(self) -> int:
        """Run what is missing and print what was found."""
        experiment = experiment_by_name(self.name)
        _refuse_varied(self.set)
        workshop = Workshop(
            recipe=configure(smart_synthetic() if self.recipe == SYNTHETIC else RECIPES[self.recipe](), self.set),
            data=self._data(),
            out=self.out,
            evaluation=EvaluateConfig(
                num_rollouts=self.num_rollouts, metric=self.metric, limit=self.limit, jobs=self._num_jobs()
            ),
            num_seeds=experiment.default_seeds if self.seeds is None else self.seeds,
            base_model=self.base_model,
            device=self.device,
        )
        findings = run_experiment(self.name, experiment, workshop)
        print_wide(*(table.for_terminal() for table in findings.tables))
        for line in findings.verdicts:
            print(f"* {line}")
        print(f"{self.out / self.name}.md")
        return 0

    def _num_jobs(self) -> int:
        if self.jobs is not None:
            return self.jobs
        return 1 if find_device(self.device).type != "cpu" else usable_cores()

    def _data(self) -> Path:
        """Folder of the data set.

        Raises:
            ConfigError: a recipe that needs one has none, or one that brings its own got another.
        """
        if self.recipe == SYNTHETIC and self.data not in (None, SYNTHETIC):
            raise ConfigError(
                f"recipe synthetic brings its own scenarios, --data {self.data} has no effect: take --recipe smart-demo."
            )
        if self.recipe != SYNTHETIC and self.data is None:
            raise ConfigError(f"recipe {self.recipe} needs scenarios: name a data set with --data.")
        return data_folder(self.data or SYNTHETIC)


def _refuse_varied(overrides: Sequence[Override]) -> None:
    """Refuse values that would have no effect.

    Raises:
        ConfigError: a field that experiments set themselves.
    """
    for override in overrides:
        name = override.partition("=")[0].replace("-", "_")
        if name in VARIED:
            raise ConfigError(
                f"{name} has no effect here: experiments vary it. All methods take their epochs and batch size from finetune."
            )
