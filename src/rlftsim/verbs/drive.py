"""`rlftsim drive`: a planner among simulated traffic."""

import sys
from pathlib import Path

from rlftsim.evaluation.drive_results import format_drives
from rlftsim.jobs.progress import print_line, print_wide


def drive(
    planner: str,
    data: str,
    out: Path,
    *,
    model: str = "demo-base",
    split: str = "validation",
    traffic: str = "policy,replay",
    scenario: list[str] | None = None,
    limit: int | None = None,
    num_rollouts: int = 1,
    seed: int = 0,
    jobs: int = 1,
    film: bool = False,
) -> None:
    """Let a planner drive the ego of every scenario, and score the planner and the traffic around it.

    Writes OUT/PLANNER-TRAFFIC.parquet for each kind of traffic, a row per scenario. `rlftsim compare` reads two of
    them. An interrupted drive continues when the same command is repeated. Needs the extra env: pip install
    'rlftsim[env]'.

    Args:
        planner: Driver of the ego: replay, constant_velocity, idm, pdm, a planner of another package, or
            package.module:Class.
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        out: Folder for the results.
        model: Traffic model: a run, a model folder or a registered name.
        split: Split of the data set.
        traffic: Drivers of the other agents, separated by commas: policy, replay, constant_velocity, idm.
        scenario: Ids of the scenarios to drive; left out, all of the split.
        limit: Number of scenarios, the first ones of the data set; left out, all of them.
        num_rollouts: Episodes of each scenario; the realism of the others is defined for 32.
        seed: Seed of the traffic. The same seed gives every planner the same dice.
        jobs: Processes, each with one thread. Changes no result.
        film: Write OUT/SCENARIO.webp: the first scenario, its kinds of traffic side by side.
    """
    # Imported late: the environments need packages of an extra, and help does not.
    from rlftsim.envs import drive as driving

    # As `python -m` does, so that a planner in a file of this folder is found.
    sys.path.insert(0, "")
    config = driving.DriveConfig(
        planner=planner, data=data, split=split, model=model,
        traffic=tuple(driver.strip() for driver in traffic.split(",")),
        num_rollouts=num_rollouts, seed=seed, limit=limit,
        scenarios=tuple(scenario) if scenario else None, jobs=jobs,
    )  # fmt: skip
    results = driving.drive(config, out)
    print_wide(format_drives(*results))
    for scenario_id, reasons in results[0].missing.items():
        print_line(f"  {scenario_id}: {'; '.join(f'no {name}, {reason}' for name, reason in reasons.items())}")
    if film:
        print(driving.film(config, out))
    print(f"{out}: {planner} in {traffic}, {len(results[0].table)} scenarios.")
