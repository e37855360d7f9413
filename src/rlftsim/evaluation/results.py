"""Scores of a policy on scenarios and the provenance, in a Parquet file with a row per scenario.

Columns: likelihoods and meta-metrics, higher is better; `*_error` in meters and `*_rate` in [0, 1], lower is better.
"""

import difflib
import json
import math
from dataclasses import asdict, dataclass
from functools import cached_property
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import rlftsim
from rlftsim.errors import ConfigError, DataError, check_not_negative, check_types, in_short
from rlftsim.evaluation.columns import SCORES, find_direction
from rlftsim.evaluation.drift import Drift, measure_drift
from rlftsim.jobs.documents import describe_type, parse_json
from rlftsim.jobs.files import write_atomically
from rlftsim.jobs.tables import check_columns, read_parquet
from rlftsim.realism import FEATURE_NAMES, Challenge, RealismResult, SimulatedStates, metric_by_name
from rlftsim.realism.config import LIGHT
from rlftsim.realism.miss import compute_miss_rates
from rlftsim.rollout.policy import Sampling
from rlftsim.scenario.sources import guessed_note
from rlftsim.scenario.types import Scenario
from rlftsim.statistics import MeanInterval, mean_interval

FORMAT = "rlftsim-evaluation-1"
NUMBERS_VERSION = "0.1.0"
"""Raised when a score or a rollout changes: stored results of other numbers are computed anew. A release that changes
no number keeps it, so that results outlive releases."""
LIKELIHOOD_COLUMNS = tuple(f"{feature}_likelihood" for feature in FEATURE_NAMES)
SCORE_COLUMNS = (
    "meta_metric", "meta_metric_light_one", "kinematic", "interactive", "map_based", *LIKELIHOOD_COLUMNS,
    "min_average_displacement_error", "average_displacement_error", "collision_rate", "offroad_rate",
    "unlogged_offroad_rate", "traffic_light_violation_rate", "miss_rate", "passing_miss_rate", "min_passing_miss_rate",
    *Drift._fields,
)  # fmt: skip
"""`meta_metric_light_one` is the meta-metric with the traffic light likelihood set to 1, as published tables of models
without a light feature have it; `meta_metric` is the official one. Miss rates: see `realism.miss`; drift:
`evaluation.drift`."""
LABELS = {"RMM": "meta_metric"}
"""Name in tables -> column."""
CLUSTER = "cluster"
"""Column with the street network or recording of a scenario; empty where the data set does not know it."""
SCHEMA = pa.schema(
    {"scenario_id": pa.string(), "num_agents": pa.int32(), "num_evaluated": pa.int32(), CLUSTER: pa.string()}
    | dict.fromkeys(SCORE_COLUMNS, pa.float64())
)

LARGEST = 1e7
"""Beyond are neither meters, nor their rates, nor numbers of agents."""
ROUNDING = 1e-6
"""Sums of weighted likelihoods may be this far out of [0, 1]."""

GoalChoice = Literal["none", "logged"]


@dataclass(frozen=True)
class EvaluateConfig:
    """Settings of an evaluation: rollouts, metric, sampling, scenarios, processes."""

    num_rollouts: int = 32
    """Rollouts per scenario; the official metric is defined for 32."""
    metric: str = "2025"
    """Year of the meta-metric, or "2025-scenario-gen"."""
    seed: int = 0
    temperature: float = 1.0
    """Below 1 likely decisions become likelier; 0 always takes the most likely one."""
    top_k: int | None = None
    """Keep only this many of the most likely decisions; None keeps all."""
    split: str | None = "validation"
    """Split of the data set; None = all scenarios."""
    limit: int | None = None
    """Only the first so many scenarios."""
    rollouts_per_pass: int = 8
    """Rollouts simulated together. Bounds memory and changes no result. A small model, such as those that ship, is a
    quarter to a third faster with 32; SMART-tiny is not."""
    jobs: int = 1
    """Processes, each with one thread. Changes no result."""
    goals: GoalChoice = "none"
    """Goals of the evaluated agents: none, or their logged final positions, for a goal-conditioned model."""

    def __post_init__(self) -> None:
        check_types(self)
        for name in ("num_rollouts", "rollouts_per_pass", "jobs", "limit"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"evaluate.{name} must be at least 1, got {value}.")
        check_not_negative(self, ("seed",))
        metric_by_name(self.metric)
        _ = self.sampling

    @property
    def challenge(self) -> Challenge:
        """Challenge of the metric: whether agents go on from the log or whole scenes are made."""
        return metric_by_name(self.metric).challenge

    @property
    def sampling(self) -> Sampling:
        """Temperature and truncation of decisions."""
        return Sampling(self.temperature, self.top_k)

    def what_counts(self) -> dict[str, object]:
        """The settings that the results of a scenario depend on."""
        # Three change no result of a scenario. goals="none" is left out, too: evaluations from before there were goals
        # are still what they were.
        ignored = ("limit", "rollouts_per_pass", "jobs", *(("goals",) if self.goals == "none" else ()))
        return {name: value for name, value in asdict(self).items() if name not in ignored}


@dataclass(frozen=True)
class Skipped:
    """A scenario that cannot be scored."""

    scenario_id: str
    reason: str


@dataclass(frozen=True)
class Provenance:
    """Policy, data, settings and version that an evaluation was made with."""

    config: EvaluateConfig
    policy: str
    """Class of the policy, or "oracle"."""
    policy_fingerprint: str
    """Hash of weights and settings."""
    dataset: str
    """Folder of the data set."""
    manifest_sha256: str
    rlftsim_version: str = NUMBERS_VERSION
    """Version of the numbers, see `NUMBERS_VERSION`."""
    package_version: str = rlftsim.__version__
    """For information; not compared. Neither are the next two."""
    sources: tuple[str, ...] = ()
    """Data sources of the scenarios."""
    guessed: tuple[str, ...] = ()
    """Values of the log that are guessed, see `Scenario.guessed`."""

    @classmethod
    def from_plain(cls, values: dict[str, Any]) -> "Provenance":
        """The provenance that `dataclasses.asdict` made plain."""
        # JSON has no tuples
        plain = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
        return cls(**{**plain, "config": EvaluateConfig(**values["config"])})

    def what_counts(self) -> dict[str, object]:
        """The values that results of the same work share; the manifest identifies a data set that was moved."""
        return {
            "policy_fingerprint": self.policy_fingerprint,
            "manifest_sha256": self.manifest_sha256,
            "rlftsim_version": self.rlftsim_version,
            **self.config.what_counts(),
        }

    def differences(self, expected: "Provenance") -> list[str]:
        """Names of the values that count and differ."""
        values, expected_values = self.what_counts(), expected.what_counts()
        return [name for name in {**values, **expected_values} if values.get(name) != expected_values.get(name)]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of a policy on the scenarios of a data set.

    `evaluation["meta_metric"]` is a column [scenarios], `len(evaluation)` the number of scored scenarios.
    """

    name: str
    provenance: Provenance
    table: pa.Table
    """Columns of `SCHEMA`, one row per scenario, in the order of the data set."""
    skipped: tuple[Skipped, ...] = ()
    """Scenarios without scores, and why."""

    def __len__(self) -> int:
        return self.table.num_rows

    def __getitem__(self, column: str) -> np.ndarray:
        return self.values(column)

    def __repr__(self) -> str:
        means = (f"{column.heading} {column.cell(self.mean_and_error(column.source))}" for column in SCORES)
        units = (f" {column.unit}" if column.unit else "" for column in SCORES)
        return f"{self._title}: {' | '.join(mean + unit for mean, unit in zip(means, units))}"

    def _repr_html_(self) -> str:
        """The main means ± standard errors as a table, for notebooks."""
        head = "".join(f'<th title="{escape(column.meaning)}">{escape(column.label)}</th>' for column in SCORES)
        cells = "".join(f"<td>{column.cell(self.mean_and_error(column.source))}</td>" for column in SCORES)
        return f"<table><caption>{escape(self._title)}</caption><tr>{head}</tr><tr>{cells}</tr></table>"

    @property
    def _title(self) -> str:
        reason = f": {self.skipped[0].reason.rstrip('.')}" if self.skipped and not len(self) else ""
        notes = [f"{len(self.skipped)} skipped{reason}"] if self.skipped else []
        notes += [f"{self.num_with_rmm} with RMM"] if self.num_with_rmm < len(self) else []
        note = f" ({', '.join(notes)})" if notes else ""
        config = self.config
        return f"{self.name}, {len(self)} scenarios{note} x {config.num_rollouts} rollouts, metric {config.metric}"

    @property
    def num_with_rmm(self) -> int:
        """Number of scenarios in the mean meta-metric: scenarios with a value of every term."""
        return self.mean_and_error("meta_metric").count

    @property
    def config(self) -> EvaluateConfig:
        """Settings of the evaluation."""
        return self.provenance.config

    @property
    def data_note(self) -> str:
        """A sentence on guessed values of the log; empty without any."""
        return guessed_note(self.provenance.sources, self.provenance.guessed)

    @property
    def scenario_ids(self) -> list[str]:
        """Scored scenarios, in the order of the rows."""
        return self.table["scenario_id"].to_pylist()

    @cached_property
    def clusters(self) -> np.ndarray:
        """Label of each scenario's street network or recording; the scenario's id where the label is unknown."""
        labels = self.table[CLUSTER].to_pylist()
        return np.array([label or scenario_id for label, scenario_id in zip(labels, self.scenario_ids)], dtype=object)

    def values(self, column: str) -> np.ndarray:
        """A column as float64 [scenarios].

        Raises:
            ConfigError: A column that no evaluation has.
        """
        return self.table[find_column(column)].to_numpy()

    def mean_and_error(self, column: str) -> MeanInterval:
        """Mean, standard error and 95 % interval over the scenarios that have a value.

        Raises:
            ConfigError: A column that no evaluation has.
        """
        return mean_interval(self.values(column))

    def write(self, path: str | PathLike[str]) -> None:
        """Write as Parquet, complete or not at all."""
        about = {
            "format": FORMAT,
            "name": self.name,
            "provenance": asdict(self.provenance),
            "skipped": [asdict(skipped) for skipped in self.skipped],
        }
        table = self.table.replace_schema_metadata({"rlftsim": json.dumps(about)})
        write_atomically(Path(path), lambda temporary: pq.write_table(table, temporary, compression="zstd"))

    @classmethod
    def read(cls, path: str | PathLike[str]) -> "Evaluation":
        """Read the file that `write` wrote.

        Raises:
            DataError: A missing file, a folder, a damaged file, or not an evaluation of this version.
        """
        # Parquet readers take a folder for one table in many files: two evaluations would become one.
        if Path(path).is_dir():
            files = sorted(file.name for file in Path(path).glob("*.parquet") if file.is_file())
            hint = f"name one of {', '.join(files)}" if files else "name a Parquet file of `rlftsim evaluate`"
            raise DataError(f"{path} is a folder: {hint}.")
        missing = f"{path}: no such evaluation: make one with `rlftsim evaluate`."
        table = read_parquet(path, "evaluate again", missing=missing)
        # our part of the file's metadata; pandas and others may add theirs
        metadata = (table.schema.metadata or {}).get(b"rlftsim", b"{}")
        about = parse_json(metadata, "evaluate again", source=str(path))
        if about.get("format") != FORMAT:
            raise DataError(
                f"{path}: not an evaluation of this version: name a file that `rlftsim evaluate` wrote, or evaluate "
                "again."
            )
        try:
            check_columns(table, SCHEMA)
            table = table.select(SCHEMA.names)
            _check_scores(table)
            name, skipped = about["name"], about["skipped"]
            if not all(isinstance(text, str) for entry in skipped for text in entry.values()):
                raise DataError("a skipped scenario or its reason is no text")
            skipped = tuple(Skipped(**entry) for entry in skipped)
            for key, value_type in (("name", str), ("provenance", dict)):
                if not isinstance(about[key], value_type):
                    raise DataError(f"its {key} is {describe_type(about[key])}")
        except (TypeError, KeyError, AttributeError, DataError) as error:
            raise DataError(f"{path}: damaged evaluation ({error}): evaluate again.") from None
        try:
            provenance = Provenance.from_plain(about["provenance"])
            check_types(provenance)
        except (TypeError, KeyError, AttributeError, ConfigError) as error:
            error = "a value of another type" if isinstance(error, AttributeError) else error
            raise DataError(f"{path}: made by a later version ({error}): update rlftsim or evaluate again.") from None
        return cls(name, provenance, table.replace_schema_metadata(None), skipped)


def find_column(name: str) -> str:
    """Column of a name or of a label of tables.

    Args:
        name: Name in `SCORE_COLUMNS`, or "RMM" as in tables.

    Raises:
        ConfigError: A column that no evaluation has; the message names the nearest one.
    """
    column = LABELS.get(name, name)
    if column not in SCORE_COLUMNS:
        columns = {label.lower(): column for label, column in LABELS.items()} | dict(zip(SCORE_COLUMNS, SCORE_COLUMNS))
        near = difflib.get_close_matches(str(name).lower(), columns, n=1)
        hint = f"did you mean {columns[near[0]]!r}?" if near else f"choose one of {', '.join(SCORE_COLUMNS)}."
        raise ConfigError(f"an evaluation has no column {in_short(name)}: {hint}")
    return column


def _check_scores(table: pa.Table) -> None:
    """Check that scores lie in the range of the column; NaN = not defined in a scenario.

    Raises:
        DataError: A number that is out of range or infinite; the message names column and scenario.
    """
    for name in table.schema.names:
        if table[name].type == pa.string():
            continue
        direction = find_direction(name)
        # likelihoods and rates are in [0, 1] but for rounding, errors and counts not below 0, drift is any number
        lowest = -LARGEST if direction == "log" and not name.startswith("num_") else 0.0
        is_fraction = name.endswith("_rate") or (direction == "higher" and not name.startswith("num_"))
        highest = 1.0 + ROUNDING if is_fraction else LARGEST
        values = table[name].to_numpy()
        outliers = np.flatnonzero((values < lowest - ROUNDING) | (values > highest))
        if len(outliers):
            row = int(outliers[0])
            scenario_id = table["scenario_id"][row].as_py()[:80]
            limits = "in [0, 1]" if is_fraction else f"within {LARGEST:g}" if lowest < 0 else f"in [0, {LARGEST:g}]"
            raise DataError(f"{name} of scenario {scenario_id} is {values[row]:g}, not {limits}")


def row_of_result(
    result: RealismResult, scenario: Scenario, states: SimulatedStates, cluster: str | None = None
) -> dict[str, object]:
    """Row of `SCHEMA` for a scenario's rollouts and scores.

    Args:
        result: Scores of the rollouts of a single scenario.
        scenario: Scenario with the logged future, for miss rates, drift and numbers of agents.
        states: Rollouts that were scored, world frame.
        cluster: Label of the street network or recording; None = unknown.
    """
    # The meta-metric is a weighted sum of likelihoods: a light likelihood of 1 adds its weight times what it lacks.
    light = result.likelihood(LIGHT)
    light_weight = dict(zip(FEATURE_NAMES, result.config.weights))[LIGHT]
    missing = light_weight * (1.0 - light) if light_weight else 0.0
    scores = {"meta_metric_light_one": result.meta_metric + missing}
    if states.challenge.makes_scenes:  # agents that are drawn have no log to miss or to drift from
        names = ("miss_rate", "passing_miss_rate", "min_passing_miss_rate", *Drift._fields)
        scores |= dict.fromkeys(names, math.nan)
    else:
        misses = compute_miss_rates(scenario, states)
        scores |= {
            "miss_rate": misses.at_goal,
            "passing_miss_rate": misses.passing,
            "min_passing_miss_rate": misses.passing_in_every_rollout,
            **measure_drift(scenario, states)._asdict(),
        }
    numbers = {name: float(scores[name] if name in scores else result.find_score(name)) for name in SCORE_COLUMNS}
    evaluated = scenario.simulated_indices if states.challenge.makes_scenes else scenario.evaluated_indices
    return {
        "scenario_id": result.scenario_ids[0],
        "num_agents": len(scenario.simulated_indices),
        "num_evaluated": len(evaluated),
        CLUSTER: cluster or "",
        **numbers,
    }
