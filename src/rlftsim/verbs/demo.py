"""`rlftsim demo`: the whole pipeline on synthetic scenarios."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.experiments.demo import run_demo
from rlftsim.jobs.progress import print_line
from rlftsim.jobs.runner import usable_cores
from rlftsim.recipes.smart import smart_demo_quick, smart_demo_rlftsim
from rlftsim.scenario.synthetic import pack_path


def demo(
    out: Path | None = None,
    processes: int | Literal["auto"] = "auto",
    quick: bool = False,
    seed: int | None = None,
) -> None:
    """Run the whole pipeline on synthetic scenarios, in minutes, on a CPU.

    Vocabulary, pre-training, calibration in closed loop with the MLOO reward, evaluation on held-out scenarios, and a
    report with pictures. An interrupted demo continues when the same command is repeated.

    Args:
        out: Folder for everything; the report is OUT/report.html. Left out: runs/demo, runs/demo-quick or
            runs/demo-seed-SEED.
        processes: Processes that train and that evaluate; auto = one for each core, up to 4. Another number
            rounds otherwise.
        quick: Run every stage at its smallest size. This shows that all stages work, not that fine-tuning helps.
        seed: Seed of tokens, weights and training, to see how much of the result is luck. Left out: the recipe's.
    """
    recipe = smart_demo_quick() if quick else smart_demo_rlftsim()
    # More processes than this only compete for memory bandwidth on the machines that the demo is made for.
    jobs = min(usable_cores(), 4) if processes == "auto" else processes
    # All rollouts in one pass: so small a model takes a quarter less time with it.
    evaluation = EvaluateConfig(split="testing", rollouts_per_pass=32, jobs=jobs)
    evaluation = replace(evaluation, num_rollouts=8, limit=8) if quick else evaluation
    recipe = (recipe if seed is None else recipe.with_seed(seed)).with_processes(processes)
    name = f"demo{'-quick' if quick else ''}{'' if seed is None else f'-seed-{seed}'}"
    out = out or Path("runs") / name
    run_demo(recipe, pack_path(), evaluation, out, is_quick=quick)
    print_line(f"report: {out / 'report.html'}")
