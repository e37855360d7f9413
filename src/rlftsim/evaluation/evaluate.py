"""Scores of a policy on a data set: simulate every scenario, score all rollouts together, keep a row per scenario.

An interrupted evaluation is resumed by the same call, see `evaluation.resumable`.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.results import NUMBERS_VERSION, EvaluateConfig, Evaluation, Provenance, Skipped, row_of_result
from rlftsim.evaluation.resumable import ScenarioRows, open_evaluation
from rlftsim.evaluation.rollout_checks import warn_of_doubts
from rlftsim.evaluation.rollout_states import Oracle, simulate_states
from rlftsim.evaluation.scenario_source import choose_scenarios, hash_manifest, open_held_out
from rlftsim.jobs.items import iterate_positions, run_items
from rlftsim.jobs.runner import Advance, Runner, check_jobs
from rlftsim.realism import metric_by_name, scenario_log, score
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, frozen_copy, get_device, is_goal_conditioned
from rlftsim.rollout.simulate import check_sampling
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset


def evaluate(
    policy: Policy | Oracle,
    data: str | PathLike[str] | ScenarioDataset,
    out: str | PathLike[str] | None = None,
    config: EvaluateConfig = EvaluateConfig(),  # noqa: B008
    *,
    name: str | None = None,
    runner: Runner | None = None,
    show_progress: bool = True,
) -> Evaluation:
    """Score a policy on the scenarios of a data set; the result is also written to `out/<name>.parquet`.

    Interrupted in any way, the same call goes on; a finished result is read.

    Args:
        policy: Any policy, or "oracle" for the log.
        data: Folder of a data set, "synthetic", or an opened data set, whose split then counts.
        out: Folder of the result, made if missing; None keeps only the returned value.
        config: Rollouts, metric, sampling, scenarios, processes.
        name: Name of the row and of the file; None = class and fingerprint of the policy. Unfinished work of another
            policy, data set or setting under this name is replaced, with a message on stderr, but never a finished
            result.
        runner: Runner of the work in place of `config.jobs` processes, see `rlftsim.jobs.runner`.
        show_progress: False prints neither progress nor the time left.

    Raises:
        DataError: No such data set or split, scenarios without a future (a test split), a scenario with a NaN, or a
            policy that makes poses that are not finite.
        ConfigError: An impossible name, a stored result of other work, several processes for a policy on a GPU, goals
            for a policy that is not goal-conditioned, or a limit that would replace a result of more scenarios.
    """
    is_oracle = isinstance(policy, str)
    title, fingerprint = ("oracle", "oracle") if is_oracle else (type(policy).__name__, fingerprint_policy(policy))
    name = name or (title if is_oracle else f"{title}-{fingerprint[:8]}")
    if config.goals != "none" and not is_goal_conditioned(policy):
        raise ConfigError(f"evaluate.goals={config.goals} has no effect: {name} is not goal-conditioned, leave it out.")
    if config.goals != "none" and config.challenge.makes_scenes:
        raise ConfigError(f"metric {config.metric} is of drawn agents, which have no logged goals: leave goals out.")
    # Everything that can be refused is refused before anything is simulated or written.
    dataset, config = open_held_out(data, config)
    ids = choose_scenarios(dataset, config)
    check_jobs(config.jobs, get_device(policy))
    frozen: Policy | Oracle = frozen_copy(policy)
    if not isinstance(frozen, str):
        check_sampling(frozen, dataset, config.sampling)
    provenance = Provenance(
        config=replace(config, jobs=1),  # the same bytes from any number of processes
        policy=title,
        policy_fingerprint=fingerprint,
        dataset=dataset.url or str(dataset.folder.resolve()),
        manifest_sha256=hash_manifest(dataset.folder),
        sources=dataset.sources, guessed=dataset.guessed,
    )  # fmt: skip
    with open_evaluation(name, provenance, out, ids, runner=runner, jobs=config.jobs) as (rows, opened):
        if isinstance(opened, Evaluation):
            return opened
        task = partial(_evaluate_scenarios, frozen, dataset, config, rows)
        return rows.join(
            run_items(f"evaluate {name}", rows.groups, task, format=rows, lease=opened, show_progress=show_progress)
        )


def evaluation_name(model: str | PathLike[str]) -> str:
    """Name of an evaluation of a model: name of the folder, or of the run for a model in RUN/model."""
    path = Path(model)
    return path.parent.name if path.name == "model" else path.name


def describe_measurement(policy: Policy, dataset: ScenarioDataset, config: EvaluateConfig) -> dict[str, object]:
    """Plain values that identify a measurement, for the comparison with stored files of `ScenarioValues`.

    Args:
        policy: Policy that is measured; weights and settings count.
        dataset: Data set of the scenarios; the contents count, not the folder.
        config: Settings of the rollouts; scenarios and processes do not count.
    """
    return {
        "rlftsim": NUMBERS_VERSION,
        "policy": fingerprint_policy(policy),
        "data": dataset.fingerprint,
        "settings": config.what_counts(),
    }


def _evaluate_scenarios(
    policy: Policy | Oracle,
    dataset: ScenarioDataset,
    config: EvaluateConfig,
    rows: ScenarioRows,
    group: range,
    advance: Advance,
    is_stopped: Callable[[], bool],
) -> None:
    """Write the rows of a group of scenarios, and the reasons for missing rows."""
    results: list[Mapping[str, object] | Skipped] = []
    for position in iterate_positions(group, advance, is_stopped):
        scenario = dataset[position]
        try:
            scenario.check_consistency()
            scenario.check_finite_arrays()
        except DataError as error:
            # An error, not a skipped scenario: NaN would lie in a histogram's last bin and look like a bad score.
            raise DataError(
                f"{dataset.folder}: scenario {scenario.scenario_id}: {error}: convert the data set again, which leaves "
                "such scenarios out."
            ) from None
        # Without a road edge, for instance, the official metric is undefined.
        try:
            log = scenario_log(scenario, get_device(policy), challenge=config.challenge)
        except DataError as error:
            results.append(Skipped(scenario.scenario_id, str(error)))
            continue
        states = simulate_states(policy, collate([scenario]), config)
        if position == 0 and not isinstance(policy, str):  # a wrong unit or frame shows in any scenario
            warn_of_doubts(scenario, states, f"rollouts of {type(policy).__name__}")
        result = score(log, states, metric_by_name(config.metric))
        results.append(row_of_result(result, scenario, states, dataset.find_cluster(scenario.scenario_id)))
    rows.write(group, results)
