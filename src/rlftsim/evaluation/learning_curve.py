"""Pictures of training runs: metrics as charts, and what each feature of a calibration earns."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlftsim.policies.calibrated.policy import CALIBRATION, read_calibration
from rlftsim.rollout.policy import Policy, get_device
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, Scenario
from rlftsim.training.run_folder import read_metrics
from rlftsim.training.trackers import write_film
from rlftsim.viewer.chart import Chart, Curve
from rlftsim.viewer.figure import Interval, charts_to_png, draw_intervals, save_figure
from rlftsim.viewer.film import Camera
from rlftsim.viewer.page import animate
from rlftsim.viewer.scene import rollout_trajectories

Lines = Sequence[Mapping[str, Any]]
"""Values of each update, see `read_metrics`."""
FILM_STEPS, FILM_DOTS_PER_INCH = 4, 80
"""Steps of 0.1 s between frames, and resolution: a film of some 500 kB in a second."""
UNDRAWN_METRICS = ("update", "time", "seconds", "predictions", "learning_rate", "gradient_norm")
"""Metrics of every imitation that say nothing about its objective."""


def write_learning_curve(run: Path) -> Path | None:
    """Draw `learning_curve.png` into the folder of a run of any stage, finished or not.

    Returns:
        The picture; None if the run has no metrics yet.
    """
    charts = run_charts(read_metrics(run))
    if not charts:
        return None
    charts_to_png(run / "learning_curve.png", charts)
    return run / "learning_curve.png"


def film_model(run: Path, policy: Policy, scenario: Scenario) -> None:
    """Add a film to the run's TensorBoard: a scenario as logged, and simulated by the trained policy.

    Args:
        run: Folder of a run that has ended.
        policy: Trained policy of the run.
        scenario: Scenario with its logged future, best a held-out one.
    """
    from torch.utils.tensorboard import SummaryWriter  # not at the top: `--help` has no use for it

    rollouts = simulate(policy, collate([scenario]).to(get_device(policy)), num_rollouts=1, seed=0)
    animation = animate(scenario, [("simulated", rollout_trajectories(scenario, rollouts, row=0))])
    camera = Camera(animation, FILM_DOTS_PER_INCH)
    num_steps = min(panel.trajectories.num_steps for panel in animation.panels)
    frames = [camera.frame(animation.panels, step) for step in range(CURRENT_STEP, num_steps, FILM_STEPS)]
    lines = read_metrics(run)
    with SummaryWriter(str(run / "tensorboard")) as board:
        write_film(board, frames, int(lines[-1]["update"]) if lines else 0, FILM_STEPS * STEP_S)


def run_charts(lines: Lines, kl_target: float | None = None) -> list[Chart]:
    """Charts of a run of any stage; none before the first update.

    Args:
        lines: Metrics of each update, see `read_metrics`.
        kl_target: Target of the KL of fine-tuning, a dashed line, in nats per decision; None = not drawn.
    """
    if not lines:
        return []
    if "credit_std" in lines[0]:  # a calibration has no updates that follow each other
        return [_chart(lines, "Realism of the rollouts", "RMM", rmm="RMM")]
    # Only fine-tuning with a reward logs the realism of its own rollouts.
    return finetuning_charts(lines, kl_target) if "rmm" in lines[0] else imitation_charts(lines)


def imitation_charts(lines: Lines) -> list[Chart]:
    """Charts of pre-training and CAT-K: loss, accuracy and, where the model was validated, realism.

    A run with an objective that the policy defines has the loss and a chart for each further metric instead.
    """
    realism = _chart(
        lines, "Realism of held-out rollouts", "RMM, mean and 95 % interval",
        validation_rmm="RMM", validation_rmm_low="low", validation_rmm_high="high",
    )  # fmt: skip
    if "accuracy" in lines[0]:
        learned = [
            _chart(lines, "Cross-entropy", "nats per token", loss="loss", entropy="entropy of predictions"),
            _chart(lines, "Next token right", "fraction", accuracy="first guess", top5_accuracy="among five"),
        ]
    else:
        names = [name for name in lines[0] if name not in UNDRAWN_METRICS and not name.startswith("validation_")]
        learned = [Chart(name.replace("_", " ").capitalize(), "update", name, [_curve(lines, name)]) for name in names]
    return [*learned, *([realism] if len(realism.curves[0].x) else [])]


def finetuning_charts(lines: Lines, kl_target: float | None = None) -> list[Chart]:
    """Charts of fine-tuning with a reward: realism, reward, distance from the base model, KL penalty, violations.

    Args:
        lines: Metrics of each update, see `read_metrics`.
        kl_target: Target of the KL, a dashed line, in nats per decision; None = not drawn.
    """
    return [
        _chart(lines, "Realism of the training rollouts", "RMM", rmm="RMM"),
        _chart(lines, "Reward", "std over a scenario's rollouts", reward_std="reward"),
        _chart(
            lines, "Distance from the base model", "nats per decision",
            reference=None if kl_target is None else ("target", kl_target), kl="KL",
        ),
        _chart(lines, "Strength of the KL penalty", "beta", beta="beta"),
        _chart(
            lines, "Off-road and collision", "fraction of evaluated agents",
            offroad_rate="off-road", collision_rate="collision",
        ),
    ]  # fmt: skip


def _chart(lines: Lines, title: str, label: str, *, reference: tuple[str, float] | None = None, **named: str) -> Chart:
    """Chart of metrics under new names; a metric that is not logged at every update has fewer points."""
    curves = [_curve(lines, key, name) for key, name in named.items()]
    return Chart(title, "update", label, curves, reference=reference)


def _curve(lines: Lines, key: str, name: str | None = None) -> Curve:
    logged = [line for line in lines if key in line]
    return Curve(name or key, [line["update"] for line in logged], [line[key] for line in logged])


def write_calibration_picture(model: Path) -> Path | None:
    """Draw `calibration.png` into a model folder: the RMM that each feature earns, with its 95 % interval.

    Args:
        model: Folder of a calibrated policy.

    Returns:
        The picture; None if the folder holds no calibration.
    """
    path = model / CALIBRATION
    if not path.exists():
        return None
    rows = sorted(read_calibration(path)["features"], key=lambda row: -row["rmm"])
    intervals = []
    for row in rows:
        half, name = 1.96 * abs(row["rmm"] / row["t"]) if row["t"] else 0.0, f"{row['feature']}  {row['eta']:+.2f}"
        intervals.append(Interval(name, row["rmm"], row["rmm"] - half, row["rmm"] + half))
    label = "RMM, predicted to first order; beside the names eta"
    figure = draw_intervals(intervals, title="What each feature earns", x_label=label, zero=True)
    save_figure(model / "calibration.png", figure)
    return model / "calibration.png"
