"""Overhead of processes, shares and Ray over the work itself; the error of `rlftsim doctor --plan`.

python benchmarks/runners.py [--rows sleep share memory ray ray-kills plan] [--model demo-base] [--limit 40]

Each row prints a line of Markdown; ray rows start a cluster of two raylets on this machine. Items of the rows sleep,
memory and ray only sleep, so that other work on the machine's cores does not count.
"""

import argparse
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

from rlftsim.workers import Inline, Processes, Share

NUM_ITEMS, ITEM_S = 16, 5.0
MANY = 20_000


def sleep(item, advance, is_stopped):
    time.sleep(item)
    advance(1)
    return os.getpid()


def write_slowly(path, advance, is_stopped):
    """Write a file, whole, after a moment."""
    time.sleep(0.3)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(path.name)
    temporary.replace(path)
    return path.name


def ignore(count):
    pass


def seconds_of(call):
    start = time.monotonic()
    call()
    return time.monotonic() - start


def resident_mb():
    """Memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def over_two(runner):
    """Part of its time that a runner adds to items that two processes share."""
    return seconds_of(lambda: runner.run(sleep, [ITEM_S] * NUM_ITEMS, advance=ignore)) / (NUM_ITEMS * ITEM_S / 2) - 1


def row_sleep(options):
    inline = seconds_of(lambda: Inline().run(sleep, [ITEM_S] * 4, advance=ignore)) / (4 * ITEM_S) - 1
    added = over_two(Processes(2))
    print(
        f"| time added to {NUM_ITEMS} items of {ITEM_S:g} s, start included | inline {inline:.1%}, two processes {added:.1%} |"
    )


def row_share(options):
    """Evaluations of one rollout of constant velocity: all of an item's time that is not work."""
    from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
    from rlftsim.evaluation.resumable import EvaluationParts
    from rlftsim.rollout.baselines import ConstantVelocity

    config = EvaluateConfig(num_rollouts=1, limit=40)
    seconds = {"inline": [], "share 1/1": []}
    for number in range(options.repeats + 1):
        for name, runner in (("inline", Inline()), ("share 1/1", Share(1, 1, Inline()))):
            with tempfile.TemporaryDirectory() as folder:
                start = time.process_time()
                evaluate(ConstantVelocity(), "synthetic", folder, config, name="a", runner=runner, show_progress=False)
                if number:  # the first time imports
                    seconds[name].append(time.process_time() - start)
    items = 40 // EvaluationParts.group_size
    inline, share = (min(values) for values in seconds.values())
    print(
        f"| CPU of an evaluation of 40 scenarios, {items} items | inline {inline:.2f} s, share {share:.2f} s: "
        f"{1000 * (share - inline) / items:.1f} ms an item |"
    )


def row_memory(options):
    before = resident_mb()
    spent = seconds_of(lambda: Processes(2).run(sleep, [0.0] * MANY, advance=ignore))
    print(
        f"| {MANY} empty items, two processes | {1000 * spent / MANY:.2f} ms each, driver {resident_mb() - before:+.1f} MB |"
    )


@contextmanager
def ray_cluster():
    """A head without cores and two nodes of one each."""
    import ray
    from ray.cluster_utils import Cluster

    os.environ["PYTHONPATH"] = str(Path(__file__).parents[1] / "src")  # for the processes of the cluster
    small = {"object_store_memory": 80_000_000, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **small})
    for _ in range(2):
        cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
    ray.init(cluster.address, log_to_driver=False)
    try:
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()


def row_ray(options):
    from rlftsim.cluster.ray import RayRunner

    with ray_cluster():
        here, there = over_two(Processes(2)), over_two(RayRunner())
        print(
            f"| time added to {NUM_ITEMS} items of {ITEM_S:g} s, start included | two processes {here:.1%}, "
            f"Ray, two raylets {there:.1%}: {(1 + there) / (1 + here) - 1:+.1%} |"
        )
        before = resident_mb()
        spent = seconds_of(lambda: RayRunner().run(sleep, [0.0] * MANY, advance=ignore))
        print(
            f"| {MANY} empty items, Ray | {1000 * spent / MANY:.2f} ms each, driver {resident_mb() - before:+.1f} MB |"
        )


def row_ray_kills(options):
    """Kill workers of a Ray cluster at random moments, and now and then a raylet, until 100 are dead."""
    from rlftsim.cluster.ray import RayRunner

    dice, kills, rounds, set_aside = random.Random(0), {"worker": 0, "raylet": 0}, 0, 0
    with ray_cluster() as cluster, tempfile.TemporaryDirectory() as folder:
        while sum(kills.values()) < options.kills:
            rounds += 1
            place = Path(folder) / str(rounds)
            place.mkdir()
            paths, is_over = [place / f"{number}" for number in range(40)], threading.Event()

            def shoot(is_over=is_over):
                while not is_over.wait(dice.uniform(0.2, 1.5)):
                    if dice.random() < 0.1:
                        cluster.remove_node(dice.choice(list(cluster.worker_nodes)), allow_graceful=False)
                        cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
                        kills["raylet"] += 1
                        continue
                    found = subprocess.run(["pgrep", "-f", "ray::_work"], capture_output=True, text=True).stdout.split()
                    if found:
                        try:
                            os.kill(int(dice.choice(found)), signal.SIGKILL)
                        except ProcessLookupError:
                            continue
                        kills["worker"] += 1

            shooter = threading.Thread(target=shoot)
            shooter.start()
            left = paths
            while left:
                try:
                    RayRunner().run(write_slowly, left, advance=ignore)
                except Exception as error:  # an item that met three of the kills is set aside: the same command again
                    if type(error).__name__ != "SetAside":
                        raise
                    set_aside += 1
                left = [path for path in paths if not path.exists()]
            is_over.set()
            shooter.join()
            written = {path.name: path.read_text() for path in place.iterdir() if not path.name.startswith(".")}
            if written != {path.name: path.name for path in paths}:
                raise SystemExit(f"round {rounds}: {sorted(written)}")
            print(f"round {rounds}: {kills}", file=sys.stderr)
    print(
        f"| Ray, kills of {kills['worker']} workers and {kills['raylet']} raylets | {rounds} rounds of 40 items, "
        f"{set_aside} times items set aside and done by the next call, 0 lost, 0 doubled |"
    )


def row_plan(options):
    """The forecast of an evaluation beside the evaluation."""
    from rlftsim.cli.plan import measure_cost
    from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
    from rlftsim.policies.registry import load_policy
    from rlftsim.scenario.dataset import ScenarioDataset

    cost = measure_cost("evaluate", options.model, "synthetic", 5)
    total = len(ScenarioDataset("synthetic", options.split))
    limit = min(options.limit, total)
    start, began = time.process_time(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        config = EvaluateConfig(limit=limit, split=options.split)
        evaluate(load_policy(options.model, "cpu"), "synthetic", folder, config, name="a", runner=Inline())
    real = time.process_time() - start
    forecast = cost.seconds * limit
    print(
        f"| `doctor --plan evaluate`, {options.model}, {limit} scenarios | forecast {forecast:.0f} s "
        f"({cost.num_measured} measured), real {real:.0f} s of CPU in {time.monotonic() - began:.0f} s: "
        f"{forecast / real - 1:+.0%} |"
    )


ROWS = {
    name.removeprefix("row_").replace("_", "-"): function
    for name, function in list(globals().items())
    if name.startswith("row_")
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--model", default="demo-base")
    parser.add_argument("--split", default="training")
    parser.add_argument("--limit", type=int, default=60)
    options = parser.parse_args()
    print("| measured | result |\n|---|---|")
    for name in options.rows:
        ROWS[name](options)


if __name__ == "__main__":
    main()
