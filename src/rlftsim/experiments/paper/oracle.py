"""The oracle: the log as rollouts, scored feature by feature, the ceiling of the metric.

The oracle scores below 1, because the histogram of a single logged future, which is smoothed, never gives a single
bin all the probability.
"""

import math
from collections.abc import Mapping

from rlftsim.evaluation.columns import SCORES, format_estimate, format_number
from rlftsim.evaluation.results import Evaluation
from rlftsim.experiments.model_specs import ORACLE
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import RMM, Row, TextTable, build_table, load_published, to_numbers
from rlftsim.realism import FEATURE_NAMES, metric_by_name
from rlftsim.statistics import MeanInterval
from rlftsim.viewer.figure import Interval, draw_intervals


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """The oracle's row."""
    return suite.evaluate({"oracle": (ORACLE,)})


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """Likelihood of the log under the log's own histograms, and the features that keep the score below 1."""
    row = rows["oracle"]
    weights: dict[str, float] = dict(zip(FEATURE_NAMES, metric_by_name(row.mean.config.metric).weights))
    features = {name: row.mean.mean_and_error(f"{name}_likelihood") for name in FEATURE_NAMES}
    return ExperimentResult(
        title="Oracle: the log against itself",
        tables=(
            build_feature_table(features, weights, row.mean),
            build_table("Ours, in all", [row], SCORES),
            load_published("oracle"),
        ),
        verdicts=(
            f"The log itself scores {row.mean.mean_and_error(RMM).mean:.4f}: the most that a model can gain here is "
            "the gap to that, not to 1.",
        ),
        notes=("A likelihood is missing (–) where no scenario has a step at which the feature counts.",),
        numbers={
            "rows": to_numbers([row], SCORES),
            "features": {
                name: {"weight": weights[name], "likelihood": e.mean, "standard_error": e.standard_error}
                for name, e in features.items()
            },
        },
        figure=draw_intervals(
            [Interval(name.replace("_", " "), e.mean, *e.interval) for name, e in features.items()],
            title="Likelihood of the log under itself",
            x_label="mean over scenarios, 95 % interval",
            zero=False,
        ),
    )


def build_feature_table(
    features: Mapping[str, MeanInterval], weights: Mapping[str, float], evaluation: Evaluation
) -> TextTable:
    """Table of the features' weights, likelihoods and costs.

    Args:
        features: Mean likelihood of each feature over scenarios, by the feature's name.
        weights: Weights in the meta-metric by the same names. The cost of a feature is weight × (1 − likelihood).
        evaluation: Evaluation of the oracle, for the facts of the note.
    """
    rows = []
    for name, estimate in features.items():
        # Weights add up to 1, so the costs add up to what the meta-metric lacks to 1, if no feature is missing.
        cost = format_number(weights[name] * (1 - estimate.mean)) if math.isfinite(estimate.mean) else "–"
        rows.append((name.replace("_", " "), f"{weights[name]:g}", format_estimate(estimate), cost))
    note = f"{len(evaluation)} scenarios, metric {evaluation.config.metric}; mean ± standard error."
    headings = ("feature", "weight", "likelihood ↑", "missing to 1, weighted ↓")
    return TextTable("Ours, by feature", headings, tuple(rows), note)


EXPERIMENT = Experiment(
    "What does the log itself score, and what is the most that a simulator can reach?", run, summarize
)
