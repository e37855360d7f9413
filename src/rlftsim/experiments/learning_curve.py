"""A run's metrics as charts, and as a picture in its folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlftsim.training.run_folder import read_metrics
from rlftsim.viewer.chart import Chart, Curve
from rlftsim.viewer.chart_picture import charts_to_png

Lines = Sequence[Mapping[str, Any]]
"""What `read_metrics` returns."""


def write_learning_curve(run: Path) -> Path | None:
    """Draw `learning_curve.png` into a run's folder, whatever stage it is and however far it got; None = it has no metrics yet."""
    lines = read_metrics(run)
    if not lines:
        return None
    charts = imitation_charts(lines) if "accuracy" in lines[0] else finetuning_charts(lines)
    charts_to_png(run / "learning_curve.png", charts)
    return run / "learning_curve.png"


def imitation_charts(lines: Lines) -> list[Chart]:
    """Loss, accuracy and, where the model was validated, its realism: of pre-training and CAT-K."""
    realism = _chart(
        lines, "Realism of held-out rollouts", "RMM, mean and 95 % interval",
        validation_rmm="RMM", validation_rmm_low="low", validation_rmm_high="high",
    )  # fmt: skip
    return [
        _chart(lines, "Cross-entropy", "nats per token", loss="loss", entropy="entropy of predictions"),
        _chart(lines, "Next token right", "share", accuracy="first guess", top5_accuracy="among five"),
        *([realism] if len(realism.curves[0].x) else []),
    ]


def finetuning_charts(lines: Lines, kl_target: float | None = None) -> list[Chart]:
    """Realism, reward, distance from the base model and what it costs: of fine-tuning with a reward."""
    return [
        _chart(lines, "Realism of the training rollouts", "RMM", rmm="RMM"),
        _chart(lines, "Reward", "std over a scenario's rollouts", reward_std="reward"),
        _chart(
            lines, "Distance from the base model", "nats per decision",
            reference=None if kl_target is None else ("target", kl_target), kl="KL",
        ),
        _chart(lines, "Strength of the KL penalty", "beta", beta="beta"),
        _chart(lines, "Off-road and collision", "share of evaluated agents", offroad_rate="off-road", collision_rate="collision"),
    ]  # fmt: skip


def _chart(lines: Lines, title: str, label: str, *, reference: tuple[str, float] | None = None, **named: str) -> Chart:
    """Curves of some metrics by their names; a metric that is not logged at every update has the points that there are."""
    curves = []
    for key, name in named.items():
        there = [line for line in lines if key in line]
        curves.append(Curve(name, [line["update"] for line in there], [line[key] for line in there]))
    return Chart(title, "update", label, curves, reference=reference)
