"""Following goals against realism, by the guidance scale of a goal-conditioned model.

python benchmarks/guidance.py DATA MODEL [--scales 1 2 4 6 8] [--limit 40] [--num-rollouts 16] [--out runs/guidance]

Two measurements for each scale on held-out scenarios. Another maneuver: the ego's goal is one that its lanes allow and
that it did not make; rollouts that come within 2 m of it. Logged endpoints as goals of all evaluated agents: passing
misses, the realism meta-metric paired with that of the first scale, minADE. Both are resumed.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from rlftsim.evaluation.compare import compare
from rlftsim.evaluation.evaluate import evaluate
from rlftsim.evaluation.goal_attainment import attain_goals
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.experiments.paper.controllability import compute_scenario_rates, estimate_mean
from rlftsim.experiments.paper.maneuver_controllability import propose_goals
from rlftsim.policies.registry import load_policy, with_guidance
from rlftsim.scenario.dataset import ScenarioDataset


def main() -> None:
    """Print a row for each scale."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("model")
    parser.add_argument("--scales", type=float, nargs="+", default=[1.0, 2.0, 4.0, 6.0, 8.0])
    parser.add_argument("--limit", type=int, default=40)
    parser.add_argument("--num-rollouts", type=int, default=16)
    parser.add_argument("--out", type=Path, default=Path("runs/guidance"))
    arguments = parser.parse_args()
    data = ScenarioDataset(arguments.data, "validation")
    config = EvaluateConfig(
        num_rollouts=arguments.num_rollouts, rollouts_per_pass=arguments.num_rollouts, limit=arguments.limit, jobs=1
    )
    alternatives = propose_goals(data, data.scenario_ids[: arguments.limit]).alternatives
    first = None
    print("| guidance scale | another maneuver passed (%) | passing misses (%) | RMM | minADE (m) |")
    print("|--:|--:|--:|--:|--:|")
    for scale in arguments.scales:
        policy, name = with_guidance(load_policy(arguments.model), scale), f"guidance-{scale:g}"
        attained = attain_goals(policy, data, arguments.out / name, config, alternatives)
        passed = estimate_mean(compute_scenario_rates(attained, "passed").values())
        result = evaluate(policy, data, arguments.out, replace(config, goals="logged"), name=name)
        first = first or result
        gain = compare(first, result)["meta_metric"]
        missed, error = (
            result.mean_and_error("passing_miss_rate"),
            result.mean_and_error("min_average_displacement_error"),
        )
        change = (
            "" if result is first else f", {gain.difference:+.4f} [{gain.interval[0]:+.3f}, {gain.interval[1]:+.3f}]"
        )
        print(
            f"| {scale:g} | {100 * passed.mean:.1f} ± {100 * passed.standard_error:.1f} | {100 * missed.mean:.1f} | "
            f"{result.mean_and_error('meta_metric').mean:.4f}{change} | {error.mean:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
