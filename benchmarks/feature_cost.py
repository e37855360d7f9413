"""What the features of a calibrated model cost in a rollout: CPU seconds beside those of its base, in turns.

    OMP_NUM_THREADS=1 PYTHONPATH=CHECKOUT/src python benchmarks/feature_cost.py

The same file runs on an older checkout. Prints a line for each repetition, and the median of the ratios.
"""

import statistics
import time

import tyro

import rlftsim as rs
from rlftsim.jobs.threads import keep_freed_memory
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate


def main(model: str = "demo-tuned", num_scenarios: int = 4, num_rollouts: int = 32, repetitions: int = 5) -> None:
    """Time rollouts of embedded validation scenarios, all in one batch.

    Args:
        model: Calibrated model; its base is the one inside it, with the same weights.
        num_scenarios: The first so many.
        num_rollouts: Futures of each scenario.
        repetitions: Counted ones; one more comes first.
    """
    keep_freed_memory()  # as the command line does
    data = rs.load_dataset("synthetic", "validation")
    batch = collate([data[index] for index in range(num_scenarios)])
    policy = load_policy(model).eval()
    ratios = []
    for seed in range(repetitions + 1):
        seconds = []
        for each in (policy.base, policy):
            began = time.process_time()
            simulate(each, batch, num_rollouts=num_rollouts, seed=seed)
            seconds.append(time.process_time() - began)
        if seed:
            ratios.append(seconds[1] / seconds[0])
            print(f"base {seconds[0]:.2f} s, calibrated {seconds[1]:.2f} s, {ratios[-1] - 1:+.1%}", flush=True)
    print(f"median {statistics.median(ratios) - 1:+.1%}")


if __name__ == "__main__":
    tyro.cli(main)
