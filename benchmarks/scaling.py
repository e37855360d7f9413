"""Time and memory against the number of agents, rollouts and scenarios, with the exponents of their growth.

python benchmarks/scaling.py [--model demo-base] [--out FOLDER]

Prints Markdown and draws FOLDER/scaling.png. Each number comes from a process of its own with one thread, which makes
and scores the rollouts of a scenario twice and keeps the second time. Scenes are synthetic: the largest of the package,
cut to the agents nearest to the ego; beyond its size copies of its agents stand 60 m and more away from their models, so
that density stays what it is. Scenarios: empty items of a list of work, whose results are files, as `evaluate` keeps
them, first all and then again with nothing left to do.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

AGENTS = (8, 16, 32, 64, 128, 256)
ROLLOUTS = (1, 2, 4, 8, 16, 32, 64, 128)
ITEMS = (1_000, 10_000, 100_000)
BASE_AGENTS, BASE_ROLLOUTS = 32, 32
MEASURES = {"simulation": "CPU s", "scoring": "CPU s", "memory": "MB"}


def main() -> None:
    """Tables of all three, and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="demo-base")
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--job", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.job:
        job = json.loads(arguments.job)
        print(json.dumps(measure_items(job["items"]) if "items" in job else measure_rollouts(**job)))
        return
    curves = {
        "agents": {n: start_job(model=arguments.model, num_agents=n, num_rollouts=BASE_ROLLOUTS) for n in AGENTS},
        "rollouts": {n: start_job(model=arguments.model, num_agents=BASE_AGENTS, num_rollouts=n) for n in ROLLOUTS},
    }
    for name, curve in curves.items():
        print(f"\n| {name} | {' | '.join(f'{m}, {unit}' for m, unit in MEASURES.items())} |\n|--:|--:|--:|--:|")
        for count, numbers in curve.items():
            print(f"| {count} | {numbers['simulation']:.2f} | {numbers['scoring']:.3f} | {numbers['memory']:.0f} |")
        halves = (slice(None, len(curve) // 2 + 1), slice(len(curve) // 2, None))
        for label, half in zip(("lower half", "upper half"), halves):
            cells = [
                f"{fit_exponent(list(curve)[half], [n[m] for n in list(curve.values())[half]]):.2f}" for m in MEASURES
            ]
            print(f"| exponent, {label} | {' | '.join(cells)} |")
    print("\n| items | ms of CPU an item | again, nothing left | memory, MB |\n|--:|--:|--:|--:|")
    for count in ITEMS:
        numbers = start_job(items=count)
        print(f"| {count:,} | {numbers['first']:.3f} | {numbers['again']:.3f} | {numbers['memory']:.1f} |")
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(curves, arguments.out / "scaling.png")


def start_job(**job: object) -> dict[str, float]:
    """Numbers of a measurement in a process of its own."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    command = [sys.executable, __file__, "--job", json.dumps(job)]
    output = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
    return json.loads(output.splitlines()[-1])


def fit_exponent(counts: list[int], values: list[float]) -> float:
    """Exponent p of value ~ count ** p, by least squares of the logarithms."""
    return float(np.polyfit(np.log(counts), np.log(np.maximum(values, 1e-9)), 1)[0])


def peak_mb() -> float:
    """Largest memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def measure_rollouts(model: str, num_agents: int, num_rollouts: int) -> dict[str, float]:
    """CPU seconds of simulation and scoring, and memory above that of the loaded program."""
    import torch

    import rlftsim as rs
    from rlftsim.cli.main import keep_freed_memory

    torch.set_num_threads(1)
    keep_freed_memory()
    policy, scenario = rs.load_policy(model), crowd(num_agents)
    start, numbers = peak_mb(), {}
    for _ in range(2):
        moments = [time.process_time()]
        rollouts = rs.simulate(policy, replace(scenario), num_rollouts=num_rollouts)
        moments.append(time.process_time())
        rs.score(replace(scenario), rollouts)
        moments.append(time.process_time())
        numbers = dict(zip(("simulation", "scoring"), np.diff(moments).tolist()))
    return numbers | {"memory": max(peak_mb() - start, 1.0)}


def crowd(num_agents: int) -> object:
    """The scenario of most agents, with fewer of these or with copies."""
    import rlftsim as rs

    data = rs.load_dataset("synthetic", "training")
    scenario = data[int(np.argmax(data.num_agents))]
    tracks, now = scenario.tracks, 10
    present = np.flatnonzero(tracks.valid[:, now])
    offset = tracks.position[present, now, :2] - tracks.position[scenario.ego_index, now, :2]
    order = present[np.argsort(np.linalg.norm(offset, axis=1))]  # the ego first
    rows = np.resize(order, num_agents)
    copy = np.arange(num_agents) // len(order)
    angle = 2.4 * copy  # each set of copies in a direction of its own
    shift = 60.0 * copy[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    values = {name: getattr(tracks, name)[rows] for name in vars(tracks)}
    values["position"] = (values["position"] + shift[:, None]).astype(np.float32)
    values["object_id"] = np.arange(1, num_agents + 1)
    evaluated = np.arange(min(num_agents, 8))
    return replace(
        scenario, tracks=type(tracks)(**values), ego_index=0, tracks_to_predict=evaluated.astype(scenario.tracks_to_predict.dtype),
        difficulty=np.zeros(len(evaluated), scenario.difficulty.dtype), objects_of_interest=scenario.objects_of_interest[:0],
    )  # fmt: skip


def measure_items(count: int) -> dict[str, float]:
    """Milliseconds of CPU for an item whose work is nothing, and memory of the driver."""
    from rlftsim.jobs.files import write_text
    from rlftsim.jobs.folder import Lease
    from rlftsim.jobs.items import WholeFiles, run_items
    from rlftsim.jobs.runner import Inline

    with tempfile.TemporaryDirectory() as temporary:
        folder, start, numbers = Path(temporary), peak_mb(), {}

        def work(item: int, advance: Callable[[int], None], is_stopped: object) -> None:
            write_text(folder / str(item), str(item))
            advance(1)

        for name in ("first", "again"):
            began = time.process_time()
            with Lease(folder / ".lock", Inline(), "works in") as lease:
                files = WholeFiles(folder, str, Path.read_text)
                run_items("items", range(count), work, format=files, lease=lease, show_progress=False)
            numbers[name] = 1000 * (time.process_time() - began) / count
        return numbers | {"memory": peak_mb() - start}


def draw(curves: dict[str, dict[int, dict[str, float]]], path: Path) -> None:
    """A panel for each curve: time and memory over the number, both axes logarithmic."""
    from matplotlib.figure import Figure

    from rlftsim.viewer.figure import COLORS, save_figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axis, (name, curve) in zip(figure.subplots(1, 2), curves.items()):
        for color, (measure, unit) in zip(COLORS, MEASURES.items()):
            axis.loglog(
                list(curve), [n[measure] for n in curve.values()], "o-", color=color, label=f"{measure}, {unit}"
            )
        axis.set_xlabel(name)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, fontsize=8)
    save_figure(path, figure)


if __name__ == "__main__":
    main()
