"""Verbs that measure: score, evaluate, compare."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.cli.data import data_folder
from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.compare import columns_of, compare, format_comparison, format_table
from rlftsim.experiments.evaluate import EvaluateConfig, evaluate
from rlftsim.experiments.evaluation import Evaluation
from rlftsim.experiments.explain import explain_rollouts
from rlftsim.experiments.score import ScoreConfig, format_scores, score_rollouts, to_json
from rlftsim.progress import print_wide
from rlftsim.recipes.models import Device, load_policy_or_oracle


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
    device: Device = "auto"
    """Where the model runs; several processes (jobs) need cpu."""
    goal_guidance: float = 1.0
    """With --goals recorded: how many times the model's aim counts. Above 1 goals are followed more closely than it learned to."""
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def run(self) -> int:
        """Evaluate and print the table."""
        path = Path(self.model)
        name = self.name or (path.parent.name if path.name == "model" else path.name)
        self._refuse_other_goals(self.out / f"{name}.parquet")
        if self.goal_guidance != 1.0 and self.config.goals == "none":
            raise ConfigError(
                f"--goal-guidance {self.goal_guidance:g} has no effect without goals: add --goals recorded."
            )
        policy = load_policy_or_oracle(self.model, self.device, goal_guidance=self.goal_guidance)
        result = evaluate(policy, data_folder(self.data), self.out, self.config, name=name)
        if not len(result):
            raise DataError(f"not one of {len(result.skipped)} scenarios could be scored: {result.skipped[0].reason}")
        print_wide(format_table(result))
        for skipped in result.skipped:
            print(f"  skipped {skipped.scenario_id}: {skipped.reason}")
        print(f"{self.out / name}.parquet")
        return 0

    def _refuse_other_goals(self, path: Path) -> None:
        """Refuse to replace what the model does with goals by what it does without, or the other way round.

        Raises:
            ConfigError: an evaluation of that name asked otherwise.
        """
        try:
            old = Evaluation.read(path).config.goals
        except DataError:  # none, or one that cannot be read and is replaced
            return
        if old != self.config.goals:
            raise ConfigError(
                f"{path} was measured with goals={old}, not {self.config.goals}: name this one apart with --name, or remove the file."
            )


@dataclass(frozen=True)
class Score:
    """Score anybody's rollouts with the official realism meta-metric.

    Reads npz files (scenario_id, object_ids [A], x y z heading [N, A, 80]) and official submission files; see
    docs/rollout_formats.md. With OUT an interrupted run goes on where it was.
    """

    rollouts: Positional[Path]
    """A file of rollouts, or a folder of them."""
    scenarios: str
    """What was simulated: a converted data set, tfrecords (file, folder, quoted glob), or "synthetic"."""
    out: Path | None = None
    """Folder for the per-scenario results (Parquet)."""
    name: str | None = None
    """Of the row and the file; left out, the name of the rollouts."""
    json: bool = False
    """Print JSON under the official messages' names instead of a table."""
    explain: Path | None = None
    """Folder for a page a scenario: which feature, agent and steps cost how much."""
    config: Annotated[ScoreConfig, tyro.conf.arg(name="")] = field(default_factory=ScoreConfig)

    def run(self) -> int:
        """Score, print, explain."""
        scenarios = data_folder(self.scenarios)
        result = score_rollouts(self.rollouts, scenarios, self.out, self.config, name=self.name)
        if self.json:
            print(json.dumps(to_json(result), allow_nan=False))
        else:
            print_wide(format_scores(result))
        for skipped in result.skipped:
            print(f"  skipped {skipped.scenario_id}: {skipped.reason}", file=sys.stderr)
        if self.explain is not None:
            pages = explain_rollouts(self.rollouts, scenarios, self.explain, self.config)
            print(f"{self.explain}: {len(pages)} pages", file=sys.stderr)
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
        comparison = compare(a, b, alpha=self.alpha)
        print_wide(format_table(a, b), format_comparison(comparison, columns=columns_of(a, b)))
        return 0
