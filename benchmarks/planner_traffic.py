"""Planners in several kinds of traffic on held-out scenarios: does the traffic change the verdict?

    python benchmarks/planner_traffic.py --data synthetic --out drives/synthetic
    python benchmarks/planner_traffic.py --data data/womd --out drives/womd [--model runs/tuned]

Each planner and kind of traffic is a file of OUT: a run that is stopped goes on behind the last whole one. Prints, as
Markdown, the scores and the paired differences between traffics, with 95 % intervals over scenarios. One rollout each.
"""

import argparse
from pathlib import Path

from rlftsim.envs.drive import drive
from rlftsim.envs.drive_scenario import DriveConfig
from rlftsim.evaluation.drive_results import DriveResult, compare_drives
from rlftsim.statistics import mean_interval

PLANNERS = ("idm", "pdm", "constant_velocity", "replay")
TRAFFICS = ("idm", "policy", "replay", "constant_velocity")
COLUMNS = ("nuplan_style", "no_at_fault_collision", "progress", "others_realism")


def report(folder: Path) -> None:
    """Print the scores, and nuPlan-style scores in each traffic minus those in the model's, of the files in a folder."""
    found = {
        (planner, traffic): DriveResult.read(path)
        for planner in PLANNERS
        for traffic in TRAFFICS
        if (path := folder / f"{planner}-{traffic}.parquet").exists()
    }
    print(f"| planner | traffic | scenarios | {' | '.join(COLUMNS)} |\n|---|---|--:|{'--:|' * len(COLUMNS)}")
    for (planner, traffic), result in found.items():
        means = [mean_interval(result.values(column)) for column in COLUMNS]
        cells = " | ".join(f"{one.mean:.3f} ± {one.standard_error:.3f}" for one in means)
        print(f"| {planner} | {traffic} | {len(result.values(COLUMNS[0]))} | {cells} |")
    print("\n| planner | nuplan_style in traffic | minus that in policy traffic |\n|---|---|---|")
    for (planner, traffic), result in found.items():
        if traffic != "policy" and (planner, "policy") in found:
            differences = compare_drives(found[planner, "policy"], result)
            (difference,) = (one for one in differences if one.column == "nuplan_style")
            print(f"| {planner} | {traffic} | {difference.verdict} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="synthetic")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--model", default="demo-base")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    for planner in PLANNERS:
        for traffic in TRAFFICS:
            config = DriveConfig(
                planner=planner, data=options.data, split=options.split, model=options.model, traffic=(traffic,),
                limit=options.limit,
            )  # fmt: skip
            if not (options.out / f"{planner}-{traffic}.parquet").exists():
                drive(config, options.out)
    report(options.out)


if __name__ == "__main__":
    main()
