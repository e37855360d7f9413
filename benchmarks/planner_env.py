"""Speed of the planner environments beside the bare loop, and a table of planners and traffic.

    python benchmarks/planner_env.py speed [--rounds 3] [--model demo-base]
    python benchmarks/planner_env.py memory [--episodes 2000]
    python benchmarks/planner_env.py steps --data long [--model demo-tuned] [--limit 3]
    python benchmarks/planner_env.py drive --versions OLD/src src [--limit 32] [--rounds 3]
    python benchmarks/planner_env.py table --data synthetic --limit 40 [--models demo-base runs/tuned] [--jobs 2]

Times are CPU time of this process with one thread; contestants of a ratio take turns, so that a busy machine slows both.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import time

import numpy as np
import torch

from rlftsim.envs import EgoEnv, EgoVectorEnv
from rlftsim.envs.drive import drive
from rlftsim.envs.drive_scenario import DriveConfig, load_source
from rlftsim.envs.planners.registry import load_planner
from rlftsim.evaluation.drive_results import compare_drives, format_drives
from rlftsim.jobs.progress import print_wide
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import AgentStates
from rlftsim.scenario.batch import collate
from rlftsim.scenario.open import open_dataset

STEPS = 80


def bare_loop(policy, batch, context):
    """Seconds of network, kinematics and a forced ego, without observations and scores: what the traffic costs."""
    ego = torch.zeros_like(batch.agent_mask)
    ego[:, 0] = True

    def force(state, step):
        k = policy.steps_per_decision
        position = batch.position[:, None, :, 10:11].expand(-1, -1, -1, k, -1)
        heading = batch.heading[:, None, :, 10:11].expand(-1, -1, -1, k)
        return AgentStates(position, heading, ego[:, None, :, None].expand(heading.shape))

    begin = time.process_time()
    simulate(policy, batch, num_rollouts=1, seed=0, context=context, force=force)
    return time.process_time() - begin


def episode(env, action):
    """Seconds of an episode after its reset."""
    env.reset(seed=0)
    begin = time.process_time()
    for _ in range(STEPS):
        env.step(action)
    return time.process_time() - begin


def speed(arguments):
    data, policy = open_dataset("synthetic", "validation"), load_policy(arguments.model)
    scenario, still = data[0], np.zeros(2, np.float32)
    one = collate([scenario])
    eight = collate([data[i] for i in range(8)])
    with torch.no_grad():
        contexts = policy.encode(one), policy.encode(eight)
    common = {"stop_on": (), "policy": policy}
    envs = {
        "policy, observations": EgoEnv(scenarios=[scenario], reward="none", **common),
        "policy, observations and reward": EgoEnv(scenarios=[scenario], **common),
        "replay": EgoEnv(scenarios=[scenario], traffic="replay", reward="none", stop_on=()),
        "constant velocity": EgoEnv(scenarios=[scenario], traffic="constant_velocity", reward="none", stop_on=()),
    }
    vectors = {
        "policy, vector of 8": (8, EgoVectorEnv(8, scenarios=[scenario], **common)),
        "replay, vector of 64": (64, EgoVectorEnv(64, scenarios=[scenario], traffic="replay", stop_on=())),
    }
    taken = {name: [] for name in ("bare loop", "bare loop of 8", *envs, *vectors)}
    for _ in range(arguments.rounds):
        taken["bare loop"].append(bare_loop(policy, one, contexts[0]))
        for name, env in envs.items():
            taken[name].append(episode(env, still))
        taken["bare loop of 8"].append(bare_loop(policy, eight, contexts[1]))
        for name, (count, env) in vectors.items():
            taken[name].append(episode(env, np.zeros((count, 2), np.float32)))
    counts = {"bare loop of 8": 8, **{name: count for name, (count, _) in vectors.items()}}
    rate = {name: counts.get(name, 1) * STEPS / min(seconds) for name, seconds in taken.items()}
    for name, value in rate.items():
        print(f"{name:34} {value:8.0f} scene steps/s   {value / rate['bare loop']:.2f} of the bare loop")
    ratio = rate["policy, vector of 8"] / rate["policy, observations and reward"]
    print(f"vector of 8 over one environment: {ratio:.2f}")


def steps(arguments):
    """CPU time of a step of `drive` in seconds 0 to 8 and 8 to 30."""
    config = DriveConfig("idm", data=arguments.data, model=arguments.model, seconds=30.0)
    env, planner, seconds = EgoEnv(source=load_source(config, "policy")), load_planner("idm"), []
    for scenario in env.source.scenario_ids[: arguments.limit]:
        observation, info = env.reset(seed=0, options={"scenario": scenario})
        planner.reset(info)
        taken = []
        while not env.state.ended[0]:
            action, begin = planner.act(observation), time.process_time()
            observation, *_ = env.step(action)
            taken.append(time.process_time() - begin)
        seconds.append((np.mean(taken[:STEPS]), np.mean(taken[STEPS:])))
        print(scenario, ", ".join(f"{1e3 * value:.1f} ms" for value in seconds[-1]))
    print("mean", ", ".join(f"{1e3 * value:.1f} ms" for value in np.mean(seconds, 0)))


def memory(arguments):
    env = EgoEnv(data="synthetic", split="validation", traffic="replay", action="bicycle")
    sizes = []
    for index in range(arguments.episodes):
        env.reset(seed=index)
        for _ in range(10):
            env.step(np.zeros(2, np.float32))
            if env.state.ended[0]:
                break
        if index % (arguments.episodes // 10) == 0:
            sizes.append(resident_mb())
    print(f"resident memory every {arguments.episodes // 10} episodes, MB: {', '.join(f'{s:.0f}' for s in sizes)}")
    print(f"peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def resident_mb():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith("VmRSS"))


DRIVE = """
import sys, time
from rlftsim.envs.drive import drive
from rlftsim.envs.drive_scenario import DriveConfig
planner, traffic, limit = sys.argv[1:]
drive(DriveConfig(planner, traffic=(traffic,), limit=1))
begin = time.process_time()
drive(DriveConfig(planner, traffic=(traffic,), limit=int(limit)))
print(int(limit) / (time.process_time() - begin))
"""


def compare_drive(arguments):
    """Episodes per CPU second of `drive` by versions of the package, a process of each in turns."""
    for planner in arguments.planners:
        for traffic in arguments.traffic:
            speeds = [[] for _ in arguments.versions]
            for _ in range(arguments.rounds):
                for version, measured in zip(arguments.versions, speeds):
                    run = subprocess.run(
                        [sys.executable, "-c", DRIVE, planner, traffic, str(arguments.limit)],
                        env={**os.environ, "PYTHONPATH": version, "OMP_NUM_THREADS": "1"},
                        capture_output=True, text=True, check=True,
                    )  # fmt: skip
                    measured.append(float(run.stdout))
            best = ", ".join(f"{max(measured):.2f}" for measured in speeds)
            ratios = ", ".join(f"{statistics.median(b / a for a, b in zip(speeds[0], m)):.2f}" for m in speeds[1:])
            print(f"{planner} in {traffic}: {best} episodes per CPU second, {ratios} times the first", flush=True)


def table(arguments):
    traffics = {"replay": None, "constant_velocity": None, "idm": None, **{f"policy {m}": m for m in arguments.models}}
    for planner in arguments.planners:
        results = []
        for name, model in traffics.items():
            config = DriveConfig(
                planner=planner, data=arguments.data, split=arguments.split, limit=arguments.limit,
                traffic=("policy",) if model else (name,), model=model or "demo-base", jobs=arguments.jobs,
            )  # fmt: skip
            results += drive(config)
        print_wide(format_drives(*results))
        # IDM traffic against the learned one: does IDM overrate the planner?
        for result in results[3:]:
            row = next(d for d in compare_drives(result, results[2]) if d.column == "nuplan_style")
            print(
                f"{planner}, nuplan_style in IDM traffic minus {result.settings.model[:8]}: {row.verdict}", flush=True
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)
    one = verbs.add_parser("speed")
    one.add_argument("--rounds", type=int, default=3)
    one.add_argument("--model", default="demo-base")
    one.set_defaults(run=speed)
    one = verbs.add_parser("steps")
    one.add_argument("--data", required=True, help="logs of 40 s or more")
    one.add_argument("--model", default="demo-tuned")
    one.add_argument("--limit", type=int, default=3)
    one.set_defaults(run=steps)
    one = verbs.add_parser("memory")
    one.add_argument("--episodes", type=int, default=2000)
    one.set_defaults(run=memory)
    one = verbs.add_parser("drive")
    one.add_argument("--versions", nargs="+", required=True, help="values of PYTHONPATH, the oldest first")
    one.add_argument("--planners", nargs="*", default=["idm", "pdm"])
    one.add_argument("--traffic", nargs="*", default=["replay"])
    one.add_argument("--limit", type=int, default=32)
    one.add_argument("--rounds", type=int, default=3)
    one.set_defaults(run=compare_drive)
    one = verbs.add_parser("table")
    one.add_argument("--data", default="synthetic")
    one.add_argument("--split", default="validation")
    one.add_argument("--limit", type=int, default=40)
    one.add_argument("--models", nargs="*", default=["demo-base"])
    one.add_argument("--planners", nargs="*", default=["replay", "constant_velocity", "idm", "pdm"])
    one.add_argument("--jobs", type=int, default=1)
    one.set_defaults(run=table)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
