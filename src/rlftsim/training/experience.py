"""The experience of an update: rollouts of some scenarios, what they earn, and the metrics that are logged of it."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.goals.attainment import is_passed, is_reached, rate
from rlftsim.realism import AgentScores, RealismResult, compute_batch_features, metric_by_name, score_batch_features
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rewards import CreditTo, Rewards, compute_rewards, parse_reward
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, STEP_S
from rlftsim.threads import one_thread
from rlftsim.training.goals import GoalConfig, StoredGoals, choose_goals
from rlftsim.training.parallel import Fabric, all_reduce_sum


@dataclass(frozen=True, eq=False)
class Experience:
    """Rollouts of some scenarios and what they earned."""

    batch: ScenarioBatch
    rollouts: Rollouts
    realism: RealismResult
    rewards: Rewards
    context: Any = None
    """Of the batch, made without gradient by the policy that rolled out; None = there is none to share."""

    def slices(self, size: int) -> Iterator[tuple[Rollouts, Float[Tensor, "B n A"]]]:
        """Yield the rollouts of every scenario, `size` at a time, with what each agent earned in them."""
        return slices(self.rollouts, self.rewards.by_agent, size)


def slices(
    rollouts: Rollouts, earned: Float[Tensor, "B N A"], size: int
) -> Iterator[tuple[Rollouts, Float[Tensor, "B n A"]]]:
    """Yield rollouts a few at a time, so that few are in memory with their gradient.

    Args:
        rollouts: N of each scenario.
        earned: by each agent in each of them.
        size: rollouts of every scenario in a slice; the last one may be smaller.
    """
    for start in range(0, rollouts.num_rollouts, size):
        part = slice(start, start + size)
        yield rollouts.select(part), earned[:, part]


# ---- sampling and rewards ------------------------------------------------------------------------------------------


def sample_rollouts(
    policy: Any,
    batch: ScenarioBatch,
    goals: GoalConfig,
    augmented: StoredGoals | None,
    *,
    num_rollouts: int,
    seed: int,
    update: int,
    fabric: Fabric,
) -> tuple[Any, Rollouts]:
    """Context and rollouts of an update, without gradient. All rollouts of a scenario have the same goals.

    Args:
        policy: decides for all agents.
        batch: scenarios with their futures.
        goals: probabilities of goals.
        augmented: goals beside the logged endpoints, if there are any.
        num_rollouts: N, of each scenario.
        seed: of the run.
        update: counted from 0; with the seed it determines goals and rollouts.
        fabric: precision of the pass.
    """
    chosen = choose_goals(batch, goals, augmented, seed=derive_seed(seed, "goals", update))
    with fabric.autocast(), torch.no_grad(), one_thread():
        context = policy.encode(batch)
        rollouts = simulate(
            policy, batch, num_rollouts=num_rollouts, seed=derive_seed(seed, "rollouts", update), context=context,
            goals=chosen,
        )  # fmt: skip
    return context, rollouts


@runtime_checkable
class RewardSettings(Protocol):
    """The settings of a run that its rewards depend on."""

    @property
    def reward(self) -> str:
        """Sum of registered rewards."""
        ...

    @property
    def metric(self) -> str:
        """Configuration of the meta-metric."""
        ...

    @property
    def credit(self) -> CreditTo:
        """Credit assignment: by rollout or by agent."""
        ...

    @property
    def credit_mixing(self) -> float:
        """Weight of the other agents' rewards."""
        ...


def compute_reward(batch: ScenarioBatch, rollouts: Rollouts, config: RewardSettings) -> tuple[RealismResult, Rewards]:
    """Realism of rollouts and what they earn; a scenario without a map counts as on the road.

    The features that both are made of are measured once, however many terms the reward has.

    Args:
        batch: scenarios with their futures.
        rollouts: N of each.
        config: reward, metric and credit assignment.
    """
    metric = metric_by_name(config.metric)
    features = compute_batch_features(batch.scenarios, states_of_rollouts(batch, rollouts), missing_map="neutral")
    realism = score_batch_features(features, metric)
    agents = AgentScores(features, metric, batch.agent_mask.shape[1]) if config.credit == "agent" else None
    terms = parse_reward(config.reward)
    return realism, compute_rewards(terms, realism, rollouts, batch, agents, credit_mixing=config.credit_mixing)


def count_decisions(experiences: Sequence[Experience], fabric: Fabric) -> tuple[int, float]:
    """Number of scenarios and of decisions in the whole batch, those of other processes included.

    Args:
        experiences: of this process.
        fabric: the processes.
    """
    counts = [(e.batch.num_scenarios, int(e.rollouts.decision_mask.sum())) for e in experiences]
    totals = torch.tensor(counts, device=fabric.device, dtype=torch.float64).sum(0)
    num_scenarios, num_decisions = all_reduce_sum(totals, fabric).tolist()
    return int(num_scenarios), num_decisions


# ---- metrics -------------------------------------------------------------------------------------------------------


def describe(experiences: Sequence[Experience], fabric: Fabric) -> dict[str, float]:
    """Metrics of an update: means over all scenarios, those of other processes included.

    A scenario without a finite value is left out of that mean.

    Args:
        experiences: of this process.
        fabric: the processes.
    """
    parts = [describe_scenarios(experience) for experience in experiences]
    values = torch.stack([torch.cat([part[name] for part in parts]).double() for name in parts[0]])  # [metrics, B]
    # Sums and counts travel, not means: processes may have different numbers of scenarios.
    known = values.isfinite()
    sums = all_reduce_sum(torch.stack([torch.where(known, values, 0.0).sum(-1), known.sum(-1).double()]), fabric)
    return dict(zip(parts[0], (sums[0] / sums[1]).tolist()))


def describe_scenarios(experience: Experience) -> dict[str, Float[Tensor, "B"]]:
    """Metrics of each scenario, by the names of metrics.jsonl."""
    realism, rewards = experience.realism, experience.rewards
    metrics = {
        "reward_mean": rewards.total.mean(-1),
        "reward_std": rewards.total.std(-1),
        # All zero: no finite reward, or rollouts that are exactly alike.
        "reward_zero_rate": (rewards.total == 0).all(-1).double(),
    }
    for term, values in zip(rewards.terms, rewards.by_term):
        metrics |= {f"reward_{term.name}_mean": values.mean(-1), f"reward_{term.name}_std": values.std(-1)}
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


def describe_goals(experience: Experience) -> dict[str, Float[Tensor, "B"]]:
    """Fraction of the evaluated agents with a goal that reach it, and that pass it; empty in goal-free runs.

    NaN for a scenario in which no evaluated agent has a goal.
    """
    rollouts, goals = experience.rollouts, experience.rollouts.goals
    if goals is None:
        return {}
    mask = goals.goal_mask & experience.batch.evaluated_mask[:, None]  # [B, N, A]
    ways = {"goal_reached_rate": is_reached, "goal_passed_rate": is_passed}
    return {name: rate(is_met(rollouts.position, goals), mask).mean(-1) for name, is_met in ways.items()}


def compute_diversity(rollouts: Rollouts) -> Float[Tensor, "B"]:
    """Mean distance of an agent's final positions from their mean over rollouts, m."""
    ends = rollouts.position[..., -1, :]  # [B, N, A, 2]
    spread = (ends - ends.mean(1, keepdim=True)).norm(dim=-1)  # [B, N, A]
    # Padding has positions, too: only agents that decide count.
    present = rollouts.decision_mask.any(-1)  # [B, N, A]
    return torch.where(present, spread, 0.0).sum((1, 2)) / present.sum((1, 2))


def compute_speed_gap(batch: ScenarioBatch, rollouts: Rollouts) -> Float[Tensor, "B"]:
    """Mean simulated speed minus mean logged speed, m/s, over the agents and steps that are valid in the log.

    Args:
        batch: scenarios with their logged tracks.
        rollouts: N of each.

    Returns:
        NaN for a scenario with no logged future.
    """
    future, valid = slice(CURRENT_STEP + 1, None), batch.valid
    # A speed is the way of one step, so both of its ends have to be valid: [B, A, T].
    logged_valid = (valid[:, :, future] & valid[:, :, CURRENT_STEP:-1] & batch.agent_mask[..., None]).double()
    # The first simulated step starts at the current one, which is logged: [B, N, A, 1, 2].
    start = batch.position[:, None, :, CURRENT_STEP, None].expand(-1, rollouts.num_rollouts, -1, -1, -1)
    simulated = torch.cat([start, rollouts.position], dim=-2).diff(dim=-2).norm(dim=-1).mean(1)  # [B, A, T]
    logged = batch.position[:, :, CURRENT_STEP:].diff(dim=-2).norm(dim=-1)  # [B, A, T]
    return ((simulated - logged) * logged_valid).sum((1, 2)) / logged_valid.sum((1, 2)) / STEP_S


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
        now = time.perf_counter()
        name = f"seconds_{name}"
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now
