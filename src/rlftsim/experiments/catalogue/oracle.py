"""The ceiling: ground truth as rollouts, feature by feature. It is below 1, because a histogram of one recorded future is never sure."""

import math
from collections.abc import Mapping

from rlftsim.experiments.catalogue import published
from rlftsim.experiments.columns import SCORES, format_number
from rlftsim.experiments.contestants import ORACLE
from rlftsim.experiments.evaluation import Evaluation
from rlftsim.experiments.findings import Experiment, Findings, TextTable, result_table, row_numbers
from rlftsim.experiments.workshop import Row, Workshop
from rlftsim.intervals import MeanInterval
from rlftsim.realism import FEATURE_NAMES, metric_by_name
from rlftsim.viewer.figure import Interval, draw_intervals


def measure(workshop: Workshop) -> dict[str, Row]:
    """The oracle's evaluation."""
    return workshop.measure({"oracle": (ORACLE,)})


def conclude(measured: Mapping[str, Row], workshop: Workshop) -> Findings:
    """What the record scores against itself, and which features keep it below 1."""
    row = measured["oracle"]
    weights: dict[str, float] = dict(zip(FEATURE_NAMES, metric_by_name(row.mean.config.metric).weights))
    features = {name: row.mean.mean_and_error(f"{name}_likelihood") for name in FEATURE_NAMES}
    mean = row.mean.mean_and_error("meta_metric").mean
    return Findings(
        title="Oracle: the record against itself",
        tables=(feature_table(features, weights, row.mean), result_table("Ours, in all", [row], SCORES), published.ORACLE),
        verdicts=(
            f"The record itself scores {mean:.4f}: what a model lacks to that, and not to 1, is what can be gained here.",
        ),
        notes=("A likelihood is missing (–) where no scenario has a step at which the feature counts.",),
        numbers={
            "rows": row_numbers([row], SCORES),
            "features": {name: {"weight": weights[name], "likelihood": e.mean, "standard_error": e.standard_error} for name, e in features.items()},
        },
        figure=draw_intervals(
            [Interval(_words(name), e.mean, *e.interval) for name, e in features.items()],
            title="Likelihood of the record under itself", x_label="mean over scenarios, 95 % interval", zero=False,
        ),
    )  # fmt: skip


def feature_table(
    features: Mapping[str, MeanInterval], weights: Mapping[str, float], evaluation: Evaluation
) -> TextTable:
    """Weight, likelihood and what the feature costs: weight times what its likelihood lacks to 1."""
    rows = []
    for name, estimate in features.items():
        error = f" ± {estimate.standard_error:.4f}" if math.isfinite(estimate.standard_error) else ""
        known = math.isfinite(estimate.mean)
        likelihood = f"{format_number(estimate.mean, 4)}{error}" if known else "–"
        cost = format_number(weights[name] * (1 - estimate.mean), 4) if known else "–"
        rows.append((_words(name), f"{weights[name]:g}", likelihood, cost))
    note = f"{len(evaluation)} scenarios, metric {evaluation.config.metric}; mean ± standard error."
    return TextTable("Ours, by feature", ("feature", "weight", "likelihood ↑", "missing to 1, weighted ↓"), tuple(rows), note)  # fmt: skip


def _words(name: str) -> str:
    return name.replace("_", " ")


EXPERIMENT = Experiment(
    question="What does the record itself score, and what is the most that a simulator can reach?",
    measure=measure,
    conclude=conclude,
)
