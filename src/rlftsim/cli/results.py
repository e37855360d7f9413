"""Verbs that measure realism: score, evaluate, compare."""

import json
import sys
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.compare import compare, format_comparison, format_table, select_columns
from rlftsim.evaluation.drive_results import DriveResult, format_drive_comparison, format_drives, is_drive_result
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate, evaluation_name
from rlftsim.evaluation.explain_page import explain_rollouts
from rlftsim.evaluation.results import Evaluation
from rlftsim.evaluation.score_files import ScoreConfig, format_scores, score_rollouts, to_json
from rlftsim.jobs.progress import print_wide
from rlftsim.jobs.runner import Runner, Unfinished, Work
from rlftsim.policies.registry import Device, load_policy_or_oracle, with_guidance
from rlftsim.scenario.open import dataset_folder


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a model with the official realism meta-metric, by 32 rollouts of every held-out scenario.

    Writes the results of each scenario to OUT/NAME.parquet. An interrupted evaluation continues when the same
    command is repeated.
    """

    model: Annotated[Positional[str], tyro.conf.arg(metavar="MODEL")]
    """A run, a model folder, a registered name such as "constant_velocity", or "oracle" (the log itself: the
    ceiling)."""
    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    out: Path
    """Folder for the results."""
    name: str | None = None
    """Name of the table row and of the file. Left out: the model's name."""
    device: Device = "auto"
    """Device of the model; several processes (--jobs) need cpu."""
    guidance_scale: float = 1.0
    """With --goals logged: factor on the goal-progress bias of the model's logits. Above 1 it follows goals
    more closely than it learned to."""
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)
    work: Annotated[Work, tyro.conf.arg(name="")] = field(default_factory=Work)

    def run(self) -> int:
        """Evaluate and print the table."""
        name = self.name or evaluation_name(self.model)
        if self.guidance_scale != 1.0 and self.config.goals == "none":
            raise ConfigError(
                f"--guidance-scale {self.guidance_scale:g} has no effect without goals: add --goals logged."
            )
        policy = with_guidance(load_policy_or_oracle(self.model, self.device), self.guidance_scale)
        runner = self.work.runner(self.config.jobs, self.work.on_error)
        result = evaluate(policy, dataset_folder(self.data), self.out, self.config, name=name, runner=runner)
        if not len(result):
            raise DataError(f"none of {len(result.skipped)} scenarios could be scored: {result.skipped[0].reason}")
        print_wide(format_table(result))
        for skipped in result.skipped:
            print(f"  skipped {skipped.scenario_id}: {skipped.reason}")
        print(f"{self.out / name}.parquet")
        return 0


@dataclass(frozen=True)
class Score:
    """Score rollouts of any simulator with the official realism meta-metric.

    Reads npz files (scenario_id, object_ids [A], x y z heading [N, A, 80]) and official submission files; see
    docs/rollout_formats.md. With --out an interrupted run continues when the same command is repeated.
    """

    rollouts: Positional[Path]
    """A file of rollouts, or a folder of them."""
    scenarios: str
    """The simulated scenarios: a converted data set, tfrecords (file, folder, quoted glob), or "synthetic"."""
    out: Path | None = None
    """Folder for the per-scenario results (Parquet)."""
    name: str | None = None
    """Name of the table row and of the file. Left out: the name of the rollouts."""
    json: bool = False
    """Print JSON with the field names of the official messages instead of a table."""
    explain: Path | None = None
    """Folder for one page per scenario that attributes the lost score to features, agents and steps."""
    config: Annotated[ScoreConfig, tyro.conf.arg(name="")] = field(default_factory=ScoreConfig)
    work: Annotated[Work, tyro.conf.arg(name="")] = field(default_factory=Work)

    def run(self) -> int:
        """Score, explain, print."""
        scenarios = dataset_folder(self.scenarios)
        runner = self.work.runner(self.config.num_jobs, self.work.on_error)
        # Before the pages: what scores refuse, such as a name or a share, is refused before a page is written.
        try:
            result = score_rollouts(self.rollouts, scenarios, self.out, self.config, name=self.name, runner=runner)
        except Unfinished:
            self._explain(scenarios, runner)
            raise
        self._explain(scenarios, runner)
        if self.json:
            print(json.dumps(to_json(result), allow_nan=False))
        else:
            print_wide(format_scores(result))
        # On standard error, so that --json prints nothing but JSON.
        for skipped in result.skipped:
            print(f"  skipped {skipped.scenario_id}: {skipped.reason}", file=sys.stderr)
        return 0

    def _explain(self, scenarios: str | PathLike[str], runner: Runner | None) -> None:
        if self.explain is not None:
            pages = explain_rollouts(self.rollouts, scenarios, self.explain, self.config, runner=runner)
            print(f"{self.explain}: {len(pages)} pages", file=sys.stderr)


@dataclass(frozen=True)
class Compare:
    """Compare two evaluations scenario by scenario: mean differences with 95 % intervals and a verdict."""

    first: Positional[Path]
    """A parquet file that `rlftsim evaluate` or `rlftsim drive` wrote."""
    second: Positional[Path]
    """Another one, on the same scenarios. Differences are second minus first."""
    alpha: float = 0.05
    """Significance level."""

    def run(self) -> int:
        """Print both tables."""
        # or: of two, the one that is damaged is to be named
        if is_drive_result(self.first) or is_drive_result(self.second):
            drives = DriveResult.read(self.first), DriveResult.read(self.second)
            print_wide(format_drives(*drives), format_drive_comparison(*drives, alpha=self.alpha))
            return 0
        a, b = Evaluation.read(self.first), Evaluation.read(self.second)
        comparison = compare(a, b, alpha=self.alpha)
        print_wide(format_table(a, b), format_comparison(comparison, columns=select_columns(a, b)))
        return 0
