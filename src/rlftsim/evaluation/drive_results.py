"""Results of `rlftsim drive`: a Parquet file with a row per scenario, for a planner in a type of traffic."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.table import Table

from rlftsim.errors import ConfigError, DataError, check_types
from rlftsim.evaluation.columns import ARROWS, find_direction, format_estimate
from rlftsim.evaluation.compare import PairedDifference, compare_paired, comparison_table, pair_rows
from rlftsim.evaluation.results import LARGEST
from rlftsim.jobs.documents import parse_json
from rlftsim.jobs.files import write_atomically
from rlftsim.jobs.tables import read_parquet, read_parquet_metadata
from rlftsim.statistics import mean_interval

FORMAT = "rlftsim-drive-1"
MAIN_SCORES = (
    "nuplan_style", "pdms_style", "no_at_fault_collision", "drivable_area", "progress", "time_to_collision", "comfort",
    "at_fault_collision_rate", "hit_rate", "others_realism", "others_collision_rate", "others_offroad_rate",
)  # fmt: skip
"""Columns of the table and of comparisons on the command line; the file has more."""
CAUSES = {
    "no_at_fault_collision": "at fault for a collision", "drivable_area": "leaves the road",
    "driving_direction": "drives against its lane", "making_progress": "hardly moves",
    "time_to_collision": "gets too close", "progress": "is slow", "speed_limit": "is too fast",
    "comfort": "jerks",
}  # fmt: skip
"""Part of the score `nuplan_style` -> what a planner does where it is low, the heaviest first."""
LOW = 0.5
"""A part of the score below this is named as a cause."""
FAILED = "all scores"
"""Name under which `DriveResult.missing` has the error of a planner that failed."""
TEXTS = ("scenario_id", "traffic")
"""Columns that are no scores."""


@dataclass(frozen=True)
class DriveSettings:
    """Planner, traffic, data and dice of a result's episodes."""

    planner: str
    traffic: str
    model: str
    """Fingerprint of the traffic model; "none" where no agent followed one."""
    dataset: str
    split: str | None
    num_rollouts: int
    seed: int
    rlftsim_version: str
    seconds: float = 8.0
    planner_code: str = ""
    """Hash of the file that defines the planner."""
    manifest_sha256: str = ""
    """Hash of the data set's manifest."""
    entries: str | None = None
    """Name, or hash of the file, of the model of who enters; None = nobody enters or leaves."""

    def what_counts(self) -> dict[str, object]:
        """The values that results of the same episodes share; the manifest identifies a data set that was moved."""
        values = asdict(self)
        if self.manifest_sha256:
            del values["dataset"]
        return values


@dataclass(frozen=True, eq=False)
class DriveResult:
    """Scores of a planner in a type of traffic, means over the rollouts of each scenario."""

    settings: DriveSettings
    table: pa.Table
    """Columns `scenario_id`, `traffic` and float64 scores; NaN = not measurable in the scenario."""
    missing: Mapping[str, Mapping[str, str]]
    """Scenario id -> score -> reason that it is missing."""

    @classmethod
    def of(
        cls, settings: DriveSettings, rows: Sequence[Mapping[str, Any]], missing: Mapping[str, Mapping[str, str]]
    ) -> "DriveResult":
        """Result of some rows.

        Args:
            settings: Planner, traffic, data and seed of the episodes.
            rows: A row per scenario, all with the same columns.
            missing: Reasons for missing scores, by scenario id and score.
        """
        return cls(
            settings, pa.Table.from_pylist(list(rows)), {name: reasons for name, reasons in missing.items() if reasons}
        )

    @property
    def name(self) -> str:
        """Planner and traffic."""
        return f"{self.settings.planner} in {self.settings.traffic}"

    @property
    def failures(self) -> dict[str, str]:
        """Scenario id -> error of the planner that failed there; all its scores are NaN."""
        return {name: reasons[FAILED] for name, reasons in self.missing.items() if FAILED in reasons}

    @property
    def scenario_ids(self) -> list[str]:
        """Ids of the scenarios, in the order of the rows."""
        return self.table["scenario_id"].to_pylist()

    def values(self, column: str) -> np.ndarray:
        """A column as float64 [scenarios]."""
        return self.table[column].to_numpy()

    def write(self, path: str | PathLike[str]) -> None:
        """Write as Parquet, whole or not at all."""
        settings = {name: value for name, value in asdict(self.settings).items() if (name, value) != ("entries", None)}
        about = {"format": FORMAT, "settings": settings, "missing": self.missing}
        table = self.table.replace_schema_metadata({"rlftsim": json.dumps(about)})
        write_atomically(Path(path), lambda temporary: pq.write_table(table, temporary, compression="zstd"))

    @classmethod
    def read(cls, path: str | PathLike[str]) -> "DriveResult":
        """Read the file that `write` wrote.

        Raises:
            DataError: Not such a file, or a file that was cut or edited.
        """
        way_out = "not a result of `rlftsim drive`, drive again"
        missing = f"{path}: no such result of `rlftsim drive`: drive again."
        table = read_parquet(path, way_out, missing=missing)
        metadata = (table.schema.metadata or {}).get(b"rlftsim", b"{}")
        about = parse_json(metadata, way_out, source=str(path))
        try:
            if about["format"] != FORMAT:
                raise ValueError(f"its format is {str(about['format'])[:40]}, not {FORMAT}")
            settings = DriveSettings(**about["settings"])
            check_types(settings)
            missing = {name: dict(reasons.items()) for name, reasons in about["missing"].items()}
            if not all(isinstance(text, str) for reasons in missing.values() for text in reasons.values()):
                raise TypeError("a reason is no text")
            _check_columns(table)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            cause = str(error).partition("\n")[0].rstrip(".")
            if isinstance(error, KeyError):
                cause = f"it lacks {error.args[0]}"
            elif isinstance(error, AttributeError):
                cause = "a value in it is of another type"
            raise DataError(f"{path}: not a result of `rlftsim drive` ({cause}): drive again.") from None
        return cls(settings, table.replace_schema_metadata(None), missing)


def _check_columns(table: pa.Table) -> None:
    """Check the columns that tables and comparisons read: a text for each scenario, and numbers.

    Raises:
        KeyError: A missing column.
        TypeError: A column of values of a wrong type.
        ValueError: A scenario that is listed twice, or an impossible number.
    """
    for name in (*TEXTS, *MAIN_SCORES, *CAUSES):
        if name not in table.schema.names:
            raise KeyError(f"column {name}")
    for name, column in zip(table.schema.names, table.columns):
        if column.type != (pa.string() if name in TEXTS else pa.float64()) or column.null_count:
            raise TypeError(f"column {name} has empty cells or those of another type")
        if name not in TEXTS and (np.abs(column.to_numpy()) > LARGEST).any():
            raise ValueError(f"column {name} has a number beyond {LARGEST:g}")
    ids = table["scenario_id"].to_pylist()
    if len({*ids}) < len(ids):
        raise ValueError("a scenario is there twice")


def is_drive_result(path: str | PathLike[str]) -> bool:
    """True for a Parquet file of `rlftsim drive`; False for any other file, and without a file."""
    metadata = read_parquet_metadata(path).get(b"rlftsim", b"{}")
    try:
        return parse_json(metadata, "drive again", source=str(path)).get("format") == FORMAT
    except DataError:
        return False


@dataclass(frozen=True, eq=False)
class DriveComparison:
    """Two results, scenario by scenario; `comparison["progress"]` is the difference of a score."""

    a: DriveResult
    b: DriveResult
    differences: tuple[PairedDifference, ...]
    """Of the scores that both have, b minus a."""

    def __iter__(self) -> Iterator[PairedDifference]:
        return iter(self.differences)

    def __getitem__(self, column: str) -> PairedDifference:
        """Difference of a score.

        Raises:
            ConfigError: A score that is not in both.
        """
        for difference in self.differences:
            if difference.column == column:
                return difference
        raise ConfigError(f"both have no score {column!r}, only {', '.join(row.column for row in self.differences)}.")


def compare_drives(a: DriveResult, b: DriveResult, *, alpha: float = 0.05) -> DriveComparison:
    """Paired differences of the scores that both have, b minus a.

    Args:
        a: Reference, such as a planner in replayed traffic.
        b: Result to judge, such as the same planner in reactive traffic.
        alpha: Probability of calling a difference that is none.

    Raises:
        DataError: Unequal numbers of rollouts, lengths, seeds or data, or no scenario in common.
    """
    # a data set may have moved, or be another one at the same place; older results know its place alone
    know_content = a.settings.manifest_sha256 and b.settings.manifest_sha256
    compared = {name: name for name in ("num_rollouts", "seed", "split", "seconds")}
    compared["dataset"] = "manifest_sha256" if know_content else "dataset"
    compared |= {"entries": "entries"} if a.settings.traffic == b.settings.traffic else {}
    for label, setting in compared.items():
        if getattr(a.settings, setting) != getattr(b.settings, setting):
            value_a, value_b = getattr(a.settings, label), getattr(b.settings, label)
            value_b = f"another {value_b}" if value_a == value_b else value_b
            raise DataError(f"{a.name} was driven with {label} {value_a}, {b.name} with {value_b}: drive both alike.")
    rows_a, rows_b = pair_rows(a.name, a.scenario_ids, b.name, b.scenario_ids)
    columns = [name for name in a.table.schema.names if name not in TEXTS and name in b.table.schema.names]
    rows = (compare_paired(name, a.values(name)[rows_a], b.values(name)[rows_b], alpha=alpha) for name in columns)
    return DriveComparison(a, b, tuple(rows))


@dataclass(frozen=True)
class RankedScenario:
    """A scenario with the lowest score of a planner in some types of traffic."""

    scenario_id: str
    score: float
    """Lowest `nuplan_style`."""
    traffic: str
    """Type of traffic with this score."""
    causes: tuple[str, ...]
    """What the planner does there, of `CAUSES`."""


def is_failure(scores: Mapping[str, Any]) -> bool:
    """True where a planner is at fault for a collision or leaves the road, by the scores of an episode, or by means."""
    return scores["at_fault_collision_rate"] > 0 or scores["drivable_area"] < 1


def find_failures(result: DriveResult) -> list[str]:
    """Ids of the scenarios with a failure in any rollout, see `is_failure`."""
    return [row["scenario_id"] for row in result.table.to_pylist() if is_failure(row)]


def rank_scenarios(results: Sequence[DriveResult]) -> list[RankedScenario]:
    """Scenarios by the lowest score of the planner in any traffic, the worst first; without those that have no score.

    Args:
        results: Results of a planner in types of traffic, on the same scenarios.
    """
    rows = [
        (float(result.values("nuplan_style")[row]), scenario_id, result, row)
        for result in results
        for row, scenario_id in enumerate(result.scenario_ids)
    ]
    worst: dict[str, RankedScenario] = {}
    for score, scenario_id, result, row in sorted(rows, key=lambda entry: entry[0]):
        if scenario_id not in worst and not math.isnan(score):
            causes = tuple(cause for name, cause in CAUSES.items() if result.values(name)[row] < LOW)
            worst[scenario_id] = RankedScenario(scenario_id, score, result.settings.traffic, causes)
    return list(worst.values())


def format_worst(scenarios: Sequence[RankedScenario]) -> Table:
    """A row per scenario: score, traffic and what the planner does there."""
    table = Table("worst scenarios", "nuplan_style", "traffic", "the planner")
    for scenario in scenarios:
        table.add_row(scenario.scenario_id, f"{scenario.score:.4f}", scenario.traffic, ", ".join(scenario.causes))
    return table


def format_drives(*results: DriveResult) -> Table:
    """A column per result: mean ± standard error over the scenarios."""
    table = Table()
    table.add_column("", no_wrap=True)
    for result in results:
        table.add_column(f"{result.name} ({len(result.table)} scenarios)", justify="right")
    for name in MAIN_SCORES:
        cells = (format_estimate(mean_interval(result.values(name))) for result in results)
        table.add_row(f"{name}{ARROWS[find_direction(name)]}", *cells)
    return table


def format_drive_comparison(comparison: DriveComparison) -> Table:
    """A row per score: both means, the difference with its interval, and the verdict."""
    a, b = comparison.a, comparison.b
    models = {a.settings.model, b.settings.model} - {"none"}
    note = ", whose traffic models differ" if len(models) > 1 else ""
    failed = len({*a.failures, *b.failures})
    left_out = f", without {failed} in which a planner failed" if failed else ""
    parts_a, parts_b = (a.settings.planner, a.settings.traffic), (b.settings.planner, b.settings.traffic)
    # headings say what differs
    differing = [names for names in zip(parts_a, parts_b) if names[0] != names[1]]
    headings = differing[0] if len(differing) == 1 else (a.name, b.name)
    table = comparison_table(*headings, max((row.alpha for row in comparison), default=0.05))
    table.title = f"{b.name} against {a.name}{note}: {max(row.count for row in comparison)} scenarios in both{left_out}"
    for row in comparison:
        if row.column in MAIN_SCORES and row.count:
            table.add_row(row.column, *row.cells)
    return table
