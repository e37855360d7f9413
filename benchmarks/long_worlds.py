"""Rollouts of 60 s of a model, with and without entries, held against SUMO's log of the same worlds.

rlftsim synthesize long --seconds 70 --num-scenarios 20 --seed 900
python benchmarks/long_worlds.py demo-tuned --data long
python benchmarks/long_worlds.py demo-tuned --data long --starts    realism of 8 s, as the world grows older

The worlds that are simulated are of the validation split; entries that ship are fitted on other networks.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import rlftsim as rs
from rlftsim.evaluation.windows import HEADINGS, TABLES, evaluate_windows
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.warm_start import choose_evaluated, start_from_rollouts
from rlftsim.scenario.types import STEP_S, Scenario

STARTS_S = (0, 10, 20, 30, 40, 50)


def measure_starts(model: str, scenarios: list[Scenario], num_rollouts: int) -> None:
    """Print the realism of 8 s that begin where the model, or the log, has driven to."""
    policy = load_policy(model)
    print("| begins where | " + " | ".join(f"{start} s" for start in STARTS_S) + " |\n|---|" + "--:|" * len(STARTS_S))
    logged = [choose_evaluated(world.window(round(start / STEP_S))) for world in scenarios for start in STARTS_S]
    for name, starts in (
        ("the log has driven to", logged),
        (f"{model} has driven to", start_from_rollouts(policy, scenarios, STARTS_S, seed=0)),
    ):
        values = [
            rs.evaluate(policy, starts[index :: len(STARTS_S)], num_rollouts=num_rollouts).values("meta_metric")
            for index in range(len(STARTS_S))
        ]
        print(f"| {name} | " + " | ".join(f"{np.nanmean(column):.4f}" for column in values) + " |", flush=True)


def main() -> None:
    """Simulate, measure, print the table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model")
    parser.add_argument("--data", type=Path, required=True, help="data set of long logs, with both splits")
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--num-rollouts", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--entries", nargs="+", default=["none", "fixed-rate", "fitted"])
    parser.add_argument("--ego", choices=["model", "log"], default="model", help="who moves the ego")
    parser.add_argument(
        "--starts", action="store_true", help="realism of 8 s from later seconds on, in place of all else"
    )
    options = parser.parse_args()
    if options.starts:
        worlds = rs.load_dataset(options.data, "validation")
        measure_starts(options.model, list(worlds)[: options.worlds], options.num_rollouts)
        return
    policy, worlds = load_policy(options.model), rs.load_dataset(options.data, "validation")
    scenarios, rows = [worlds[position] for position in range(min(options.worlds, len(worlds)))], []
    for name in options.entries:
        start = time.process_time()
        result = evaluate_windows(
            policy, scenarios, seconds=options.seconds, name=name, num_rollouts=options.num_rollouts, entries=name,
            ego=options.ego,
        )  # fmt: skip
        print(f"{name}: {time.process_time() - start:.0f} s")
        rows += result.rows()[len(result.log) * bool(rows) :]
    for title, columns in TABLES.items():
        print(f"\n{title}:\n")
        print("|", " | ".join(HEADINGS[column] for column in columns), "|\n|---|", "--:|" * (len(columns) - 1), sep="")
        for row in rows:
            print("|", " | ".join(row[column] for column in columns), "|")


if __name__ == "__main__":
    main()
