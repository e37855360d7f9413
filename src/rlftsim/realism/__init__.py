"""How real it is: the realism meta-metric of the Waymo Open Sim Agents Challenge, equal to the official evaluator.

`score` for one scenario, `score_batch` for several; `measure_batch` (or `compute_features`) and `score_measured`, `AgentScores` where
several readers share the features. Nothing here knows models or rewards.
"""

from rlftsim.realism.agent_scores import AgentScores
from rlftsim.realism.agents import SimulatedStates
from rlftsim.realism.batch import Measured, measure_batch, score_batch, score_measured
from rlftsim.realism.config import (
    FEATURE_NAMES,
    METRIC_2023,
    METRIC_2024,
    METRIC_2024_ORIGINAL,
    METRIC_2025,
    METRICS,
    MetricConfig,
    metric_by_name,
)
from rlftsim.realism.credit import Credit, compute_credit, compute_single_credit
from rlftsim.realism.features import (
    ComputeConfig,
    Features,
    ScenarioLog,
    build_scenario_log,
    compute_features,
    scenario_log,
)
from rlftsim.realism.meta_metric import RealismResult, score, score_features

__all__ = [
    "FEATURE_NAMES",
    "METRICS",
    "METRIC_2023",
    "METRIC_2024",
    "METRIC_2024_ORIGINAL",
    "METRIC_2025",
    "AgentScores",
    "ComputeConfig",
    "Credit",
    "Features",
    "Measured",
    "MetricConfig",
    "RealismResult",
    "ScenarioLog",
    "SimulatedStates",
    "build_scenario_log",
    "compute_credit",
    "compute_features",
    "compute_single_credit",
    "measure_batch",
    "metric_by_name",
    "scenario_log",
    "score",
    "score_batch",
    "score_features",
    "score_measured",
]
