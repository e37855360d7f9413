"""What tables of policies show: a row for each policy, a column for each score, the same in reports and experiments."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rlftsim.experiments.evaluation import Evaluation, direction_of
from rlftsim.intervals import MeanInterval


@dataclass(frozen=True)
class ResultRow:
    """One policy's results on the held-out scenarios. None = not measured."""

    name: str
    realism_meta_metric: MeanInterval | None = None
    kinematic: MeanInterval | None = None
    interactive: MeanInterval | None = None
    map_based: MeanInterval | None = None
    min_average_displacement_error_m: MeanInterval | None = None
    collision_rate: MeanInterval | None = None
    """Share in [0, 1]."""
    offroad_rate: MeanInterval | None = None
    """Share in [0, 1]."""
    average_displacement_error_m: MeanInterval | None = None
    miss_rate: MeanInterval | None = None
    """Share in [0, 1]."""
    passing_miss_rate: MeanInterval | None = None
    """Share of the evaluated agents and rollouts, in [0, 1]."""
    min_passing_miss_rate: MeanInterval | None = None
    """Share of the evaluated agents that miss in every rollout, in [0, 1]."""
    note: str = ""
    emphasised: bool = False

    @classmethod
    def of(
        cls, evaluation: Evaluation, columns: Sequence["Column"], *, note: str = "", emphasised: bool = False
    ) -> "ResultRow":
        """The row of an evaluation, with these of `COLUMNS`."""
        estimates = {column.field: evaluation.mean_and_error(column.source) for column in columns}
        return cls(evaluation.name, **estimates, note=note, emphasised=emphasised)


@dataclass(frozen=True)
class Column:
    """How one field of `ResultRow` is shown."""

    field: str
    source: str
    """Column of an `Evaluation`."""
    heading: str
    meaning: str
    digits: int
    factor: float = 1.0

    @property
    def higher_is_better(self) -> bool:
        """Which way is better."""
        return direction_of(self.source) == "higher"

    @property
    def label(self) -> str:
        """Heading with an arrow that says which way is better."""
        return f"{self.heading} {'↑' if self.higher_is_better else '↓'}"

    def estimate(self, row: ResultRow) -> MeanInterval | None:
        """The row's value; None where it was not measured or has no finite mean."""
        value: MeanInterval | None = getattr(row, self.field)
        return value if value is not None and math.isfinite(value.mean) else None

    def text(self, number: float) -> str:
        """A number in the column's unit and digits."""
        return format_number(self.factor * number, self.digits)

    def cell(self, row: ResultRow) -> str:
        """Mean ± standard error, or a dash."""
        estimate = self.estimate(row)
        if estimate is None:
            return "–"
        error = f" ± {self.text(estimate.standard_error)}" if math.isfinite(estimate.standard_error) else ""
        return f"{self.text(estimate.mean)}{error}"


SCORES = (
    Column("realism_meta_metric", "meta_metric", "RMM", "realism meta-metric", 4),
    Column("kinematic", "kinematic", "kinematic", "kinematic sub-score", 4),
    Column("interactive", "interactive", "interactive", "interactive sub-score", 4),
    Column("map_based", "map_based", "map-based", "map-based sub-score", 4),
    Column(
        "min_average_displacement_error_m", "min_average_displacement_error", "minADE [m]",
        "displacement from the log of the best rollout", 2,
    ),
    Column("collision_rate", "collision_rate", "collision [%]", "evaluated agents that collide", 2, 100.0),
    Column("offroad_rate", "offroad_rate", "off-road [%]", "evaluated agents that leave the road", 2, 100.0),
)  # fmt: skip
"""What every table of policies shows."""
COLUMNS = (
    *SCORES,
    Column(
        "average_displacement_error_m", "average_displacement_error", "ADE [m]",
        "displacement from the log, mean over rollouts", 2,
    ),
    Column("miss_rate", "miss_rate", "miss [%]", "evaluated agents that end too far from the log's end", 2, 100.0),
)  # fmt: skip

GOAL_COLUMNS = (
    Column(
        "passing_miss_rate", "passing_miss_rate", "passing miss [%]", "evaluated agents that never come near the log's end", 2, 100.0,
    ),
    Column(
        "min_passing_miss_rate", "min_passing_miss_rate", "in all rollouts [%]",
        "evaluated agents that never come near the log's end in any rollout", 2, 100.0,
    ),
    *SCORES[1:4],
    SCORES[0],
)  # fmt: skip
"""What the table of goal conditioning shows."""


def shown_columns(rows: Sequence[ResultRow]) -> list[Column]:
    """Columns that some row has."""
    return [column for column in COLUMNS if any(getattr(row, column.field) is not None for row in rows)]


def format_number(value: float, digits: int) -> str:
    """Fixed digits, with a real minus sign."""
    return f"{value:.{digits}f}".replace("-", "−")
