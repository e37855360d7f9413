"""The whole pipeline on the synthetic scenarios: vocabulary, pre-training, fine-tuning, evaluation, report."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rlftsim.evaluation.compare import Comparison, compare
from rlftsim.evaluation.evaluate import evaluate
from rlftsim.evaluation.report import report_table, write_report
from rlftsim.evaluation.results import Evaluation
from rlftsim.experiments.demo_report import BASE, CEILING, FLOOR, TUNED, DemoConfig, animate, build_report
from rlftsim.jobs.folder import check_folder
from rlftsim.jobs.progress import print_line, print_wide
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.train import find_vocabulary, finetune_model, open_training, pretrain_policy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.viewer.picture import to_png


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
        config: Recipe, data and sizes; a folder of other settings is refused by the stage that made the folder.
        out: Folder for runs, evaluations and the report `out/report.html`.

    Raises:
        RlftsimError: A stage failed; the message says which file and why.
    """
    check_folder(out, "results")
    console, seconds = Console(stderr=True), {}  # seconds that each stage took in this run

    @contextmanager
    def stage(title: str) -> Iterator[None]:
        console.rule(f"{len(seconds) + 1}  {title}", align="left")
        start = time.perf_counter()
        yield
        seconds[title] = time.perf_counter() - start

    recipe, training, vocabulary = config.recipe, open_training(config.data), None
    if recipe.tokens is not None:
        with stage("vocabulary: motion and map tokens from the training scenarios"):
            origin = f"demo on {config.data.name}, {recipe.tokens}"
            vocabulary = find_vocabulary(training, recipe.tokens, out / "vocabulary.safetensors", origin=origin)
    with stage("pre-training: predict the next token of every agent"):
        policy = recipe.new_policy(vocabulary)
        base = pretrain_policy(policy, training, recipe.pretrain, out / "pretrain")
    with stage("fine-tuning: closed loop, MLOO reward, KL to the base model"):
        tuned = finetune_model(base, training, recipe.finetune, out / "finetune")
    with stage(f"evaluation: {config.evaluate.num_rollouts} rollouts of every held-out scenario"):
        # Both models from their folders, as `rlftsim evaluate` would load them.
        policies = {BASE: load_policy(str(base)), TUNED: load_policy(str(tuned))}
        rows = {**policies, FLOOR: ConstantVelocity(), CEILING: "oracle"}
        evaluations = tuple(
            evaluate(row, config.data, out / "evaluations", config.evaluate, name=name)  # type: ignore[arg-type]
            for name, row in rows.items()
        )
    with stage("report"):
        comparison = compare(evaluations[0], evaluations[1])
        animations = animate(policies, evaluations, config)
        report = build_report(evaluations, comparison, animations, config, out, seconds)
        write_report(out / "report.html", report)
        to_png(out / "picture.png", animations[0])
    print_wide(report_table(report))
    print_line(f"fine-tuned against base, {comparison.pairing}: {comparison['meta_metric'].verdict}")
    return DemoResult(out / "report.html", comparison, evaluations)
