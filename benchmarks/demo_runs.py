"""What runs of the demo gain, each by itself and all together, on the scenarios on which nothing was chosen.

for seed in 1 2 3 4 5; do
    rlftsim demo --seed $seed --out runs/native-$seed
    ATEN_CPU_CAPABILITY=default rlftsim demo --seed $seed --out runs/default-$seed
done
python benchmarks/demo_runs.py runs/native-* runs/default-*

Intervals are over street networks, of all runs together over networks and runs. Markdown.
"""

import argparse
from pathlib import Path

import numpy as np

from rlftsim.evaluation.compare import compare_paired
from rlftsim.evaluation.results import Evaluation
from rlftsim.experiments.demo import BASE, TUNED
from rlftsim.experiments.tables import RMM
from rlftsim.statistics import prediction_interval

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
    parser.add_argument("folders", nargs="+", type=Path)
    folders = parser.parse_args().folders
    base, tuned = ([Evaluation.read(f / "evaluations" / f"{name}.parquet") for f in folders] for name in (BASE, TUNED))
    print("| run | base | tuned | RMM | p |\n|---|--:|--:|--:|--:|")
    for folder, before, after in zip(folders, base, tuned):
        change = compare([before], [after], RMM)
        print(
            f"| {folder.name} | {change.mean_a:.4f} | {change.mean_b:.4f} | {in_words(change)} | {change.p_value:.1g} |"
        )
    print(f"\n| {len(folders)} runs | base | tuned | change |\n|---|--:|--:|--:|")
    for title, column in COLUMNS.items():
        change = compare(base, tuned, column)
        print(f"| {title} | {change.mean_a:.4f} | {change.mean_b:.4f} | {in_words(change)} |")
    gains = [np.nanmean(after[RMM] - before[RMM]) for before, after in zip(base, tuned)]
    print("\nThe next run gains {:+.4f} to {:+.4f} with 95 %.".format(*prediction_interval(np.array(gains)).interval))


def compare(base, tuned, column):
    """Change of a column over all scenarios and runs."""
    before, after = (np.stack([evaluation.values(column) for evaluation in runs]) for runs in (base, tuned))
    return compare_paired(column, before, after, clusters=base[0].clusters)


def in_words(change):
    """Difference with its interval."""
    return "{:+.4f} [{:+.4f}, {:+.4f}]".format(change.difference, *change.interval)


if __name__ == "__main__":
    main()
