"""Columns of tables of evaluations, the same on the command line, in reports and in experiments."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from rlftsim.evaluation.drift import Drift
from rlftsim.statistics import MeanInterval

ARROWS = {"higher": " ↑", "lower": " ↓", "log": ""}


def find_direction(source: str) -> Literal["higher", "lower", "log"]:
    """The better direction of a column of an evaluation: errors and rates are better lower, drift is best nearest to
    the log's value, all remaining columns are better higher."""
    if source.endswith(("_error", "_rate")):
        return "lower"
    return "log" if source in Drift._fields else "higher"


@dataclass(frozen=True)
class Column:
    """A column of an evaluation with the heading and unit of tables."""

    source: str
    """Name in an `Evaluation`."""
    heading: str
    meaning: str
    unit: Literal["", "m", "%", "m/s", "°"] = ""
    """Rates are stored as fractions and shown in percent, angles in radians and shown in degrees."""
    rate_heading: str = ""
    """Heading where a rate is shown as a fraction; empty = the heading and the word rate."""

    @property
    def direction_text(self) -> str:
        """The better direction in words."""
        direction = find_direction(self.source)
        return "best near the log's" if direction == "log" else f"{direction} is better"

    @property
    def label(self) -> str:
        """Heading with the unit, if any, and an arrow in the better direction."""
        return f"{self.heading}{f' [{self.unit}]' if self.unit else ''}{ARROWS[find_direction(self.source)]}"

    @property
    def fraction_label(self) -> str:
        """As `label`, for tables that show rates as fractions."""
        if self.unit != "%":
            return self.label
        return f"{self.rate_heading or f'{self.heading} rate'}{ARROWS[find_direction(self.source)]}"

    def text(self, number: float) -> str:
        """A number in the column's unit and digits."""
        # rates are fractions in [0, 1] in an evaluation
        factor, digits = {
            "": (1.0, 4), "m": (1.0, 2), "%": (100.0, 2), "m/s": (1.0, 2), "°": (math.degrees(1.0), 1),
        }[self.unit]  # fmt: skip
        return format_number(factor * number, digits)

    def cell(self, estimate: MeanInterval | None) -> str:
        """Mean ± standard error; a dash without a finite mean."""
        return "–" if estimate is None else format_estimate(estimate, self.text)


SCORES = (
    Column("meta_metric", "RMM", "realism meta-metric"),
    Column("kinematic", "kinematic", "kinematic sub-score"),
    Column("interactive", "interactive", "interactive sub-score"),
    Column("map_based", "map-based", "map-based sub-score"),
    Column("min_average_displacement_error", "minADE", "displacement from the log of the best rollout", "m"),
    Column("collision_rate", "collision", "evaluated agents that collide", "%"),
    Column("offroad_rate", "off-road", "evaluated agents that leave the road", "%"),
)
"""Shown in every table of policies."""
COLUMNS = (
    *SCORES,
    Column("average_displacement_error", "ADE", "displacement from the log, mean over rollouts", "m"),
    Column("miss_rate", "miss", "evaluated agents that end too far from the log's end", "%"),
)
"""Shown in reports, where some row has a value."""
_MISSES = (
    Column(
        "passing_miss_rate", "passing miss",
        "evaluated agents that never come near the log's end", "%", "goal missed",
    ),
    Column(
        "min_passing_miss_rate", "in all rollouts",
        "evaluated agents that never come near the log's end in any rollout", "%", "in all rollouts",
    ),
)  # fmt: skip
GOAL_COLUMNS = (*_MISSES, *SCORES[1:4], SCORES[0])
"""Shown in the table of goal conditioning, in the order of the paper's."""
# The next three are on the command line only: reports and papers show neither.
_WITHOUT_LIGHT = Column(
    "meta_metric_light_one", "RMM, light = 1", "realism meta-metric with the traffic light term set to 1"
)
_LEAVES_ROAD = Column(
    "unlogged_offroad_rate", "leaves road",
    "evaluated agents that leave the road, of those whose log does not", "%", "leaves road",
)  # fmt: skip
_RED_LIGHT = Column("traffic_light_violation_rate", "red light", "evaluated agents that pass a red light", "%")
TERMINAL_COLUMNS = (SCORES[0], _WITHOUT_LIGHT, *SCORES[1:], _LEAVES_ROAD, _RED_LIGHT)
"""Shown on the command line; rates as fractions."""
TERMINAL_GOAL_COLUMNS = (*TERMINAL_COLUMNS, *_MISSES)
"""Shown on the command line where agents had goals."""

DRIFT_COLUMNS = (
    Column(
        "speed_gap", "speed − log",
        "mean speed of agents that move in the log, minus their logged one; negative = slower", "m/s",
    ),
    Column("speed_gap_all", "all agents", "the same over all simulated agents, not the evaluated ones alone", "m/s"),
    Column("speed_p10", "speed, 10 %", "10th percentile of the speed of moving agents", "m/s"),
    Column("speed_p50", "50 %", "median speed of moving agents", "m/s"),
    Column("speed_p90", "90 %", "90th percentile of the speed of moving agents", "m/s"),
    Column("unlogged_stop_rate", "stops", "moving agents that stop for a second, of those whose log does not", "%"),
    Column(
        "lane_offset_straight", "off the lane center, straight",
        "mean distance of vehicles from the center of their lane where it is straight", "m",
    ),
    Column("lane_offset_curved", "curved", "the same where its radius is below 100 m", "m"),
    Column(
        "lane_heading_straight", "turned from the lane, straight",
        "mean angle between vehicles and their lane where it is straight", "°",
    ),
    Column("lane_heading_curved", "curved", "the same where its radius is below 100 m", "°"),
    Column("contact_speed", "speed at contact", "mean relative speed of agents that collide, at first contact", "m/s"),
)  # fmt: skip
"""Shown in a table of their own in reports: see `evaluation.drift`."""


def format_number(value: float, digits: int = 4) -> str:
    """A number with fixed digits and a real minus sign.

    Args:
        value: Number in the unit that is shown.
        digits: Number of digits after the decimal point.
    """
    return f"{value:.{digits}f}".replace("-", "−")


def format_estimate(estimate: MeanInterval, format_value: Callable[[float], str] = format_number) -> str:
    """Mean ± standard error, where there is one; a dash without a finite mean.

    Args:
        estimate: Mean with its standard error.
        format_value: Function from a number to its text.
    """
    if not math.isfinite(estimate.mean):
        return "–"
    error = f" ± {format_value(estimate.standard_error)}" if math.isfinite(estimate.standard_error) else ""
    return f"{format_value(estimate.mean)}{error}"
