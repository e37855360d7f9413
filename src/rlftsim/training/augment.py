"""Goals that were met by chance, stored beside a data set: stochastic target augmentation (RLFTSim, algorithm 1).

Where the record ended is one place an agent could go. For every scenario rollouts are sampled, and where the most realistic one takes its
agents become further goals, which the policy is known to be able to meet.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from rlftsim.errors import require_positive
from rlftsim.goals.recorded import recorded_goals
from rlftsim.goals.stored import write_goal_part
from rlftsim.goals.types import Points
from rlftsim.progress import progress_bar
from rlftsim.realism import RealismResult, metric_by_name, score_batch
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.policy import Policy, Sampling, device_of
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.types import Scenarios
from rlftsim.training.data import batch_with_futures
from rlftsim.training.run_folder import RunFolder, describe_inputs


def most_realistic(scores: RealismResult) -> Int64[Tensor, "B"]:
    """The rollout of each scenario that is most realistic alone."""
    return torch.nan_to_num(scores.single_meta_metric, nan=-math.inf).argmax(-1)


def ends_of(rollouts: Rollouts, chosen: Int64[Tensor, "B"]) -> Float[Tensor, "B A 2"]:
    """Where the agents are in the end, in one rollout of each scenario."""
    return rollouts.position[torch.arange(len(chosen), device=chosen.device), chosen, :, -1]


@dataclass(frozen=True)
class AugmentConfig:
    """How goals are drawn."""

    num_rollouts: int = 32
    """Rollouts of a scenario among which the most realistic is taken (N_G); the paper does not give it."""
    top_k: int = 32
    """Most likely decisions that are sampled among."""
    metric: str = "2025"
    scenarios_per_part: int = 64
    """Of a file; what is in a finished file is not done again."""
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive(self, ("num_rollouts", "top_k", "scenarios_per_part"))
        metric_by_name(self.metric)


def augment_goals(policy: Policy, scenarios: Scenarios, folder: Path, config: AugmentConfig) -> int:
    """Write where the most realistic rollout of each scenario took its agents (RLFTSim, algorithm 1). Goes on where it was stopped.

    A policy that sees goals is asked to go where the record ended.

    Args:
        policy: samples the rollouts.
        scenarios: with their futures.
        folder: for the files, see `goals.stored`.
        config: see its fields.

    Returns:
        How many scenarios have goals now.

    Raises:
        DataError: a scenario withholds its future.
        CheckpointError: the folder holds goals of another policy, other scenarios or other settings.
    """
    RunFolder(folder, config, describe_inputs(policy, scenarios))
    with progress_bar("augment", len(scenarios), 0) as advance:
        for path, indices in _parts(folder, len(scenarios), config.scenarios_per_part):
            if not path.exists():
                write_goal_part(path, dict(_drawn_goals(policy, scenarios, indices, config)))
            for _ in indices:
                advance()
    return len(scenarios)


def _parts(folder: Path, count: int, size: int) -> Iterator[tuple[Path, range]]:
    for start in range(0, count, size):
        yield folder / f"part-{start // size:06d}.parquet", range(start, min(start + size, count))


def _drawn_goals(
    policy: Policy, scenarios: Scenarios, indices: range, config: AugmentConfig
) -> Iterator[tuple[str, Points]]:
    """Scenario ids with the goals of their agents."""
    for index in indices:
        batch = batch_with_futures(scenarios, [index]).to(device_of(policy))
        rollouts = simulate(
            policy, batch, num_rollouts=config.num_rollouts, seed=config.seed, goals=recorded_goals(batch),
            sampling=Sampling(top_k=config.top_k),
        )  # fmt: skip
        scores = score_batch(
            batch.scenarios,
            states_of_rollouts(batch, rollouts),
            metric_by_name(config.metric),
            missing_map="neutral",
        )
        best = most_realistic(scores)
        ends = batch.to_world(ends_of(rollouts, best)[:, None, :, None])[0, 0, :, 0]
        yield batch.scenarios[0].scenario_id, (batch.object_id[0].cpu().numpy(), ends.double().cpu().numpy())
