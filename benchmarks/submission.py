"""Submissions: speed of packing and checking, memory, the same bytes after kills and with any number of processes.

python benchmarks/submission.py FOLDER [--archive ARCHIVE --data DATA --split SPLIT] [--kills 50] [--rows pack check ...]

Prints a Markdown table. Speeds are bytes of messages per second of CPU time of one core.
"""

import argparse
import multiprocessing
import os
import random
import resource
import signal
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch

from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.policies.registry import load_policy
from rlftsim.realism import SimulatedStates
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.submission.build import build_archive
from rlftsim.submission.check import check_archive
from rlftsim.submission.entry import Entry, describe_entry
from rlftsim.submission.messages import decode_rollouts, encode_rollouts
from rlftsim.submission.plan import Job, make_plan

METADATA = describe_entry(Entry("jane@doe.edu", "Benchmark", ("Jane",), "Doe", "Measured.", "https://doe.edu"), "0")
NUM_SHARDS = 12


def build(folder, jobs=1, delete_parts=False):
    """Bytes of an archive of constant velocity on small scenarios, which are written beside the folder."""
    place = folder.parent / "scenarios"
    if not place.exists():
        pack = ScenarioDataset("synthetic", "validation")
        small = sorted(range(len(pack)), key=lambda n: len(pack[n].simulated_indices))[: 2 * NUM_SHARDS]
        write_dataset(pack[small], place, split="testing")
    policy, data = load_policy("constant_velocity"), ScenarioDataset(place, "testing", cache_size=2)
    config = EvaluateConfig(split="testing", jobs=jobs)
    plan = make_plan(data, fingerprint_policy(policy), METADATA, config, num_shards=NUM_SHARDS, round_m=None)
    job = Job(policy, data, plan, METADATA, config, None, folder)
    return build_archive(job, is_deleting=delete_parts, show_progress=False).read_bytes()


def cpu_seconds(work, at_least=1.0):
    """CPU seconds of one call."""
    work()
    start, count = time.process_time(), 0
    while time.process_time() - start < at_least:
        work()
        count += 1
    return (time.process_time() - start) / count


def rows_of_packing(options):
    rng = np.random.default_rng(0)
    for agents in (33, 128):
        arrays = (torch.from_numpy(rng.normal(0, 1000, (32, agents, 80)).astype(np.float32)) for _ in range(4))
        states = SimulatedStates(rng.permutation(4000)[:agents], *arrays)
        data = encode_rollouts("0123456789abcdef", states)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        packing = cpu_seconds(partial(encode_rollouts, "0123456789abcdef", states))
        reading = cpu_seconds(partial(decode_rollouts, data))
        more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        yield f"packing, {agents} agents", f"{len(data) / packing / 1e6:.0f} MB/s, {packing * 1e3:.1f} ms a scenario"
        yield (
            f"reading, {agents} agents",
            f"{len(data) / reading / 1e6:.0f} MB/s; both together {more:.0f} MB of memory",
        )


def rows_of_checking(options):
    data = ScenarioDataset(options.data, options.split, cache_size=2)
    for sample in (1.0, 0.02):
        found = []

        def check(sample=sample, found=found):
            found.append(check_archive(options.archive, data, sample=sample, show_progress=False))

        seconds = cpu_seconds(check, 3.0)
        speed = f"{found[0].raw_bytes / seconds / 1e6:.0f} MB/s"
        counts = f"{found[0].num_scenarios} scenarios, compressed to {found[0].size / found[0].raw_bytes:.2f}"
        yield f"checking, sample {sample:g}", f"{speed} ({counts}, {sum(found[0].findings.counts.values())} findings)"


def rows_of_kills(options):
    whole = build(options.folder / "whole")
    start = time.monotonic()
    build(options.folder / "timed")
    seconds = time.monotonic() - start
    moments, killed, equal, strays = random.Random(1), 0, 0, 0
    for number in range(options.kills):
        folder = options.folder / f"killed-{number}"
        process = multiprocessing.get_context("fork").Process(target=build, args=(folder, 1, number % 2 == 1))
        process.start()
        time.sleep(moments.uniform(0.0, 1.1 * seconds))
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        killed += process.exitcode == -signal.SIGKILL
        equal += build(folder, 1, number % 2 == 1) == whole
        strays += sum(path.name.startswith(".") and path.name != ".lock" for path in folder.rglob("*"))
    yield (
        f"kill -9 at a random moment, {NUM_SHARDS} shards",
        f"{equal} of {options.kills} archives equal, {killed} killed before the end, {strays} stray files",
    )


def rows_of_jobs(options):
    whole = build(options.folder / "one")
    equal = [build(options.folder / f"jobs-{jobs}", jobs=jobs) == whole for jobs in (2, 4)]
    yield "2 and 4 processes", f"{sum(equal)} of 2 archives equal to that of one process"


ROWS = {"pack": rows_of_packing, "check": rows_of_checking, "kill": rows_of_kills, "jobs": rows_of_jobs}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--archive", type=Path)
    parser.add_argument("--data", default="synthetic")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=["pack", "kill", "jobs"])
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| what | measured |\n|---|---|")
    for name in options.rows:
        for what, value in ROWS[name](options):
            print(f"| {what} | {value} |")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
