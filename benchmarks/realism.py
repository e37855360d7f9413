"""How long and how much memory does the realism metric take, beside the official evaluator and as scenes grow?

    python benchmarks/realism.py ../shared
    python benchmarks/realism.py ../shared --official /some/venv/bin/python [--keep official.json] [--model runs/pretrain/model]

Prints Markdown tables. Every measurement is a process of its own with one thread, because the peak of resident memory never
goes down. Times are CPU time: what a process used, whatever else the machine was doing. `--official` runs the evaluator
on the same scenarios and rollouts (8 to 10 minutes) through `tools/official_rmm/evaluate.py` of the shared folder, in an environment
made by `make_venv.sh` beside it; `--keep` stores what it printed and reads it the next time.
"""

import argparse
import json
import multiprocessing
import os
import resource
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

COMPARED = ("bada", "637f", "ee51", "68d5")
FAST_WOSAC_EVAL_S = {"bada": 7.3, "637f": 11.4, "ee51": 14.6, "68d5": 18.8}
"""CPU seconds of the community's PyTorch implementation, as published beside the reference numbers; not run here."""
NUM_ROLLOUTS = 32
ROLLOUTS_SCALED = (1, 2, 4, 8, 16, 32, 64, 128)
AGENTS_SCALED = (1, 8, 32, 64, 84, 128)


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def median_cpu_s(call, runs: int = 5) -> float:
    times = []
    for _ in range(runs):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return sorted(times)[runs // 2]


def read_case(shared: Path, prefix: str, recipe: str, num_rollouts: int):
    import numpy as np
    import torch

    from rlftsim.realism import SimulatedStates
    from rlftsim.scenario.womd import read_scenarios

    torch.set_num_threads(1)
    scenario = next(s for s in read_scenarios(shared / "data" / "womd") if s.scenario_id.startswith(prefix))
    archive = np.load(shared / "golden" / "rmm" / "rollouts" / f"{prefix}_{recipe}.npz")
    copies = -(-num_rollouts // len(archive["x"]))
    fields = [np.tile(archive[name], (copies, 1, 1))[:num_rollouts] for name in ("x", "y", "z", "heading")]
    return scenario, SimulatedStates(archive["object_ids"], *(torch.from_numpy(values) for values in fields))


def change_agents(scenario, states, num_agents: int):
    """The scene with only its first agents, or with copies of them beside themselves; one of them is evaluated."""
    import numpy as np
    import torch

    ego = list(scenario.simulated_indices).index(scenario.ego_index)
    order = [ego, *(a for a in range(len(scenario.simulated_indices)) if a != ego)]
    chosen = np.array([order[a % len(order)] for a in range(num_agents)])
    shift = np.array([a // len(order) for a in range(num_agents)]) * 3.0
    rows = scenario.simulated_indices[chosen]
    tracks = replace(scenario.tracks, **{name: values[rows].copy() for name, values in vars(scenario.tracks).items()})
    tracks.position[..., 0] += shift[:, None].astype(np.float32)
    tracks.object_id[:] = np.arange(num_agents)
    predicted = np.arange(1, min(num_agents, 8), dtype=np.int32)
    other = replace(
        scenario, tracks=tracks, ego_index=0, tracks_to_predict=predicted, difficulty=np.zeros(len(predicted), np.int8)
    )
    at = {int(object_id): row for row, object_id in enumerate(states.object_id)}
    index = torch.tensor([at[int(scenario.tracks.object_id[row])] for row in rows])
    x, y, z, heading = (v[:, index].contiguous() for v in (states.x, states.y, states.z, states.heading))
    x = x + torch.from_numpy(shift).float()[:, None]
    return other, type(states)(np.arange(num_agents), x, y, z, heading)


def measure(shared: Path, prefix: str, recipe: str, num_rollouts: int, num_agents: int | None) -> dict[str, Any]:
    """CPU seconds and peak memory of one scenario; runs in a process of its own."""
    import torch

    from rlftsim.realism import scenario_log, score

    scenario, states = read_case(shared, prefix, recipe, num_rollouts)
    if num_agents is not None:
        scenario, states = change_agents(scenario, states, num_agents)
    torch.ones(1) + 1
    before = peak_mib()
    start = time.process_time()
    log = scenario_log(scenario)
    prepared = time.process_time()
    meta_metric = float(score(log, states).meta_metric)
    first_s = time.process_time() - start
    peak = peak_mib()
    return {
        "agents": len(log.agents.object_id),
        "evaluated": len(log.agents.evaluated),
        "points": len(scenario.map_features.points),
        "first_s": first_s,
        "first_prepare_s": prepared - start,
        "prepare_s": median_cpu_s(lambda: scenario_log(replace(scenario))),
        "score_s": median_cpu_s(lambda: score(log, states)),
        "added_mib": peak - before,
        "peak_mib": peak,
        "meta_metric": meta_metric,
    }


def measure_leave_one_out(shared: Path, prefix: str, recipe: str) -> dict[str, float]:
    """CPU seconds of a scoring and of turning counts into the values of 1 set of rollouts and of 1 + 32 sets."""
    import torch

    from rlftsim.realism import METRIC_2025, scenario_log, score
    from rlftsim.realism.features import compute_features
    from rlftsim.realism.likelihood import (
        RolloutCounts,
        compute_likelihoods,
        count_rollouts,
        histogram_table,
        log_target,
    )

    scenario, states = read_case(shared, prefix, recipe, NUM_ROLLOUTS)
    log = scenario_log(scenario)
    counts = count_rollouts(compute_features(log, states), log, METRIC_2025)
    target, table = log_target(log, METRIC_2025), histogram_table(METRIC_2025, torch.device("cpu"))

    def likelihoods_of(with_sets: bool):
        bins, agreement = counts.bins.sum(0, keepdim=True), counts.agreement.sum(0, keepdim=True)
        sizes = torch.tensor([float(NUM_ROLLOUTS)])
        if with_sets:
            bins, agreement = (
                torch.cat([bins, bins - counts.bins]),
                torch.cat([agreement, agreement - counts.agreement]),
            )
            sizes = torch.cat([sizes, torch.full((NUM_ROLLOUTS,), NUM_ROLLOUTS - 1.0)])
        return compute_likelihoods(RolloutCounts(bins, agreement, counts.num_steps), sizes, target, table)

    return {
        "score_s": median_cpu_s(lambda: score(log, states), 9),
        "one_set_s": median_cpu_s(lambda: likelihoods_of(False), 99),
        "all_sets_s": median_cpu_s(lambda: likelihoods_of(True), 99),
    }


def measure_scenarios(shared: Path, recipe: str, prefixes: tuple[str, ...]) -> dict[str, float]:
    """CPU seconds and peak of several scenarios scored one after the other in one process."""
    from rlftsim.realism import scenario_log, score

    cases = [read_case(shared, prefix, recipe, NUM_ROLLOUTS) for prefix in prefixes]
    before, start = peak_mib(), time.process_time()
    for scenario, states in cases:
        score(scenario_log(scenario), states)
    return {"cpu_s": time.process_time() - start, "added_mib": peak_mib() - before}


def measure_update(
    shared: Path, model: str, size: str, prefixes: tuple[str, ...], num_updates: int
) -> dict[str, float]:
    """Seconds of the parts of a fine-tuning update (median), on the vocabulary of a model folder."""
    import torch

    from rlftsim.policies.registry import load_policy
    from rlftsim.policies.smart.config import smart_tiny
    from rlftsim.policies.smart.policy import SmartPolicy
    from rlftsim.scenario.batch import collate
    from rlftsim.scenario.womd import read_scenarios
    from rlftsim.training.config import DeviceConfig, FinetuneConfig
    from rlftsim.training.parallel import start_fabric
    from rlftsim.training.reward import prepare, update_policy

    torch.set_num_threads(1)
    scenarios = [s for s in read_scenarios(shared / "data" / "womd") if s.scenario_id.startswith(prefixes)]
    policy = load_policy(model)
    if size == "smart-tiny":
        policy = SmartPolicy(smart_tiny(), policy.vocabulary)  # weights as they are born: time does not depend on them
    config = FinetuneConfig(batch_size=len(scenarios), device=DeviceConfig("cpu", threads=1))
    fabric = start_fabric(config.device)
    learner, batch = prepare(policy, config, fabric.device), collate(scenarios)
    logged = [update_policy(learner, batch, config, fabric) for _ in range(num_updates)]
    names = [name for name in logged[0] if name.startswith("seconds_")]
    first = {f"first_{name}": logged[0][name] for name in names}
    return first | {name: sorted(values[name] for values in logged)[num_updates // 2] for name in names}


def alone(function, *arguments) -> Any:
    """The value of a call in a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def run_official(python: Path, shared: Path, recipe: str) -> dict[str, dict[str, float]]:
    """CPU seconds (without starting up), peak memory and meta-metric of the official evaluator, one process per scenario."""
    script = shared / "tools" / "official_rmm" / "evaluate.py"
    found = {}
    for prefix in COMPARED:
        rollouts = shared / "golden" / "rmm" / "rollouts" / f"{prefix}_{recipe}.npz"
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "result.json"
            arguments = ["--scenarios", shared / "data" / "womd", "--rollouts", rollouts, "--configs", "2025"]
            subprocess.run([python, script, *arguments, "--threads", "1", "--out", out], check=True)
            result = json.loads(out.read_text())
        case = result["cases"][0]
        found[prefix] = {
            "cpu_s": case["timing_s"]["cpu_features"] + case["timing_s"]["scoring"]["2025"],
            "wall_s": case["timing_s"]["total"],
            "peak_mib": result["environment"]["peak_rss_mib"],
            "meta_metric": case["configs"]["2025"]["metrics"]["metametric"],
        }
    return found


def official_results(options: argparse.Namespace) -> dict[str, dict[str, float]]:
    if options.keep and options.keep.exists():
        return json.loads(options.keep.read_text())
    found = run_official(options.official, options.shared, options.recipe)
    if options.keep:
        options.keep.write_text(json.dumps(found, indent=1) + "\n")
    return found


def print_comparison(options: argparse.Namespace) -> None:
    official = official_results(options)
    print(f"\n## Against the official evaluator: {NUM_ROLLOUTS} rollouts ({options.recipe}), CPU seconds\n")
    print("Ours: everything in a fresh process (scenario part and scoring, first call) and the median once warm.\n")
    print(
        "| scenario | official | ours, first call | ratio | ours, warm | ratio | fast_wosac_eval (quoted) | ratio to first | "
        "official peak MiB | our peak MiB | RMM difference |"
    )
    print("|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|", flush=True)
    for prefix in COMPARED:
        theirs = official[prefix]
        ours = alone(measure, options.shared, prefix, options.recipe, NUM_ROLLOUTS, None)
        warm, quoted = ours["prepare_s"] + ours["score_s"], FAST_WOSAC_EVAL_S[prefix]
        print(
            f"| {prefix} | {theirs['cpu_s']:.1f} | {ours['first_s']:.2f} | {theirs['cpu_s'] / ours['first_s']:.0f}× | "
            f"{warm:.2f} | {theirs['cpu_s'] / warm:.0f}× | {quoted} | {quoted / ours['first_s']:.0f}× | "
            f"{theirs['peak_mib']:.0f} | {ours['peak_mib']:.0f} | {ours['meta_metric'] - theirs['meta_metric']:.1e} |",
            flush=True,
        )


def print_scaling(options: argparse.Namespace) -> None:
    header = (
        "agents | evaluated | map points | rollouts | prepare ms | score ms | ms per rollout | added MiB | peak MiB |"
    )
    settings = {
        "rollouts (637f)": [("637f", n, None) for n in ROLLOUTS_SCALED],
        "agents (ee51 with fewer agents, or with copies 3 m beside)": [
            ("ee51", NUM_ROLLOUTS, a) for a in AGENTS_SCALED
        ],
    }
    for title, cases in settings.items():
        print(f"\n## More {title}\n\n| {header}\n|{'--:|' * 9}", flush=True)
        for prefix, num_rollouts, num_agents in cases:
            row = alone(measure, options.shared, prefix, options.recipe, num_rollouts, num_agents)
            print(
                f"| {row['agents']} | {row['evaluated']} | {row['points']} | {num_rollouts} | {1e3 * row['prepare_s']:.0f} | "
                f"{1e3 * row['score_s']:.0f} | {1e3 * row['score_s'] / num_rollouts:.1f} | {row['added_mib']:.0f} | "
                f"{row['peak_mib']:.0f} |",
                flush=True,
            )
    print("\n## More scenarios, one after the other in one process\n\n| scenarios | CPU s | added MiB |\n|--:|--:|--:|")
    for count in (1, 2, 4):
        row = alone(measure_scenarios, options.shared, options.recipe, COMPARED[:count])
        print(f"| {count} | {row['cpu_s']:.2f} | {row['added_mib']:.0f} |", flush=True)


def print_leave_one_out(options: argparse.Namespace) -> None:
    print("\n## All 32 leave-one-out values on top of one scoring\n")
    print("| scenario | scoring ms | likelihoods of 1 set ms | of 1 + 32 sets ms | added |\n|---|--:|--:|--:|--:|")
    for prefix in COMPARED:
        row = alone(measure_leave_one_out, options.shared, prefix, options.recipe)
        added = (row["all_sets_s"] - row["one_set_s"]) / row["score_s"]
        print(
            f"| {prefix} | {1e3 * row['score_s']:.0f} | {1e3 * row['one_set_s']:.2f} | {1e3 * row['all_sets_s']:.2f} | "
            f"{added:.1%} |",
            flush=True,
        )


def print_update_share(options: argparse.Namespace) -> None:
    print("\n## The reward's part of a fine-tuning update: 4 rollouts, wall time of one thread\n")
    print(
        "| model | scenarios | rollouts s | reward s | gradients s | part | part in the first update, scenario part included |"
    )
    print("|---|--:|--:|--:|--:|--:|--:|")
    for size, prefixes, num_updates in (("the given one", COMPARED, 3), ("smart-tiny", ("bada",), 2)):
        row = alone(measure_update, options.shared, options.model, size, prefixes, num_updates)
        parts = ("rollout", "reward", "backward", "step")
        fraction, first = (
            row[f"{at}seconds_reward"] / sum(row[f"{at}seconds_{p}"] for p in parts) for at in ("", "first_")
        )
        print(
            f"| {size} | {len(prefixes)} | {row['seconds_rollout']:.2f} | {row['seconds_reward']:.2f} | "
            f"{row['seconds_backward']:.2f} | {fraction:.1%} | {first:.1%} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shared", type=Path, help="folder with data/womd, golden/rmm and tools/official_rmm")
    parser.add_argument("--official", type=Path, help="Python of an environment with the official evaluator")
    parser.add_argument("--keep", type=Path, help="JSON file with the official evaluator's part, written once")
    parser.add_argument("--model", help="a fine-tunable model's folder: also measure the reward's part of an update")
    parser.add_argument("--recipe", default="messy")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    if options.official or options.keep:
        print_comparison(options)
    print_leave_one_out(options)
    if options.model:
        print_update_share(options)
    print_scaling(options)


if __name__ == "__main__":
    main()
