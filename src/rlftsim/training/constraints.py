"""Constraints: means over rollouts that fine-tuning leaves as they are, by name.

Realism pays for slow driving, as slow cars collide less. So calibration projects the step, and weights pay a price for
a change, see `Prices`. A constraint of a notebook or a separate package:

    @register_constraint("gap", tolerance=0.5)
    def gap(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
        return ...  # shares of the agents in the mean gap, m

    [project.entry-points."rlftsim.constraints"]
    gap = "my_package:gap"
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint, is_ours
from rlftsim.realism import SUB_SCORES, AgentScores, RealismResult, score_rollouts
from rlftsim.rewards import leave_one_out
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, MOVING_M_S, STEP_S, STOP_M_S, STOP_STEPS

Direction = Literal["both", "rise", "fall"]
Shares = Callable[[ScenarioBatch, Rollouts, AgentScores], Float[Tensor, "B N A"]]

SCORES = (
    *("meta_metric", "kinematic", "interactive", "map_based", "average_displacement_error"),
    *("min_average_displacement_error", "collision_rate", "offroad_rate", "unlogged_offroad_rate"),
    "traffic_light_violation_rate",
)
"""Scores of a scenario that may be the value of a constraint."""
MEASURED = ("rmm", *SUB_SCORES, "collision_rate", "offroad_rate")
"""Scores that calibration measures beside the constraints, as `RealismResult` has them."""
TAKEN = frozenset((*MEASURED, "length", "kl", "num_decisions"))
"""Columns that calibration measures, no names for constraints of packages."""
RATE = 0.02
"""Growth of a price per update while a mean is off, as a fraction of the part that answers at once."""
SHARE = 0.003
"""Price of a change by the tolerance, as a fraction of the spread of rewards."""
KEPT = 0.9
"""Weight of earlier updates in running means."""


@dataclass(frozen=True)
class Constraint:
    """A sum over agents; fine-tuning holds the mean over rollouts, or the least value."""

    name: str
    shares: Shares
    """Part of each agent in each rollout, to be summed over agents."""
    tolerance: float
    """Change that may be missed, in the unit of the mean."""
    forbidden: Direction = "both"
    """The change that is held back: of minADE a rise, of a sub-score a fall."""
    is_minimum: bool = False
    """True = the value is that of the rollout with the least sum."""
    score: str = ""
    """Field of `RealismResult` that has the value; "" = the sum of the shares has."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "__module__", self.shares.__module__)  # for `is_ours`: that of the function

    def split(self, batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float64[Tensor, "B N A"]:
        """Shares of the agents, see `credit_constraints` for the arguments.

        Raises:
            ConfigError: The function gives no tensor with a number for each agent in each rollout.
        """
        shares, shape = self.shares(batch, rollouts, agents), rollouts.heading.shape[:3]
        if not isinstance(shares, Tensor) or shares.shape != shape:
            result = f"shape {list(shares.shape)}" if isinstance(shares, Tensor) else f"a {type(shares).__name__}"
            raise ConfigError(
                f"constraint {self.name!r} of {self.__module__} gives {result}, expected {list(shape)}: return "
                "a tensor with each agent's share in each rollout [B, N, A]."
            )
        return shares.double()

    def measure(
        self, realism: RealismResult, batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores
    ) -> Float64[Tensor, "B"]:
        """Value in each scenario: the score, or without a score the value of the shares, see `split`.

        Args:
            realism: Scores of the rollouts, a row per scenario.
            batch: Scenarios with logged tracks.
            rollouts: N rollouts of each scenario.
            agents: Scores of the same rollouts, split over agents.
        """
        if self.score:
            return getattr(realism, self.score).double()
        return self.value(self.split(batch, rollouts, agents))

    def value(self, shares: Float[Tensor, "B N A"]) -> Float[Tensor, "B"]:
        """Value in each scenario, by the shares."""
        total = shares.sum(-1)
        return total.amin(1) if self.is_minimum else total.mean(1)

    def credit(self, shares: Float[Tensor, "B N A"]) -> Float[Tensor, "B N A"]:
        """Contribution of an agent's decisions in a rollout to the value.

        Summed with score functions over rollouts and agents, credits are an estimate of the value's gradient, without
        bias where no agent's part depends on other agents.
        """
        if not self.is_minimum:
            return leave_one_out(shares / shares.shape[1])
        # Without the rollout of the least sum the value is the second one, without any other it is what it was.
        first, second = shares.sum(-1).topk(2, dim=1, largest=False).indices.unbind(1)  # [B]
        row, added = torch.arange(len(shares), device=shares.device), torch.zeros_like(shares)
        added[row, first] = shares[row, first] - shares[row, second]
        return added

    def bound(self, price: float) -> float:
        """The price without a part that would pay for the change that is allowed."""
        if self.forbidden == "rise":
            return max(price, 0.0)
        return min(price, 0.0) if self.forbidden == "fall" else price


CONSTRAINTS: ExtensionPoint[Constraint] = ExtensionPoint(
    "constraint", "rlftsim.constraints", use=lambda name: constraint_by_name(name)
)
"""Constraints by name, this package's and others'."""


def register_constraint(
    name: str, *, tolerance: float, forbidden: Direction = "both", is_minimum: bool = False, score: str = ""
) -> Callable[[Shares], Constraint]:
    """Decorator that makes a constraint of a function and registers it; an earlier one of yours is replaced.

    Args:
        name: Name in `finetune.constraints` and `calibrate.constraints`.
        tolerance: Change that may be missed, in the unit of the mean.
        forbidden: Changes that are held back: both, a rise, or a fall.
        is_minimum: The value is that of the rollout with the least sum, in place of the mean over rollouts.
        score: Field of `RealismResult` that has the value, where shares have the differences between rollouts alone.

    Raises:
        ConfigError: The name of a shipped constraint or of a measured column, a tolerance that is not above 0, or an
            unknown score.
    """
    if not (math.isfinite(tolerance) and tolerance > 0):
        raise ConfigError(f"constraint {name!r}: tolerance is a finite number above 0, got {tolerance}.")
    if score and score not in SCORES:
        raise ConfigError(f"constraint {name!r}: there is no score {score!r}: take one of {', '.join(SCORES)}.")

    def register(function: Shares) -> Constraint:
        constraint = Constraint(name, function, tolerance, forbidden, is_minimum, score)
        _check_name(name, constraint)
        CONSTRAINTS.add(name, constraint, stacklevel=3)
        return constraint

    return register


def constraint_by_name(name: str) -> Constraint:
    """The constraint of a name, installed packages included.

    Raises:
        ConfigError: Unknown, with the nearest registered name; or no constraint; or the name of a measured column.
    """
    constraint = CONSTRAINTS.get(name)
    if not isinstance(constraint, Constraint):
        raise ConfigError(
            f"constraint {name!r} is of type {type(constraint).__name__}: decorate it with register_constraint."
        )
    _check_name(name, constraint)
    return constraint


def _check_name(name: str, constraint: Constraint) -> None:
    if name in TAKEN and not is_ours(constraint):
        raise ConfigError(f"constraint {name!r} has the name of a column that is measured: choose another name.")


def check_constraints(names: Sequence[str]) -> None:
    """Check before a run that each name is that of a constraint, and none comes twice: it would halve the price.

    Raises:
        ConfigError: A repeated name, or the causes in `constraint_by_name`.
    """
    if len(set(names)) < len(names):
        raise ConfigError(f"constraints are different names, got {', '.join(names)}.")
    for name in names:
        constraint_by_name(name)


def credit_constraints(
    names: Sequence[str], batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores
) -> Float64[Tensor, "C B N A"]:
    """Credits of the agents for each constraint; 0 for agents without a decision.

    Args:
        names: Names of C constraints.
        batch: Scenarios with logged tracks.
        rollouts: N rollouts of each scenario.
        agents: Scores of the same rollouts.
    """
    decides = rollouts.decision_mask.any(-1)  # [B, N, A]
    credits = torch.zeros(len(names), *decides.shape, dtype=torch.float64, device=decides.device)
    for row, constraint in zip(credits, map(constraint_by_name, names)):
        values = constraint.credit(constraint.split(batch, rollouts, agents))
        row.copy_(torch.where(decides, values.nan_to_num(), 0.0))
    return credits


def measure_constraints(
    names: Sequence[str], batch: ScenarioBatch, rollouts: Rollouts, metric: str
) -> Float64[Tensor, "C B"]:
    """Values of the constrained means in each scenario; 0 where no agent counts.

    Args:
        names: Names of C constraints.
        batch: Scenarios with futures.
        rollouts: Rollouts of each scenario.
        metric: Configuration of the meta-metric.
    """
    realism, agents = score_rollouts(batch, rollouts, metric)
    values = torch.zeros(len(names), batch.num_scenarios, dtype=torch.float64, device=batch.device)
    for row, constraint in zip(values, map(constraint_by_name, names)):
        row.copy_(constraint.measure(realism, batch, rollouts, agents))
    return values


# ---- prices of weights -----------------------------------------------------------------------------------------------


class Prices:
    """Lagrange multipliers of the constraints: the price of a unit of each mean, in rewards.

    A price is the slope of the rewards by the mean (a regression over agents), so that a change earns nothing at first,
    and a part in proportion to the measured change, and a part that grows while the change lasts: dual ascent, kept
    from swinging by the proportional part.

    Source: Stooke et al., "Responsive Safety in Reinforcement Learning by PID Lagrangian Methods", 2020.

    Args:
        names: Names of C constraints.
    """

    def __init__(self, names: Sequence[str]):
        self.names = tuple(names)
        self.change = dict.fromkeys(self.names, 0.0)
        """Last measured change of each mean."""
        self.lasting = dict.fromkeys(self.names, 0.0)
        """Part of each price that grew, in changes by the tolerance."""
        self.spread = 0.0
        """Running standard deviation of a rollout's reward times the number of rollouts."""
        self.moments = np.zeros((len(self.names) + 1, len(self.names)))
        """Running sums over agents of products of two credits, and in the last row of credit and reward."""

    def watch(self, spread: float, moments: Float64[np.ndarray, "D C"], changes: Sequence[float]) -> dict[str, float]:
        """Take in the rewards and the measured changes of an update.

        Args:
            spread: Standard deviation of a rollout's reward times the number of rollouts.
            moments: Sums over agents of products of two credits, and in the last row of credit and reward.
            changes: Change of each mean from the reference, in the order of the names.

        Returns:
            Metrics of the update: each change, and the price to be paid.
        """
        if math.isfinite(spread) and np.isfinite(moments).all():
            weight = 1 - KEPT if self.spread else 1.0
            self.spread += weight * (spread - self.spread)
            self.moments = self.moments + weight * (moments - self.moments)
        for name, change in zip(self.names, changes):
            if math.isfinite(change):
                constraint = constraint_by_name(name)
                self.change[name] = change
                self.lasting[name] = constraint.bound(self.lasting[name] + RATE * change / constraint.tolerance)
        prices = {f"price_{name}": self.price(name) for name in self.names}
        return {f"change_{name}": change for name, change in zip(self.names, changes)} | prices

    def price(self, name: str) -> float:
        """Reward that a unit of the mean costs."""
        constraint, index = constraint_by_name(name), self.names.index(name)
        paid = np.linalg.lstsq(self.moments[:-1], self.moments[-1], rcond=1e-6)[0][index]
        level = self.change[name] / constraint.tolerance + self.lasting[name]
        return constraint.bound(float(paid) + SHARE * self.spread * level / constraint.tolerance)

    def to_numbers(self) -> dict[str, float]:
        """Numbers for a checkpoint; none without constraints."""
        numbers = {"prices.spread": self.spread} if self.names else {}
        for name, moments in zip(self.names, self.moments.T):
            values = (self.change[name], self.lasting[name], *moments.tolist())
            numbers |= {f"prices.{name}.{index}": value for index, value in enumerate(values)}
        return numbers

    def load_numbers(self, numbers: Mapping[str, float]) -> None:
        """Take back the numbers of a checkpoint."""
        self.spread = numbers["prices.spread"] if self.names else 0.0
        for column, name in enumerate(self.names):
            values = [numbers[f"prices.{name}.{index}"] for index in range(3 + len(self.names))]
            self.change[name], self.lasting[name], *moments = values
            self.moments[:, column] = moments


# ---- the constraints of this package ---------------------------------------------------------------------------------


@register_constraint("speed", tolerance=0.1)
def share_speed(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """Parts of the agents in the mean speed, m/s, over the steps that the log has.

    Args:
        batch: Scenarios with logged tracks.
        rollouts: N rollouts of each scenario.
        agents: Scores of the same rollouts; not read here.
    """
    speed, counts = mean_speeds(batch, rollouts)
    return _mean_shares(speed, counts)


@register_constraint("evaluated_speed", tolerance=0.1)
def share_evaluated_speed(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """Parts of the evaluated agents in the mean speed, m/s; see `share_speed`."""
    speed, counts = mean_speeds(batch, rollouts)
    return _mean_shares(speed, counts & batch.evaluated_mask)


@register_constraint("moving_speed", tolerance=0.1)
def share_moving_speed(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """Parts in the mean speed, m/s, of the agents that move in the log, as in evaluations."""
    speed, _ = mean_speeds(batch, rollouts)
    return _mean_shares(speed, find_moving(batch))


@register_constraint("evaluated_moving_speed", tolerance=0.1)
def share_evaluated_moving_speed(
    batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores
) -> Float[Tensor, "B N A"]:
    """Parts in the mean speed, m/s, of the evaluated agents that move in the log."""
    speed, _ = mean_speeds(batch, rollouts)
    return _mean_shares(speed, find_moving(batch) & batch.evaluated_mask)


@register_constraint("min_ade", tolerance=0.05, forbidden="rise", is_minimum=True)
def share_displacement(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """Parts of the evaluated agents in the mean displacement error, m."""
    return agents.displacement_error


@register_constraint("kinematic", tolerance=0.002, forbidden="fall", score="kinematic")
def share_kinematic(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """Parts of the evaluated agents in the kinematic sub-score, less the mean over rollouts."""
    # a leave-one-out share is what a rollout adds to the score of all N
    return agents.sub_scores["kinematic"] * rollouts.num_rollouts


@register_constraint("stops", tolerance=0.01, forbidden="rise")
def share_stops(batch: ScenarioBatch, rollouts: Rollouts, agents: AgentScores) -> Float[Tensor, "B N A"]:
    """Parts of the agents in the fraction that stops of evaluated agents that go on in the log.

    Args:
        batch: Scenarios with logged tracks.
        rollouts: N rollouts of each scenario.
        agents: Scores of the same rollouts; not read here.
    """
    speed, logged_valid = simulated_speeds(batch, rollouts)  # [B, N, A, T], [B, A, T]
    never_stops = find_moving(batch) & batch.evaluated_mask & ~_stops(logged_speeds(batch), logged_valid)  # [B, A]
    return _mean_shares(_stops(speed, logged_valid[:, None]).float(), never_stops)


def simulated_speeds(
    batch: ScenarioBatch, rollouts: Rollouts
) -> tuple[Float[Tensor, "B N A T"], Float[Tensor, "B A T"]]:
    """Speeds of each step of the future, m/s, and 1 for the agents and steps that are valid in the log, else 0.

    Args:
        batch: scenarios with logged tracks.
        rollouts: N rollouts of each scenario, in the frame of the batch.
    """
    # The first simulated step starts at the current one, which is logged: [B, N, A, 1, 2].
    start = batch.position[:, None, :, CURRENT_STEP, None].expand(-1, rollouts.num_rollouts, -1, -1, -1)
    return torch.cat([start, rollouts.position], dim=-2).diff(dim=-2).norm(dim=-1) / STEP_S, find_logged(batch)


def mean_speeds(batch: ScenarioBatch, rollouts: Rollouts) -> tuple[Float[Tensor, "B N A"], Bool[Tensor, "B A"]]:
    """Mean speed of each agent over the steps that its log has, m/s, and True for agents with such steps; else 0.

    Args:
        batch: Scenarios with logged tracks.
        rollouts: N rollouts of each scenario, in the frame of the batch.
    """
    speed, logged_valid = simulated_speeds(batch, rollouts)
    mean = (speed * logged_valid[:, None]).sum(-1) / logged_valid.sum(-1).clamp(min=1)[:, None]
    return mean, logged_valid.any(-1)


def logged_speeds(batch: ScenarioBatch) -> Float[Tensor, "B A T"]:
    """Speeds of each step of the logged future, m/s; meaningless where the log is not valid."""
    return batch.position[:, :, CURRENT_STEP:].diff(dim=-2).norm(dim=-1) / STEP_S


def find_moving(batch: ScenarioBatch) -> Bool[Tensor, "B A"]:
    """True for agents that move at 1 m/s or more on average in the steps that the log has."""
    logged_valid = find_logged(batch)
    mean = (logged_speeds(batch) * logged_valid).sum(-1) / logged_valid.sum(-1).clamp(min=1)
    return mean >= MOVING_M_S


def find_logged(batch: ScenarioBatch) -> Float64[Tensor, "B A T"]:
    """1 for the agents and steps of the future at which the log has a speed, else 0."""
    future, valid = slice(CURRENT_STEP + 1, None), batch.valid
    # A speed is the way of one step, so both of its ends have to be valid: [B, A, T].
    return (valid[:, :, future] & valid[:, :, CURRENT_STEP:-1] & batch.agent_mask[..., None]).double()


def _stops(speed: Float[Tensor, "*n T"], logged_valid: Float[Tensor, "*m T"]) -> Bool[Tensor, "*n"]:
    """True for agents that stand for a second on end, at steps that the log has."""
    return ((speed < STOP_M_S) & (logged_valid > 0)).unfold(-1, STOP_STEPS, 1).all(-1).any(-1)


def _mean_shares(values: Float[Tensor, "B N A"], counts: Bool[Tensor, "B A"]) -> Float[Tensor, "B N A"]:
    """Values of the agents that count, over the number of these."""
    return torch.where(counts[:, None], values, 0.0) / counts.sum(-1).clamp(min=1)[:, None, None]
