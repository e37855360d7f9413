"""`rlftsim experiment`: repeat an experiment of the paper."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.experiments.model_specs import VARIED
from rlftsim.experiments.registry import PAPER, experiment_by_name
from rlftsim.experiments.results import run_experiment
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.jobs.progress import log, print_line, print_wide
from rlftsim.jobs.runner import usable_cores
from rlftsim.policies.registry import find_device
from rlftsim.recipes.base import Recipe
from rlftsim.scenario.dataset import SYNTHETIC, dataset_folder
from rlftsim.verbs.arguments import Device, Processes, RecipeOption
from rlftsim.verbs.inputs import to_recipe

QUESTIONS = "Experiment. " + "; ".join(f"{name}: {experiment_by_name(name).question}" for name in PAPER)
QUESTIONS += "; exam: Are models better where no choice was made? (see `rlftsim experiment exam --help`)"
QUESTIONS += (
    "; true-world: Are planners judged rightly in simulated traffic? (see `rlftsim experiment true-world --help`)"
)


def check_flags(values: Mapping[str, Any], recipe: Recipe, flags: Sequence[str]) -> None:
    """Check that experiments do not set a flag themselves, and warn of flags that reach one of two recipes.

    Args:
        values: Values of the command line by argument.
        recipe: Recipe with the values of its flags.
        flags: Flags that were given.

    Raises:
        ConfigError: A flag has no effect, or a data set is missing.
    """
    name, recipe_name, data = values["name"], values["recipe"], values["data"]
    if values["counterpart_model"] is not None and name != "model-agnosticism":
        raise ConfigError(
            f"--counterpart-model {values['counterpart_model']} has no effect: {name} has one architecture."
        )
    of_recipe = [flag for flag in flags if "." in flag or flag == "--processes"]
    if name == "model-agnosticism" and of_recipe:
        log.warning(
            f"{' '.join(of_recipe)}: for recipe {recipe_name} alone, the other architecture is trained as its own "
            "recipe says (name that one with --recipe to set it instead)."
        )
    for flag in flags:
        if flag.removeprefix("--").replace("-", "_") in VARIED:
            raise ConfigError(
                f"{flag} has no effect: experiments vary it. All methods take their epochs and batch size from "
                "the section finetune."
            )
    experiment_by_name(name)  # an unknown one is named first
    if recipe_name == SYNTHETIC and data not in (None, SYNTHETIC):
        raise ConfigError(
            f"recipe synthetic brings its own scenarios, --data {data} has no effect: name another --recipe."
        )
    if recipe_name != SYNTHETIC and data is None:
        raise ConfigError(f"recipe {recipe_name} needs scenarios: name a data set with --data.")


def experiment(
    name: str,
    *,
    out: Path = Path("runs/experiments"),
    recipe: RecipeOption = SYNTHETIC,
    data: str | None = None,
    base_model: str | None = None,
    counterpart_model: str | None = None,
    seeds: int | None = None,
    num_rollouts: int = 32,
    rollouts_per_pass: int = 8,
    metric: str = "2025",
    limit: int | None = None,
    jobs: int | None = None,
    processes: Processes = None,
    device: Device = "auto",
) -> None:
    """Repeat one of the paper's experiments: train and evaluate what it needs, write a table, verdicts and a figure.

    An interrupted run continues when the same command is repeated. Experiments with the same OUT share trained models.

    Args:
        name: QUESTIONS
        out: Folder for everything: OUT/NAME.md, OUT/NAME.json and a figure, and the runs and evaluations behind them.
        recipe: Model and training settings. synthetic: a small model on the scenarios that ship with the package. All
            others (`rlftsim recipe` lists them) need --data.
        data: Folder of a data set with the splits training and validation.
        base_model: Model to fine-tune: a run, a model folder or a registered name. Left out, one is pre-trained by the
            recipe.
        counterpart_model: Model to fine-tune of the other architecture of model-agnosticism; likewise.
        seeds: Fine-tuning runs of each kind, with different seeds. Left out: as many as the experiment's table needs, 3
            for benchmark and credit, else 1.
        num_rollouts: Rollouts of each scenario in evaluations.
        rollouts_per_pass: Rollouts simulated together in evaluations. Changes no result; small models are faster with
            all in one pass.
        metric: Year of the meta-metric in evaluations.
        limit: Number of held-out scenarios to evaluate on, the first ones.
        jobs: Processes that evaluate, each with one thread. Left out: one for each core, or a single one on a GPU.
        processes: Processes that train, in short for device.processes of each section.
        device: Device of evaluations; training has its own, such as --finetune.device.accelerator.
    """
    planned = experiment_by_name(name)
    # Several processes only help on a CPU: on a GPU they would share it.
    if jobs is None:
        jobs = 1 if find_device(device).type != "cpu" else usable_cores()
    settings = to_recipe(recipe)
    suite = ExperimentSuite(
        recipe=settings if processes is None else settings.with_processes(processes),
        data=dataset_folder(data or SYNTHETIC),
        out=out,
        evaluation=EvaluateConfig(
            num_rollouts=num_rollouts, metric=metric, limit=limit, rollouts_per_pass=rollouts_per_pass, jobs=jobs
        ),
        num_seeds=planned.default_seeds if seeds is None else seeds,
        base_model=base_model,
        counterpart_model=counterpart_model,
        device=device,
    )
    result = run_experiment(name, planned, suite)
    print_wide(*(table.for_terminal() for table in result.tables))
    for line in result.verdicts:
        print_line(f"* {line}")
    print_line(f"{out / name}.md")


experiment.__doc__ = (experiment.__doc__ or "").replace("name: QUESTIONS", f"name: {QUESTIONS}")
