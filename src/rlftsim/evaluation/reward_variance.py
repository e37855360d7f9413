"""Variance of a rollout's reward against the number N of rollouts in the computation.

Many rollouts of a scenario are simulated once. For each N, random subsets of N rollouts are scored as in training, and
the rewards of all members are stored. The mean is 0 by construction, so the mean square is the variance. A file per
scenario is stored: an interrupted measurement is resumed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.evaluate import describe_measurement
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.evaluation.resumable import ScenarioValues, measure_scenarios
from rlftsim.evaluation.rollout_states import simulate_states
from rlftsim.evaluation.scenario_source import choose_scenarios, open_held_out
from rlftsim.jobs.runner import check_jobs, choose_runner
from rlftsim.realism import Features, ScenarioLog, compute_features, metric_by_name, scenario_log, score_features
from rlftsim.rewards.base import leave_one_out
from rlftsim.rewards.realism import compute_mloo
from rlftsim.rollout.policy import Policy, frozen_copy, get_device
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset

SIZES = (2, 3, 4, 6, 8, 12, 16, 24, 32)
REWARDS = ("mloo", "rloo")
MIN_SIZES_FOR_A_SLOPE = 3
MEMBERS_A_SIZE = 128
"""Rewards averaged over for each N, about; whole subsets of N are drawn until there are as many."""

SubsetScorer = Callable[[Int[np.ndarray, "n"]], tuple[Tensor, Tensor]]
"""From the numbers of some rollouts to the `mloo` and `rloo` reward [n] of each among just these."""


@dataclass(frozen=True, eq=False)
class Variances:
    """Variance of the reward of a rollout, by scenario and number of rollouts."""

    scenario_ids: tuple[str, ...]
    sizes: tuple[int, ...]
    by_reward: dict[str, Float[np.ndarray, "scenarios sizes"]]


def measure_variances(
    policy: Policy,
    data: str | PathLike[str] | ScenarioDataset,
    out: str | PathLike[str],
    config: EvaluateConfig,
) -> Variances:
    """Variances of a policy's rewards for each number of rollouts in `SIZES`, up to the settings' number.

    Args:
        policy: Policy whose rollouts are scored; need not be trainable.
        data: Folder of a data set, "synthetic", or an opened data set.
        out: Folder of the results, a JSON file per scenario, made if missing.
        config: Rollouts, seed, sampling, scenarios, processes.

    Raises:
        ConfigError: Too few rollouts for a slope.
        DataError: No scenario that can be scored, or a second process at work in the folder.
    """
    dataset, config = open_held_out(data, config)
    sizes = tuple(size for size in SIZES if size <= config.num_rollouts)
    if len(sizes) < MIN_SIZES_FOR_A_SLOPE:
        raise ConfigError(
            "a slope over N = 2, 3, 4, ... needs 4 rollouts at least, "
            f"got {config.num_rollouts}: set --num-rollouts 32."
        )
    check_jobs(config.jobs, get_device(policy))
    ids = choose_scenarios(dataset, config)
    identity = {"sizes": list(sizes), **describe_measurement(policy, dataset, config)}
    files = ScenarioValues(Path(out), ids, dict.fromkeys(ids, identity), _parse_variances)
    work = partial(_measure_scenario, frozen_copy(policy), dataset, config, sizes)
    stored = measure_scenarios("variances", work, files, runner=choose_runner(config.jobs, len(ids)))
    # [rewards, sizes] each; a scenario that cannot be scored has an empty array
    scored = {scenario_id: values for scenario_id, values in zip(ids, stored) if len(values)}
    if not scored:
        raise DataError(f"{dataset.folder}: not one of {len(ids)} scenarios can be scored.")
    stacked = np.stack(list(scored.values()))  # [scenarios, rewards, sizes]
    return Variances(tuple(scored), sizes, {name: stacked[:, k] for k, name in enumerate(REWARDS)})


def variance_by_size(
    score_subset: SubsetScorer, num_rollouts: int, sizes: Sequence[int], rng: np.random.Generator
) -> Float[np.ndarray, "rewards sizes"]:
    """Mean square of the rewards in random subsets of the rollouts.

    Args:
        score_subset: Function from the numbers of rollouts to the rewards, computed from these alone.
        num_rollouts: Number of rollouts that subsets are drawn from.
        sizes: Numbers N of rollouts in a subset, each at most `num_rollouts`.
        rng: Generator of the subsets.
    """
    variances = np.zeros((len(REWARDS), len(sizes)))  # [rewards, sizes]
    for column, size in enumerate(sizes):
        # all subsets of all rollouts are the same one; else at least two
        num_subsets = 1 if size == num_rollouts else max(MEMBERS_A_SIZE // size, 2)
        subsets = [np.sort(rng.permutation(num_rollouts)[:size]) for _ in range(num_subsets)]
        squares = [[float(reward.double().square().mean()) for reward in score_subset(subset)] for subset in subsets]
        variances[:, column] = np.mean(squares, axis=0)
    return variances


def _parse_variances(scenario_id: str, values: Mapping[str, Any]) -> Float[np.ndarray, "..."]:
    """Stored variances of a scenario [rewards, sizes]; empty for a scenario that cannot be scored.

    Raises:
        ValueError: Values of other axes.
    """
    variances = np.array(values["variances"], float)
    if len(variances) and variances.shape != (len(REWARDS), len(values["sizes"])):
        raise ValueError(f"variances of axes {variances.shape}")
    return variances


def _measure_scenario(
    policy: Policy, dataset: ScenarioDataset, config: EvaluateConfig, sizes: tuple[int, ...], position: int
) -> dict[str, object]:
    """Simulate once and score subsets of the rollouts."""
    scenario, device = dataset[position], get_device(policy)
    try:
        log = scenario_log(scenario, device)
    except DataError as error:
        return {"variances": [], "skipped": str(error)}
    # features once for all rollouts: subsets pick rows of them, which is what training would compute
    batch = collate([scenario]).to(device)
    with torch.no_grad():
        features = compute_features(log, simulate_states(policy, batch, config, context=policy.encode(batch)))
    score_subset = partial(_score_subset, log, features, config.metric)
    # by scenario: neither the order of the scenarios nor the number of processes changes the subsets
    rng = np.random.default_rng([config.seed, *scenario.scenario_id.encode()])
    return {"variances": variance_by_size(score_subset, config.num_rollouts, sizes, rng).tolist()}


def _score_subset(
    log: ScenarioLog, features: Features, metric: str, rollout_ids: Int[np.ndarray, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Both rewards of a subset of rollouts, computed as in training, from these rollouts alone."""
    # every tensor of the features has the rollouts first
    index = torch.from_numpy(rollout_ids).to(features.linear_speed.device)
    subset = {name: values[index] for name, values in vars(features).items() if isinstance(values, Tensor)}
    realism = score_features(log, replace(features, **subset), metric_by_name(metric))  # type: ignore[arg-type]
    return compute_mloo(realism.leave_one_out_meta_metric[None])[0], leave_one_out(realism.single_meta_metric[None])[0]
