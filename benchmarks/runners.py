"""Overhead of processes, shares and Ray over the work itself; the error of `rlftsim doctor --plan`.

python benchmarks/runners.py [--rows sleep share memory ray ray-memory ray-kills plan] [--model demo-base] [--limit 160]

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
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path

from rlftsim.jobs.processes import Processes
from rlftsim.jobs.runner import Inline, Share

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
    """Everything that a run has more as a share: two locks, one of them let go and taken again."""
    from rlftsim.jobs.folder import Lease

    start, number = time.process_time(), 1000
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(number):
            with Lease(Path(folder) / ".lock", Share(1, 1, Inline()), "works in") as lease:
                lease.finish("work")
                lease.remove()
    print(f"| lease of a share, once for all its items | {1000 * (time.process_time() - start) / number:.2f} ms |")


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
    from rlftsim.jobs.ray import RayRunner

    with ray_cluster():
        here, first, second = over_two(Processes(2)), over_two(RayRunner()), over_two(RayRunner())
    print(
        f"| time added to {NUM_ITEMS} items of {ITEM_S:g} s | two processes {here:.1%}; Ray, two raylets, "
        f"with the start of its workers {first:.1%}, on a cluster whose workers run {second:.1%} |"
    )


def row_ray_memory(options):
    from rlftsim.jobs.ray import RayRunner

    with ray_cluster():
        before = resident_mb()
        spent = seconds_of(lambda: RayRunner().run(sleep, [0.0] * MANY, advance=ignore))
        print(
            f"| {MANY} empty items, Ray | {1000 * spent / MANY:.2f} ms each, driver {resident_mb() - before:+.1f} MB |"
        )


def row_ray_kills(options):
    """Kill workers of a Ray cluster at random moments, and now and then a raylet, until 100 are dead."""
    from rlftsim.jobs.processes import SetAside
    from rlftsim.jobs.ray import RayRunner

    dice, kills, rounds = random.Random(0), Counter(), 0

    def work(paths):
        # An item that met three of the kills is set aside, and done by the next call.
        while left := [path for path in paths if not path.exists()]:
            try:
                RayRunner().run(write_slowly, left, advance=ignore)
            except SetAside as error:
                kills["set aside"] += len(str(error).split("set aside: ")[1].split("; "))

    with ray_cluster() as cluster, tempfile.TemporaryDirectory() as folder:
        while kills["worker"] + kills["raylet"] < options.kills:
            rounds += 1
            place = Path(folder) / str(rounds)
            place.mkdir()
            paths = [place / f"{number}" for number in range(40)]
            worker = threading.Thread(target=work, args=(paths,), daemon=True)
            worker.start()
            while worker.is_alive():  # Ray adds nodes from the main thread alone
                time.sleep(dice.uniform(0.2, 1.5))
                if dice.random() < 0.1:
                    cluster.remove_node(dice.choice(list(cluster.worker_nodes)), allow_graceful=False)
                    cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
                    kills["raylet"] += 1
                    continue
                found = subprocess.run(["pgrep", "-f", "ray::_work"], capture_output=True, text=True).stdout.split()
                with suppress(ProcessLookupError):
                    if found:
                        os.kill(int(dice.choice(found)), signal.SIGKILL)
                        kills["worker"] += 1
            written = {path.name: path.read_text() for path in place.iterdir() if not path.name.startswith(".")}
            if written != {path.name: path.name for path in paths}:
                raise SystemExit(f"round {rounds}: {sorted(written)}")
            print(f"round {rounds}: {dict(kills)}", file=sys.stderr)
    print(
        f"| Ray, SIGKILL of {kills['worker']} workers and {kills['raylet']} raylets | {rounds} rounds of 40 items, "
        f"{kills['set aside']} items set aside and done by the next call, 0 lost, 0 different |"
    )


def row_plan(options):
    """The forecast of an evaluation beside the evaluation."""
    from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
    from rlftsim.policies.registry import load_policy
    from rlftsim.scenario.dataset import ScenarioDataset
    from rlftsim.verbs.doctor import measure_cost

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
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--model", default="demo-base")
    parser.add_argument("--split", default="training")
    parser.add_argument("--limit", type=int, default=160)
    options = parser.parse_args()
    print("| measured | result |\n|---|---|")
    for name in options.rows:
        ROWS[name](options)


if __name__ == "__main__":
    main()
