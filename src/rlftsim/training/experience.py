"""The experience of an update: rollouts of some scenarios, rewards, and the metrics that are logged."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from rlftsim.goals.attainment import is_passed, is_reached, rate
from rlftsim.jobs.threads import one_thread
from rlftsim.realism import RealismResult, score_rollouts
from rlftsim.rewards import Rewards, Term, compute_rewards, parse_reward
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import encode_like
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.config import FinetuneConfig
from rlftsim.training.constraints import credit_constraints, logged_speeds, measure_constraints, simulated_speeds
from rlftsim.training.goals import choose_goals
from rlftsim.training.parallel import Fabric, all_gather, all_reduce_sum

NUM_COMPARED = 8
"""Rollouts of a scenario by the reference that constrained means are compared with."""


@dataclass(frozen=True, eq=False)
class Experience:
    """Rollouts of some scenarios with rewards."""

    batch: ScenarioBatch
    rollouts: Rollouts
    realism: RealismResult
    rewards: Rewards
    constraint_credits: Float64[Tensor, "C B N A"]
    """Contributions of the agents to the means that are held."""
    context: Any = None
    """Of the batch, made without gradient by the policy that rolled out; None = there is none to share."""
    rollout_ids: range | None = None
    """Rollouts that this process simulated, where several have the same scenarios; None = all."""


# ---- sampling and rewards ------------------------------------------------------------------------------------------


def sample_rollouts(
    learner: Any, batch: ScenarioBatch, config: FinetuneConfig, rollout_ids: range, fabric: Fabric
) -> tuple[Any, Rollouts]:
    """Context and rollouts of an update, without gradient. All rollouts of a scenario have the same goals.

    Args:
        learner: Policy that decides for all agents, augmented goals if any, and number of the update.
        batch: scenarios with futures.
        config: Settings of goals, number of rollouts, and seed, which determines goals and rollouts with the update.
        rollout_ids: Rollouts that this process simulates; the rest comes from the processes with the same scenarios.
        fabric: precision of the pass, and the processes.
    """
    goal_seed, seed = (derive_seed(config.seed, purpose, learner.update) for purpose in ("goals", "rollouts"))
    goals = choose_goals(batch, config.goals, learner.augmented_goals, seed=goal_seed)
    with fabric.autocast(), torch.no_grad(), one_thread():
        context = learner.policy.encode(batch)
        rollouts = simulate(
            learner.policy, batch, num_rollouts=rollout_ids, seed=seed, context=context, goals=goals, may_be_nan=True
        )
    if len(rollout_ids) < config.num_rollouts:
        rollouts = _gather_rollouts(rollouts, config.num_rollouts, fabric)
    return context, rollouts


def _gather_rollouts(rollouts: Rollouts, num_rollouts: int, fabric: Fabric) -> Rollouts:
    """All rollouts of the scenarios that several processes share, in order and with the same bits in each process.

    Rewards compare the rollouts of a scenario with each other, so each process needs all rollouts, which are small.
    """
    names = [field.name for field in fields(rollouts) if isinstance(getattr(rollouts, field.name), Tensor)]
    gathered = all_gather({name: getattr(rollouts, name) for name in names}, fabric)
    sharing = num_rollouts // rollouts.num_rollouts
    first = fabric.global_rank - fabric.global_rank % sharing
    groups = gathered[first : first + sharing]
    joined: dict[str, Any] = {name: torch.cat([tensors[name] for tensors in groups], 1) for name in names}
    goals = rollouts.goals and rollouts.goals.rollouts(slice(1)).repeat(num_rollouts)
    return replace(rollouts, **joined, goals=goals)


def compute_reward(
    batch: ScenarioBatch, rollouts: Rollouts, config: FinetuneConfig
) -> tuple[RealismResult, Rewards, Float64[Tensor, "C B N A"]]:
    """Realism and rewards of rollouts, see `score_rollouts`, and shares of the agents in the constrained means.

    Args:
        batch: Scenarios with futures.
        rollouts: N rollouts of each scenario, in the frame of the batch.
        config: Reward, metric, credit assignment and constraints.
    """
    realism, agents = score_rollouts(batch, rollouts, config.metric)
    terms, split = parse_reward(config.reward), agents if config.credit == "agent" else None
    rewards = compute_rewards(terms, realism, rollouts, batch, split, credit_mixing=config.credit_mixing)
    return realism, rewards, credit_constraints(config.constraints, batch, rollouts, agents)


def most_realistic_ends(rollouts: Rollouts, realism: RealismResult) -> Float[Tensor, "B A 2"]:
    """Final positions of the agents in the rollout of each scenario with the highest single meta-metric, map frame.

    Args:
        rollouts: N rollouts of each scenario.
        realism: Scores of the same rollouts, a row per scenario.
    """
    # A rollout without a finite score (nothing valid to compare with) is never chosen before one that has a score.
    index = torch.nan_to_num(realism.single_meta_metric, nan=-math.inf).argmax(-1)
    return rollouts.position[torch.arange(len(index), device=index.device), index, :, -1]


def measure_changes(
    learner: Any, experiences: Sequence[Experience], config: FinetuneConfig, fabric: Fabric
) -> list[float]:
    """Change of each constrained mean from the reference, rolled out with the same scenarios, goals and noise.

    Args:
        learner: Policy, reference, and number of the update.
        experiences: Rollouts of this process by the policy, an entry per micro batch.
        config: Constraints, and the seed of the rollouts.
        fabric: Precision of the pass, and the processes that sums are added over.
    """
    count, seed = min(NUM_COMPARED, config.num_rollouts), derive_seed(config.seed, "rollouts", learner.update)
    sums = torch.zeros(2, len(config.constraints), device=fabric.device, dtype=torch.float64)
    for experience in experiences:
        batch, rollouts = experience.batch, experience.rollouts.select(slice(count))
        with fabric.autocast(), torch.no_grad(), one_thread():
            context = encode_like(learner.reference, batch, experience.context)
            before = simulate(
                learner.reference, batch, num_rollouts=count, seed=seed, context=context, goals=rollouts.goals,
                may_be_nan=True,
            )  # fmt: skip
        values, earlier = (measure_constraints(config.constraints, batch, r, config.metric) for r in (rollouts, before))
        change = values - earlier  # [C, B]
        sums += torch.stack([torch.where(change.isfinite(), change, 0.0).sum(1), change.isfinite().sum(1)])
    total, num_scenarios = all_reduce_sum(sums, fabric)
    return (total / num_scenarios.clamp(min=1)).tolist()


def count_decisions(experiences: Sequence[Experience], fabric: Fabric) -> tuple[int, float]:
    """Number of scenarios and of decisions in the whole batch, other processes included.

    Args:
        experiences: Rollouts of this process with rewards, an entry per micro batch.
        fabric: Processes of the run, over which sums are added.
    """
    totals = torch.zeros(2, device=fabric.device, dtype=torch.float64)
    for experience in experiences:
        rollout_ids = experience.rollout_ids or range(experience.rollouts.num_rollouts)
        # Of processes with the same scenarios, the one with the first rollouts counts these.
        num_scenarios = experience.batch.num_scenarios if rollout_ids.start == 0 else 0
        num_decisions = experience.rollouts.decision_mask[:, rollout_ids.start : rollout_ids.stop].sum()
        totals += torch.stack([torch.tensor(num_scenarios, device=fabric.device), num_decisions])
    num_scenarios, num_decisions = all_reduce_sum(totals, fabric).tolist()
    return int(num_scenarios), num_decisions


# ---- metrics -------------------------------------------------------------------------------------------------------


def describe(experiences: Sequence[Experience], fabric: Fabric) -> dict[str, float]:
    """Metrics of an update: means over all scenarios, other processes included.

    A scenario without a finite value is left out of that mean.

    Args:
        experiences: Rollouts of this process with rewards, an entry per micro batch.
        fabric: Processes of the run, over which sums are added.
    """
    metrics = [describe_scenarios(experience) for experience in experiences]
    values = torch.stack(
        [torch.cat([scenario_metrics[name] for scenario_metrics in metrics]).double() for name in metrics[0]]
    )  # [metrics, B]
    # Sums and counts travel, not means: processes may have different numbers of scenarios.
    is_finite = values.isfinite()
    sums = all_reduce_sum(
        torch.stack([torch.where(is_finite, values, 0.0).sum(-1), is_finite.sum(-1).double()]), fabric
    )
    return dict(zip(metrics[0], (sums[0] / sums[1]).tolist()))


def describe_scenarios(experience: Experience) -> dict[str, Float[Tensor, "B"]]:
    """Metrics of each scenario, by the names of metrics.jsonl."""
    realism, rewards = experience.realism, experience.rewards
    metrics = {
        "reward_mean": rewards.total.mean(-1),
        "reward_std": rewards.total.std(-1),
        # All zero: no finite reward, or rollouts that are exactly alike.
        "reward_zero_rate": (rewards.total == 0).all(-1).double(),
    }
    for term, values, is_missing in zip(rewards.terms, rewards.by_term, rewards.is_missing):
        metrics |= {f"reward_{term.name}_mean": values.mean(-1), f"reward_{term.name}_std": values.std(-1)}
        metrics[missing_rate_name(term)] = is_missing.double()
    metrics |= describe_goals(experience)
    metrics |= {
        "rmm": realism.meta_metric,
        "kinematic": realism.kinematic,
        "interactive": realism.interactive,
        "map_based": realism.map_based,
        "ade_m": realism.average_displacement_error,
        "min_ade_m": realism.min_average_displacement_error,
        "collision_rate": realism.collision_rate,
        "offroad_rate": realism.offroad_rate,
        "traffic_light_violation_rate": realism.traffic_light_violation_rate,
        "diversity_m": compute_diversity(experience.rollouts),
        "speed_gap_mps": compute_speed_gap(experience.batch, experience.rollouts),
    }
    return metrics


def missing_rate_name(term: Term) -> str:
    """Name of the metric for the fraction of scenarios in which a term of the reward is not finite."""
    return f"reward_{term.name}_missing_rate"


def describe_goals(experience: Experience) -> dict[str, Float[Tensor, "B"]]:
    """Fraction of the evaluated agents with a goal that reach it, and that pass it; empty in goal-free runs.

    NaN for a scenario in which no evaluated agent has a goal.
    """
    rollouts, goals = experience.rollouts, experience.rollouts.goals
    if goals is None:
        return {}
    mask = goals.goal_mask & experience.batch.evaluated_mask[:, None]  # [B, N, A]
    criteria = {"goal_reached_rate": is_reached, "goal_passed_rate": is_passed}
    return {name: rate(is_met(rollouts.position, goals), mask).mean(-1) for name, is_met in criteria.items()}


def compute_diversity(rollouts: Rollouts) -> Float[Tensor, "B"]:
    """Mean distance of an agent's final positions from the mean position over rollouts, m."""
    ends = rollouts.position[..., -1, :]  # [B, N, A, 2]
    spread = (ends - ends.mean(1, keepdim=True)).norm(dim=-1)  # [B, N, A]
    # Padding has positions, too: only agents that decide count.
    present = rollouts.decision_mask.any(-1)  # [B, N, A]
    return torch.where(present, spread, 0.0).sum((1, 2)) / present.sum((1, 2))


def compute_speed_gap(batch: ScenarioBatch, rollouts: Rollouts) -> Float[Tensor, "B"]:
    """Mean simulated speed minus mean logged speed, m/s, over the agents and steps that are valid in the log.

    Args:
        batch: scenarios with logged tracks.
        rollouts: N rollouts of each scenario, in the frame of the batch.

    Returns:
        NaN for a scenario with no logged future.
    """
    simulated, logged_valid = simulated_speeds(batch, rollouts)
    return ((simulated.mean(1) - logged_speeds(batch)) * logged_valid).sum((1, 2)) / logged_valid.sum((1, 2))


class UpdateClock:
    """Stopwatch of an update: seconds of each kind of lap, the device's work included."""

    def __init__(self, device: torch.device) -> None:
        self.seconds: dict[str, float] = {}
        self._device = device
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Add the seconds since the last lap under the name "seconds_NAME"."""
        # CUDA runs behind Python: without waiting, a lap would be charged to the next one.
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        current = time.perf_counter()
        name = f"seconds_{name}"
        self.seconds[name] = self.seconds.get(name, 0.0) + current - self._last
        self._last = current
