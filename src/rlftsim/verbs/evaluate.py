"""`rs.evaluate` and `rlftsim evaluate`: a policy's scores on a data set."""

import os
import tempfile
from pathlib import Path
from typing import Literal, overload

from rich.table import Table

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation import evaluate as evaluation
from rlftsim.evaluation.compare import format_table
from rlftsim.evaluation.results import EvaluateConfig, Evaluation
from rlftsim.evaluation.windows import HEADINGS, TABLES, WindowEvaluation, evaluate_windows
from rlftsim.jobs.progress import print_line, print_wide
from rlftsim.jobs.runner import Work
from rlftsim.policies.hub import pin_model
from rlftsim.policies.registry import load_policy_or_oracle, with_guidance
from rlftsim.rollout.policy import Sampling, frozen_copy
from rlftsim.scenario.dataset import ScenarioDataset, dataset_folder, write_dataset
from rlftsim.scenario.open import to_scenarios
from rlftsim.verbs.arguments import Data, Device, File, Metric, Model
from rlftsim.verbs.inputs import (
    check_left_out,
    check_sampling,
    find_policy_name,
    to_policy,
    to_sampling,
    with_checked_arguments,
)

BY_METRIC, LONG = ("metric", "goals", "jobs", "guidance_scale", "work"), ("entries", "ego")
"""Arguments without effect on long rollouts, and on rollouts of 8 s."""


@overload
def evaluate(
    policy: Model, data: Data, *, name: str | None = ..., out: File | None = ..., num_rollouts: int = ...,
    seed: int = ..., seconds: None = None, limit: int | None = ..., metric: Metric = ...,
    sampling: Sampling | None = ..., goals: Literal["none", "logged"] = ..., jobs: int = ..., split: str | None = ...,
    device: Device = ..., guidance_scale: float = ..., rollouts_per_pass: int = ..., work: Work = ...,
) -> Evaluation: ...  # fmt: skip
@overload
def evaluate(
    policy: Model, data: Data, *, name: str | None = ..., out: File | None = ..., num_rollouts: int = ...,
    seed: int = ..., seconds: float, entries: str | None = ..., ego: Literal["model", "log"] = ...,
    limit: int | None = ...,
    sampling: Sampling | None = ..., split: str | None = ..., device: Device = ...,
) -> WindowEvaluation: ...  # fmt: skip
@with_checked_arguments
def evaluate(
    policy: Model,
    data: Data,
    *,
    name: str | None = None,
    out: File | None = None,
    num_rollouts: int = 32,
    seed: int = 0,
    seconds: float | None = None,
    entries: str | None = None,
    ego: Literal["model", "log"] = "model",
    limit: int | None = None,
    metric: Metric = "2025",
    sampling: Sampling | None = None,
    goals: Literal["none", "logged"] = "none",
    jobs: int = 1,
    split: str | None = "validation",
    device: Device = "auto",
    guidance_scale: float = 1.0,
    rollouts_per_pass: int = 8,
    work: Work = Work(),  # noqa: B008
) -> Evaluation | WindowEvaluation:
    """Evaluate a model with the official realism meta-metric, by 32 rollouts of every held-out scenario.

    Writes the results of each scenario to OUT/NAME.parquet. An interrupted evaluation continues when the same command
    is repeated. Rollouts of a minute are held against the log in windows of 10 s instead: density, speed, gaps,
    entries and incidents, in OUT/NAME.csv.

    Args:
        policy: Run, model folder, registered name such as "constant_velocity", or "oracle" (the log itself: the
            ceiling). In Python also a policy.
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package. In Python also an
            opened data set or scenarios in any other form.
        name: Name of the table row and of the file. Left out: the model's name; of a policy that was not loaded, or
            was changed since, its class with the beginning of its fingerprint.
        out: Folder for the results. In Python they may be in memory alone.
        num_rollouts: Rollouts per scenario; the official metric is defined for 32.
        seed: Seed of all randomness. The same seed gives the same scores.
        seconds: Length of long rollouts, a multiple of 10, of worlds whose logs are as long (`rlftsim synthesize
            --seconds 70`); left out, the 8 seconds of the metric.
        entries: Who enters a long world, as in `rlftsim simulate`; left out, nobody enters or leaves.
        ego: Who moves the ego of a long world: around the logged one rollouts and log are of the same streets.
        limit: Number of scenarios, the first ones of the data set; left out, all of them.
        metric: Year of the meta-metric, or "2025-scenario-gen" for the challenge in which whole scenes are made: agents
            but the ego begin at states drawn from the lanes, see docs/scenario_generation.md.
        sampling: Temperature and truncation of the decisions; left out, the whole distribution is sampled.
        goals: Goals of the evaluated agents: none, or their logged final positions, for a goal-conditioned model.
        jobs: Processes, each with one thread, on CPUs only. Changes no result.
        split: Split of the data set; None = all scenarios. An opened data set has its own.
        device: Device of a model that is loaded; several processes (--jobs) need cpu.
        guidance_scale: Factor on the goal-progress bias of the logits, with --goals logged; above 1 goals count more.
        rollouts_per_pass: Rollouts simulated together. Bounds memory, changes no result; 32 suit small models best.
        work: Machines that share the work.

    Returns:
        One row of scores per scenario; see `compare` for two of them. With `seconds` samples of each window.

    Raises:
        ConfigError: A setting out of range, or goals or a temperature that have no effect on the policy.
        DataError: No such data set or split, no scenario with a logged future, an unsound scenario, or a pose of the
            policy that is not finite.
    """
    # 1. Settings first: they are refused before anything is loaded.
    sampling = to_sampling(sampling)
    config = EvaluateConfig(
        num_rollouts=num_rollouts, metric=str(metric), seed=seed, temperature=sampling.temperature,
        top_k=sampling.top_k, split=split, limit=limit, rollouts_per_pass=rollouts_per_pass, jobs=jobs, goals=goals,
    )  # fmt: skip
    if guidance_scale != 1.0 and goals == "none":
        raise ConfigError(f"--guidance-scale {guidance_scale:g} has no effect without goals: add --goals logged.")
    if seconds is not None:
        check_left_out(evaluate, locals(), BY_METRIC, "has no effect on long rollouts: leave it out, or seconds.")
    else:
        check_left_out(evaluate, locals(), LONG, "has no effect on 8 s: leave it out, or name the seconds.")
    # 2. The policy and its name.
    if isinstance(policy, str | os.PathLike):
        name = name or evaluation.evaluation_name(pin_model(policy))
        model = load_policy_or_oracle(policy, device)
    else:
        model = to_policy(policy, device)
        name = name or find_policy_name(model)
    model = with_guidance(model, guidance_scale)
    check_sampling(model, sampling)
    if seconds is not None:
        if isinstance(model, str):
            raise ConfigError("the oracle has no long rollouts: the log is in every table, name a model.")
        return evaluate_windows(
            frozen_copy(model), to_scenarios(data, split, limit), seconds=seconds, name=name,
            num_rollouts=num_rollouts, seed=seed, sampling=sampling, entries=entries, ego=ego,
            rollouts_per_pass=rollouts_per_pass, out=None if out is None else Path(out),
        )  # fmt: skip
    # 3. Scores.
    runner = work.runner(jobs, work.on_error)
    source = dataset_folder(data) if isinstance(data, str | os.PathLike) else to_scenarios(data)
    with tempfile.TemporaryDirectory(prefix="rlftsim-") as temporary:
        # The evaluation reads scenarios by name, in other processes too, so those of a list get a data set.
        if not isinstance(source, Path | ScenarioDataset):
            write_dataset((source[position] for position in range(len(source))), f"{temporary}/scenarios")
            source = ScenarioDataset(f"{temporary}/scenarios")
        return evaluation.evaluate(model, source, out, config, name=name, runner=runner)


def print_evaluation(result: Evaluation | WindowEvaluation, *, out: Path) -> None:
    """Print the table, and the scenarios without scores.

    Args:
        result: Scores of the policy, a row per scenario, or samples of windows.
        out: Folder of the result, see `evaluate`.

    Raises:
        DataError: No scenario could be scored.
    """
    if isinstance(result, WindowEvaluation):
        for title, columns in TABLES.items():
            table = Table(*(HEADINGS[column] for column in columns), title=title)
            for row in result.rows():
                table.add_row(*(row[column] for column in columns))
            print_wide(table)
        return print_line(f"{out / result.name}.csv")
    if not len(result):
        raise DataError(f"none of {len(result.skipped)} scenarios could be scored: {result.skipped[0].reason}")
    print_wide(format_table(result))
    for skipped in result.skipped:
        print_line(f"  skipped {skipped.scenario_id}: {skipped.reason}")
    print_line(f"{out / result.name}.parquet")
