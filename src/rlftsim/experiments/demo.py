"""The whole pipeline on the synthetic scenarios: vocabulary, pre-training, fine-tuning, evaluation, report."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from rlftsim.experiments.columns import SCORES, ResultRow
from rlftsim.experiments.compare import Comparison, compare, paired_values
from rlftsim.experiments.evaluate import EvaluateConfig, evaluate
from rlftsim.experiments.evaluation import Evaluation
from rlftsim.experiments.learning_curve import finetuning_charts, imitation_charts
from rlftsim.experiments.report import (
    ChartGroup,
    PairedComparison,
    Report,
    report_table,
    write_report,
)
from rlftsim.experiments.stages import find_vocabulary, finetune_with_reward, open_training, pretrain_smart
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.progress import print_wide
from rlftsim.recipes.smart import SmartRecipe
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.training.run_folder import describe_environment, read_metrics
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.picture import to_png
from rlftsim.viewer.scene import build_scene, logged_trajectories, rollout_trajectories

CLAIM = "closed-loop fine-tuning makes a traffic model more realistic"
NO_CLAIM = "closed-loop fine-tuning of a traffic model"
BASE, TUNED, FLOOR, CEILING = "base", "fine-tuned", "constant velocity", "oracle"
NOTES = {CEILING: "the record itself: what a perfect simulator would score", FLOOR: "no model"}


@dataclass(frozen=True)
class DemoConfig:
    """What the demo runs, and on what."""

    recipe: SmartRecipe
    data: Path
    """A data set with the splits training and validation."""
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    num_scenes: int = 3
    """Animated scenarios."""
    rollouts_shown: int = 4
    synthetic: bool = True
    """Whether the report warns that its numbers say nothing about WOMD."""


@dataclass
class _Stages:
    """Seconds that each stage took in this run."""

    console: Console
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        self.console.rule(f"{len(self.seconds) + 1}  {name}", align="left")
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start


@dataclass(frozen=True)
class DemoResult:
    """What the demo ends with."""

    report: Path
    comparison: Comparison
    evaluations: tuple[Evaluation, ...]
    """Base, fine-tuned, constant velocity, oracle."""


def run_demo(config: DemoConfig, out: Path) -> DemoResult:
    """Run the pipeline; stages that are done already are not done again.

    Args:
        config: recipe and data.
        out: folder for everything; the report is `out/report.html`.

    Raises:
        RlftsimError: a stage failed; the message says which file and why.
    """
    stages = _Stages(Console(stderr=True))
    recipe, training = config.recipe, open_training(config.data)
    with stages("vocabulary: motion and map tokens from the training scenarios"):
        origin = f"demo on {config.data.name}, {recipe.tokens}"
        vocabulary = find_vocabulary(training, recipe.tokens, out / "vocabulary.safetensors", origin=origin)
    with stages("pre-training: predict the next token of every agent"):
        base = pretrain_smart(vocabulary, training, recipe.model, recipe.pretrain, out / "pretrain")
    with stages("fine-tuning: closed loop, MLOO reward, KL to the base model"):
        tuned = finetune_with_reward(base, training, recipe.finetune, out / "finetune")
    with stages(f"evaluation: {config.evaluate.num_rollouts} rollouts of every held-out scenario"):
        contestants = {BASE: SmartPolicy.from_pretrained(base), TUNED: SmartPolicy.from_pretrained(tuned)}
        evaluations = _evaluated(contestants, config, out / "evaluations")
    with stages("report"):
        comparison = compare(evaluations[0], evaluations[1])
        animations = _animations(contestants, evaluations, config)
        report = build_report(evaluations, comparison, animations, config, out, stages.seconds)
        write_report(out / "report.html", report)
        to_png(out / "picture.png", animations[0])
    print_wide(report_table(report))
    print(f"fine-tuned against base, {comparison.pairing}: {comparison['meta_metric'].verdict}")
    return DemoResult(out / "report.html", comparison, evaluations)


def _evaluated(contestants: dict[str, SmartPolicy], config: DemoConfig, out: Path) -> tuple[Evaluation, ...]:
    rows: dict[str, Policy | str] = {**contestants, FLOOR: ConstantVelocity(), CEILING: "oracle"}
    return tuple(
        evaluate(policy, config.data, out, config.evaluate, name=name)  # type: ignore[arg-type]
        for name, policy in rows.items()
    )


# ---- the report ---------------------------------------------------------------------------------------------------------


def build_report(
    evaluations: Sequence[Evaluation],
    comparison: Comparison,
    animations: Sequence[Animation],
    config: DemoConfig,
    out: Path,
    seconds: dict[str, float],
) -> Report:
    """The page: table, paired comparison, learning curves, animations, facts."""
    base, tuned = evaluations[:2]
    difference = comparison["meta_metric"]
    return Report(
        title=f"RLFTSim demo: {CLAIM if difference.is_difference and difference.difference > 0 else NO_CLAIM}",
        summary=(
            "A small next-token traffic model was pre-trained on synthetic scenarios and then fine-tuned closed-loop: it drives "
            "every agent itself, and the realism meta-metric of its own rollouts, left one out at a time (MLOO), is the reward.",
        ),
        rows=[ResultRow.of(e, SCORES, note=NOTES.get(e.name, ""), emphasised=e is tuned) for e in evaluations],
        table_note=f"{len(base)} held-out scenarios, {base.config.num_rollouts} rollouts each, metric {base.config.metric}; mean ± standard error over scenarios.",
        comparison=PairedComparison(
            BASE, TUNED, difference.difference, difference.interval, difference.p_value, difference.count,
            differences=_gains(base, tuned)[1],
        ),
        chart_groups=_charts(out, config),
        animations=animations,
        animations_note="Every agent moves by the model, the ego included; the first 1.1 s are recorded.",
        facts=_facts(config, seconds),
        footnotes=(
            "The scenarios are synthetic (SUMO traffic on invented streets): these numbers show that the pipeline works and say "
            "nothing about the Waymo Open Motion Dataset.",
        ) if config.synthetic else (),
    )  # fmt: skip


def _gains(base: Evaluation, tuned: Evaluation) -> tuple[list[str], np.ndarray]:
    """Ids of the scenarios that both have, and what fine-tuning adds to the RMM of each."""
    ids, before, after = paired_values(base, tuned, "meta_metric")
    return ids, after - before


def _charts(out: Path, config: DemoConfig) -> list[ChartGroup]:
    before, after = read_metrics(out / "pretrain"), read_metrics(out / "finetune")
    return [
        ChartGroup(
            "Fine-tuning",
            finetuning_charts(after, config.recipe.finetune.kl.target),
            f"Training rollouts come in groups of {config.recipe.finetune.num_rollouts}, so their RMM is not comparable with the table's "
            f"(groups of {config.evaluate.num_rollouts}).",
        ),
        ChartGroup("Pre-training", imitation_charts(before)),
    ]


def _facts(config: DemoConfig, seconds: dict[str, float]) -> dict[str, str]:
    environment, recipe = describe_environment(), config.recipe
    return {
        "command": environment["command"],
        "machine": environment["machine"],
        "versions": ", ".join(f"{name} {number}" for name, number in environment["packages"].items()),
        "commit": environment["commit"] or "installed package",
        "pre-training": f"{recipe.pretrain.epochs:g} epochs, batch {recipe.pretrain.batch_size}, learning rate {recipe.pretrain.learning_rate:g}",
        "fine-tuning": f"{recipe.finetune.epochs:g} epochs, {recipe.finetune.batch_size} scenarios x {recipe.finetune.num_rollouts} rollouts an update, "
        f"learning rate {recipe.finetune.learning_rate:g}, KL target {recipe.finetune.kl.target:g}",
        "time": f"{sum(seconds.values()) / 60:.1f} min ("
        + ", ".join(f"{name.split(':')[0]} {s:.0f} s" for name, s in seconds.items())
        + ")",
    }


# ---- animations ---------------------------------------------------------------------------------------------------------


def _animations(
    contestants: dict[str, SmartPolicy], evaluations: Sequence[Evaluation], config: DemoConfig
) -> list[Animation]:
    """Logged, base and fine-tuned side by side: the scenarios that gained most, and one in the middle."""
    base, tuned = evaluations[:2]
    scenarios = ScenarioDataset(config.data, config.evaluate.split)
    ids, gains = _gains(base, tuned)
    order = [ids[i] for i in np.argsort(-gains)]
    chosen = dict.fromkeys([*order[: max(config.num_scenes - 1, 1)], order[len(order) // 2]])
    by_id = dict(zip(ids, gains))
    return [_animation(scenarios.by_id(i), contestants, by_id[i], config) for i in list(chosen)[: config.num_scenes]]


def _animation(scenario: Scenario, contestants: dict[str, SmartPolicy], gain: float, config: DemoConfig) -> Animation:
    scene = build_scene(scenario)
    panels = [Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents))]
    batch = collate([scenario])
    for name, policy in contestants.items():
        rollouts = simulate(policy.eval(), batch, num_rollouts=config.rollouts_shown, seed=config.evaluate.seed)
        panels.append(Panel(name, rollout_trajectories(scenario, rollouts, row=0).with_overlaps(scene.agents)))
    title = f"Scenario {scenario.scenario_id}"
    return Animation(
        title, build_scene(scenario), panels, caption=f"RMM of the fine-tuned model minus the base model: {gain:+.3f}"
    )
