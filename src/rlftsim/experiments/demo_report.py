"""Settings and report of the demo: table, paired comparison, learning curves, animations, facts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
class DemoConfig:
    """Recipe, data and size of the demo."""

    recipe: Recipe
    data: Path
    """A data set with the splits training and validation."""
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    num_scenes: int = 3
    """Animated scenarios."""
    rollouts_shown: int = 4
    synthetic: bool = True
    """Warn in the report that its numbers say nothing about WOMD."""


def build_report(
    evaluations: Sequence[Evaluation],
    comparison: Comparison,
    animations: Sequence[Animation],
    config: DemoConfig,
    out: Path,
    seconds: Mapping[str, float],
) -> Report:
    """Report of the demo, for `write_report`: table, paired comparison, learning curves, animations, facts.

    Args:
        evaluations: Base and fine-tuned model first, then the baselines.
        comparison: Fine-tuned against base model, scenarios paired.
        animations: Scenes that play in the report.
        config: Recipe, data and sizes that the report describes.
        out: Folder with the runs `pretrain` and `finetune`, for the learning curves.
        seconds: Time of each stage by title.
    """
    base, tuned = evaluations[:2]
    difference, (_, gains) = comparison["meta_metric"], _compute_gains(base, tuned)
    # The title claims a gain only where the paired test finds one.
    is_gain = difference.is_difference and difference.difference > 0
    pretrain, finetune, num_rollouts = config.recipe.pretrain, config.recipe.finetune, config.evaluate.num_rollouts
    environment = describe_environment()
    packages = (f"{name} {number}" for name, number in environment["packages"].items())
    durations = (f"{title.split(':')[0]} {s:.0f} s" for title, s in seconds.items())
    return Report(
        title=f"RLFTSim demo: {CLAIM if is_gain else NO_CLAIM}",
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
                finetuning_charts(read_metrics(out / "finetune"), finetune.kl.target),
                f"Training rollouts come in groups of {finetune.num_rollouts}, so their RMM is not comparable with "
                f"the table's (groups of {num_rollouts}).",
            ),
            ChartGroup("Pre-training", imitation_charts(read_metrics(out / "pretrain"))),
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
            "time": f"{sum(seconds.values()) / 60:.1f} min ({', '.join(durations)})",
        },
        footnotes=(
            "The scenarios are synthetic (SUMO traffic on invented streets): these numbers show that the pipeline "
            "works and say nothing about the Waymo Open Motion Dataset.",
        )
        if config.synthetic
        else (),
    )


def _compute_gains(base: Evaluation, tuned: Evaluation) -> tuple[list[str], np.ndarray]:
    """Ids of the scenarios that both evaluations have, and the gain in RMM of each."""
    ids, base_scores, tuned_scores = paired_values(base, tuned, "meta_metric")
    return ids, tuned_scores - base_scores


def animate(policies: Mapping[str, Policy], evaluations: Sequence[Evaluation], config: DemoConfig) -> list[Animation]:
    """Log, base and fine-tuned model side by side: in the scenarios that gained most, and in an ordinary scenario.

    Args:
        policies: Models by the titles of the panels.
        evaluations: Evaluations of base and fine-tuned model first, which choose the scenarios.
        config: Data, seed, number of animations, and of rollouts in each panel.
    """
    scenarios = ScenarioDataset(config.data, config.evaluate.split)
    ids, gains = _compute_gains(*evaluations[:2])
    # The largest gains first, then the one in the middle of the order.
    order = [ids[i] for i in np.argsort(-gains)]
    scenario_ids = dict.fromkeys([*order[: max(config.num_scenes - 1, 1)], order[len(order) // 2]])
    gain_by_id, animations = dict(zip(ids, gains)), []
    for scenario_id in list(scenario_ids)[: config.num_scenes]:
        scenario = scenarios.by_id(scenario_id)
        scene, batch = build_scene(scenario), collate([scenario])
        panels = [Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents))]
        for name, policy in policies.items():
            rollouts = simulate(policy, batch, num_rollouts=config.rollouts_shown, seed=config.evaluate.seed)
            panels.append(Panel(name, rollout_trajectories(scenario, rollouts, row=0).with_overlaps(scene.agents)))
        caption = f"RMM of the fine-tuned model minus the base model: {gain_by_id[scenario_id]:+.3f}"
        animations.append(Animation(f"Scenario {scenario_id}", scene, panels, caption=caption))
    return animations
