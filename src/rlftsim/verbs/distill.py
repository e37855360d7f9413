"""`rlftsim distill`: a small, fast model that decides like a large one."""

from pathlib import Path
from typing import Any, Literal

from rlftsim.policies.registry import POLICIES
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.open import to_scenarios
from rlftsim.training.config import DistillConfig
from rlftsim.training.distill import Lesson, check_teacher
from rlftsim.verbs.arguments import Data, File, Model, Processes
from rlftsim.verbs.inputs import with_checked_arguments
from rlftsim.verbs.runs import print_model
from rlftsim.verbs.training import load_start, train, with_changes, write_card


@with_checked_arguments
def distill(
    policy: Model,
    scenarios: Data,
    out: File | None = None,
    *,
    size: Literal["small"] = "small",
    epochs: float | None = None,
    max_updates: int | None = None,
    processes: Processes = None,
    limit: int | None = None,
    seed: int | None = None,
    split: str = "training",
) -> Policy:
    """Train a small, fast model to decide like a large one: on the probabilities of the large model, along rollouts.

    Example: rlftsim distill demo-tuned --data synthetic --out runs/fast

    The result is calibrated (`rlftsim finetune smart-demo --method calibrate --model OUT`), evaluated and driven among
    as any model. An interrupted run continues when the same command is repeated.

    Args:
        policy: Teacher: a run, a model folder or a registered name of a model that chooses tokens, such as SMART. In
            Python also a policy.
        scenarios: Folder of a data set, or "synthetic" for the scenarios that ship with the package. In Python also
            scenarios with their logged futures.
        out: Folder of the run: configuration, metrics, checkpoints, model. A finished run is not repeated. In Python
            left out, no file is kept.
        size: Size of the student. small: 63,200 weights, 512 of the teacher's tokens of each class.
        epochs: Passes over the training scenarios; left out, 5.
        max_updates: Updates after which the run ends early, with a model. A larger number later continues to the
            weights of a whole run.
        processes: Processes that train; left out, as many as the machine has cores for.
        limit: Number of training scenarios, from the first on; left out, all.
        seed: Seed of weights and rollouts.
        split: Split of the data set to train on.

    Returns:
        The student, ready to simulate.

    Raises:
        ConfigError: A teacher without a vocabulary, or no scenario.
        DataError: No such data set, or it has no such split.
        CheckpointError: The folder holds another run, or the run diverged.
        NotYetError: Another run is at work in the folder.
    """
    training = to_scenarios(scenarios, split, limit)
    settings: Any = with_changes(DistillConfig() if epochs is None else DistillConfig(epochs=epochs), processes, seed)
    teacher: Any
    teacher, device = load_start(policy)
    check_teacher(teacher)
    student_type: Any = POLICIES.get("compact")
    lesson = Lesson(student_type.new_student(size, teacher.vocabulary, training, settings.seed), teacher)
    card = write_card("distilled", training, policy)
    options: Any = {"max_updates": max_updates, "tracker": "tensorboard", "held_out": None, "card": card}
    train(lesson, training, out, settings, device=device, **options)
    return lesson.student


def print_student(policy: Any, *, out: Path) -> None:
    """Print where the student is.

    Args:
        policy: Trained student, which is shown by its folder.
        out: Folder of the run.
    """
    print_model(policy, out=out, seeds=None)
