"""The verb that looks at scenarios that no choice was made on: experiment exam."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from rlftsim.errors import ConfigError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluation_name
from rlftsim.experiments.exam import CHECKOUT, LEDGER, ExamConfig, take_exam
from rlftsim.experiments.exam_report import write_exam
from rlftsim.experiments.ledger import Ledger
from rlftsim.jobs.progress import print_wide
from rlftsim.jobs.runner import usable_cores
from rlftsim.policies.registry import Device, find_device
from rlftsim.scenario.open import SYNTHETIC


@dataclass(frozen=True)
class Exam:
    """Compare models with the one they started from on scenarios that no choice was made on, and note the look.

    Synthetic scenarios are generated from a seed that follows from the commit; of a data set of logs it is the split
    exam, a fixed third of the validation split. Writes tables with intervals over street networks, margins and verdicts
    to OUT/EXAM/exam.md and exam.json. An interrupted exam continues when the same command is repeated.
    """

    models: Annotated[list[str], tyro.conf.arg(metavar="[NAME=]MODEL[,MODEL...]")]
    """Candidates: runs, model folders or registered names. Several behind one name are runs of one recipe with
    different seeds."""
    base_model: Annotated[str, tyro.conf.arg(metavar="MODEL[,MODEL...]")] = "demo-base"
    """Model that the candidates started from; of several, the first one's candidates come first in each row."""
    out: Path = Path("runs/exam")
    """Folder for everything. Exams in one OUT share scenarios and evaluations."""
    data: str = SYNTHETIC
    """Folder of a data set with a validation split. Left out: scenarios are generated, which needs SUMO."""
    seed: int | None = None
    """Seed of generated scenarios. Left out: it follows from the commit, in a checkout."""
    num_scenarios: int = 200
    """Scenarios to generate, 8 from each street network."""
    num_rollouts: int = 32
    """Rollouts of each scenario."""
    temperatures: list[float] = field(default_factory=lambda: [0.7, 0.8, 0.9, 1.0, 1.1])
    """Temperatures of the base to try on the split tune: validation, of logs without the exam's third. The best has a
    row of its own."""
    metric: str = "2025"
    """Year of the meta-metric."""
    rollouts_per_pass: int = 8
    """Rollouts simulated together. Changes no result; small models are faster with all in one pass."""
    ledger: Path | None = None
    """File that the look is added to. Left out: benchmarks/exam.jsonl of the checkout, or OUT/exam.jsonl."""
    again: bool = False
    """Allow a further look at a recipe or model that has sat this exam; the ledger counts it."""
    jobs: int | None = None
    """Processes that generate and evaluate, each with one thread. Left out: one for each core, or a single one on a
    GPU."""
    device: Device = "auto"
    """Device of the models."""

    def run(self) -> int:
        """Take the exam and print tables and verdicts."""
        jobs = self.jobs or (usable_cores() if find_device(self.device).type == "cpu" else 1)
        evaluation = EvaluateConfig(
            num_rollouts=self.num_rollouts, metric=self.metric, rollouts_per_pass=self.rollouts_per_pass, jobs=jobs
        )
        config = ExamConfig(
            candidates=parse_rows(self.models),
            bases=self.base_model.split(","),
            data=self.data,
            seed=self.seed,
            num_scenarios=self.num_scenarios,
            temperatures=self.temperatures,
            evaluation=evaluation,
            device=self.device,
        )
        of_checkout = CHECKOUT / "benchmarks" / LEDGER
        ledger = Ledger(self.ledger or (of_checkout if of_checkout.exists() else self.out / LEDGER))
        result = take_exam(config, self.out, ledger, is_repeat=self.again)
        tables, verdicts = write_exam(result, config, ledger)
        print_wide(*(table.for_terminal() for table in tables))
        for line in verdicts:
            print(f"* {line}")
        print(result.folder / "exam.md")
        return 0


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
