"""Processor time of converting a scenario of Argoverse 2, and of WOMD beside it, by part.

python benchmarks/convert_speed.py AV2_FOLDER [WOMD_TFRECORD] [--repeats 30]
"""

import argparse
import cProfile
import pstats
import tempfile
import time
from pathlib import Path

from rlftsim.scenario.av2 import Av2Source, find_files, read_scenario
from rlftsim.scenario.shards import ShardWriter
from rlftsim.scenario.womd import read_scenarios


def measure(name, read, repeats):
    """Mean milliseconds to read and to write a scenario, and its kilobytes."""
    seconds = {"read": 0.0, "write": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        writer, count = ShardWriter(Path(folder) / "x.arrow"), 0
        for _ in range(repeats + 1):
            start = time.process_time()
            scenarios = read()
            middle = time.process_time()
            for scenario in scenarios:
                writer.add(scenario, "unknown")
            if count:  # the first time imports
                seconds["read"] += middle - start
                seconds["write"] += time.process_time() - middle
            count += len(scenarios)
        writer.close()
        size = writer.path.stat().st_size / count / 1000
    each = {part: 1000 * value / repeats / len(scenarios) for part, value in seconds.items()}
    rate = 1000 / sum(each.values())
    print(
        f"{name}: read {each['read']:.1f} ms, write {each['write']:.1f} ms, {rate:.1f} a second and core, {size:.1f} kB"
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("av2", type=Path)
    parser.add_argument("womd", type=Path, nargs="?")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    file, source = find_files(options.av2)[0], Av2Source()
    measure("av2", lambda: [scenario for scenario, _ in read_scenario(file, source)], options.repeats)
    if options.womd:
        measure("womd", lambda: list(read_scenarios(options.womd)), options.repeats)
    if options.profile:
        profile = cProfile.Profile()
        profile.runcall(lambda: [list(read_scenario(file, source)) for _ in range(5)])
        pstats.Stats(profile).sort_stats("tottime").print_stats(14)


if __name__ == "__main__":
    main()
