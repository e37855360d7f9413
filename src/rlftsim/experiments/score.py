"""Scores of anybody's rollouts: read from files, matched with recorded scenarios, scored scenario by scenario.

The result is an `Evaluation`, as `evaluate` makes one: the same Parquet file, comparable with `compare`. A run that was
interrupted goes on with what is missing, see `experiments.parts`.
"""

import hashlib
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.evaluation import (
    SCORE_COLUMNS,
    EvaluateConfig,
    Evaluation,
    Provenance,
    Skipped,
    direction_of,
    row_of_result,
)
from rlftsim.experiments.parts import ResumableEvaluation
from rlftsim.experiments.rollout_files import RolloutEntry, find_rollouts, read_states
from rlftsim.experiments.scenario_source import ScenarioSource, open_scenarios
from rlftsim.progress import say
from rlftsim.realism import MetricConfig, SimulatedStates, build_scenario_log, metric_by_name, score
from rlftsim.realism.map_based import select_polylines
from rlftsim.realism.official_names import is_reported, official_buckets, official_fields
from rlftsim.scenario.types import ROAD_EDGE_TYPES, Scenario
from rlftsim.workers import usable_cores

_NO_ROAD_EDGE = "has no road edge, so the distance to it is undefined"


@dataclass(frozen=True)
class ScoreConfig:
    """How rollouts from files are scored."""

    metric: Literal["2025", "2024", "2024_original_code", "2023"] = "2025"
    """Year of the meta-metric. 2024 is the configuration of that year read by today's code, 2024_original_code the code of that
    year too."""
    missing_map: Literal["error", "skip"] = "error"
    """A scenario without road edges stops the run, as in the official evaluator, or is left out and listed."""
    missing_scenario: Literal["error", "skip"] = "error"
    """Rollouts of a scenario that is not among the given ones stop the run, or are left out and listed."""
    limit: int | None = None
    """Only the first so many scenarios."""
    jobs: int | None = None
    """Processes, each with one thread; left out, as many as there are cores. Changes no result."""

    def __post_init__(self) -> None:
        for name in ("limit", "jobs"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"score.{name} must be at least 1, got {value}.")
        metric_by_name(self.metric)

    @property
    def num_jobs(self) -> int:
        """Processes to start."""
        return self.jobs or usable_cores()


def score_rollouts(
    rollouts: Path,
    scenarios: Path,
    out: Path | None = None,
    config: ScoreConfig = ScoreConfig(),
    *,
    name: str | None = None,
    show_progress: bool = True,
) -> Evaluation:
    """Score rollouts from files; every scenario's numbers are also written to `out/<name>.parquet`.

    Interrupted in any way, the same call goes on where it was. Once finished, it reads the file. Scenarios come in the order
    of the files and of their places in them.

    Args:
        rollouts: npz, submission file or a folder of them, see `find_rollouts`.
        scenarios: converted data set, or tfrecords (file, folder or glob). Those without rollouts are not looked at.
        out: folder of the result, made if missing; None keeps nothing.
        config: metric, what to do where something is missing, processes.
        name: of the row and the file; None = the name of `rollouts`.
        show_progress: whether to show progress and the time left on stderr.

    Raises:
        DataError: files that cannot be read, agents that are not the scenario's, values that are no numbers, sets of different
            numbers of rollouts; under "error" also scenarios without road edges or unknown ones.
    """
    with tempfile.TemporaryDirectory() as nowhere:
        entries, source = find_rollouts(rollouts)[: config.limit], open_scenarios(scenarios)
        check_entries(entries, source, config, scenarios)
        known = next((entry for entry in entries if entry.scenario_id in source), None)
        if known is None:
            raise DataError(f"{rollouts}: none of its {len(entries)} scenarios is in {scenarios}: nothing to score.")
        num_rollouts = read_states(known).num_rollouts
        provenance = _describe(entries, source, scenarios, num_rollouts, config)
        place = ResumableEvaluation(name or _name_of(rollouts), provenance, Path(out or nowhere))
        job = _Job(tuple(entries), source, config, place)
        result = place.run(
            partial(_score_group, job),
            [entry.scenario_id for entry in entries],
            jobs=config.num_jobs,
            title=f"score {place.name}",
            show_progress=show_progress,
        )
    _refuse_mapless(result.skipped, config)
    return result


def _name_of(rollouts: Path) -> str:
    """Name of a file or folder without the endings of rollout files."""
    name = Path(rollouts).resolve().name
    for ending in (".npz", ".binproto", ".pb"):
        name = name.removesuffix(ending)
    return name


def to_json(evaluation: Evaluation) -> dict[str, Any]:
    """Plain values under the official messages' names; where there is no number, None.

    `{"metric", "scenarios": [{"scenario_id", fields, "buckets"}], "mean": {fields, "buckets"}, "standard_error": {...}}`.
    Means are over the scenarios that have a number; the standard error needs two of them.
    """
    metric = metric_by_name(evaluation.config.metric)
    rows = evaluation.table.to_pylist()
    summary = {column: evaluation.mean_and_error(column) for column in SCORE_COLUMNS}
    return {
        "metric": metric.name,
        "scenarios": [{"scenario_id": row["scenario_id"], **_official_fields(row, metric)} for row in rows],
        "mean": _official_fields({column: value.mean for column, value in summary.items()}, metric),
        "standard_error": _official_fields({c: value.standard_error for c, value in summary.items()}, metric),
    }


def format_scores(evaluation: Evaluation) -> Table:
    """Every mean ± standard error with the metric's version beside it; arrows say which way is better."""
    metric = metric_by_name(evaluation.config.metric)
    title = f"{evaluation.name}: {len(evaluation)} scenarios, {evaluation.config.num_rollouts} rollouts each"
    table = Table(title=title, title_justify="left")
    for heading in ("", "mean", "standard error", "scenarios", "metric"):
        table.add_column(heading, justify="left" if heading in ("", "metric") else "right", no_wrap=True)
    for column in SCORE_COLUMNS:
        if not is_reported(column, metric):
            continue
        found = evaluation.mean_and_error(column)
        arrow = "↑" if direction_of(column) == "higher" else "↓"
        label = "meta_metric, traffic light term set to 1" if column == "meta_metric_light_one" else column
        spread = "" if math.isnan(found.standard_error) else f"± {found.standard_error:.4f}"
        table.add_row(f"{label} {arrow}", f"{found.mean:.4f}", spread, str(found.count), metric.name)
    return table


@dataclass(frozen=True, eq=False)
class _Job:
    """One scoring under way; is handed to other processes."""

    entries: tuple[RolloutEntry, ...]
    source: ScenarioSource
    config: ScoreConfig
    place: ResumableEvaluation


def check_entries(entries: Sequence[RolloutEntry], source: ScenarioSource, config: ScoreConfig, where: Path) -> None:
    """Refuse, or mention, rollouts without scenario and scenarios with several sets of rollouts."""
    unknown = [entry for entry in entries if entry.scenario_id not in source]
    if unknown and config.missing_scenario == "error":
        raise DataError(
            f"{unknown[0]}: {len(unknown)} of {len(entries)} scenarios with rollouts, this one first, are not among the "
            f"{len(source)} of {where}: give all scenarios, or leave them out with missing_scenario=skip (--missing-scenario skip)."
        )
    repeated = [scenario_id for scenario_id, count in Counter(e.scenario_id for e in entries).items() if count > 1]
    if repeated:
        say(
            f"{len(repeated)} scenarios, {repeated[0]} first, have several sets of rollouts: each set is scored and counts "
            "in the means."
        )


def _describe(
    entries: Sequence[RolloutEntry],
    source: ScenarioSource,
    scenarios: Path,
    num_rollouts: int,
    config: ScoreConfig,
) -> Provenance:
    digest = hashlib.sha256()
    stats = {path: path.stat() for path in {entry.file for entry in entries}}
    for entry in entries:
        stat = stats[entry.file]
        place = (entry.scenario_id, entry.file.name, entry.start, entry.stop, stat.st_size, stat.st_mtime_ns)
        digest.update(repr(place).encode())
    return Provenance(
        config=EvaluateConfig(num_rollouts=num_rollouts, metric=config.metric, split=None, limit=config.limit),
        policy="rollouts from files",
        policy_fingerprint=digest.hexdigest(),
        dataset=str(Path(scenarios).absolute()),
        manifest_sha256=source.fingerprint,
    )


def _score_group(job: _Job, group: range, advance: Callable[[int], None], is_stopped: Callable[[], bool]) -> None:
    """Score a few scenarios and write their part."""
    outcomes = []
    for position in group:
        if is_stopped():
            return
        outcomes.append(_score_entry(job, job.entries[position]))
        advance(1)
    job.place.write_part(group, outcomes)


def _score_entry(job: _Job, entry: RolloutEntry) -> dict[str, object] | Skipped:
    """Row of one scenario, or why there is none."""
    if entry.scenario_id not in job.source:
        return Skipped(entry.scenario_id, "not among the given scenarios")
    scenario = job.source.by_id(entry.scenario_id)
    if not has_road_edge(scenario):
        skipped = Skipped(scenario.scenario_id, _NO_ROAD_EDGE)
        _refuse_mapless([skipped], job.config)
        return skipped
    states = read_states(entry)
    _check_number(entry, states, job.place.provenance.config.num_rollouts)
    try:
        result = score(build_scenario_log(scenario), states, metric_by_name(job.config.metric))
    except DataError as error:
        raise DataError(f"{entry}: {error}") from error
    return row_of_result(result, scenario, states)


def has_road_edge(scenario: Scenario) -> bool:
    """Whether the map has a road edge of two points or more, without which the official metric is undefined."""
    return len(select_polylines(scenario.map_features, ROAD_EDGE_TYPES).count) > 0


def _check_number(entry: RolloutEntry, states: SimulatedStates, num_rollouts: int) -> None:
    if states.num_rollouts != num_rollouts:
        raise DataError(
            f"{entry}: {states.num_rollouts} rollouts, others have {num_rollouts}: the meta-metric depends on the number, so "
            "a mean over both means nothing. Score them apart."
        )


def _refuse_mapless(skipped: Sequence[Skipped], config: ScoreConfig) -> None:
    """Under "error" nothing may be missing from the means, also where an earlier run left it out."""
    mapless = [scenario for scenario in skipped if scenario.reason == _NO_ROAD_EDGE]
    if mapless and config.missing_map == "error":
        raise DataError(
            f"scenario {mapless[0].scenario_id} {_NO_ROAD_EDGE}, as for the official evaluator: leave such "
            "scenarios out with missing_map=skip (--missing-map skip)."
        )


def _official_fields(values: dict[str, Any], metric: MetricConfig) -> dict[str, Any]:
    def named(names: dict[str, str]) -> dict[str, float | None]:
        return {official: values[c] if math.isfinite(values[c]) else None for c, official in names.items()}

    return {**named(official_fields(metric)), "buckets": named(official_buckets(metric))}
