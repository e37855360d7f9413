"""Numbers of the true world that its report does not have: models against each other, realism, single rollouts.

    python benchmarks/true_world.py runs/true-world/rows.parquet --reference demo-tuned \\
        --rmm untrained 0.3193 demo-base 0.7848 demo-tuned 0.8011

Reads the rows of `rlftsim experiment true-world`; intervals over street networks.
"""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import tyro
from scipy.stats import spearmanr
from tyro.conf import Positional

from rlftsim.experiments.true_world import (
    CHANGED,
    HIT,
    SCORE,
    WindowSet,
    arrange_episodes,
    average,
    choose_sets,
    format_cell,
)

STATISTICS = [(column, statistic) for column in (SCORE, HIT) for statistic in ("planner_error", "episode_error")]


def compare_models(windows: WindowSet, reference: str, rmm: dict[str, float]) -> None:
    """Print errors minus those of a reference, and the rank correlation of realism and error."""
    rows = {name: number for number, name in enumerate(windows.episodes.traffic)}
    for column, statistic in STATISTICS:
        table = windows.measure(column, statistic)  # [D, T]
        for name, row in rows.items():
            if name not in ("truth", reference):
                print(
                    column,
                    statistic,
                    f"{name} − {reference}:",
                    format_cell(table[:, row] - table[:, rows[reference]], 3, "+"),
                )
        for label, names in (("all", rmm), ("RMM above 0.7", [name for name in rmm if rmm[name] > 0.7])):
            if len(names) > 2:
                realism, errors = [rmm[name] for name in names], table[:, [rows[name] for name in names]]
                ranks = np.array([spearmanr(realism, draw).statistic for draw in errors])
                print(column, statistic, f"rank correlation with RMM, {label}:", format_cell(ranks, 2))


def describe_rollouts(windows: WindowSet, reference: str) -> None:
    """Print in how many windows reaction matters, and what several rollouts of the reference change."""
    episodes = windows.episodes
    mask, ghost, row = episodes.is_measured, episodes.traffic.index("ghost"), episodes.traffic.index(reference)
    score, hit_rate = (episodes.values[column] for column in (SCORE, HIT))  # [N, T, P, W]
    differs = (np.abs(score[0, ghost] - score[0, 0]) > CHANGED) | (hit_rate[0, ghost] != hit_rate[0, 0])
    print(f"reaction matters to a planner in {(differs & mask).any(0).mean():.0%} of the windows")
    varies = np.ptp(score[:, row], 0) > CHANGED
    print(f"{reference}: rollouts differ by more than {CHANGED} in {varies[mask].mean():.0%} of the episodes")
    for column in (SCORE, HIT):
        singles = []
        for values in episodes.values[column]:
            means = average(values, mask, episodes.weights)[0]  # [T, P]
            singles.append(f"{np.nanmean(np.abs(means[row] - means[0])):.3f}")
        print(f"{reference}: {column}, error of a planner by rollout {', '.join(singles)}")


def main(rows: Positional[Path], reference: str = "demo-tuned", rmm: dict[str, float] | None = None) -> None:
    """Print the numbers for random windows and for those with a conflict."""
    for windows in choose_sets(arrange_episodes(pq.read_table(rows).to_pylist(), "truth")):
        print(f"\n{windows.name}")
        compare_models(windows, reference, rmm or {})
        describe_rollouts(windows, reference)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
