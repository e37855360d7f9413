"""Rollouts of 60 s of a model, with and without entries, held against SUMO's log of the same worlds.

rlftsim synthesize long --seconds 70 --num-scenarios 20 --seed 900
python benchmarks/long_worlds.py demo-tuned --data long

Entries are fitted on the training split; the worlds that are simulated are of the validation split, of other networks.
"""

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from long_world_samples import (  # beside this file
    WindowSamples,
    compute_distance,
    join_samples,
    measure_windows,
    read_log,
    read_rollouts,
)

import rlftsim as rs
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.entries import ENTRIES, fit_entries
from rlftsim.rollout.open_world import add_visitors
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate

HEADINGS = (
    "world", "seconds", "agents within 60 m", "that move", "speed of these [m/s]", "W1 of speed [m/s]", "W1 of gap [m]",
    "ego [m/s]", "collisions per agent-min", "entries per min",
)  # fmt: skip


def table_row(name: str, window: int, samples: WindowSamples, log: WindowSamples) -> list[str]:
    """Cells of a window; ratios to the log in parentheses."""

    def ratio(field: str) -> str:
        value, truth = (
            float(np.mean(getattr(of, field))) if len(getattr(of, field)) else np.nan for of in (samples, log)
        )
        return f"{value:.1f}" if samples is log else f"{value:.1f} ({value / max(truth, 0.01):.2f})"

    minutes = samples.agent_minutes.sum()
    return [
        name, f"{10 * window}-{10 * window + 10}", ratio("density"), ratio("driving"), ratio("speed"),
        f"{compute_distance(samples.speed, log.speed):.2f}", f"{compute_distance(samples.gap, log.gap):.1f}",
        ratio("ego_speed"), f"{samples.collisions.sum() / minutes:.2f}", f"{6 * samples.entries.mean():.0f}",
    ]  # fmt: skip


def main() -> None:
    """Simulate, measure, print the table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model")
    parser.add_argument("--data", type=Path, required=True, help="data set of long logs, with both splits")
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--num-rollouts", type=int, default=2)
    parser.add_argument("--seconds", type=int, default=60)
    options = parser.parse_args()
    fitted = fit_entries(list(rs.load_dataset(options.data, "training")))
    print(f"fitted: {len(fitted.entrants.speed_mps)} entrants, weights {np.round(fitted.weights, 3).tolist()}")
    models = {name: ENTRIES.get(name) for name in ("none", "fixed-rate")} | {"fitted": fitted}
    policy, worlds = load_policy(options.model), rs.load_dataset(options.data, "validation")
    measured: dict[str, list[list[WindowSamples]]] = defaultdict(list)
    steps, seconds = 10 * options.seconds, defaultdict(float)
    for position in range(min(options.worlds, len(worlds))):
        scenario = worlds[position]
        measured["log"].append(measure_windows(read_log(scenario).steps(slice(0, steps))))
        for name, entries in models.items():
            start = time.process_time()
            batch = collate([add_visitors(scenario)])
            rollouts = simulate(
                policy, batch, num_rollouts=options.num_rollouts, seed=0, num_steps=steps, entries=entries
            )
            seconds[name] += time.process_time() - start
            measured[name] += [measure_windows(motion) for motion in read_rollouts(batch.scenarios[0], rollouts)]
        print(
            f"world {position + 1}: {', '.join(f'{name} {value:.0f} s' for name, value in seconds.items())}", flush=True
        )
    print("|", " | ".join(HEADINGS), "|\n|---|", "--:|" * (len(HEADINGS) - 1), sep="")
    windows = {name: [join_samples(of_window) for of_window in zip(*samples)] for name, samples in measured.items()}
    for name, samples in windows.items():
        for window, (of_world, of_log) in enumerate(zip(samples, windows["log"])):
            print("|", " | ".join(table_row(name, window, of_world, of_log)), "|")


if __name__ == "__main__":
    main()
