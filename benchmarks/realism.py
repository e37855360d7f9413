"""How long and how much memory does the realism metric take per scenario?

    python benchmarks/realism.py ../shared [--rollouts 4 32] [--recipe messy] [--threads 1]

Scores the reference rollouts of each real scenario in a process of its own. Prints a Markdown table: the best of several
runs, the time to prepare the scenario (once per scenario and device), and the peak of the process above what it held
before (torch, the scenario and its rollouts).
"""

import argparse
import multiprocessing
import resource
import time
from pathlib import Path

SCENARIOS = ("bada", "637f", "ee51", "68d5", "db4e", "eb4b", "ef3a")


def time_best(call, at_least_runs: int, at_least_s: float = 0.5) -> float:
    best, total, runs = float("inf"), 0.0, 0
    while runs < at_least_runs or total < at_least_s:
        start = time.perf_counter()
        call()
        elapsed = time.perf_counter() - start
        best, total, runs = min(best, elapsed), total + elapsed, runs + 1
    return best


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(arguments: tuple[Path, str, str, int, int]) -> str:
    shared, prefix, recipe, num_rollouts, num_threads = arguments
    import numpy as np
    import torch

    from rlftsim.realism import SimulatedStates, build_scenario_log, score
    from rlftsim.scenario.womd import read_scenarios

    torch.set_num_threads(num_threads)
    scenario = next(s for s in read_scenarios(shared / "data" / "womd") if s.scenario_id.startswith(prefix))
    archive = np.load(shared / "golden" / "rmm" / "rollouts" / f"{prefix}_{recipe}.npz")
    copies = -(-num_rollouts // len(archive["x"]))
    fields = [np.tile(archive[name], (copies, 1, 1))[:num_rollouts] for name in ("x", "y", "z", "heading")]
    states = SimulatedStates(archive["object_ids"], *(torch.from_numpy(values) for values in fields))
    torch.ones(1) + 1
    before = peak_mib()
    log = build_scenario_log(scenario)
    score(log, states)
    peak = peak_mib() - before
    prepare_s = time_best(lambda: build_scenario_log(scenario), 3)
    score_s = time_best(lambda: score(log, states), 3)
    agents, evaluated = len(log.agents.object_id), len(log.agents.evaluated)
    points = len(scenario.map_features.points)
    return (
        f"| {prefix} | {agents} | {evaluated} | {points} | {num_rollouts} | "
        f"{1e3 * prepare_s:.1f} | {1e3 * score_s:.1f} | {peak:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shared", type=Path, help="folder with data/womd and golden/rmm")
    parser.add_argument("--rollouts", type=int, nargs="+", default=[4, 32])
    parser.add_argument("--recipe", default="messy")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    print("| scenario | agents | evaluated | map points | rollouts | prepare ms | score ms | peak MiB |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|", flush=True)
    for prefix in SCENARIOS:
        for num_rollouts in options.rollouts:
            # A fresh process each: the peak of resident memory never goes down.
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                row = pool.apply(measure, [(options.shared, prefix, options.recipe, num_rollouts, options.threads)])
            print(row, flush=True)


if __name__ == "__main__":
    main()
