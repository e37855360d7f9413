"""`rlftsim failures`: how often a planner fails in realistic traffic, and the failures as films."""

from pathlib import Path
from typing import Literal

from rlftsim.errors import whole_number
from rlftsim.jobs.progress import log, print_line, print_wide
from rlftsim.jobs.runner import Work, choose_runner


def failures(
    planner: str,
    data: str,
    out: Path,
    *,
    model: str = "demo-base",
    traffic: Literal["policy", "replay", "constant_velocity", "idm"] = "policy",
    event: str = "at_fault_collision",
    budget: str = "10m",
    particles: int = 8,
    split: str = "validation",
    scenario: list[str] | None = None,
    limit: int | None = None,
    seed: int = 0,
    films: int = 12,
    jobs: int = 1,
    work: Work = Work(),  # noqa: B008
) -> None:
    """Estimate how often a planner causes an event in realistic traffic, and show how.

    Splitting drives the planner again and again from the moments at which it came nearest to the event, with new dice:
    the estimates are unbiased, and every failure is a sample of the traffic model. Writes OUT/failures.parquet, a row
    per failing episode, and OUT/index.html. An interrupted call continues when the same command is repeated, and a
    larger budget adds to a smaller, but fewer steps or scenarios never replace a result. With --share the
    first call does the pilot, and the same call again the rest. Needs the extra env: pip install 'rlftsim[env]'.

    Args:
        planner: Driver of the ego: constant_velocity, idm, pdm, a planner of another package, or
            package.module:Class. One with memory is copied: copy(), or a deep copy.
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        out: Folder for the results.
        model: Traffic model: a run, a model folder or a registered name.
        traffic: Drivers of the other agents: policy, replay, constant_velocity or idm.
        event: Event to count: at_fault_collision, collision, off_road, red_light or hard_braking.
        budget: Time of one core, such as 90s, 10m or 2h, at 600 steps a second, whatever this machine does; or a
            number of steps. The same budget gives the same results on any machine.
        particles: Undisturbed episodes that each estimate begins with.
        split: Split of the data set.
        scenario: Ids of the scenarios to drive; left out, all of the split.
        limit: Number of scenarios, the first ones of the data set; left out, all of them.
        seed: Seed of the traffic.
        films: Largest number of failures on the page.
        jobs: Processes, each with one thread. Changes no result.
        work: Machines that share the work.
    """
    # Imported late: the environments need packages of an extra, and help does not.
    from rlftsim.envs.failure_page import format_study, write_failure_page
    from rlftsim.envs.failure_run import run_study
    from rlftsim.envs.failure_study import STEPS_PER_S, StudyConfig, parse_budget

    whole_number("jobs", jobs, 1)
    whole_number("films", films, 0)
    config = StudyConfig(
        planner=planner, data=data, split=split, model=model, traffic=traffic, event=event, particles=particles,
        seed=seed, scenarios=tuple(scenario) if scenario else None, limit=limit,
    )  # fmt: skip
    steps = parse_budget(budget)
    log.info(f"a budget of {steps} steps, {steps / STEPS_PER_S / 60:.3g} minutes of a core at {STEPS_PER_S} a second")
    study = run_study(config, out, steps, lambda count: work.runner(jobs, work.on_error) or choose_runner(jobs, count))
    print_wide(format_study(study))
    for problem in study.problems.values():
        print_line(f"left out: {problem}")
    print_line(study.describe_total())
    page = out / "index.html"
    write_failure_page(study, page, limit=films)
    print_line(page)


def show_failure(folder: Path, number: int, *, film: Path | None = None) -> None:
    """Drive a failing episode again, bit for bit, and describe it.

    Args:
        folder: Folder that `rlftsim failures` wrote.
        number: Row of FOLDER/failures.parquet, from 0 on.
        film: File of a film to write, .mp4 or .webp.
    """
    from rlftsim.envs.failure_page import build_exhibit
    from rlftsim.envs.failure_study import read_failure
    from rlftsim.envs.result import Result

    config, failure = read_failure(folder, number)
    exhibit = build_exhibit(config, number, failure)
    for name, text in exhibit.facts().items():
        print_line(f"{name}: {text}")
    if film is not None:
        Result(exhibit.record).film(film, title=config.planner)
        print_line(film)
