"""Stochastic target augmentation (RLFTSim, algorithm 1): goals that rollouts have met, stored beside a data set.

The logged endpoint is a single place an agent could go. For every scenario rollouts are sampled, and the endpoints of
the most realistic rollout become further goals, which the policy is known to be able to reach.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.goals.types import logged_goals, read_goal_file, write_goal_file
from rlftsim.jobs.files import remove_temporaries
from rlftsim.jobs.folder import Lease
from rlftsim.jobs.items import GroupFormat, do_group, group_positions, read_stored, run_items
from rlftsim.jobs.runner import Inline, Runner
from rlftsim.rollout.policy import Policy, Sampling, get_device
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.types import Scenarios
from rlftsim.training.config import AugmentConfig
from rlftsim.training.data import batch_with_futures
from rlftsim.training.experience import most_realistic_ends, score_rollouts
from rlftsim.training.run_folder import RunFolder, describe_inputs


@dataclass(frozen=True)
class _GoalFiles(GroupFormat[Path, tuple[str, Any]]):
    """Ids and `Points` of some scenarios, see `goals.types`."""

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
        folder: Folder of the files, made if missing, see `goals.types`.
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
        paths = run_items("augment", groups, partial(do_group, work, goals), format=goals, lease=lease)
        remove_temporaries([folder / "config.json", folder / "environment.json", *paths])  # of killed processes
        lease.remove()
    return len(scenarios)


def _find_ends(policy: Policy, scenarios: Scenarios, config: AugmentConfig, index: int) -> tuple[str, Any]:
    """Id of a scenario, and `Points` of the agents: object ids and endpoints, world frame."""
    batch = batch_with_futures(scenarios, [index]).to(get_device(policy))
    rollouts = simulate(
        policy, batch, num_rollouts=config.num_rollouts, seed=config.seed, goals=logged_goals(batch),
        sampling=Sampling(top_k=config.top_k),
    )  # fmt: skip
    ends = most_realistic_ends(rollouts, score_rollouts(batch, rollouts, config.metric)[0])  # [1, A, 2]
    ends = batch.to_world(ends[:, None, :, None])[0, 0, :, 0]  # to_world takes [B, N, A, T, 2]
    return batch.scenarios[0].scenario_id, (batch.object_id[0].cpu().numpy(), ends.double().cpu().numpy())
