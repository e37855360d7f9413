"""What runs of a recipe gain, each by itself and all together, over the same scenarios.

for seed in 1 2 3 4 5; do
    rlftsim demo --seed $seed --out runs/native-$seed
    ATEN_CPU_CAPABILITY=default rlftsim demo --seed $seed --out runs/default-$seed
done
python benchmarks/paired_runs.py --base runs/*-?/evaluations/base.parquet --tuned runs/*-?/evaluations/fine-tuned.parquet

Evaluations of the bases (or of a single one) and, in the same order, of what was made from each. Intervals are over
street networks or logs, of all runs together over these and runs. Markdown.
"""

import argparse
from pathlib import Path

from rlftsim.evaluation.results import Evaluation
from rlftsim.experiments.exam import ExamRow
from rlftsim.experiments.tables import RMM

COLUMNS = {
    "RMM ↑": RMM, "kinematic ↑": "kinematic", "interactive ↑": "interactive", "map-based ↑": "map_based",
    "minADE (m) ↓": "min_average_displacement_error", "collision ↓": "collision_rate",
    "leaves the road ↓": "unlogged_offroad_rate", "red light ↓": "traffic_light_violation_rate",
    "speed − log, evaluated (m/s)": "speed_gap", "speed − log, all (m/s)": "speed_gap_all",
    "stops ↓": "unlogged_stop_rate",
}  # fmt: skip


def main() -> None:
    """Read the evaluations and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", nargs="+", type=Path, required=True)
    parser.add_argument("--tuned", nargs="+", type=Path, required=True)
    options = parser.parse_args()
    bases = options.base * len(options.tuned) if len(options.base) == 1 else options.base
    row = ExamRow("tuned", (), *([Evaluation.read(path) for path in paths] for paths in (options.tuned, bases)))
    print("| run | base | tuned | RMM | p |\n|---|--:|--:|--:|--:|")
    for path, before, after in zip(options.tuned, row.references, row.by_run, strict=True):
        change = ExamRow("tuned", (), [after], [before]).change(RMM)
        print(f"| {path} | {change.mean_a:.4f} | {change.mean_b:.4f} | {in_words(change)} | {change.p_value:.1g} |")
    print(f"\n| {len(row.by_run)} runs | base | tuned | change |\n|---|--:|--:|--:|")
    for title, column in COLUMNS.items():
        change = row.change(column)
        print(f"| {title} | {change.mean_a:.4f} | {change.mean_b:.4f} | {in_words(change)} |")
    print("\nThe next run gains {:+.4f} to {:+.4f} with 95 %.".format(*row.next_run.interval))


def in_words(change):
    """Difference with its interval."""
    return "{:+.4f} [{:+.4f}, {:+.4f}]".format(change.difference, *change.interval)


if __name__ == "__main__":
    main()
