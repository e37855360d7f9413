"""Names of a scenario's scores in the official messages."""

from rlftsim.realism.config import FEATURE_NAMES, MetricConfig

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
