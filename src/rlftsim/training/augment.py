"""Stochastic target augmentation (RLFTSim, algorithm 1): goals that rollouts have met, stored beside a data set.

The logged endpoint is one place an agent could go. For every scenario rollouts are sampled, and the endpoints of
the most realistic one become further goals, which the policy is known to be able to reach.
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError, given, require_positive, require_types
from rlftsim.goals.logged import logged_goals
from rlftsim.goals.stored import write_goal_file
from rlftsim.goals.types import Points
from rlftsim.jobs.progress import progress_bar
from rlftsim.realism import RealismResult, metric_by_name, score_batch
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.policy import Policy, Sampling, get_device
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.types import Scenarios
from rlftsim.training.data import batch_with_futures
from rlftsim.training.run_folder import RunFolder, describe_inputs


def most_realistic(realism: RealismResult) -> Int64[Tensor, "B"]:
    """Index of the rollout of each scenario with the highest meta-metric of its own."""
    # A rollout without a finite score (nothing valid to compare with) is never chosen before one that has a score.
    return torch.nan_to_num(realism.single_meta_metric, nan=-math.inf).argmax(-1)


def ends_of(rollouts: Rollouts, chosen: Int64[Tensor, "B"]) -> Float[Tensor, "B A 2"]:
    """Final positions of the agents in one rollout of each scenario, map frame.

    Args:
        rollouts: N of each scenario.
        chosen: index of the one.
    """
    return rollouts.position[torch.arange(len(chosen), device=chosen.device), chosen, :, -1]


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
        require_types(self)
        require_positive(self, ("num_rollouts", "scenarios_per_part", *given(self, ("top_k",))))
        metric_by_name(self.metric)


def augment_goals(policy: Policy, scenarios: Scenarios, folder: str | os.PathLike[str], config: AugmentConfig) -> int:
    """Write the endpoints of the most realistic rollout of each scenario (RLFTSim, algorithm 1); resumes.

    A goal-conditioned policy has the logged endpoints as its goals.

    Args:
        policy: samples the rollouts.
        scenarios: with their futures.
        folder: for the files, see `goals.stored`.
        config: see its fields.

    Returns:
        Number of scenarios that have goals now.

    Raises:
        DataError: a scenario withholds its future.
        CheckpointError: the folder holds goals of another policy, other scenarios or other settings.
        ConfigError: `top_k` is set and the policy's decisions are not categories.
    """
    folder, size = Path(folder), config.scenarios_per_part
    if config.top_k is not None and len(scenarios) and not folder.exists():
        # Tried on one scenario before the folder is claimed for settings that cannot work.
        batch = batch_with_futures(scenarios, [0]).to(get_device(policy))
        try:
            simulate(policy, batch, num_rollouts=1, seed=config.seed, sampling=Sampling(top_k=config.top_k))
        except ConfigError as error:
            name = type(policy).__name__
            raise ConfigError(f"top_k={config.top_k} and {name}: {str(error).rstrip('.')} (--top-k None).") from None
    RunFolder(folder, config, describe_inputs(policy, scenarios))
    with progress_bar("augment", len(scenarios), 0) as advance:
        for start in range(0, len(scenarios), size):
            path = folder / f"part-{start // size:06d}.parquet"
            indices = range(start, min(start + size, len(scenarios)))
            # Files are written whole, so one that exists is finished.
            if not path.exists():
                write_goal_file(path, dict(_endpoints(policy, scenarios, i, config) for i in indices))
            advance(len(indices))
    return len(scenarios)


def _endpoints(policy: Policy, scenarios: Scenarios, index: int, config: AugmentConfig) -> tuple[str, Points]:
    """Id of a scenario, and the object ids and endpoints (world frame) of its agents."""
    batch = batch_with_futures(scenarios, [index]).to(get_device(policy))
    rollouts = simulate(
        policy, batch, num_rollouts=config.num_rollouts, seed=config.seed, goals=logged_goals(batch),
        sampling=Sampling(top_k=config.top_k),
    )  # fmt: skip
    states = states_of_rollouts(batch, rollouts)
    # A scenario without a map still has endpoints: it counts as on the road.
    realism = score_batch(batch.scenarios, states, metric_by_name(config.metric), missing_map="neutral")
    ends = ends_of(rollouts, most_realistic(realism))  # [1, A, 2]
    ends = batch.to_world(ends[:, None, :, None])[0, 0, :, 0]  # to_world takes [B, N, A, T, 2]
    return batch.scenarios[0].scenario_id, (batch.object_id[0].cpu().numpy(), ends.double().cpu().numpy())
