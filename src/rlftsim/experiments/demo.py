"""The whole pipeline on the synthetic scenarios: vocabulary, pre-training, fine-tuning, evaluation, report."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from rlftsim.evaluation.compare import compare, format_table
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.evaluation.report import build_report, write_report
from rlftsim.evaluation.results import Evaluation
from rlftsim.evaluation.scenario_pages import EvaluatedModels
from rlftsim.jobs.folder import check_folder
from rlftsim.jobs.progress import print_line, print_wide
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.train import find_vocabulary, finetune_model, open_training, pretrain_policy
from rlftsim.rollout.policy import frozen_copy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.viewer.picture import to_png

CLAIM = "closed-loop fine-tuning makes a traffic model more realistic"
NO_CLAIM = "closed-loop fine-tuning of a traffic model"
BASE, TUNED, FLOOR, CEILING = "base", "fine-tuned", "constant velocity", "oracle"
SUMMARY = (
    "A small next-token traffic model was pre-trained on synthetic scenarios and then fine-tuned closed-loop: it "
    "drives every agent itself, and the realism meta-metric of its own rollouts, left one out at a time (MLOO), is the "
    "reward. What is fitted are the weights of a few named features of each decision (calibration), at unchanged speed."
)
QUICK_SUMMARY = (
    "Quick run: every stage at its smallest size. These numbers mean nothing; `rlftsim demo` makes real ones."
)


PREDICTED_GAIN = 0.0168, 0.0346
"""RMM that the next run gains with 95 %, from ten runs: five seeds, two instruction sets (benchmarks/models.md)."""


def run_demo(
    recipe: Recipe, data: Path, evaluation: EvaluateConfig, out: Path, *, is_quick: bool = False
) -> tuple[Evaluation, ...]:
    """Run the pipeline; stages that are finished are not repeated.

    Args:
        recipe: Settings of model and training; a folder of other settings is refused by the stage that made the folder.
        data: Data set with the split training, and that of the evaluation.
        evaluation: Settings of the evaluations.
        out: Folder for runs, evaluations and the report `out/report.html`.
        is_quick: True = fewer films and pages, and the report says that its numbers mean nothing.

    Returns:
        Evaluations of the base, the fine-tuned model, constant velocity and the oracle.

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

    training, vocabulary = open_training(data), None
    if recipe.tokens is not None:
        with stage("vocabulary: motion and map tokens from the training scenarios"):
            origin = f"demo on {data.name}, {recipe.tokens}"
            vocabulary = find_vocabulary(training, recipe.tokens, out / "vocabulary.safetensors", origin=origin)
    with stage("pre-training: predict the next token of every agent"):
        policy = recipe.new_policy(vocabulary)
        base = pretrain_policy(policy, training, recipe.pretrain, out / "pretrain")
    with stage("fine-tuning: closed loop, MLOO reward, calibration at unchanged speed"):
        settings = (recipe.calibrate if recipe.method == "calibrate" else None) or recipe.finetune
        tuned = finetune_model(base, training, settings, out / "finetune")
    with stage(f"evaluation: {evaluation.num_rollouts} rollouts of every held-out scenario"):
        # Both models from their folders, as `rlftsim evaluate` would load them.
        policies = {BASE: load_policy(str(base)), TUNED: load_policy(str(tuned))}
        rows = {**policies, FLOOR: load_policy("constant_velocity"), CEILING: "oracle"}
        evaluations = tuple(
            evaluate(row, data, out / "evaluations", evaluation, name=name)  # type: ignore[arg-type]
            for name, row in rows.items()
        )
    with stage("report"):
        comparison = compare(evaluations[0], evaluations[1])
        difference = comparison["meta_metric"]
        # The title claims a gain only where the paired test finds one.
        is_gain = difference.is_difference and difference.difference > 0 and not is_quick
        frozen = {position: frozen_copy(policy) for position, policy in enumerate(policies.values())}
        durations = ", ".join(f"{title.partition(':')[0]} {time:.0f} s" for title, time in seconds.items())
        report = build_report(
            EvaluatedModels(evaluations, frozen, ScenarioDataset(data, evaluation.split)),
            out,
            runs=(out / "finetune", out / "pretrain"),
            num_listed=1 if is_quick else 3,
            num_played=2 if is_quick else 3,
            jobs=evaluation.jobs,
            title=f"RLFTSim demo: {CLAIM if is_gain else NO_CLAIM}",
            summary=[*([QUICK_SUMMARY] if is_quick else []), SUMMARY],
            facts={
                "time": f"{sum(seconds.values()) / 60:.1f} min ({durations})",
                **({} if is_quick else {"expected gain": place_gain(difference.difference)}),
            },
        )
        write_report(out / "report.html", report)
        to_png(out / "picture.png", report.animations[0])
    print_wide(format_table(*evaluations))
    print_line(f"fine-tuned against base, {comparison.pairing}: {comparison['meta_metric'].verdict}")
    return evaluations


def place_gain(gain: float) -> str:
    """Where a gain in RMM lies in the prediction interval of the recipe."""
    low, high = PREDICTED_GAIN
    position = "below" if gain < low else "above" if gain > high else "inside"
    return f"RMM {low:+.4f} to {high:+.4f}, by ten earlier runs; this run's {gain:+.4f} lies {position}"
