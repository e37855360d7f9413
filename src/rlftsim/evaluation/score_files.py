"""Scores of rollouts in files, from any simulator: matched with logged scenarios, scored scenario by scenario.

The result is an `Evaluation`, as `evaluate` makes one: the same Parquet file, comparable with `compare`. An interrupted
scoring is resumed by the same call, see `evaluation.resumable`.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from rlftsim.errors import ConfigError, DataError, check_types
from rlftsim.evaluation.columns import ARROWS, find_direction
from rlftsim.evaluation.results import SCORE_COLUMNS, EvaluateConfig, Evaluation, Provenance, Skipped, row_of_result
from rlftsim.evaluation.resumable import open_evaluation
from rlftsim.evaluation.rollout_checks import warn_of_doubts
from rlftsim.evaluation.rollout_files import RolloutEntry, find_rollouts, read_states
from rlftsim.evaluation.scenario_source import ScenarioSource, has_road_edge, hash_source, open_scenarios
from rlftsim.jobs.documents import to_finite
from rlftsim.jobs.items import do_group, run_items
from rlftsim.jobs.progress import log
from rlftsim.jobs.runner import Runner, usable_cores
from rlftsim.realism import MetricConfig, metric_by_name, scenario_log, score
from rlftsim.realism.config import is_reported, official_buckets, official_fields

_NO_ROAD_EDGE = "has no road edge, so the distance to it is undefined"


@dataclass(frozen=True)
class ScoreConfig:
    """Settings of scoring rollouts from files."""

    metric: Literal["2025", "2024", "2024_original_code", "2023"] = "2025"
    """Year of the meta-metric. 2024 is the configuration of that year read by today's code, 2024_original_code the code
    of that year too."""
    missing_map: Literal["error", "skip"] = "error"
    """A scenario without road edges stops the run, as in the official evaluator, or is left out and listed."""
    missing_scenario: Literal["error", "skip"] = "error"
    """Rollouts of a scenario that is not among the given ones stop the run, or are left out and listed."""
    limit: int | None = None
    """Only the first so many scenarios."""
    jobs: int | None = None
    """Processes, each with one thread; left out, as many as there are cores. Changes no result."""

    def __post_init__(self) -> None:
        check_types(self)
        for name in ("limit", "jobs"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"score.{name} must be at least 1, got {value}.")
        _ = self.official_metric

    @property
    def official_metric(self) -> MetricConfig:
        """Configuration of the metric's year."""
        return metric_by_name(self.metric)

    @property
    def num_jobs(self) -> int:
        """Processes to start."""
        return self.jobs or usable_cores()


def score_rollouts(
    rollouts: str | PathLike[str],
    scenarios: str | PathLike[str],
    out: str | PathLike[str] | None = None,
    config: ScoreConfig = ScoreConfig(),
    *,
    name: str | None = None,
    runner: Runner | None = None,
    show_progress: bool = True,
) -> Evaluation:
    """Score rollouts from files; every scenario's numbers are also written to `out/<name>.parquet`.

    Impossible rollouts, such as in a wrong frame, are scored with a warning that names scenario and agent.

    Interrupted in any way, the same call goes on; a finished result is read. Scenarios come in the order of
    the files, and in the order inside each file.

    Args:
        rollouts: Npz, submission file or a folder of either, see `find_rollouts`.
        scenarios: Converted data set, or tfrecords (file, folder or glob). Scenarios without rollouts are not read.
        out: Folder of the result, made if missing; None keeps only the returned value.
        config: Metric, handling of missing maps and scenarios, processes.
        name: Name of the row and of the file; None = the name of `rollouts`.
        runner: Runner of the work in place of `config.jobs` processes, see `rlftsim.jobs.runner`.
        show_progress: False prints neither progress nor the time left.

    Raises:
        DataError: Files that cannot be read, agents of a different scenario, values that are no numbers or more
            than 1000 km from the origin, sets of different numbers of rollouts; under "error" also scenarios without
            road edges or unknown ones.
        ConfigError: A limit that would replace a stored result of more scenarios.
    """
    rollouts, scenarios = Path(rollouts), Path(scenarios)
    all_entries, source = find_rollouts(rollouts), open_scenarios(scenarios)
    entries = all_entries[: config.limit]
    check_entries(entries, source, config, scenarios)
    first_entry = next((entry for entry in entries if entry.scenario_id in source), None)
    if first_entry is None:
        raise DataError(f"{rollouts}: none of its {len(entries)} scenarios is in {scenarios}: nothing to score.")
    # Read once more by the work on its scenario; all others are compared with this number.
    num_rollouts = read_states(first_entry).num_rollouts
    provenance = Provenance(
        config=EvaluateConfig(num_rollouts=num_rollouts, metric=config.metric, split=None, limit=config.limit),
        policy="rollouts from files",
        # of all, also under a limit: a quick look and the whole are of the same rollouts
        policy_fingerprint=hash_entries(all_entries),
        dataset=str(scenarios.absolute()), manifest_sha256=hash_source(source),
        sources=source.sources, guessed=source.guessed,
    )  # fmt: skip
    name = name or rollouts.resolve().name.removesuffix(".npz").removesuffix(".binproto").removesuffix(".pb")
    ids, work = [entry.scenario_id for entry in entries], partial(_score_entry, entries, source, config, num_rollouts)
    with open_evaluation(name, provenance, out, ids, runner=runner, jobs=config.num_jobs) as (rows, result):
        if not isinstance(result, Evaluation):
            task = partial(do_group, work, rows)
            result = rows.join(
                run_items(f"score {name}", rows.groups, task, format=rows, lease=result, show_progress=show_progress)
            )
    # The result may be a stored one, made under missing_map="skip".
    _check_maps(result.skipped, config)
    return result


def to_json(evaluation: Evaluation) -> dict[str, Any]:
    """Plain values under the names of the official messages; None = no number.

    `{"metric", "sources", "guessed", "scenarios": [{"scenario_id", fields, "buckets"}], "mean": {fields, "buckets"},
    "standard_error": ...}`.
    Means are over the scenarios that have a number; the standard error needs two numbers.
    """
    metric = metric_by_name(evaluation.config.metric)
    rows = evaluation.table.to_pylist()
    summary = {column: evaluation.mean_and_error(column) for column in SCORE_COLUMNS}
    return {
        "metric": metric.name,
        "sources": list(evaluation.provenance.sources),
        "guessed": list(evaluation.provenance.guessed),
        "scenarios": [{"scenario_id": row["scenario_id"], **_official_fields(row, metric)} for row in rows],
        "mean": _official_fields({column: value.mean for column, value in summary.items()}, metric),
        "standard_error": _official_fields({c: value.standard_error for c, value in summary.items()}, metric),
    }


def format_scores(evaluation: Evaluation) -> Table:
    """Every mean ± standard error with the metric's version; arrows show the better direction."""
    metric = metric_by_name(evaluation.config.metric)
    title = f"{evaluation.name}: {len(evaluation)} scenarios, {evaluation.config.num_rollouts} rollouts each"
    table = Table(title=title, caption=evaluation.data_note or None)
    for heading in ("", "mean", "standard error", "scenarios", "metric"):
        table.add_column(heading, justify="left" if heading in ("", "metric") else "right", no_wrap=True)
    # all columns by their stored names, other than in tables of policies: the place to look a single score up
    for column in SCORE_COLUMNS:
        if not is_reported(column, metric):
            continue
        mean = evaluation.mean_and_error(column)
        label = "meta_metric, traffic light term set to 1" if column == "meta_metric_light_one" else column
        spread = "" if math.isnan(mean.standard_error) else f"± {mean.standard_error:.4f}"
        table.add_row(
            f"{label}{ARROWS[find_direction(column)]}", f"{mean.mean:.4f}", spread, str(mean.count), metric.name
        )
    return table


def check_entries(entries: Sequence[RolloutEntry], source: ScenarioSource, config: ScoreConfig, path: Path) -> None:
    """Check that rollouts have scenarios, and mention scenarios with several sets of rollouts.

    Args:
        entries: Rollouts in files, in the order of the scores.
        source: Scenarios that the rollouts may belong to, by id.
        config: Setting `missing_scenario`: rollouts without scenario are an error, or left out.
        path: Data set or tfrecords that the scenarios come from, for messages.

    Raises:
        DataError: Rollouts without scenario, under `missing_scenario="error"`.
    """
    unmatched = [entry for entry in entries if entry.scenario_id not in source]
    if unmatched and config.missing_scenario == "error":
        raise DataError(
            f"{unmatched[0]}: {len(unmatched)} of {len(entries)} scenarios with rollouts, this one first, are not "
            f"among the {len(source)} of {path}: give all scenarios, or leave them out with missing_scenario=skip "
            "(--missing-scenario skip)."
        )
    counts = Counter(entry.scenario_id for entry in entries)
    repeated = [scenario_id for scenario_id, count in counts.items() if count > 1]
    if repeated:
        log.info(
            f"{len(repeated)} scenarios, {repeated[0]} first, have several sets of rollouts: each set is scored and "
            "counts in the means."
        )


def hash_entries(entries: Sequence[RolloutEntry]) -> str:
    """Hash of names, positions, sizes and modification times of rollouts in files."""
    # not of their bytes: a submission has gigabytes
    digest = hashlib.sha256()
    stats = {path: path.stat() for path in {entry.file for entry in entries}}
    for entry in entries:
        stat = stats[entry.file]
        location = (entry.scenario_id, entry.file.name, entry.start, entry.stop, stat.st_size, stat.st_mtime_ns)
        digest.update(repr(location).encode())
    return digest.hexdigest()


def _score_entry(
    entries: Sequence[RolloutEntry], source: ScenarioSource, config: ScoreConfig, num_rollouts: int, position: int
) -> dict[str, object] | Skipped:
    """Row of a scenario, or the reason for a missing row; all scenarios must have the same number of rollouts."""
    entry = entries[position]
    if entry.scenario_id not in source:
        return Skipped(entry.scenario_id, "not among the given scenarios")
    scenario = source.by_id(entry.scenario_id)
    if not has_road_edge(scenario):
        skipped = Skipped(scenario.scenario_id, _NO_ROAD_EDGE)
        _check_maps([skipped], config)
        return skipped
    states = read_states(entry)
    if states.num_rollouts != num_rollouts:
        raise DataError(
            f"{entry}: {states.num_rollouts} rollouts, others have {num_rollouts}: the meta-metric depends on the "
            "number, so a mean over both means nothing. Score them apart."
        )
    try:
        result = score(scenario_log(scenario), states, config.official_metric)
    except DataError as error:
        raise DataError(f"{entry}: {error}") from error
    warn_of_doubts(scenario, states, entry.file)
    return row_of_result(result, scenario, states, source.find_cluster(entry.scenario_id))


def _check_maps(skipped: Sequence[Skipped], config: ScoreConfig) -> None:
    """Check, under "error", that no scenario is missing from the means, also by the choice of an earlier run."""
    mapless = [scenario for scenario in skipped if scenario.reason == _NO_ROAD_EDGE]
    if mapless and config.missing_map == "error":
        raise DataError(
            f"scenario {mapless[0].scenario_id} {_NO_ROAD_EDGE}, as for the official evaluator: leave such scenarios "
            "out with missing_map=skip (--missing-map skip)."
        )


def _official_fields(values: dict[str, Any], metric: MetricConfig) -> dict[str, Any]:
    fields, buckets = (
        {official: values[column] for column, official in names.items()}
        for names in (official_fields(metric), official_buckets(metric))
    )
    return to_finite({**fields, "buckets": buckets})
