"""`rlftsim experiment exam`: models on scenarios that no choice was made on."""

from pathlib import Path
from typing import Annotated

import tyro

from rlftsim.errors import ConfigError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluation_name
from rlftsim.experiments.exam import CHECKOUT, LEDGER, ExamConfig, Ledger, take_exam
from rlftsim.experiments.exam_report import write_exam
from rlftsim.jobs.progress import print_line, print_wide
from rlftsim.jobs.runner import usable_cores
from rlftsim.policies.registry import find_device
from rlftsim.scenario.dataset import SYNTHETIC
from rlftsim.verbs.arguments import Device


def exam(
    models: Annotated[list[str], tyro.conf.arg(metavar="[NAME=]MODEL[,MODEL...]")],
    *,
    base_model: Annotated[str, tyro.conf.arg(metavar="MODEL[,MODEL...]")] = "demo-base",
    out: Path = Path("runs/exam"),
    data: str = SYNTHETIC,
    seed: int | None = None,
    num_scenarios: int = 200,
    num_rollouts: int = 32,
    temperatures: tuple[float, ...] = (0.7, 0.8, 0.9, 1.0, 1.1),
    metric: str = "2025",
    rollouts_per_pass: int = 8,
    ledger: Path | None = None,
    again: bool = False,
    jobs: int | None = None,
    device: Device = "auto",
) -> None:
    """Compare models with the one they started from on scenarios that no choice was made on, and note the look.

    Synthetic scenarios are generated from a seed that follows from the commit; of a data set of logs it is the split
    exam, a fixed third of the validation split. Writes tables with intervals over street networks, margins and verdicts
    to OUT/EXAM/exam.md and exam.json. An interrupted exam continues when the same command is repeated.

    Args:
        models: Candidates: runs, model folders or registered names. Several behind one name are runs of one
            recipe with different seeds.
        base_model: Model that the candidates started from; of several, the first one's candidates come first in
            each row.
        out: Folder for everything. Exams in one OUT share scenarios and evaluations.
        data: Folder of a data set with a validation split. Left out: scenarios are generated, which needs SUMO.
        seed: Seed of generated scenarios. Left out: it follows from the commit, in a checkout.
        num_scenarios: Scenarios to generate, 8 from each street network.
        num_rollouts: Rollouts of each scenario.
        temperatures: Temperatures of the base to try on the split tune: validation, of logs without the exam's
            third. The best has a row of its own.
        metric: Year of the meta-metric.
        rollouts_per_pass: Rollouts simulated together. Changes no result; small models are faster with all in
            one pass.
        ledger: File that the look is added to. Left out: benchmarks/exam.jsonl of the checkout, or
            OUT/exam.jsonl.
        again: Allow a further look at a recipe or model that has sat this exam; the ledger counts it.
        jobs: Processes that generate and evaluate, each with one thread. Left out: one for each core, or a
            single one on a GPU.
        device: Device of the models.
    """
    num_jobs = jobs or (usable_cores() if find_device(device).type == "cpu" else 1)
    evaluation = EvaluateConfig(
        num_rollouts=num_rollouts, metric=metric, rollouts_per_pass=rollouts_per_pass, jobs=num_jobs
    )
    config = ExamConfig(
        candidates=parse_rows(models),
        bases=base_model.split(","),
        data=data,
        seed=seed,
        num_scenarios=num_scenarios,
        temperatures=list(temperatures),
        evaluation=evaluation,
        device=device,
    )
    checkout_ledger = CHECKOUT / "benchmarks" / LEDGER
    looks = Ledger(ledger or (checkout_ledger if checkout_ledger.exists() else out / LEDGER))
    result = take_exam(config, out, looks, is_repeat=again)
    tables, verdicts = write_exam(result, config, looks)
    print_wide(*(table.for_terminal() for table in tables))
    for line in verdicts:
        print_line(f"* {line}")
    print_line(result.folder / "exam.md")


def parse_rows(words: list[str]) -> dict[str, list[str]]:
    """Models by the name of their row.

    Args:
        words: Models, each with a name before it or without, such as "mloo=runs/a,runs/b".

    Raises:
        ConfigError: Two rows have one name.
    """
    rows: dict[str, list[str]] = {}
    for word in words:
        name, _, models = word.rpartition("=")
        name = name or evaluation_name(models)
        if name in rows:
            raise ConfigError(f"two rows are called {name}: write NAME={models}.")
        rows[name] = models.split(",")
    return rows
