"""What an update learns from, and what a person wants to know of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from lightning_fabric import Fabric
from torch import Tensor

from rlftsim.goals.attainment import is_passed, is_reached, rate
from rlftsim.realism import RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, STEP_S
from rlftsim.training.parallel import add_up
from rlftsim.training.rewards import Rewards


@dataclass(frozen=True, eq=False)
class Experience:
    """Rollouts of some scenarios and what they earned."""

    batch: ScenarioBatch
    rollouts: Rollouts
    scores: RealismResult
    rewards: Rewards

    def slices(self, size: int) -> Iterator[tuple[Rollouts, Float[Tensor, "B n A"]]]:
        """So many of the rollouts of every scenario at once, and what each agent in them earned."""
        return slices(self.rollouts, self.rewards.by_agent, size)


def slices(
    rollouts: Rollouts, earned: Float[Tensor, "B N A"], size: int
) -> Iterator[tuple[Rollouts, Float[Tensor, "B n A"]]]:
    """So many of the rollouts of every scenario at once, and what each agent in them earned."""
    for start in range(0, rollouts.num_rollouts, size):
        part = slice(start, start + size)
        yield rollouts.select(part), earned[:, part]


def describe(experiences: Sequence[Experience], fabric: Fabric) -> dict[str, float]:
    """Means over all scenarios of an update, those of other processes included; a scenario without a value counts nowhere."""
    parts = [describe_scenarios(experience) for experience in experiences]
    values = torch.stack([torch.cat([part[name] for part in parts]).double() for name in parts[0]])  # [K, B]
    known = values.isfinite()
    sums = add_up(torch.stack([torch.where(known, values, 0.0).sum(-1), known.sum(-1).double()]), fabric)
    return dict(zip(parts[0], (sums[0] / sums[1]).tolist()))


def describe_scenarios(experience: Experience) -> dict[str, Float[Tensor, "B"]]:
    """What is logged, for each scenario."""
    scores, rewards = experience.scores, experience.rewards
    reward = {
        "reward_mean": rewards.total.mean(-1),
        "reward_std": rewards.total.std(-1),
        "reward_zero_rate": (rewards.total == 0).all(-1).double(),
    }
    for term, values in zip(rewards.terms, rewards.by_term):
        reward |= {f"reward_{term.name}_mean": values.mean(-1), f"reward_{term.name}_std": values.std(-1)}
    return (
        reward
        | describe_goals(experience)
        | {
            "rmm": scores.meta_metric,
            "kinematic": scores.kinematic,
            "interactive": scores.interactive,
            "map_based": scores.map_based,
            "ade_m": scores.average_displacement_error,
            "min_ade_m": scores.min_average_displacement_error,
            "collision_rate": scores.collision_rate,
            "offroad_rate": scores.offroad_rate,
            "traffic_light_violation_rate": scores.traffic_light_violation_rate,
            "diversity_m": compute_diversity(experience.rollouts),
            "speed_gap_mps": compute_speed_gap(experience.batch, experience.rollouts),
        }
    )


def describe_goals(experience: Experience) -> dict[str, Float[Tensor, "B"]]:
    """Shares of the evaluated agents with a goal that meet it; NaN for a scenario in which nobody has one. Nothing in goal-free runs."""
    rollouts, goals = experience.rollouts, experience.rollouts.goals
    if goals is None:
        return {}
    mask = goals.goal_mask & experience.batch.evaluated_mask[:, None]
    ways = {"goal_reached_rate": is_reached, "goal_passed_rate": is_passed}
    return {name: rate(is_met(rollouts.position, goals), mask).mean(-1) for name, is_met in ways.items()}


def compute_diversity(rollouts: Rollouts) -> Float[Tensor, "B"]:
    """Mean distance of an agent's final positions from their mean over rollouts, m."""
    ends = rollouts.position[..., -1, :]
    spread = (ends - ends.mean(1, keepdim=True)).norm(dim=-1)
    present = rollouts.decision_mask.any(-1)
    return torch.where(present, spread, 0.0).sum((1, 2)) / present.sum((1, 2))


def compute_speed_gap(batch: ScenarioBatch, rollouts: Rollouts) -> Float[Tensor, "B"]:
    """Mean speed in the rollouts minus that in the record, over the agents and steps that were recorded, m/s.

    A speed is the way of one step; NaN for a scenario with no recorded future.
    """
    future, valid = slice(CURRENT_STEP + 1, None), batch.valid
    recorded = (valid[:, :, future] & valid[:, :, CURRENT_STEP:-1] & batch.agent_mask[..., None]).double()
    start = batch.position[:, None, :, CURRENT_STEP, None].expand(-1, rollouts.num_rollouts, -1, -1, -1)
    simulated = torch.cat([start, rollouts.position], dim=-2).diff(dim=-2).norm(dim=-1).mean(1)  # [B, A, T]
    logged = batch.position[:, :, CURRENT_STEP:].diff(dim=-2).norm(dim=-1)
    return ((simulated - logged) * recorded).sum((1, 2)) / recorded.sum((1, 2)) / STEP_S
