"""`rlftsim drive`: a planner among simulated traffic."""

from pathlib import Path

from rlftsim.evaluation.drive_results import FAILED, DriveResult, format_drives, format_worst, rank_scenarios
from rlftsim.jobs.progress import print_line, print_wide

MAX_WORST = 5
"""Scenarios, and errors of a planner, that are printed."""


def drive(
    planner: str,
    data: str,
    out: Path,
    *,
    model: str = "demo-base",
    split: str = "validation",
    traffic: str = "policy,replay",
    entries: str | None = None,
    scenario: list[str] | None = None,
    limit: int | None = None,
    num_rollouts: int = 1,
    seed: int = 0,
    seconds: float = 8.0,
    jobs: int = 1,
    film: str | None = None,
) -> int:
    """Let a planner drive the ego of every scenario, and score the planner and the traffic around it.

    Writes OUT/PLANNER-TRAFFIC.parquet for each type of traffic, a row per scenario. `rlftsim compare` reads two of
    them. An interrupted drive continues when the same command is repeated. Needs the extra env: pip install
    'rlftsim[env]'.

    Args:
        planner: Driver of the ego: replay, constant_velocity, idm, pdm, a planner of another package, or
            package.module:Class, with options as in "careful:Careful(headway=1.0)". A planner that fails in a scenario
            has no scores there.
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        out: Folder for the results.
        model: Traffic model: a run, a model folder or a registered name.
        split: Split of the data set.
        traffic: Drivers of the other agents, separated by commas: policy, replay, constant_velocity, idm, or
            sumo for data made by `rlftsim synthesize --keep-worlds`.
        entries: Who enters traffic "policy" where lanes cross the border of a region around the ego: "fitted",
            "fixed-rate", "none", a file that `rlftsim entries fit` wrote, or a name of an installed plug-in. Agents
            beyond the border leave. Left out, the agents of "now" are there all the time.
        scenario: Ids of the scenarios to drive; left out, all of the split.
        limit: Number of scenarios, the first ones of the data set; left out, all of them.
        num_rollouts: Episodes of each scenario; the realism of the others is defined for 32.
        seed: Seed of the traffic. The same seed gives every planner the same dice.
        seconds: Length of the episodes. A longer one ends where the map does, and has fewer scores where the log ends.
        jobs: Processes, each with one thread. Changes no result.
        film: Scenarios to film, the types of traffic side by side: first, worst:N for the N lowest scores such as
            worst:5, or failures for collisions at fault and driving off the road. Written to OUT/SCENARIO.webp.

    Returns:
        Exit status: 1 if the planner failed in a scenario, which then has no scores.
    """
    # Imported late: the environments need packages of an extra, and help does not.
    from rlftsim.envs import drive as driving
    from rlftsim.envs.drive_films import choose_films, write_film

    config = driving.DriveConfig(
        planner=planner, data=data, split=split, model=model,
        traffic=tuple(driver.strip() for driver in traffic.split(",")),
        num_rollouts=num_rollouts, seed=seed, seconds=seconds, entries=entries, limit=limit,
        scenarios=tuple(scenario) if scenario else None, jobs=jobs, film=film,
    )  # fmt: skip
    results = driving.drive(config, out)
    worst = [scenario for scenario in rank_scenarios(results) if scenario.score < 1.0][:MAX_WORST]
    print_wide(format_drives(*results), *([format_worst(worst)] if worst else []))
    for result in results:
        for line in describe_missing(result):
            print_line(line)
    for result in results:
        failures, count = result.failures, len(result.table)
        for message in list(failures.values())[:MAX_WORST]:
            print_line(message)
        if failures:
            print_line(f"{result.name}: failed in {len(failures)} of {count} scenarios, which the means leave out.")
    for scenario_id in choose_films(results, film) if film is not None else ():
        print_line(write_film(config, scenario_id, out))
    print_line(f"{out}: {planner} in {traffic}, {len(results[0].table)} scenarios.")
    return int(any(result.failures for result in results))


def describe_missing(result: DriveResult) -> list[str]:
    """A line for each score that scenarios cannot give, with the reason and the first of the scenarios.

    Args:
        result: Scores of a planner in a type of traffic.
    """
    scenarios: dict[str, list[str]] = {}
    for scenario_id, reasons in result.missing.items():
        for name, reason in reasons.items():
            if name != FAILED:
                scenarios.setdefault(f"no {name}, {reason}", []).append(scenario_id)
    lines = []
    for missing, ids in scenarios.items():
        others = f" and {len(ids) - MAX_WORST} more" if len(ids) > MAX_WORST else ""
        lines.append(f"  {result.name}: {missing}: {', '.join(ids[:MAX_WORST])}{others}")
    return lines
