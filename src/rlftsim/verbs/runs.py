"""`rlftsim runs`: training runs side by side, with the settings in which they differ."""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.table import Table

from rlftsim.errors import ConfigError, DataError, in_short, whole_number
from rlftsim.jobs.folder import recognize_folder
from rlftsim.jobs.progress import print_line, print_wide
from rlftsim.statistics import mean_interval
from rlftsim.training.run_folder import RUN_INPUTS, flatten, may_change, read_metrics, stored_settings

VALIDATION, BOUND = "validation_rmm", "validation_gain_low"
MEASURES = (VALIDATION, "rmm", "loss", "imitation_loss")
"""Metrics that say how good a model is, the most telling first; losses are better where they are lower."""
NO_VALUE = "–"
Trained = TypeVar("Trained")
SEED_FOLDER = "seed-"
"""Beginning of the name of a run's folder, of several that differ in the seed alone."""


@dataclass(frozen=True)
class RunSummary:
    """Results of a run of any training method, finished or not."""

    folder: Path
    settings: Mapping[str, Any]
    """Settings by dotted name, and hashes of the inputs; without those that change no result."""
    metrics: Sequence[Mapping[str, Any]]
    """Metrics of each update, as in metrics.jsonl."""
    has_model: bool
    """False = the run has not finished. A run that is made longer has the model of the shorter one until it ends."""

    @property
    def num_updates(self) -> int:
        """Number of updates done."""
        return int(self.metrics[-1]["update"]) if self.metrics else 0

    @property
    def measure(self) -> str | None:
        """The most telling metric that the run has logged; None before the first update."""
        logged = {name for values in self.metrics for name in values}
        return next((name for name in MEASURES if name in logged), None)

    @property
    def last(self) -> float | None:
        """Last value of the measure; of a metric of training batches, which are small, the mean of the last tenth."""
        name = self.measure
        values = [float(line[name]) for line in self.metrics if name is not None and name in line]
        recent = values[-1:] if name == VALIDATION else values[-math.ceil(len(values) / 10) :]
        return sum(recent) / len(recent) if recent else None

    @property
    def best(self) -> tuple[int, float] | None:
        """Update with the best validation, and its RMM: the one whose weights are the model, where the run keeps these.
        The best of many training batches would be luck."""
        values = [line for line in self.metrics if self.measure == VALIDATION and VALIDATION in line]
        best = max(values, key=lambda line: line.get(BOUND, line[VALIDATION]), default=None)
        return None if best is None else (int(best["update"]), float(best[VALIDATION]))


def runs(folders: list[str]) -> list[RunSummary]:
    """List training runs: how far they are, how good, and which settings differ.

    Example: `rlftsim runs runs/*`

    The metric is the RMM of validation where a run has validated; else the RMM of its training rollouts or the loss,
    whose mean over the last tenth of the updates is "last". Values of different data do not compare. Runs of --seeds
    have a further table with the mean.

    Args:
        folders: Folders of runs; other files and folders are passed over, if there is a run among them.

    Raises:
        DataError: No run, or no such folder.
        CheckpointError: A file of settings is damaged.
    """
    paths = [Path(folder) for folder in folders]
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise DataError(f"{missing[0]} does not exist: name folders of training runs, such as runs/*.")
    listed = [read_run(path) for path in paths if recognize_folder(path) == "run"]
    if not listed:
        raise DataError(f"no training run in {in_short(', '.join(map(str, paths)))}: name the --out of a training.")
    return listed


def read_run(folder: Path) -> RunSummary:
    """The run in a folder.

    Raises:
        CheckpointError: The file of settings is damaged.
    """
    stored = stored_settings(folder)
    settings = {name: value for name, value in flatten(stored).items() if not may_change(name)}
    settings |= {name: stored[name][:8] for name in RUN_INPUTS if isinstance(stored.get(name), str)}
    return RunSummary(folder, settings, read_metrics(folder), (folder / "model" / "config.json").exists())


def find_differences(training_runs: Sequence[RunSummary]) -> dict[str, list[str]]:
    """Settings in which runs differ, by name: the value of each run as text.

    Args:
        training_runs: Runs of any methods; a setting that a run does not have is no difference, and "–" there.
    """
    rows: dict[str, list[str]] = {}
    for name in dict.fromkeys(name for run in training_runs for name in run.settings):
        values = [_format(run.settings[name]) if name in run.settings else NO_VALUE for run in training_runs]
        if len(set(values) - {NO_VALUE}) > 1:
            rows[name] = values
    return rows


def find_seeds(training_runs: Sequence[RunSummary]) -> list[list[RunSummary]]:
    """Groups of two or more runs side by side in folders seed-N that differ in the seed alone.

    Args:
        training_runs: Runs of any methods.
    """
    groups: dict[object, list[RunSummary]] = {}
    for run in training_runs:
        # fresh weights are drawn with the seed
        equal = {name: value for name, value in run.settings.items() if name not in ("seed", "initial_policy")}
        if run.folder.name.startswith(SEED_FOLDER):
            key = (run.folder.absolute().parent, run.measure, json.dumps(equal, sort_keys=True))
            groups.setdefault(key, []).append(run)
    return [group for group in groups.values() if len(group) > 1]


def print_runs(training_runs: list[RunSummary]) -> None:
    """Print a table of runs, and one of the settings in which they differ.

    Args:
        training_runs: Runs, in the order of the rows.
    """
    names = _shorten_names([run.folder for run in training_runs])
    table = Table()
    for heading in ("run", "model", "updates", "metric", "last", "best", "at update"):
        table.add_column(heading, justify="left" if heading in ("run", "model", "metric") else "right")
    for name, run in zip(names, training_runs):
        update, best = run.best or (NO_VALUE, None)
        numbers = (_format(run.last), _format(best), str(update))
        table.add_row(name, "yes" if run.has_model else "no", str(run.num_updates), run.measure or NO_VALUE, *numbers)
    differences = Table("setting", *names)
    for name, values in find_differences(training_runs).items():
        differences.add_row(name, *values)
    means = Table("mean over seeds, 95 % interval", "seeds", "metric", "last", "best")
    for group in find_seeds(training_runs):
        last, best = [run.last for run in group], [run.best and run.best[1] for run in group]
        label = f"{names[training_runs.index(group[0])]} …"
        means.add_row(label, str(len(group)), group[0].measure, _average(last), _average(best))
    print_wide(table, *(further for further in (differences, means) if further.row_count))


def _average(values: Sequence[float | None]) -> str:
    """Mean and interval (Student's t) as text; a dash where a value is missing."""
    if None in values:
        return NO_VALUE
    mean, (low, high) = (estimate := mean_interval(np.array(values, float))).mean, estimate.interval
    return f"{mean:.5g} [{low:.5g}, {high:.5g}]"


def _shorten_names(folders: Sequence[Path]) -> list[str]:
    """Paths without the folder that all of them are in."""
    if len(folders) < 2:
        return [str(folder) for folder in folders]
    shared = os.path.commonpath([folder.absolute().parent for folder in folders])
    return [os.path.relpath(folder.absolute(), shared) for folder in folders]


def _format(value: Any) -> str:
    """A setting or a metric as text."""
    if isinstance(value, float):
        return f"{value:.5g}"
    return NO_VALUE if value is None else value if isinstance(value, str) else json.dumps(value)


def repeat_for_seeds(verb: Callable[..., Trained], arguments: Mapping[str, Any], seeds: int) -> Trained:
    """Train several times, with a seed and a folder for each run; returns the policy of the first run.

    Args:
        verb: Verb that trains, called without `seeds` for each run.
        arguments: Arguments of the verb by name.
        seeds: Number of runs, with the seeds 0, 1, 2 and so on.

    Raises:
        ConfigError: No run, no folder for the runs, or a seed for all.
    """
    if arguments["out"] is None or arguments["seed"] is not None:
        raise ConfigError(f"seeds={seeds}: several runs need a folder for theirs, out, and each has its seed.")
    policies = []
    for seed in range(whole_number("seeds", seeds, 1)):
        out = Path(arguments["out"]) / f"{SEED_FOLDER}{seed}"
        policies.append(verb(**{**arguments, "out": out, "seed": seed, "seeds": None}))
    return policies[0]


def print_model(policy: Any, *, out: Path, seeds: int | None) -> None:
    """Print where the model is, or the table of several runs.

    Args:
        policy: Trained policy.
        out: Folder of the run.
        seeds: Number of runs with different seeds; None = a single one.
    """
    if seeds is None:
        print_line(f"model: {out / 'model'}")
    else:
        print_runs(runs([str(folder) for folder in sorted(out.glob(f"{SEED_FOLDER}*"))]))
