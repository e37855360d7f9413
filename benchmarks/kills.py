"""Random kills: conversions, evaluations, simulations, augmented goals and submissions that are killed again and again
end with the bytes of undisturbed ones.

python benchmarks/kills.py FOLDER [--kills 100] [--backends inline processes shares ray] [--seed 0] [--scenarios 24]

Kills (SIGKILL) come at random moments: of the command itself, of one of its workers, or of all at once. The same
command is repeated until it ends with status 0; then every file is compared with that of an undisturbed run. Finished
rounds are kept in FOLDER/rounds.jsonl: the same command goes on. Prints a Markdown table; exit status 1 for a
difference.

A new process is forked from one that has imported everything, as importing torch would be nearly all of the time. For
the same reason the workers of `Processes` come from a fork server in place of "spawn"; all else is the real command.
"""

import argparse
import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager, nullcontext
from functools import cache
from multiprocessing import forkserver
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

from rlftsim.cli.main import main as rlftsim
from rlftsim.scenario import womd_pb2
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.tfrecord import write_records
from rlftsim.verbs import (  # noqa: F401 (so that forked commands need not import them)
    augment,
    convert,
    evaluate,
    failures,
    score,
    simulate,
    submit,
    synthesize,
)  # fmt: skip

NUM_FILES = 6
LIMIT_S = 400.0
ENTRY = """
account = "jane@doe.edu"
method = "Benchmark"
authors = ["Jane"]
affiliation = "Doe"
description = "Measured."
link = "https://doe.edu"
"""
SHARED_WORDS = {
    "inline": [["--jobs", "1"]],
    "processes": [["--jobs", "2"]],
    "shares": [["--jobs", "1", "--share", "1/2"], ["--jobs", "1", "--share", "2/2"]],
    "ray": [["--ray", "auto"]],
}
"""Command lines that run side by side, by back end."""
VICTIMS = {
    "inline": ["command"],
    "processes": ["command", "worker", "all"],
    "shares": ["command", "all"],
    "ray": ["command", "worker", "all"],
}
TIMED = ("submission.report.json", "submission.report.md", "environment.json")
"""Files that hold the duration of the run, or the words of the command."""
COMMANDS = ["convert", "evaluate", "simulate", "augment", "score --explain", "submit build"]
"""Those that are killed unless others are named; `failures` has two parts, which shares do one after the other."""


def write_sources(folder, num_scenarios):
    """Tfrecords, a data set and the description of an entry."""
    if (folder / "entry.toml").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "womd").mkdir(parents=True)
    for number in range(NUM_FILES):
        messages = [message(f"{number}-{k}").SerializeToString() for k in range(num_scenarios // 4)]
        write_records(folder / "womd" / f"training.tfrecord-{number:05d}-of-{NUM_FILES:05d}", messages)
    pack = ScenarioDataset("synthetic", "validation")
    write_dataset(list(pack[:num_scenarios]), folder / "set", split="validation")
    words = [*commands(folder, folder / "rollouts")["simulate"], "--jobs", "1"]
    subprocess.run([sys.executable, "-m", "rlftsim", *words], check=True)
    (folder / "entry.toml").write_text(ENTRY)


def message(scenario_id):
    """Two vehicles on a straight road."""
    scenario = womd_pb2.Scenario(scenario_id=scenario_id, sdc_track_index=1, current_time_index=10)
    scenario.timestamps_seconds.extend(0.1 * step for step in range(91))
    for k in range(2):
        track = scenario.tracks.add(id=100 + k, object_type=1)
        for step in range(91):
            track.states.add(
                center_x=10.0 * k + 0.1 * (1 + k) * step,
                length=4.5,
                width=2.0,
                height=1.5,
                velocity_x=1.0 + k,
                valid=True,
            )
    scenario.tracks_to_predict.add(track_index=0)
    edge = scenario.map_features.add(id=8).road_edge
    edge.type = womd_pb2.RoadEdge.TYPE_ROAD_EDGE_BOUNDARY
    for x in (-100.0, 200.0):
        edge.polyline.add(x=x, y=-4.0)
    return scenario


def commands(sources, out):
    """Words of each command, without those of the back end."""
    return {
        "convert": ["convert", sources / "womd", out],
        "evaluate": [
            "evaluate", "constant_velocity", "--data", sources / "set", "--out", out, "--num-rollouts", "2",
            "--device", "cpu",
        ],
        "simulate": [
            "simulate", "constant_velocity", "--data", sources / "set", "--out", out, "--num-rollouts", "2",
            "--device", "cpu",
        ],
        "augment": [
            "augment", "constant_velocity", "--data", sources / "set", "--split", "validation", "--out", out,
            "--num-rollouts", "2", "--top-k", "None", "--scenarios-per-part", "2", "--device", "cpu",
        ],
        "score --explain": [
            "score", sources / "rollouts", "--data", sources / "set", "--name", "constant_velocity", "--out", out,
            "--explain", out / "pages",
        ],
        "submit build": [
            "submit", "build", "constant_velocity", "--data", sources / "set", "--split", "validation", "--out", out,
            "--config", sources / "entry.toml", "--num-shards", "6", "--device", "cpu", "--i-comply",
        ],
        "failures": [
            "failures", "constant_velocity", "--data", sources / "set", "--limit", "2", "--particles", "2", "--budget",
            "8000", "--out", out,
        ],
    }  # fmt: skip


def start(words, log):
    """Process id of a command that runs in a fork of this process."""
    start_fork_server()  # again, where a command that was killed while it asked for a worker has ended it
    pid = os.fork()
    if pid:
        return pid
    status = 70
    try:
        os.setsid()
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(file, 1)
        os.dup2(file, 2)
        spawn = multiprocessing.get_context("forkserver")
        multiprocessing.get_context = lambda method=None: spawn
        status = rlftsim([str(word) for word in words])
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def start_fork_server():
    """Start the server that workers are forked from, for all commands that this process forks."""
    forkserver.set_forkserver_preload(
        [
            *(
                f"rlftsim.verbs.{name}"
                for name in ("augment", "convert", "evaluate", "failures", "score", "simulate", "submit", "synthesize")
            ),
        ]
    )
    forkserver.ensure_running()
    forkserver._forkserver.ensure_running = lambda: None  # a forked command finds it by its address


@contextmanager
def ray_cluster():
    """Two raylets of one core each, in a process of their own: one with Ray's threads is not forked."""
    import rlftsim.jobs.ray  # noqa: F401 (so that forked commands need not import it)

    script = """
import sys
from ray.cluster_utils import Cluster
small = {"object_store_memory": 80_000_000, "include_dashboard": False}
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **small})
for _ in range(2):
    cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
print(cluster.address, flush=True)
sys.stdin.read()
cluster.shutdown()
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1] / "src")}
    cluster = subprocess.Popen(
        [sys.executable, "-c", script], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    SHARED_WORDS["ray"] = [["--ray", cluster.stdout.readline().strip()]]
    try:
        yield
    finally:
        cluster.communicate()


def ray_workers():
    """Process ids of the workers of a Ray cluster that do an item now."""
    return [int(pid) for pid in subprocess.run(["pgrep", "-f", "ray::_work"], capture_output=True).stdout.split()]


def workers():
    """Process ids of the workers that live now."""
    server, found = forkserver._forkserver._forkserver_pid, []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = path.read_text().rpartition(") ")[2].split()[:2]
        except OSError:  # it has just ended
            continue
        if int(parent) == server and state != "Z":
            found.append(int(path.parent.name))
    return found


def wait_for_workers():
    """Return when all workers have ended: those of a killed command end, and clear up, by themselves."""
    latest = time.monotonic() + 60.0
    while workers() and time.monotonic() < latest:
        time.sleep(0.05)


def kill(pid):
    """End a process; False if it had ended."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def tree(folder):
    """Bytes of every file by name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in TIMED
    }


def is_done(folder):
    """True if the result is there."""
    if any((folder / name).exists() for name in ("rollouts.json", "config.json", "failures.parquet")):
        return not any(folder.glob(".lock*"))
    return any((folder / name).exists() for name in ("manifest.json", "submission.tar.gz", "constant_velocity.parquet"))


def undisturbed(words, backend, out, log):
    """Files and seconds of a command that nothing happens to."""
    shutil.rmtree(out, ignore_errors=True)
    began = time.monotonic()
    for more in SHARED_WORDS[backend]:
        _, status = os.waitpid(start([*words, *more], log), 0)
        if status:
            raise SystemExit(f"{words[0]} fails undisturbed, see {log}")
    return tree(out), time.monotonic() - began


def disturbed(words, backend, out, log, seconds, dice):
    """Repeat a command until it ends well, and kill it meanwhile; returns the kills by victim."""
    shutil.rmtree(out, ignore_errors=True)
    kills = Counter()
    lines = [[*words, *more] for more in SHARED_WORDS[backend]]
    while lines:
        kills += end_with_kills(lines, backend, log, seconds, dice)
        # Shares end well while others are at work; if the last one was killed, joining is left.
        lines = [] if is_done(out) else [["join", *words]]
    return kills


def end_with_kills(lines, backend, log, seconds, dice):
    """Run commands side by side, each again until its status is 0; returns the kills by victim."""
    kills, waiting, running = Counter(), list(lines), {}
    latest = time.monotonic() + LIMIT_S
    while waiting or running:
        if time.monotonic() > latest:
            raise SystemExit(f"{lines[0]} does not end, see {log}")
        running |= {start(line, log): line for line in waiting}
        waiting = []
        moment = time.monotonic() + dice.uniform(0.0, 1.2 * seconds)
        while running and time.monotonic() < moment:
            time.sleep(0.005)
            for pid in list(running):
                ended, status = os.waitpid(pid, os.WNOHANG)
                if ended:
                    line = running.pop(pid)
                    waiting += [line] if status else []
        if not running:
            continue
        victim, crew = dice.choice(VICTIMS[backend]), ray_workers() if backend == "ray" else workers()
        if victim == "worker" and crew:
            kills[victim] += kill(dice.choice(crew))
            continue
        if victim == "all":
            for worker in crew:
                kill(worker)
        victim = "all" if victim == "all" else "command"
        has_killed = False
        for pid in list(running) if victim == "all" else [dice.choice(list(running))]:
            line = running.pop(pid)
            os.kill(pid, signal.SIGKILL)
            _, status = os.waitpid(pid, 0)
            has_killed |= os.WIFSIGNALED(status)
            waiting += [line] if status else []
        kills[victim] += has_killed
    return kills


def measure(options):
    """Do rounds until each back end has had its kills; returns the rounds."""
    sources, out, log, kept = (options.folder / name for name in ("sources", "out", "log.txt", "rounds.jsonl"))
    write_sources(sources, options.scenarios)
    start_fork_server()
    rounds = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    inline = cache(lambda name: undisturbed(commands(sources, out)[name], "inline", out, log))
    for backend in options.backends:
        chosen = {
            name: words for name, words in commands(sources, out).items() if name in (options.commands or COMMANDS)
        }
        for name, words in chosen.items():
            wanted = -(-options.kills // len(chosen))
            own = [one for one in rounds if (one["backend"], one["command"]) == (backend, name)]
            had, number = sum(sum(one["kills"].values()) for one in own), len(own)
            if had >= wanted:
                continue
            expected, seconds = inline(name)
            if backend != "inline":
                _, seconds = undisturbed(words, backend, out, log)
            while had < wanted:
                dice = random.Random(f"{options.seed} {backend} {name} {number}")
                kills = disturbed(words, backend, out, log, seconds, dice)
                wait_for_workers()
                found = tree(out)
                different = sorted(file for file in {*found, *expected} if found.get(file) != expected.get(file))
                rounds.append({"backend": backend, "command": name, "kills": dict(kills), "different": different})
                with kept.open("a") as file:
                    file.write(json.dumps(rounds[-1]) + "\n")
                had, number = had + sum(kills.values()), number + 1
                differing = f", other bytes in {', '.join(different)}" if different else ""
                print(f"{backend}, {name}: {had} kills of {wanted}{differing}", file=sys.stderr)
    return rounds


def table(rounds):
    """Rounds as Markdown."""
    lines = [
        "| back end | command | kills of the command | of a worker | of all | rounds | rounds with another byte |",
        "|---|---|--:|--:|--:|--:|--:|",
    ]
    for backend, name in dict.fromkeys((one["backend"], one["command"]) for one in rounds):
        own = [one for one in rounds if (one["backend"], one["command"]) == (backend, name)]
        kills = sum((Counter(one["kills"]) for one in own), Counter())
        bad = sum(bool(one["different"]) for one in own)
        lines.append(
            f"| {backend} | {name} | {kills['command']} | {kills['worker']} | {kills['all']} | {len(own)} | {bad} |"
        )
    return "\n".join(lines)


def main():
    """Kill, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=100, help="of each back end")
    parser.add_argument("--backends", nargs="+", choices=list(SHARED_WORDS), default=["inline", "processes", "shares"])
    parser.add_argument("--commands", nargs="+", help="names; left out, all but failures")
    parser.add_argument("--scenarios", type=int, default=24, help="of the data set")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.folder = options.folder.resolve()
    with ray_cluster() if "ray" in options.backends else nullcontext():
        rounds = measure(options)
    print(table(rounds))
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(
        f"CPU of the commands without their workers: {sum(u.ru_utime + u.ru_stime for u in used):.0f} s",
        file=sys.stderr,
    )
    return int(any(one["different"] for one in rounds))


if __name__ == "__main__":
    sys.exit(main())
