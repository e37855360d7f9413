"""Scores of a policy on a data set: simulate every scenario, score all its rollouts together, keep every scenario's numbers.

A run that was interrupted goes on with what is missing, see `experiments.parts`.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.evaluation import EvaluateConfig, Evaluation, Provenance, Skipped, row_of_result
from rlftsim.experiments.parts import ResumableEvaluation
from rlftsim.goals.recorded import recorded_goals
from rlftsim.goals.types import Goals
from rlftsim.realism import SimulatedStates, build_scenario_log, metric_by_name, score
from rlftsim.realism.from_rollouts import logged_states, states_of_rollouts
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, device_of, sees_goals
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.dataset import MANIFEST, ScenarioDataset
from rlftsim.scenario.shards import hash_file
from rlftsim.scenario.types import TOTAL_STEPS, Scenario

__all__ = ["EvaluateConfig", "Evaluation", "Provenance", "Skipped", "evaluate", "simulate_states"]

_CACHED_SCENARIOS = 2  # each is looked at once

Oracle = Literal["oracle"]


def evaluate(
    policy: Policy | Oracle,
    dataset_folder: Path,
    out: Path,
    config: EvaluateConfig = EvaluateConfig(),  # noqa: B008
    *,
    name: str,
    show_progress: bool = True,
) -> Evaluation:
    """Score a policy on the scenarios of a data set; the result is also written to `out/<name>.parquet`.

    Interrupted in any way, the same call goes on where it was. Once finished, it reads the file.

    Args:
        policy: any policy, or "oracle" for the record itself.
        dataset_folder: an `rlftsim convert` data set.
        out: folder of the result, made if missing.
        config: rollouts, metric, sampling, scenarios, processes.
        name: of the row and the file. Unfinished work and results of another policy, data set or setting under this name
            are replaced, with a word on stderr.
        show_progress: whether to show progress and the time left on stderr.

    Raises:
        DataError: no such data set or split, or scenarios whose future is withheld (a test split).
        ConfigError: an impossible name, several processes for a policy that lives on a GPU, or goals for one that sees none.
    """
    if config.goals != "none" and not sees_goals(policy):
        raise ConfigError(f"evaluate.goals={config.goals} has no effect: {name} does not see goals, leave it out.")
    dataset_folder, out = Path(dataset_folder), Path(out)
    positions = choose_scenarios(ScenarioDataset(dataset_folder, config.split), config)
    job = _Job(_frozen_copy(policy), dataset_folder, _describe(policy, dataset_folder, config), name, out)
    check_jobs(config, job.device)
    ids = _open(job).scenario_ids[: len(positions)]
    return job.parts.run(
        partial(_evaluate_group, job), ids, jobs=config.jobs, title=f"evaluate {name}", show_progress=show_progress
    )


def evaluated_ends(batch: ScenarioBatch) -> Goals:
    """Where the record left the evaluated agents, as their goals."""
    return recorded_goals(batch, batch.evaluated_mask)


def check_jobs(config: EvaluateConfig, device: torch.device) -> None:
    """Refuse several processes for a policy on a GPU.

    Raises:
        ConfigError: that was asked for.
    """
    if config.jobs > 1 and device.type != "cpu":
        raise ConfigError(
            f"evaluate.jobs={config.jobs} works on CPUs only, the policy is on {device}: use --jobs 1 or --device cpu."
        )


def simulate_states(
    policy: Policy,
    scenario: Scenario,
    config: EvaluateConfig,
    device: torch.device,
    *,
    goals_of: Callable[[ScenarioBatch], Goals] | None = None,
) -> SimulatedStates:
    """All rollouts of one scenario, simulated a few at a time; a deterministic policy is simulated once.

    Args:
        policy: who decides.
        scenario: what is simulated.
        config: rollouts, seed, sampling.
        device: where.
        goals_of: what agents are asked, the same in all rollouts; None = nothing.

    Raises:
        ConfigError: the policy cannot do what `config` asks, e.g. top-k without categories.
    """
    batch = collate([scenario]).to(device)
    with torch.no_grad():
        context = policy.encode(batch)
    return simulate_encoded(policy, batch, context, config, goals=goals_of and goals_of(batch))


def simulate_encoded(
    policy: Policy, batch: ScenarioBatch, context: Any, config: EvaluateConfig, *, goals: Goals | None = None
) -> SimulatedStates:
    """As `simulate_states`, of a scenario that the policy has encoded."""
    is_random = policy.initial_noise_size or (policy.noise_size and config.temperature > 0)
    ids = range(config.num_rollouts if is_random else 1)
    passes = []
    for first in range(0, len(ids), config.rollouts_per_pass):
        some = ids[first : first + config.rollouts_per_pass]
        rollouts = simulate(
            policy, batch, num_rollouts=some, seed=config.seed, context=context, sampling=config.sampling, goals=goals
        )
        passes.append(states_of_rollouts(batch, rollouts)[0])
    joined = _join_passes(passes)
    return joined if is_random else replace(joined, repeat=config.num_rollouts)


def _join_passes(passes: Sequence[SimulatedStates]) -> SimulatedStates:
    x, y, z, heading = (torch.cat([getattr(p, axis) for p in passes]) for axis in ("x", "y", "z", "heading"))
    return SimulatedStates(passes[0].object_id, x, y, z, heading)


@dataclass(frozen=True, eq=False)
class _Job:
    """One evaluation under way; is handed to other processes."""

    policy: Policy | Oracle
    dataset_folder: Path
    provenance: Provenance
    name: str
    out: Path

    @property
    def config(self) -> EvaluateConfig:
        return self.provenance.config

    @property
    def parts(self) -> ResumableEvaluation:
        return ResumableEvaluation(self.name, self.provenance, self.out)

    @property
    def device(self) -> torch.device:
        return device_of(self.policy)


def _frozen_copy(policy: Policy | Oracle) -> Policy | Oracle:
    """A copy without dropout whose weights nobody trains, so that parts of it may be looked up in tables."""
    return copy.deepcopy(policy).eval().requires_grad_(False) if isinstance(policy, nn.Module) else policy


def _describe(policy: Policy | Oracle, dataset_folder: Path, config: EvaluateConfig) -> Provenance:
    is_oracle = isinstance(policy, str)
    return Provenance(
        config=config,
        policy="oracle" if is_oracle else type(policy).__name__,
        policy_fingerprint="oracle" if is_oracle else fingerprint_policy(policy),
        dataset=str(dataset_folder.resolve()),
        manifest_sha256=hash_file(dataset_folder / MANIFEST),
    )


def choose_scenarios(dataset: ScenarioDataset, config: EvaluateConfig) -> range:
    """Positions of the scenarios that are evaluated.

    Raises:
        DataError: none, or one without its future.
    """
    chosen = range(min(len(dataset), config.limit or len(dataset)))
    where = f"{dataset.folder}" + (f" (split {dataset.split})" if dataset.split else "")
    if not chosen:
        raise DataError(f"{where} has no scenarios: nothing to evaluate.")
    steps = dataset.index["num_steps"].to_pylist()
    short = [i for i in chosen if steps[i] < TOTAL_STEPS]
    if short:
        raise DataError(
            f"{where}: {len(short)} of {len(chosen)} scenarios withhold their future, the first is "
            f"{dataset.scenario_ids[short[0]]} with {steps[short[0]]} steps: a test split can be simulated but not "
            "evaluated, use training or validation data."
        )
    return chosen


def _evaluate_group(job: _Job, group: range, advance: Callable[[int], None], is_stopped: Callable[[], bool]) -> None:
    """Score a few scenarios and write their part."""
    dataset = _open(job)
    outcomes = []
    for position in group:
        if is_stopped():
            return
        outcomes.append(_evaluate_scenario(job, dataset[position]))
        advance(1)
    job.parts.write_part(group, outcomes)


def _evaluate_scenario(job: _Job, scenario: Scenario) -> dict[str, object] | Skipped:
    """Row of one scenario, or why there is none."""
    try:
        log = build_scenario_log(scenario, job.device)
    except DataError as error:
        return Skipped(scenario.scenario_id, str(error))
    config = job.config
    if isinstance(job.policy, str):
        states = logged_states(scenario, num_rollouts=config.num_rollouts, device=job.device)
    else:
        goals_of = evaluated_ends if config.goals == "recorded" else None
        states = simulate_states(job.policy, scenario, config, job.device, goals_of=goals_of)
    return row_of_result(score(log, states, metric_by_name(config.metric)), scenario, states)


def _open(job: _Job) -> ScenarioDataset:
    return ScenarioDataset(job.dataset_folder, job.config.split, cache_size=_CACHED_SCENARIOS)
