"""`rlftsim synthesize`: synthetic scenarios made with SUMO."""

from pathlib import Path

from rlftsim.jobs.progress import print_line
from rlftsim.jobs.runner import Work
from rlftsim.scenario.synthetic.generate import generate
from rlftsim.scenario.types import count_steps


def synthesize(
    destination: Path,
    *,
    num_scenarios: int = 200,
    seed: int = 0,
    seconds: float = 9.1,
    jobs: int = 1,
    keep_worlds: bool = False,
    work: Work = Work(),  # noqa: B008
) -> None:
    """Make synthetic scenarios with SUMO (pip install "rlftsim[synthetic]").

    The same arguments and SUMO version give the same scenarios. The pack that ships with the package was made
    this way; its manifest holds the arguments.

    Args:
        destination: Folder of the data set.
        num_scenarios: Scenarios in training and validation together, 4 : 1. No street network is in both.
        seed: Seed of streets and traffic.
        seconds: Length of each scenario, 9.1 to 120; the first second of it is the history. Long ones have no freeways,
            which all cars leave in 20 s.
        jobs: Processes, each with a street network of its own. Changes no result.
        keep_worlds: Write what SUMO needs to run each network again, for `rlftsim drive --traffic sumo`. Boxes are
            then made from the past alone, so the scenarios differ from those without it.
        work: Machines that share the work.
    """
    manifest = generate(
        destination, num_scenarios=num_scenarios, seed=seed, num_steps=count_steps(seconds), jobs=jobs,
        runner=work.runner(jobs, work.on_error), keep_worlds=keep_worlds,
    )  # fmt: skip
    print_line(f"{destination}: {sum(shard.num_rows for shard in manifest.shards)} scenarios.")
