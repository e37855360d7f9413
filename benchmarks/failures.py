"""Failure rates by splitting: against brute force, and what tuning the traffic changes. Writes tables; resumable.

    python benchmarks/failures.py brute OUT              five scenarios × idm, pdm with 5 000 episodes each
    python benchmarks/failures.py tuning OUT --data FOLDER [FOLDER]   idm, pdm × demo-base, demo-tuned, per data set
    --quick                                              minutes in place of hours: few scenarios, episodes and steps

Everything that is finished lies in OUT and is not done again.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
from scipy import stats

from rlftsim.envs.failure_run import run_study
from rlftsim.envs.failure_study import Study, StudyConfig, parse_budget
from rlftsim.envs.splitting import estimate_interval
from rlftsim.jobs.files import write_text
from rlftsim.jobs.runner import choose_runner
from rlftsim.scenario.open import open_dataset
from rlftsim.statistics import cluster_bootstrap

CHUNK = 100
PLANNERS = ("idm", "pdm")
TRAFFIC = ("demo-base", "demo-tuned")
RATES = (1e-3, 1e-1)
"""Rates of the scenarios that are compared with brute force."""


def load_or_make(path: Path, make) -> dict:
    """Values of a JSON file, made now where it is missing."""
    if not path.exists():
        write_text(path, json.dumps(make()))
    return json.loads(path.read_text())


def count_events(config: StudyConfig, scenario_id: str, episodes: int, out: Path) -> tuple[int, int]:
    """Events and steps of undisturbed episodes, a file for every hundred."""
    total = steps = 0
    for first in range(0, episodes, CHUNK):

        def drive(first: int = first) -> dict:
            chain = config.chain(scenario_id)
            paths, _ = chain.start(np.arange(first, first + CHUNK))
            steps = sum(len(path.motion) for path in paths)
            return {"events": sum(bool((path.danger >= 0).any()) for path in paths), "steps": steps}

        values = load_or_make(out / f"{config.planner}-{scenario_id}-{first:05d}.json", drive)
        total, steps = total + values["events"], steps + values["steps"]
    return total, steps


def split(config: StudyConfig, scenario_id: str, repeat: int) -> dict:
    """An estimate by splitting."""
    return asdict(config.chain(scenario_id, repeat).estimate(config.particles, 1)[0])


@dataclass(frozen=True)
class Comparison:
    """Size of the comparison with brute force, for each planner."""

    planners: tuple[str, ...] = PLANNERS
    data: str = "synthetic"
    scenarios: int = 5
    look: int = 300
    """Episodes of each scenario that choose."""
    episodes: int = 5000
    particles: int = 64
    repeats: int = 10


def compare_with_brute_force(out: Path, size: Comparison) -> None:
    """Table: intervals of brute force and of splitting, and variance × steps of both."""
    scenarios, look, episodes = size.scenarios, size.look, size.episodes
    particles, repeats = size.particles, size.repeats
    rows, overlaps = [], 0
    for planner in size.planners:
        config, chosen = StudyConfig(planner, size.data, particles=particles), []
        for scenario_id in config.scenario_ids():
            # the first look decides which scenarios are driven further, and is not part of the comparison
            events, _ = count_events(config, scenario_id, look, out / "look")
            if 0 < events <= RATES[1] * look:
                chosen.append(scenario_id)
            if len(chosen) == scenarios:
                break
        for scenario_id in chosen:
            events, brute_steps = count_events(
                StudyConfig(planner, size.data, particles=particles, seed=1), scenario_id, episodes, out / "brute"
            )
            rate = events / episodes
            low = stats.beta.ppf(0.025, events, episodes - events + 1) if events else 0.0
            high = stats.beta.ppf(0.975, events + 1, episodes - events)
            results = [
                load_or_make(
                    out / f"split-{particles}" / f"{planner}-{scenario_id}-{repeat}.json",
                    partial(split, config, scenario_id, repeat),
                )
                for repeat in range(1, repeats + 1)
            ]
            estimates = np.array([result["probability"] for result in results])
            steps = sum(result["num_steps"] for result in results)
            ends = estimate_interval(estimates, particles * repeats)
            overlap = ends[0] <= high and low <= ends[1]
            overlaps += overlap
            cost = float(estimates.var(ddof=1)) / repeats * steps
            gain = rate * (1 - rate) / episodes * brute_steps / cost if cost and events else np.nan
            rows.append(
                f"| {planner} | {scenario_id} | {rate:.4f} [{low:.4f}, {high:.4f}] | {estimates.mean():.4f} "
                f"[{ends[0]:.4f}, {ends[1]:.4f}] | {'yes' if overlap else 'no'} | {steps} | {gain:.1f} |"
            )
            print(rows[-1], flush=True)
    head = "| planner | scenario | brute force | splitting | overlap | steps | Monte Carlo's steps over splitting's |"
    write_text(
        out / "brute.md", "\n".join([head, "|" + "---|" * 7, *rows, "", f"{overlaps} of {len(rows)} overlap."]) + "\n"
    )


def compare_studies(folder: str, base: Study, tuned: Study) -> str:
    """Change of the event's probability in an episode, scenario by scenario, with an interval over street networks."""
    dataset = open_dataset(folder, "validation")
    before, after = ({s.pilot.scenario_id: s.probability for s in study.scenarios} for study in (base, tuned))
    ids = [scenario_id for scenario_id in before if scenario_id in after]
    change = np.array([after[scenario_id] - before[scenario_id] for scenario_id in ids])
    result = cluster_bootstrap(change, np.array([dataset.find_cluster(scenario_id) for scenario_id in ids]))
    low, high = result.interval
    return (
        f"{100 * np.mean([before[i] for i in ids]):.2f} → {100 * np.mean([after[i] for i in ids]):.2f} % of episodes, "
        f"{100 * result.mean:+.2f} [{100 * low:+.2f}, {100 * high:+.2f}], p = {result.p_value:.2g}"
    )


def measure_tuning(
    out: Path, planners: Sequence[str], data: list[str], budget: str, jobs: int, limit: int | None
) -> None:
    """Table: failures of each planner per 1 000 km in both kinds of traffic, and the difference over street networks."""
    lines = []
    for folder in data:
        for planner in planners:
            studies = []
            for model in TRAFFIC:
                config = StudyConfig(planner, folder, model=model, limit=limit)
                name = f"{Path(folder).name}-{planner}-{model}"
                study: Study = run_study(config, out / name, parse_budget(budget), lambda n: choose_runner(jobs, n))
                studies.append(study)
                lines.append(f"| {Path(folder).name} | {planner} | {model} | {study.describe_total()} |")
                print(lines[-1], flush=True)
            lines.append(f"| {Path(folder).name} | {planner} | difference | {compare_studies(folder, *studies)} |")
            print(lines[-1], flush=True)
    write_text(
        out / "tuning.md", "\n".join(["| data | planner | traffic | events |", "|---|---|---|---|", *lines]) + "\n"
    )


def main() -> None:
    """Read the command line and run a part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("brute", "tuning"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--planners", nargs="+", default=PLANNERS)
    parser.add_argument("--data", nargs="+", default=["synthetic"])
    parser.add_argument("--budget", default="90m", help="of each study of `tuning`, time of one core")
    parser.add_argument("--limit", type=int, help="scenarios of each study of `tuning`, the first ones; default: all")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--quick", action="store_true")
    sizes = parser.add_argument_group("size of `brute`")
    for field in fields(Comparison)[2:]:
        sizes.add_argument(f"--{field.name}", type=int, default=field.default)
    arguments = parser.parse_args()
    if arguments.part == "brute":
        numbers = {field.name: getattr(arguments, field.name) for field in fields(Comparison)[2:]}
        numbers = (
            {"scenarios": 1, "look": 100, "episodes": 200, "particles": 8, "repeats": 3} if arguments.quick else numbers
        )
        compare_with_brute_force(arguments.out, Comparison(tuple(arguments.planners), arguments.data[0], **numbers))
    else:
        budget, limit = ("60s", 2) if arguments.quick else (arguments.budget, arguments.limit)
        measure_tuning(arguments.out, arguments.planners, arguments.data, budget, arguments.jobs, limit)


if __name__ == "__main__":
    main()
