"""Verbs that measure: evaluate, compare."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.cli.data import data_folder
from rlftsim.experiments.compare import compare, format_comparison, format_table
from rlftsim.experiments.evaluate import EvaluateConfig, evaluate
from rlftsim.experiments.evaluation import Evaluation
from rlftsim.progress import print_wide
from rlftsim.recipes.models import load_policy_or_oracle


@dataclass(frozen=True)
class Evaluate:
    """Measure a model with the official realism meta-metric: 32 rollouts of every held-out scenario.

    Results are kept for each scenario in OUT/NAME.parquet. An interrupted run goes on where it was.
    """

    model: Positional[str]
    """Model folder, "constant_velocity", or "oracle" (the record itself: the ceiling)."""
    data: str
    """Folder of a data set, or "synthetic"."""
    out: Path
    """Folder for the results."""
    name: str | None = None
    """Of the row and the file; left out, the model's name."""
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def run(self) -> int:
        """Evaluate and print the table."""
        path = Path(self.model)
        name = self.name or (path.parent.name if path.name == "model" else path.name)
        policy = load_policy_or_oracle(self.model)
        result = evaluate(policy, data_folder(self.data), self.out, self.config, name=name)
        print_wide(format_table(result))
        for skipped in result.skipped:
            print(f"  skipped {skipped.scenario_id}: {skipped.reason}")
        print(f"{self.out / name}.parquet")
        return 0


@dataclass(frozen=True)
class Compare:
    """Compare two evaluations scenario by scenario: mean differences with 95 % intervals and a verdict."""

    first: Positional[Path]
    """A parquet file that `rlftsim evaluate` wrote."""
    second: Positional[Path]
    """Another one, on the same scenarios. Differences are second minus first."""
    alpha: float = 0.05
    """Significance level."""

    def run(self) -> int:
        """Print both tables."""
        a, b = Evaluation.read(self.first), Evaluation.read(self.second)
        print_wide(format_table(a, b), format_comparison(compare(a, b, alpha=self.alpha)))
        return 0
