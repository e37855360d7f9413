"""The whole pipeline on the synthetic scenarios: vocabulary, pre-training, fine-tuning, evaluation, report."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from rlftsim.evaluation.compare import Comparison, compare
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.evaluation.report import report_table, write_report
from rlftsim.evaluation.results import Evaluation
from rlftsim.experiments.demo_report import BASE, CEILING, FLOOR, TUNED, ReportSettings, animate, build_report
from rlftsim.jobs.folder import check_folder
from rlftsim.jobs.progress import print_wide
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.train import find_vocabulary, finetune_model, open_training, pretrain_policy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.viewer.picture import to_png


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
    """Report and evaluations of the demo."""

    report: Path
    comparison: Comparison
    evaluations: tuple[Evaluation, ...]
    """Base, fine-tuned, constant velocity, oracle."""


def run_demo(config: DemoConfig, out: Path) -> DemoResult:
    """Run the pipeline; stages that are finished are not repeated.

    Args:
        config: recipe and data.
        out: folder for everything; the report is `out/report.html`.

    Raises:
        RlftsimError: a stage failed; the message says which file and why.
    """
    check_folder(out, "results")
    stages = _Stages(Console(stderr=True))
    recipe, training, vocabulary = config.recipe, open_training(config.data), None
    if recipe.tokens is not None:
        with stages("vocabulary: motion and map tokens from the training scenarios"):
            origin = f"demo on {config.data.name}, {recipe.tokens}"
            vocabulary = find_vocabulary(training, recipe.tokens, out / "vocabulary.safetensors", origin=origin)
    with stages("pre-training: predict the next token of every agent"):
        policy = recipe.new_policy(vocabulary)
        base = pretrain_policy(policy, training, recipe.pretrain, out / "pretrain")
    with stages("fine-tuning: closed loop, MLOO reward, KL to the base model"):
        tuned = finetune_model(base, training, recipe.finetune, out / "finetune")
    with stages(f"evaluation: {config.evaluate.num_rollouts} rollouts of every held-out scenario"):
        # Both models from their folders, as `rlftsim evaluate` would load them.
        policies = {BASE: load_policy(str(base)), TUNED: load_policy(str(tuned))}
        rows = {**policies, FLOOR: ConstantVelocity(), CEILING: "oracle"}
        evaluations = tuple(
            evaluate(row, config.data, out / "evaluations", config.evaluate, name=name)  # type: ignore[arg-type]
            for name, row in rows.items()
        )
    with stages("report"):
        comparison = compare(evaluations[0], evaluations[1])
        settings = ReportSettings(recipe, config.data, config.evaluate, config.synthetic, out, stages.seconds)
        animations = animate(policies, evaluations, settings, config.num_scenes, config.rollouts_shown)
        report = build_report(evaluations, comparison, animations, settings)
        write_report(out / "report.html", report)
        to_png(out / "picture.png", animations[0])
    print_wide(report_table(report))
    print(f"fine-tuned against base, {comparison.pairing}: {comparison['meta_metric'].verdict}")
    return DemoResult(out / "report.html", comparison, evaluations)
