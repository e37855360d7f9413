"""`rlftsim augment`: further goals for a whole data set."""

from pathlib import Path

from rlftsim.jobs.progress import print_line
from rlftsim.jobs.runner import Work, check_jobs, choose_runner
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.policy import get_device
from rlftsim.scenario.open import open_dataset
from rlftsim.training.augment import augment_goals
from rlftsim.training.config import AugmentConfig
from rlftsim.verbs.arguments import Device


def augment(
    model: str,
    data: str,
    out: Path,
    *,
    split: str = "training",
    device: Device = "auto",
    jobs: int = 1,
    config: AugmentConfig = AugmentConfig(),  # noqa: B008
    work: Work = Work(),  # noqa: B008
) -> None:
    """Sample further goals for goal-conditioned fine-tuning: the endpoints of the most realistic of a model's rollouts.

    Writes a folder of Parquet files: scenario_id, object_id, x, y in the world frame. `rlftsim finetune` reads it with
    --finetune.goals.augmented FOLDER. An interrupted run continues when the same command is repeated.

    Args:
        model: Model to sample from, such as the one that fine-tuning starts from: a run, a model folder or a registered
            name.
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        out: Folder for the goals.
        split: Split of the data set.
        device: Device of the model; auto: the GPU if torch has one; several processes (--jobs) need cpu.
        jobs: Processes, each with one thread. Changes no result.
        config: Settings of the sampling.
        work: Machines that share the work.
    """
    # The data set is opened first: a wrong path is found before weights are loaded.
    scenarios = open_dataset(data, split)
    policy = load_policy(model, device)
    check_jobs(jobs, get_device(policy), "jobs")
    runner = work.runner(jobs, work.on_error) or choose_runner(jobs, len(scenarios))
    count = augment_goals(policy, scenarios, out, config, runner=runner)
    print_line(f"{out}: goals for {count} scenarios.")
