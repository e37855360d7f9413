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
        score: our name.
        config: the metric's year.
    """
    return config.reports_traffic_lights or LIGHT not in score


def official_fields(config: MetricConfig) -> dict[str, str]:
    """Official names of a scenario's scores in a year, by our names."""
    return {ours: official for ours, official in _FIELDS.items() if is_reported(ours, config)}


def official_buckets(config: MetricConfig) -> dict[str, str]:
    """Official names of the sub-scores and the figures beside them in a year, by our names."""
    return {ours: official for ours, official in _BUCKETS.items() if is_reported(ours, config)}
