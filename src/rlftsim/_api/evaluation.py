"""Public `evaluate`: a policy's scores on a data set."""

import contextlib
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Literal

from rlftsim._api.loop import sampling_of
from rlftsim._api.sources import load_policy, policy_of
from rlftsim.errors import ConfigError
from rlftsim.evaluation import evaluate as evaluation
from rlftsim.evaluation.compare import Comparison
from rlftsim.evaluation.compare import compare as compare_evaluations
from rlftsim.evaluation.results import EvaluateConfig, Evaluation
from rlftsim.jobs.buckets import validate_folder
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, Sampling
from rlftsim.scenario.any_form import AnyScenarios, Name, to_scenarios
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset

ORACLE = "oracle"


def evaluate(
    policy: Policy | Name,
    data: AnyScenarios,
    *,
    name: str | None = None,
    out: Name | None = None,
    num_rollouts: int = 32,
    seed: int = 0,
    limit: int | None = None,
    metric: str | int = "2025",
    sampling: Sampling | None = None,
    goals: Literal["none", "logged"] = "none",
    jobs: int = 1,
) -> Evaluation:
    """Score a policy with the realism meta-metric: simulate every scenario, keep every scenario's numbers.

    The result equals that of `rlftsim evaluate` on the same data.

    Args:
        policy: a policy, a name for `load_policy`, or "oracle" for the log itself (the ceiling).
        data: a data set or one of its splits (`load_dataset`), or scenarios in any other form; a name of a data set
            stands for its split validation.
        name: of the row in tables and of the file; left out, the model's name, or the class of the policy with the
            beginning of its fingerprint.
        out: folder that keeps the result as `NAME.parquet`; an interrupted evaluation goes on there. None keeps none.
        num_rollouts: rollouts per scenario; the official metric is defined for 32.
        seed: of all randomness.
        limit: only the first so many scenarios.
        metric: year of the challenge.
        sampling: temperature and truncation; None samples the whole distribution.
        goals: "logged" gives evaluated agents the end of their log as a goal, for goal-conditioned policies.
        jobs: processes, on CPUs only.

    Returns:
        One row of scores per scenario; see `compare` for two of them.

    Raises:
        ConfigError: a setting out of range, or goals for a policy that is not goal-conditioned.
        DataError: no such data set or split, no scenario with a logged future, an unsound scenario, or a pose of the
            policy that is not finite.
    """
    # 1. Settings first: they are refused before anything is loaded.
    sampling = sampling_of(sampling)
    config = EvaluateConfig(
        num_rollouts=num_rollouts, seed=seed, limit=limit, metric=str(metric), goals=goals, jobs=jobs,
        temperature=sampling.temperature, top_k=sampling.top_k,
    )  # fmt: skip
    # 2. The policy and its name.
    if isinstance(policy, str | os.PathLike):
        name = name or evaluation.evaluation_name(policy)
        subject: Policy | Literal["oracle"] = ORACLE if policy == ORACLE else load_policy(policy)
    else:
        subject = policy_of(policy)
        name = name or f"{type(policy).__name__}-{fingerprint_policy(policy)[:8]}"
    # 3. Scores.
    scenarios = to_scenarios(data)
    with contextlib.ExitStack() as stack:
        temporary = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rlftsim-")))
        if isinstance(scenarios, ScenarioDataset):
            folder, split = scenarios.folder, scenarios.split
        else:
            # The evaluation reads scenarios by name, in other processes too, so those of a list get a data set.
            folder, split = temporary / "scenarios", None
            write_dataset((scenarios[position] for position in range(len(scenarios))), folder)
        # Without `out` the results are in memory alone when the folder is gone.
        out = validate_folder(out or temporary / "results")
        return evaluation.evaluate(subject, folder, out, replace(config, split=split), name=name)


def compare(a: Evaluation | Name, b: Evaluation | Name, *, alpha: float = 0.05) -> Comparison:
    """Paired comparison, b against a.

    Args:
        a: the reference, e.g. the base model: an evaluation, or the file of one.
        b: the other one, e.g. the fine-tuned model.
        alpha: probability of calling a difference that is none.

    Raises:
        ConfigError: alpha is no probability, or something else than an evaluation.
        DataError: other metric or number of rollouts, no scenario in common, or no such file.
    """
    read = [Evaluation.read(one) if isinstance(one, str | os.PathLike) else one for one in (a, b)]
    for one in read:
        if not isinstance(one, Evaluation):
            raise ConfigError(f"{type(one).__name__}: not an evaluation: hand over one of rs.evaluate, or its file.")
    return compare_evaluations(*read, alpha=alpha)
