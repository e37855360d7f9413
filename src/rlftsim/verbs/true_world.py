"""`rlftsim experiment true-world`: are planners judged rightly in simulated traffic?"""

from pathlib import Path

from rlftsim.errors import ConfigError, whole_number
from rlftsim.jobs.progress import print_line
from rlftsim.jobs.runner import Work, choose_runner

ALL = "all"


def true_world(
    data: str,
    *,
    models: str = "demo-base,demo-tuned",
    planners: str = ALL,
    out: Path = Path("runs/true-world"),
    shifts: tuple[float, ...] = (0.1,),
    limit: int | None = None,
    conflict_windows: int = 0,
    num_rollouts: int = 1,
    films: int = 0,
    seed: int = 0,
    jobs: int = 1,
    work: Work = Work(),  # noqa: B008
) -> None:
    """Score planners in simulated traffic and in the world that made the logs, where all others react as they do.

    Every window is driven in the world itself (SUMO), in the same world without reaction (ghost), in replay, constant
    velocity, IDM and each model. Writes OUT/rows.parquet, a row per episode, OUT/report.md and OUT/figure.png, with
    intervals over street networks. Interrupted, the same command goes on where it was; with a smaller --limit it
    reports on what has been driven. Needs the extras env and synthetic.

    Args:
        data: Folder of a data set made by `rlftsim synthesize --keep-worlds`, unseen by the models.
        models: Traffic models separated by commas: runs, model folders or registered names, also as NAME=MODEL, and
            with a temperature as in demo-tuned@1.3.
        planners: Names separated by commas: log, constant_velocity, idm, pdm, timid, rush, late_braker, hard_braker, or
            package.module:Class; all stands for these eight.
        out: Folder for the results.
        shifts: Meters by which the world's drivers see the ego ahead of its place: the floor of every error.
        limit: Number of windows, one of each network in turn; left out, all of them.
        conflict_windows: Windows with a conflict of vehicles to drive, of those after the limit if it has too few.
        num_rollouts: Rollouts of each episode in traffic with a model, IDM included, whose pedestrians a model drives.
        films: Windows to film for OUT/films.html, those in which the last of the models errs most about a planner's
            score: the world, that model, replay and IDM side by side. Driven again by each call, in a single process.
        seed: Seed of the traffic.
        jobs: Processes, each with one thread. Changes no result.
        work: Machines that share the work.
    """
    # Imported late: the environments need packages of an extra, and help does not.
    from rlftsim.envs.true_world import GHOST, RULES, TRUTH, TrueWorldConfig, drive_true_world, shift_truth
    from rlftsim.envs.true_world_episode import PLANNERS
    from rlftsim.envs.true_world_films import write_films
    from rlftsim.envs.true_world_traffic import Surroundings
    from rlftsim.experiments.true_world import REFERENCES, SCORE, arrange_episodes, find_largest_errors, write_report

    learned = list(map(Surroundings.parse, filter(None, models.split(","))))
    if whole_number("films", films, 0) and not learned:
        raise ConfigError("films show where a model errs: name one with --models.")
    chosen = tuple(PLANNERS) if planners == ALL else tuple(name.strip() for name in planners.split(","))
    surroundings = (TRUTH, GHOST, *RULES, *map(shift_truth, shifts), *learned)
    config = TrueWorldConfig(data, surroundings, chosen, seed, limit, conflict_windows, num_rollouts)
    runner = work.runner(jobs, work.on_error) or choose_runner(jobs, len(config.trips))
    table = drive_true_world(config, out, runner)
    episodes = arrange_episodes(table.to_pylist(), TRUTH.name)
    for line in write_report(episodes, [s.name for s in learned], out, ghost=GHOST.name):
        print_line(f"* {line}")
    if films:
        choices = find_largest_errors(episodes, SCORE, learned[-1].name, films)
        write_films(config, choices, (TRUTH.name, learned[-1].name, *REFERENCES), out / "films.html")
        print_line(out / "films.html")
    print_line(out / "report.md")
