"""Speed of models in rollouts: CPU seconds in turns, of calibrated models beside those of their bases.

    OMP_NUM_THREADS=1 PYTHONPATH=CHECKOUT/src python benchmarks/rollout_speed.py demo-tuned demo-fast
    OMP_NUM_THREADS=1 python benchmarks/rollout_speed.py demo-fast --num-scenarios 1 --num-rollouts 4

The same file runs on an older checkout. Prints a table of medians, with the least and greatest ratio to the first row.
A decision is that of all agents of all scenarios and rollouts; maps and history are encoded before.
"""

import statistics
import time

import torch
import tyro
from tyro.conf import Positional

import rlftsim as rs
from rlftsim.jobs.threads import keep_freed_memory
from rlftsim.policies.calibrated.policy import CalibratedPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.policy import frozen_copy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import FUTURE_STEPS


def time_rollouts(policy: rs.Policy, batch: ScenarioBatch, num_rollouts: int, seed: int) -> tuple[float, float]:
    """CPU seconds of the encoding, and of the rollouts after it."""
    began = time.process_time()
    with torch.no_grad():
        context = policy.encode(batch)
    encoded = time.process_time()
    simulate(policy, batch, num_rollouts=num_rollouts, seed=seed, context=context)
    return encoded - began, time.process_time() - encoded


def main(
    models: Positional[tuple[str, ...]] = ("demo-tuned",),
    num_scenarios: int = 4,
    num_rollouts: int = 32,
    repetitions: int = 5,
) -> None:
    """Time rollouts of embedded validation scenarios, all in one batch.

    Args:
        models: Models, the calibrated ones with the base inside them.
        num_scenarios: The first so many.
        num_rollouts: Futures of each scenario.
        repetitions: Counted ones, at least 1; one more comes first.
    """
    keep_freed_memory()  # as the command line does
    data = rs.load_dataset("synthetic", "validation")
    batch = collate([data[index] for index in range(min(num_scenarios, len(data)))])
    policies = {}
    for model in models:
        policy = frozen_copy(load_policy(model))
        policies |= {f"{model}, base": policy.base} if isinstance(policy, CalibratedPolicy) else {}
        policies[model] = policy
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in policies}
    for seed in range(repetitions + 1):
        for name, policy in policies.items():
            pair = time_rollouts(policy, batch, num_rollouts, seed)
            seconds[name] += [pair] if seed else []
    agents = int(batch.agent_mask.sum()) * num_rollouts
    print(f"{agents} agents in all\n")
    print(
        "| model | encoding, s | rollouts, s | time to the first | agent steps/s | a decision, ms |\n|---|--:|--:|--:|--:|--:|"
    )
    first = [sum(values) for values in next(iter(seconds.values()))]
    for name, values in seconds.items():
        encoding, rollouts = (statistics.median(column) for column in zip(*values))
        ratios = sorted(sum(pair) / reference for pair, reference in zip(values, first))
        ratio = f"{statistics.median(ratios):.3f} ({ratios[0]:.3f} to {ratios[-1]:.3f})"
        speed = agents * FUTURE_STEPS / (encoding + rollouts)
        decision = 1e3 * rollouts * policies[name].steps_per_decision / FUTURE_STEPS
        print(f"| {name} | {encoding:.2f} | {rollouts:.2f} | {ratio} | {speed:,.0f} | {decision:.2f} |")


if __name__ == "__main__":
    tyro.cli(main)
