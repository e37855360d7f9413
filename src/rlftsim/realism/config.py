"""Configurations of the realism meta-metric: ranges, bins, pseudocounts and weights of each year's challenge.

Each metric year is an entry of `METRICS`, with the numbers of the challenge's published configuration files. Every
feature axis F of a tensor has the order of `FEATURE_NAMES`. Official messages have other names for some scores.
"""

from dataclasses import dataclass, replace

from rlftsim.errors import ConfigError, in_short
from rlftsim.scenario.types import HISTORY_STEPS, TOTAL_STEPS

HISTOGRAM_FEATURES = (
    "linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration",
    "distance_to_nearest_object", "time_to_collision", "distance_to_road_edge",
)  # fmt: skip
BERNOULLI_FEATURES = ("collision_indication", "offroad_indication", "traffic_light_violation")
FEATURE_NAMES = HISTOGRAM_FEATURES + BERNOULLI_FEATURES
"""Order of the feature axis F."""

SUB_SCORES = {
    "kinematic": ("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration"),
    "interactive": ("distance_to_nearest_object", "collision_indication", "time_to_collision"),
    "map_based": ("distance_to_road_edge", "offroad_indication", "traffic_light_violation"),
}
"""Families of features and their members."""
LIGHT = "traffic_light_violation"
_RATES = {
    "collision_rate": "simulated_collision_rate",
    "offroad_rate": "simulated_offroad_rate",
    "traffic_light_violation_rate": "simulated_traffic_light_violation_rate",
}
_FIELDS = {
    "meta_metric": "metametric",
    "average_displacement_error": "average_displacement_error",
    "min_average_displacement_error": "min_average_displacement_error",
    **{f"{feature}_likelihood": f"{feature}_likelihood" for feature in FEATURE_NAMES},
    **_RATES,
}
_BUCKETS = {
    "meta_metric": "realism_meta_metric",
    "kinematic": "kinematic_metrics",
    "interactive": "interactive_metrics",
    "map_based": "map_based_metrics",
    "min_average_displacement_error": "min_ade",
    **_RATES,
}


@dataclass(frozen=True)
class Challenge:
    """Rules of a leaderboard: the steps of a scenario that are simulated and scored."""

    name: str
    title: str
    first_step: int
    """First of these steps, up to step 90. From 0 on, whole scenes are made: no history is given, boxes have sizes of
    their own at each step, and every simulated agent is evaluated."""

    @property
    def num_steps(self) -> int:
        """Number of simulated steps."""
        return TOTAL_STEPS - self.first_step

    @property
    def makes_scenes(self) -> bool:
        """True where agents begin with the scene, and not where the log stops."""
        return self.first_step == 0


SIM_AGENTS = Challenge("sim-agents", "Sim Agents", HISTORY_STEPS)
SCENARIO_GEN = Challenge("scenario-gen", "Scenario Generation", 0)


@dataclass(frozen=True)
class HistogramConfig:
    """Equal-width bins over [low, high] with additive smoothing; `low` and `high` carry the feature's own unit."""

    low: float
    high: float
    num_bins: int
    weight: float
    pseudocount: float = 0.1

    def __post_init__(self) -> None:
        if not self.low < self.high or self.num_bins < 1 or self.pseudocount <= 0:
            raise ConfigError(f"A histogram needs low < high, num_bins >= 1 and pseudocount > 0, got {self}.")


@dataclass(frozen=True)
class BernoulliConfig:
    """Two outcomes with additive smoothing; 0.001 is the official message's default, which no official file writes."""

    weight: float
    pseudocount: float = 0.001


@dataclass(frozen=True)
class MetricConfig:
    """Meta-metric of a year: speeds in m/s and rad/s, accelerations in m/s² and rad/s², distances in m, time in s."""

    name: str
    linear_speed: HistogramConfig
    linear_acceleration: HistogramConfig
    angular_speed: HistogramConfig
    angular_acceleration: HistogramConfig
    distance_to_nearest_object: HistogramConfig
    time_to_collision: HistogramConfig
    distance_to_road_edge: HistogramConfig
    collision_indication: BernoulliConfig
    offroad_indication: BernoulliConfig
    traffic_light_violation: BernoulliConfig
    time_to_collision_vehicles_only: bool = True
    """Score time to collision on evaluated vehicles only (code of 2025) or on all evaluated agents (code of 2024)."""
    reports_traffic_lights: bool = True
    """True if the official result of that year has traffic light fields."""
    challenge: Challenge = SIM_AGENTS
    """One that makes scenes counts the values of all agents in the same histogram, those of traffic lights excepted."""

    @property
    def histograms(self) -> tuple[HistogramConfig, ...]:
        """Histogram configurations in the order of `HISTOGRAM_FEATURES`."""
        return tuple(getattr(self, name) for name in HISTOGRAM_FEATURES)

    @property
    def bernoullis(self) -> tuple[BernoulliConfig, ...]:
        """Bernoulli configurations in the order of `BERNOULLI_FEATURES`."""
        return tuple(getattr(self, name) for name in BERNOULLI_FEATURES)

    @property
    def weights(self) -> tuple[float, ...]:
        """Weight of each feature, in the order of `FEATURE_NAMES`."""
        return tuple(getattr(self, name).weight for name in FEATURE_NAMES)

    def sub_score_weights(self, sub_score: str) -> tuple[float, ...]:
        """Weight of each feature inside a sub-score, in the order of `FEATURE_NAMES`; the weights sum to 1."""
        members = SUB_SCORES[sub_score]
        total = sum(getattr(self, name).weight for name in members)
        return tuple(getattr(self, name).weight / total if name in members else 0.0 for name in FEATURE_NAMES)


METRIC_2025 = MetricConfig(
    name="2025",
    linear_speed=HistogramConfig(0.0, 25.0, 10, 0.05),
    linear_acceleration=HistogramConfig(-12.0, 12.0, 11, 0.05),
    angular_speed=HistogramConfig(-0.628, 0.628, 11, 0.05),
    angular_acceleration=HistogramConfig(-3.14, 3.14, 11, 0.05),
    distance_to_nearest_object=HistogramConfig(-5.0, 40.0, 10, 0.10),
    time_to_collision=HistogramConfig(0.0, 5.0, 10, 0.10),
    distance_to_road_edge=HistogramConfig(-20.0, 40.0, 10, 0.05),
    collision_indication=BernoulliConfig(0.25),
    offroad_indication=BernoulliConfig(0.25),
    traffic_light_violation=BernoulliConfig(0.05),
)
"""The leaderboard of 2025."""


METRIC_2025_SCENARIO_GEN = replace(METRIC_2025, name="2025-scenario-gen", challenge=SCENARIO_GEN)
"""The scenario generation leaderboard of 2025."""

# Only two weights differ from 2025: the road edge counts twice as much, traffic lights do not count.
METRIC_2024 = replace(
    METRIC_2025,
    name="2024",
    distance_to_road_edge=HistogramConfig(-20.0, 40.0, 10, 0.10),
    traffic_light_violation=BernoulliConfig(0.0),
)
"""The configuration file of 2024 read by the code of 2025: time to collision over vehicles only."""

METRIC_2024_ORIGINAL = replace(
    METRIC_2024, name="2024_original_code", time_to_collision_vehicles_only=False, reports_traffic_lights=False
)
"""The leaderboard of 2024: time to collision over all evaluated agents, no traffic lights."""

METRIC_2023 = MetricConfig(
    name="2023",
    linear_speed=HistogramConfig(0.0, 35.0, 10, 0.09),
    linear_acceleration=HistogramConfig(-15.0, 15.0, 10, 0.09),
    angular_speed=HistogramConfig(-31.5, 31.5, 10, 0.09),
    angular_acceleration=HistogramConfig(-31.5, 31.5, 10, 0.09),
    distance_to_nearest_object=HistogramConfig(-5.0, 40.0, 10, 0.09),
    time_to_collision=HistogramConfig(0.0, 5.0, 10, 0.09),
    distance_to_road_edge=HistogramConfig(-20.0, 40.0, 10, 0.09),
    collision_indication=BernoulliConfig(0.18),
    offroad_indication=BernoulliConfig(0.18),
    traffic_light_violation=BernoulliConfig(0.0),
    time_to_collision_vehicles_only=False,
    reports_traffic_lights=False,
)
"""The weights and ranges of 2023. They sum to 0.99 as published; values are not comparable with later years."""

METRICS = {
    config.name: config
    for config in (METRIC_2025, METRIC_2024, METRIC_2024_ORIGINAL, METRIC_2023, METRIC_2025_SCENARIO_GEN)
}


def metric_by_name(name: str) -> MetricConfig:
    """Configuration of a metric year, by name in `METRICS`.

    Raises:
        ConfigError: No such configuration; the message lists the known names.
    """
    if name not in METRICS:
        raise ConfigError(f"Unknown metric {in_short(name)}: known are {', '.join(METRICS)}.")
    return METRICS[name]


def is_reported(score: str, config: MetricConfig) -> bool:
    """True if the official result of a year has a score.

    Args:
        score: Name of the score here, such as `RealismResult` has it; not the official name.
        config: Year of the metric; results before 2025 may lack traffic lights.
    """
    return config.reports_traffic_lights or LIGHT not in score


def official_fields(config: MetricConfig) -> dict[str, str]:
    """Official names of a scenario's scores in a year, by our names."""
    return {name: official_name for name, official_name in _FIELDS.items() if is_reported(name, config)}


def official_buckets(config: MetricConfig) -> dict[str, str]:
    """Official names of the sub-scores and of further figures in a year, by our names."""
    return {name: official_name for name, official_name in _BUCKETS.items() if is_reported(name, config)}
