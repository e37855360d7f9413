"""Report of the demo: table, paired comparison, learning curves, animations, facts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlftsim.evaluation.columns import DRIFT_COLUMNS, SCORES
from rlftsim.evaluation.compare import Comparison, paired_values
from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.evaluation.learning_curve import finetuning_charts, imitation_charts
from rlftsim.evaluation.report import ChartGroup, PairedComparison, Report, ResultRow
from rlftsim.evaluation.results import Evaluation
from rlftsim.recipes.base import Recipe
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.training.run_folder import describe_environment, read_metrics
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.scene import build_scene, logged_trajectories, rollout_trajectories

CLAIM = "closed-loop fine-tuning makes a traffic model more realistic"
NO_CLAIM = "closed-loop fine-tuning of a traffic model"
BASE, TUNED, FLOOR, CEILING = "base", "fine-tuned", "constant velocity", "oracle"
NOTES = {CEILING: "the log itself: what a perfect simulator would score", FLOOR: "no model"}


@dataclass(frozen=True)
class ReportSettings:
    """Settings and folders that the report describes."""

    recipe: Recipe
    data: Path
    evaluate: EvaluateConfig
    synthetic: bool
    """Warn that the numbers say nothing about WOMD."""
    out: Path
    """Folder with the runs `pretrain` and `finetune`."""
    seconds: Mapping[str, float]
    """Time of each stage."""


def build_report(
    evaluations: Sequence[Evaluation], comparison: Comparison, animations: Sequence[Animation], settings: ReportSettings
) -> Report:
    """The demo's report, for `write_report`.

    Args:
        evaluations: base and fine-tuned model first, then the others.
        comparison: of the first two.
        animations: to show.
        settings: to describe.
    """
    base, tuned = evaluations[:2]
    difference, (_, gains) = comparison["meta_metric"], _gains(base, tuned)
    # The title claims a gain only where the paired test finds one.
    is_better = difference.is_difference and difference.difference > 0
    pretrain, finetune, simulated = settings.recipe.pretrain, settings.recipe.finetune, settings.evaluate.num_rollouts
    environment = describe_environment()
    packages = (f"{name} {number}" for name, number in environment["packages"].items())
    seconds = (f"{name.split(':')[0]} {s:.0f} s" for name, s in settings.seconds.items())
    return Report(
        title=f"RLFTSim demo: {CLAIM if is_better else NO_CLAIM}",
        summary=(
            "A small next-token traffic model was pre-trained on synthetic scenarios and then fine-tuned "
            "closed-loop: it drives every agent itself, and the realism meta-metric of its own rollouts, left one "
            "out at a time (MLOO), is the reward.",
        ),
        rows=[
            ResultRow.of(e, (*SCORES, *DRIFT_COLUMNS), note=NOTES.get(e.name, ""), emphasized=e is tuned)
            for e in evaluations
        ],
        table_note=(
            f"{len(base)} held-out scenarios, {base.config.num_rollouts} rollouts each, metric {base.config.metric}. "
            f"{base.data_note}".rstrip()
        ),
        comparison=PairedComparison(
            BASE,
            TUNED,
            difference.difference,
            difference.interval,
            difference.p_value,
            difference.count,
            test=f"by {difference.num_clusters} street networks" if difference.num_clusters else "paired t-test",
            differences=gains,
            verdict="" if math.isfinite(difference.p_value) else f"RMM: {difference.verdict}",
        ),
        chart_groups=[
            ChartGroup(
                "Fine-tuning",
                finetuning_charts(read_metrics(settings.out / "finetune"), finetune.kl.target),
                f"Training rollouts come in groups of {finetune.num_rollouts}, so their RMM is not comparable with "
                f"the table's (groups of {simulated}).",
            ),
            ChartGroup("Pre-training", imitation_charts(read_metrics(settings.out / "pretrain"))),
        ],
        animations=animations,
        animations_note="The model moves every agent, the ego included; the first 1.1 s are logged.",
        facts={
            "command": environment["command"],
            "machine": environment["machine"],
            "versions": ", ".join(packages),
            "commit": environment["commit"] or "installed package",
            "pre-training": f"{pretrain.epochs:g} epochs, batch {pretrain.batch_size}, "
            f"learning rate {pretrain.learning_rate:g}",
            "fine-tuning": f"{finetune.epochs:g} epochs, {finetune.batch_size} scenarios x {finetune.num_rollouts} "
            f"rollouts an update, learning rate {finetune.learning_rate:g}, KL target {finetune.kl.target:g}",
            "time": f"{sum(settings.seconds.values()) / 60:.1f} min ({', '.join(seconds)})",
        },
        footnotes=(
            "The scenarios are synthetic (SUMO traffic on invented streets): these numbers show that the pipeline "
            "works and say nothing about the Waymo Open Motion Dataset.",
        )
        if settings.synthetic
        else (),
    )


def _gains(base: Evaluation, tuned: Evaluation) -> tuple[list[str], np.ndarray]:
    """Ids of the scenarios that both have, and the gain in RMM of each."""
    ids, before, after = paired_values(base, tuned, "meta_metric")
    return ids, after - before


def animate(
    policies: Mapping[str, Policy],
    evaluations: Sequence[Evaluation],
    settings: ReportSettings,
    num_scenes: int,
    num_rollouts: int,
) -> list[Animation]:
    """Log, base and fine-tuned model side by side: in the scenarios that gained most, and in one from the middle.

    Args:
        policies: models by name.
        evaluations: base and fine-tuned model first.
        settings: data and seed.
        num_scenes: number of animations.
        num_rollouts: of each policy.
    """
    scenarios = ScenarioDataset(settings.data, settings.evaluate.split)
    ids, gains = _gains(*evaluations[:2])
    # The largest gains first, then the one in the middle of the order: an ordinary scenario.
    order = [ids[i] for i in np.argsort(-gains)]
    chosen = dict.fromkeys([*order[: max(num_scenes - 1, 1)], order[len(order) // 2]])
    gain_of, animations = dict(zip(ids, gains)), []
    for scenario_id in list(chosen)[:num_scenes]:
        scenario = scenarios.by_id(scenario_id)
        scene, batch = build_scene(scenario), collate([scenario])
        panels = [Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents))]
        for name, policy in policies.items():
            rollouts = simulate(policy, batch, num_rollouts=num_rollouts, seed=settings.evaluate.seed)
            panels.append(Panel(name, rollout_trajectories(scenario, rollouts, row=0).with_overlaps(scene.agents)))
        caption = f"RMM of the fine-tuned model minus the base model: {gain_of[scenario_id]:+.3f}"
        animations.append(Animation(f"Scenario {scenario_id}", scene, panels, caption=caption))
    return animations
