"""Stochastic target augmentation (RLFTSim, algorithm 1): goals that rollouts have met, stored beside a data set.

The logged endpoint is a single place an agent could go. For every scenario rollouts are sampled, and the endpoints of
the most realistic rollout become further goals, which the policy is known to be able to reach.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError, check_positive, check_types, given
from rlftsim.goals.stored import read_goal_file, write_goal_file
from rlftsim.goals.types import Points, logged_goals
from rlftsim.jobs.files import remove_temporaries
from rlftsim.jobs.folder import Lease
from rlftsim.jobs.items import GroupFormat, group_positions, group_task, read_stored, run_items
from rlftsim.jobs.runner import Inline, Runner
from rlftsim.realism import RealismResult, metric_by_name, score_batch
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.policy import Policy, Sampling, get_device
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.types import Scenarios
from rlftsim.training.data import batch_with_futures
from rlftsim.training.run_folder import RunFolder, describe_inputs


def most_realistic(realism: RealismResult) -> Int64[Tensor, "B"]:
    """Index of the rollout of each scenario with the highest single meta-metric."""
    # A rollout without a finite score (nothing valid to compare with) is never chosen before one that has a score.
    return torch.nan_to_num(realism.single_meta_metric, nan=-math.inf).argmax(-1)


def select_ends(rollouts: Rollouts, index: Int64[Tensor, "B"]) -> Float[Tensor, "B A 2"]:
    """Final positions of the agents in a selected rollout of each scenario, map frame.

    Args:
        rollouts: Rollouts of B scenarios, N of each.
        index: Number of the selected rollout of each scenario, in [0, N).
    """
    return rollouts.position[torch.arange(len(index), device=index.device), index, :, -1]


@dataclass(frozen=True)
class AugmentConfig:
    """Sampling of augmented goals."""

    num_rollouts: int = 32
    """Rollouts of a scenario among which the most realistic is taken (N_G); the paper does not give it."""
    top_k: int | None = 32
    """Most likely decisions that are sampled among; None = all, for policies whose decisions are not categories."""
    metric: str = "2025"
    """Configuration of the meta-metric."""
    scenarios_per_part: int = 64
    """Scenarios of a file; those of a finished file are not done again."""
    seed: int = 0
    """Of the rollouts."""

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(self, ("num_rollouts", "scenarios_per_part", *given(self, ("top_k",))))
        metric_by_name(self.metric)


@dataclass(frozen=True)
class _GoalFiles(GroupFormat[Path, tuple[str, Any]]):
    """Ids and `Points` of some scenarios, see `goals.stored`."""

    folder: Path
    size: int

    def _path(self, group: range) -> Path:
        return self.folder / f"part-{group.start // self.size:06d}.parquet"

    def write(self, item: range, results: Sequence[tuple[str, Any]]) -> None:
        """Write the file of a group, see `GroupFormat`."""
        write_goal_file(self._path(item), dict(results))

    def read(self, item: range) -> Path | None:
        """The file of a group, see `ResultFormat`."""
        return None if read_stored(self._path(item), read_goal_file) is None else self._path(item)


def augment_goals(
    policy: Policy,
    scenarios: Scenarios,
    folder: str | os.PathLike[str],
    config: AugmentConfig,
    *,
    runner: Runner = Inline(),  # noqa: B008
) -> int:
    """Write the endpoints of the most realistic rollout of each scenario (RLFTSim, algorithm 1); resumes.

    A goal-conditioned policy pursues the logged endpoints.

    Args:
        policy: Policy that the rollouts are sampled from.
        scenarios: Scenarios with logged futures, by which realism is measured.
        folder: Folder of the files, made if missing, see `goals.stored`.
        config: Number of rollouts, sampling, metric, seed; a stored folder is continued only with equal settings.
        runner: Runner of the work; changes no result.

    Returns:
        Number of scenarios that have goals now.

    Raises:
        DataError: A scenario withholds the future, or a second driver is at work in the folder.
        CheckpointError: The folder holds goals of a different policy, other scenarios or other settings.
        ConfigError: `top_k` is set and the policy's decisions are not categories.
        SetAside, Unfinished: See `run_items`.
    """
    folder, inputs = Path(folder), describe_inputs(policy, scenarios)
    if config.top_k is not None and len(scenarios) and not folder.exists():
        # Tried on one scenario before the folder is claimed for settings that cannot work.
        batch = batch_with_futures(scenarios, [0]).to(get_device(policy))
        try:
            simulate(policy, batch, num_rollouts=1, seed=config.seed, sampling=Sampling(top_k=config.top_k))
        except ConfigError as error:
            name = type(policy).__name__
            raise ConfigError(f"top_k={config.top_k} and {name}: {str(error).rstrip('.')} (--top-k None).") from None
    RunFolder(folder, config, inputs, writes=False)  # refuses before the folder gets a lock file
    with Lease(folder / ".lock", runner, "works in") as lease:
        RunFolder(folder, config, inputs)
        goals = _GoalFiles(folder, config.scenarios_per_part)
        groups, work = group_positions(len(scenarios), goals.size), partial(_find_ends, policy, scenarios, config)
        paths = run_items("augment", groups, group_task(work, goals), format=goals, lease=lease, runner=runner)
        remove_temporaries([folder / "config.json", *paths])  # of processes that were killed
        lease.remove()
    return len(scenarios)


def _find_ends(policy: Policy, scenarios: Scenarios, config: AugmentConfig, index: int) -> tuple[str, Points]:
    """Id of a scenario, and the object ids and endpoints (world frame) of the agents."""
    batch = batch_with_futures(scenarios, [index]).to(get_device(policy))
    rollouts = simulate(
        policy, batch, num_rollouts=config.num_rollouts, seed=config.seed, goals=logged_goals(batch),
        sampling=Sampling(top_k=config.top_k),
    )  # fmt: skip
    states = states_of_rollouts(batch, rollouts)
    # A scenario without a map still has endpoints: it counts as on the road.
    realism = score_batch(batch.scenarios, states, metric_by_name(config.metric), missing_map="neutral")
    ends = select_ends(rollouts, most_realistic(realism))  # [1, A, 2]
    ends = batch.to_world(ends[:, None, :, None])[0, 0, :, 0]  # to_world takes [B, N, A, T, 2]
    return batch.scenarios[0].scenario_id, (batch.object_id[0].cpu().numpy(), ends.double().cpu().numpy())
