"""The verb that repeats an experiment of the paper: experiment."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro
from tyro.conf import Positional

from rlftsim.cli.recipe_verb import Processes, RecipeVerb, value_of
from rlftsim.errors import ConfigError
from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.experiments.model_specs import VARIED
from rlftsim.experiments.registry import PAPER, experiment_by_name
from rlftsim.experiments.results import run_experiment
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.jobs.progress import log, print_line, print_wide
from rlftsim.jobs.runner import usable_cores
from rlftsim.policies.registry import Device, find_device
from rlftsim.recipes.base import SECTIONS
from rlftsim.scenario.open import SYNTHETIC, dataset_folder

QUESTIONS = "; ".join(f"{name}: {experiment_by_name(name).question}" for name in PAPER)
QUESTIONS += "; exam: Are models better where no choice was made? (see `rlftsim experiment exam --help`)"


@dataclass(frozen=True)
class RunExperiment(RecipeVerb):
    """Repeat one of the paper's experiments: train and evaluate what it needs, write a table, verdicts and a figure.

    An interrupted run continues when the same command is repeated. Experiments with the same OUT share trained models.
    """

    sections: ClassVar[tuple[str, ...]] = SECTIONS

    name: Annotated[Positional[str], tyro.conf.arg(help=QUESTIONS, metavar="NAME")]
    out: Path = Path("runs/experiments")
    """Folder for everything: OUT/NAME.md, OUT/NAME.json and a figure, and the runs and evaluations behind them."""
    recipe: Annotated[str, tyro.conf.arg(metavar="RECIPE")] = SYNTHETIC
    """Model and training settings. synthetic: a small model on the scenarios that ship with the package. All others
    (`rlftsim recipe` lists them) need --data."""
    data: str | None = None
    """Folder of a data set with the splits training and validation."""
    base_model: str | None = None
    """Model to fine-tune: a run, a model folder or a registered name. Left out, one is pre-trained by the recipe."""
    counterpart_model: str | None = None
    """The same for the other architecture of model-agnosticism."""
    seeds: int | None = None
    """Fine-tuning runs of each kind, with different seeds. Left out: as many as the experiment's table needs, 3
    for benchmark and credit, else 1."""
    num_rollouts: int = 32
    """Rollouts of each scenario in evaluations."""
    rollouts_per_pass: int = 8
    """Rollouts simulated together in evaluations. Changes no result; small models are faster with all in one pass."""
    metric: str = "2025"
    """Year of the meta-metric in evaluations."""
    limit: int | None = None
    """Evaluate on the first LIMIT held-out scenarios only."""
    jobs: int | None = None
    """Processes that evaluate, each with one thread. Left out: one for each core, or a single one on a GPU."""
    processes: Processes = None
    """Processes that train, in short for device.processes of each section."""
    device: Device = "auto"
    """Device of evaluations; training has its own, such as --finetune.device.accelerator."""

    @classmethod
    def recipe_name_in(cls, words: Sequence[str]) -> str:
        """The value of `--recipe`, or the synthetic one."""
        return value_of("--recipe", words) or SYNTHETIC

    def refuse_useless(self, flags: Sequence[str]) -> None:
        """Refuse settings that the experiments set themselves, and warn of those that reach one of two recipes.

        Raises:
            ConfigError: one of them is given.
        """
        if self.counterpart_model is not None and self.name != "model-agnosticism":
            raise ConfigError(
                f"--counterpart-model {self.counterpart_model} has no effect: {self.name} has one architecture."
            )
        of_recipe = [flag for flag in flags if "." in flag or flag == "--processes"]
        if self.name == "model-agnosticism" and of_recipe:
            log.warning(
                f"{' '.join(of_recipe)}: for recipe {self.recipe} alone, the other architecture is trained as its own "
                "recipe says (name that one with --recipe to set it instead)."
            )
        for flag in flags:
            name = flag.removeprefix("--").replace("-", "_")
            if name in VARIED:
                raise ConfigError(
                    f"{flag} has no effect: experiments vary it. All methods take their epochs and batch size from "
                    "the section finetune."
                )

    def run(self) -> int:
        """Run the missing stages and print the results."""
        experiment = experiment_by_name(self.name)
        # Several processes only help on a CPU: on a GPU they would share it.
        jobs = self.jobs
        if jobs is None:
            jobs = 1 if find_device(self.device).type != "cpu" else usable_cores()
        suite = ExperimentSuite(
            recipe=self.settings,
            data=self._data(),
            out=self.out,
            evaluation=EvaluateConfig(
                num_rollouts=self.num_rollouts,
                metric=self.metric,
                limit=self.limit,
                rollouts_per_pass=self.rollouts_per_pass,
                jobs=jobs,
            ),
            num_seeds=experiment.default_seeds if self.seeds is None else self.seeds,
            base_model=self.base_model,
            counterpart_model=self.counterpart_model,
            device=self.device,
        )
        result = run_experiment(self.name, experiment, suite)
        print_wide(*(table.for_terminal() for table in result.tables))
        for line in result.verdicts:
            print_line(f"* {line}")
        print(f"{self.out / self.name}.md")
        return 0

    def _data(self) -> Path:
        """Folder of the data set.

        Raises:
            ConfigError: a recipe that needs a data set has none, or the synthetic one got another.
        """
        if self.recipe == SYNTHETIC and self.data not in (None, SYNTHETIC):
            raise ConfigError(
                f"recipe synthetic brings its own scenarios, --data {self.data} has no effect: name another --recipe."
            )
        if self.recipe != SYNTHETIC and self.data is None:
            raise ConfigError(f"recipe {self.recipe} needs scenarios: name a data set with --data.")
        return dataset_folder(self.data or SYNTHETIC)
