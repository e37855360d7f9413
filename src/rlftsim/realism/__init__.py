"""Realism meta-metric (RMM) of the Waymo Open Sim Agents Challenge, equal to the official evaluator to 1e-6.

`score` for one scenario, `score_batch` for several. `compute_batch_features` (or `compute_features`), then
`score_batch_features` and `AgentScores`, where several readers share the features. Independent of models and rewards.
"""

from rlftsim.realism.agents import SimulatedStates
from rlftsim.realism.config import (
    FEATURE_NAMES,
    METRIC_2023,
    METRIC_2024,
    METRIC_2024_ORIGINAL,
    METRIC_2025,
    METRIC_2025_SCENARIO_GEN,
    METRICS,
    SCENARIO_GEN,
    SIM_AGENTS,
    SUB_SCORES,
    Challenge,
    MetricConfig,
    metric_by_name,
)
from rlftsim.realism.credit import AgentScores, Credit, compute_credit, compute_single_credit
from rlftsim.realism.features import ComputeConfig, Features, ScenarioLog, compute_features, scenario_log
from rlftsim.realism.from_rollouts import score_rollouts
from rlftsim.realism.meta_metric import (
    RealismResult,
    ScenarioFeatures,
    compute_batch_features,
    score,
    score_batch,
    score_batch_features,
    score_features,
)

__all__ = [
    "FEATURE_NAMES", "METRICS", "METRIC_2023", "METRIC_2024", "METRIC_2024_ORIGINAL", "METRIC_2025",
    "METRIC_2025_SCENARIO_GEN", "SCENARIO_GEN", "SIM_AGENTS", "SUB_SCORES", "AgentScores", "Challenge",
    "ComputeConfig", "Credit", "Features", "MetricConfig", "RealismResult", "ScenarioFeatures", "ScenarioLog",
    "SimulatedStates", "compute_batch_features", "compute_credit", "compute_features", "compute_single_credit",
    "metric_by_name", "scenario_log", "score", "score_batch", "score_batch_features", "score_features",
    "score_rollouts",
]  # fmt: skip
