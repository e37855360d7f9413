"""`rs.score` and `rlftsim score`: the official realism meta-metric of rollouts, in memory or in files."""

import json as json_text
import os
import sys
from pathlib import Path
from typing import Literal, overload

from rlftsim.errors import ConfigError
from rlftsim.evaluation.explain_page import explain_rollouts
from rlftsim.evaluation.results import Evaluation
from rlftsim.evaluation.score_files import ScoreConfig, format_scores, score_rollouts, to_json
from rlftsim.evaluation.score_in_memory import score_in_memory
from rlftsim.jobs.progress import print_line, print_lines, print_wide
from rlftsim.jobs.runner import Unfinished, Work
from rlftsim.realism import RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.dataset import ScenarioDataset, dataset_folder
from rlftsim.scenario.types import Scenario
from rlftsim.verbs.arguments import Data, File, ScoreMetric, Simulated
from rlftsim.verbs.inputs import check_left_out, to_batch, with_checked_arguments
from rlftsim.viewer.notebook import check_rollouts

IN_FILES = ("out", "name", "explain", "missing_map", "missing_scenario", "limit", "jobs", "work")
"""Arguments without effect on rollouts in memory."""


@overload
def score(scenarios: Data, rollouts: Rollouts, metric: ScoreMetric = "2025") -> RealismResult: ...
@overload
def score(
    scenarios: Data, rollouts: File, metric: ScoreMetric = "2025", *, out: File | None = ..., name: str | None = ...,
    explain: File | None = ..., missing_map: Literal["error", "skip"] = ...,
    missing_scenario: Literal["error", "skip"] = ..., limit: int | None = ..., jobs: int | None = ..., work: Work = ...,
) -> Evaluation: ...  # fmt: skip
@with_checked_arguments
def score(
    scenarios: Data,
    rollouts: Simulated,
    metric: ScoreMetric = "2025",
    *,
    out: File | None = None,
    name: str | None = None,
    explain: File | None = None,
    missing_map: Literal["error", "skip"] = "error",
    missing_scenario: Literal["error", "skip"] = "error",
    limit: int | None = None,
    jobs: int | None = None,
    work: Work = Work(),  # noqa: B008
) -> RealismResult | Evaluation:
    """Score rollouts of any simulator with the official realism meta-metric.

    Reads npz files (scenario_id, object_ids [A], x y z heading [N, A, 80]) and official submission files; see
    docs/rollout_formats.md. In Python also those of `simulate`. With a folder for the results an interrupted run
    continues when the same command is repeated.

    Rollouts that cannot be, such as those of another frame, are scored with a warning that names scenario and agent.

    Args:
        scenarios: Simulated scenarios: a converted data set, tfrecords (file, folder, quoted glob), or "synthetic".
            In Python, for rollouts in memory, scenarios with their logged futures, in the same order.
        rollouts: File of rollouts, or folder of them; in Python also a result of `simulate`.
        metric: Year of the meta-metric. 2024 is the configuration of that year read by today's code, 2024_original_code
            the code of that year too.
        out: Folder for the per-scenario results (Parquet).
        name: Name of the table row and of the file. Left out: the name of the rollouts.
        explain: Folder for one page per scenario that attributes the lost score to features, agents and steps.
        missing_map: Treatment of a scenario without road edges: it stops the run, as in the official evaluator, or is
            left out and listed.
        missing_scenario: Treatment of rollouts of a scenario that is not among the given ones: they stop the run, or
            are left out and listed.
        limit: Number of scenarios, the first ones; left out, all of them.
        jobs: Processes, each with one thread; left out, as many as there are cores. Changes no result.
        work: Machines that share the work on files.

    Returns:
        Scores of rollouts in memory, without a leading axis for a `Scenario`, else with one of B scenarios. Of files an
        evaluation with a row per scenario.

    Raises:
        ConfigError: Rollouts of other scenarios, no such metric, or an option of files for rollouts in memory.
        DataError: A scenario that cannot be scored, such as one without its future, a pose that is not finite, a
            scenario with other agents than the simulated one, or a file that cannot be read.
    """
    if isinstance(rollouts, str | os.PathLike) and not isinstance(scenarios, Rollouts):
        config = ScoreConfig(str(metric), missing_map, missing_scenario, limit, jobs)  # pyright: ignore
        return _score_files(Path(rollouts), scenarios, out, name, explain, config, work)
    way_out = "leave it out, or name files of rollouts"
    check_left_out(score, locals(), IN_FILES, f"has no effect on rollouts in memory: {way_out}.")
    check_rollouts("score", scenarios, rollouts)
    assert isinstance(rollouts, Rollouts)
    batch = to_batch(scenarios, rollouts.position.device)
    return score_in_memory(batch, rollouts, str(metric), is_single=isinstance(scenarios, Scenario))


def _score_files(
    rollouts: Path,
    scenarios: Data,
    out: File | None,
    name: str | None,
    explain: File | None,
    config: ScoreConfig,
    work: Work,
) -> Evaluation:
    """Scores of rollouts in files, and pages that explain them; arguments as in `score`."""
    if isinstance(scenarios, ScenarioDataset):
        scenarios = scenarios.folder
    if not isinstance(scenarios, str | os.PathLike):
        raise ConfigError(f"rollouts in files need the name of a data set, got {type(scenarios).__name__}.")
    folder, runner = dataset_folder(scenarios), work.runner(config.num_jobs, work.on_error)

    def write_pages() -> None:
        if explain is not None:
            pages = explain_rollouts(rollouts, folder, explain, config, runner=runner)
            print_line(f"{explain}: {len(pages)} pages", file=sys.stderr)

    # Before the pages: what scores refuse, such as a name or a share, is refused before a page is written.
    try:
        result = score_rollouts(rollouts, folder, out, config, name=name, runner=runner)
    except Unfinished:
        write_pages()
        raise
    write_pages()
    return result


def print_scores(result: Evaluation, *, json: bool = False) -> None:
    """Print every mean.

    Args:
        result: Scores of rollouts in files.
        json: Print JSON with the field names of the official messages instead of a table.
    """
    if json:
        print_lines(json_text.dumps(to_json(result), allow_nan=False))
    else:
        print_wide(format_scores(result))
    # On standard error, so that --json prints nothing but JSON.
    for skipped in result.skipped:
        print_line(f"  skipped {skipped.scenario_id}: {skipped.reason}", file=sys.stderr)
