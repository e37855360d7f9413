"""What an evaluation is: one row of scores per scenario and how they came about, in one Parquet file.

Columns: likelihoods and meta-metrics, higher is better; `*_error` in metres and `*_rate`, lower is better.
"""

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import rlftsim
from rlftsim.errors import ConfigError, DataError
from rlftsim.files import write_whole
from rlftsim.intervals import MeanInterval, mean_interval
from rlftsim.realism import FEATURE_NAMES, RealismResult, SimulatedStates, metric_by_name
from rlftsim.realism.miss import compute_miss_rates
from rlftsim.realism.official_names import LIGHT
from rlftsim.rollout.policy import Sampling
from rlftsim.scenario.types import Scenario

FORMAT = "rlftsim-evaluation-1"
LIKELIHOOD_COLUMNS = tuple(f"{feature}_likelihood" for feature in FEATURE_NAMES)
SCORE_COLUMNS = (
    "meta_metric",
    "meta_metric_light_one",
    "kinematic",
    "interactive",
    "map_based",
    *LIKELIHOOD_COLUMNS,
    "min_average_displacement_error",
    "average_displacement_error",
    "collision_rate",
    "offroad_rate",
    "traffic_light_violation_rate",
    "miss_rate",
    "passing_miss_rate",
    "min_passing_miss_rate",
)
"""`meta_metric_light_one` is the meta-metric with the traffic light likelihood set to 1, as published tables of models without
a light feature have it; `meta_metric` is the official one. Miss rates: see `realism.miss`."""
SCHEMA = pa.schema(
    [
        pa.field("scenario_id", pa.string()),
        pa.field("num_agents", pa.int32()),
        pa.field("num_evaluated", pa.int32()),
        *(pa.field(name, pa.float64()) for name in SCORE_COLUMNS),
    ]
)


GoalsGiven = Literal["none", "recorded"]


def direction_of(column: str) -> Literal["higher", "lower"]:
    """Which way is better."""
    return "lower" if column.endswith(("_error", "_rate")) else "higher"


@dataclass(frozen=True)
class EvaluateConfig:
    """What is simulated and how it is scored."""

    num_rollouts: int = 32
    """Rollouts per scenario; the official metric is defined for 32."""
    metric: str = "2025"
    """Year of the meta-metric."""
    seed: int = 0
    temperature: float = 1.0
    top_k: int | None = None
    """Keep only this many of the most likely decisions; None keeps all."""
    split: str | None = "validation"
    """Split of the data set; None = all scenarios."""
    limit: int | None = None
    """Only the first so many scenarios."""
    rollouts_per_pass: int = 8
    """Rollouts simulated together: bounds memory, and small passes stay in the processor's cache. Changes no result."""
    jobs: int = 1
    """Processes, each with one thread. Changes no result."""
    goals: GoalsGiven = "none"
    """What evaluated agents are asked: nothing, or to go where their record ends, for a model that sees goals."""

    def __post_init__(self) -> None:
        for name in ("num_rollouts", "rollouts_per_pass", "jobs", "limit"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"evaluate.{name} must be at least 1, got {value}.")
        metric_by_name(self.metric)
        _ = self.sampling

    @property
    def sampling(self) -> Sampling:
        """How decisions are drawn."""
        return Sampling(self.temperature, self.top_k)

    def what_counts(self) -> dict[str, object]:
        """The settings that results depend on, for one and the same scenario."""
        ignored = ("limit", "rollouts_per_pass", "jobs", *(("goals",) if self.goals == "none" else ()))
        return {name: value for name, value in asdict(self).items() if name not in ignored}


@dataclass(frozen=True)
class Skipped:
    """A scenario that cannot be scored."""

    scenario_id: str
    reason: str


@dataclass(frozen=True)
class Provenance:
    """What was evaluated on what."""

    config: EvaluateConfig
    policy: str
    """Class of the policy, or "oracle"."""
    policy_fingerprint: str
    """Hash of weights and settings."""
    dataset: str
    """Folder of the data set."""
    manifest_sha256: str
    rlftsim_version: str = rlftsim.__version__

    def what_counts(self) -> dict[str, object]:
        """What two results must share to belong together. The folder may move, the manifest says what is in it."""
        return {
            "policy_fingerprint": self.policy_fingerprint,
            "manifest_sha256": self.manifest_sha256,
            "rlftsim_version": self.rlftsim_version,
            **self.config.what_counts(),
        }

    def differences(self, other: "Provenance") -> list[str]:
        """Names of what counts and differs."""
        mine, theirs = self.what_counts(), other.what_counts()
        return [name for name in {**mine, **theirs} if mine.get(name) != theirs.get(name)]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of one policy on the scenarios of a data set."""

    name: str
    provenance: Provenance
    table: pa.Table
    """Columns of `SCHEMA`, one row per scenario, in the order of the data set."""
    skipped: tuple[Skipped, ...] = ()
    """Scenarios without scores, and why."""

    def __len__(self) -> int:
        return self.table.num_rows

    @property
    def config(self) -> EvaluateConfig:
        """What was simulated and how it was scored."""
        return self.provenance.config

    @cached_property
    def scenario_ids(self) -> list[str]:
        """Scored scenarios, in the order of the rows."""
        return self.table["scenario_id"].to_pylist()

    def values(self, column: str) -> np.ndarray:
        """A column as float64 [scenarios].

        Raises:
            ConfigError: there is no such column.
        """
        if column not in SCORE_COLUMNS:
            raise ConfigError(f"an evaluation has no column {column!r}, only {', '.join(SCORE_COLUMNS)}.")
        return self.table[column].to_numpy()

    def mean_and_error(self, column: str) -> MeanInterval:
        """Mean, standard error and 95 % interval over the scenarios that have a value.

        Raises:
            ConfigError: there is no such column.
        """
        return mean_interval(self.values(column))

    def write(self, path: Path) -> None:
        """Write as Parquet, whole or not at all."""
        about = {
            "format": FORMAT,
            "name": self.name,
            "provenance": asdict(self.provenance),
            "skipped": [asdict(s) for s in self.skipped],
        }
        table = self.table.replace_schema_metadata({"rlftsim": json.dumps(about)})
        write_whole(path, lambda temporary: pq.write_table(table, temporary, compression="zstd"))

    @classmethod
    def read(cls, path: Path) -> "Evaluation":
        """Read what `write` wrote.

        Raises:
            DataError: no such file, a damaged one, or not an evaluation of this version.
        """
        try:
            table = pq.read_table(path)
        except FileNotFoundError:
            raise DataError(f"{path}: no such evaluation: make one with `rlftsim evaluate`.") from None
        except (OSError, pa.ArrowException) as error:
            raise DataError(f"{path}: damaged evaluation ({error}): evaluate again.") from None
        about = json.loads((table.schema.metadata or {}).get(b"rlftsim", b"{}"))
        if about.get("format") != FORMAT or table.schema.names != SCHEMA.names:
            raise DataError(f"{path}: not an evaluation of this version: evaluate again.")
        return cls(
            name=about["name"],
            provenance=_provenance_of(about["provenance"]),
            table=table.replace_schema_metadata(None),
            skipped=tuple(Skipped(**s) for s in about["skipped"]),
        )


def join_evaluations(name: str, provenance: Provenance, parts: list[Evaluation]) -> Evaluation:
    """One evaluation of the scenarios of several, in their order."""
    table = pa.concat_tables([SCHEMA.empty_table(), *(part.table for part in parts)]).combine_chunks()
    return Evaluation(name, provenance, table, tuple(s for part in parts for s in part.skipped))


def row_of_result(result: RealismResult, scenario: Scenario, states: SimulatedStates) -> dict[str, object]:
    """Row of `SCHEMA` for a scenario's rollouts and their scores."""
    light = result.likelihood(LIGHT)
    light_weight = dict(zip(FEATURE_NAMES, result.config.weights))[LIGHT]
    missing = light_weight * (1.0 - light) if light_weight else 0.0
    misses = compute_miss_rates(scenario, states)
    scores = {
        "meta_metric_light_one": result.meta_metric + missing,
        "miss_rate": misses.at_goal,
        "passing_miss_rate": misses.passing,
        "min_passing_miss_rate": misses.passing_in_all,
    }
    numbers = {name: float(scores[name] if name in scores else result.score_of(name)) for name in SCORE_COLUMNS}
    return {
        "scenario_id": result.scenario_ids[0],
        "num_agents": len(scenario.simulated_indices),
        "num_evaluated": len(scenario.evaluated_indices),
        **numbers,
    }


def _provenance_of(values: dict[str, Any]) -> Provenance:
    return Provenance(**{**values, "config": EvaluateConfig(**values["config"])})
