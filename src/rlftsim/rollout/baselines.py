"""Policies without weights: the floor every model has to beat, and the smallest example of the interface."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.goals.types import Goals
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, STEP_S


@dataclass(frozen=True, eq=False)
class PointMass:
    """A distribution with a single possible decision: probability 1, so log-probability, KL and entropy are 0."""

    decision: Float[Tensor, "*batch event"]

    def sample(self, sampling: Sampling, noise: Tensor) -> Tensor:
        """The decision. Raises ConfigError where `sampling.top_k` is asked for: there are no categories."""
        _refuse_top_k(sampling)
        return self.decision

    def log_prob(self, decision: Tensor, sampling: Sampling = Sampling()) -> Float[Tensor, "*batch"]:  # noqa: B008
        """Zeros."""
        _refuse_top_k(sampling)
        return torch.zeros_like(decision[..., 0])

    def kl(self, other: "PointMass") -> Float[Tensor, "*batch"]:
        """Zeros."""
        return torch.zeros_like(self.decision[..., 0])

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Zeros."""
        return torch.zeros_like(self.decision[..., 0])


def _refuse_top_k(sampling: Sampling) -> None:
    if sampling.top_k is not None:
        raise ConfigError(f"top_k={sampling.top_k} needs a policy with categories, this one has none: leave top_k out.")


@dataclass(frozen=True, eq=False)
class ConstantVelocityContext:
    """State of every agent at the current step, map frame."""

    position: Float[Tensor, "B A 2"]
    heading: Float[Tensor, "B A"]
    velocity: Float[Tensor, "B A 2"]


@dataclass(frozen=True, eq=False)
class ConstantVelocityState:
    """Where everybody is."""

    position: Float[Tensor, "B N A 2"]
    heading: Float[Tensor, "B N A"]
    velocity: Float[Tensor, "B N A 2"]
    poses: Float[Tensor, "B N A 1 3"] | None = None
    draws: Tensor | None = None


class ConstantVelocity:
    """Every agent keeps the velocity and heading it has at the current step. A decision is a velocity, kept for 0.1 s."""

    steps_per_decision = 1
    noise_size = 0
    initial_noise_size = 0

    def encode(self, scenarios: ScenarioBatch) -> ConstantVelocityContext:
        """The current states."""
        now = CURRENT_STEP
        return ConstantVelocityContext(
            scenarios.position[:, :, now], scenarios.heading[:, :, now], scenarios.velocity[:, :, now]
        )

    def begin(
        self, context: ConstantVelocityContext, num_rollouts: int, goals: Goals | None, noise: Tensor
    ) -> ConstantVelocityState:
        """The current state, N times. Goals are ignored: this policy cannot be asked for anything."""
        repeated = (
            v[:, None].expand(-1, num_rollouts, *v.shape[1:])
            for v in (context.position, context.heading, context.velocity)
        )
        return ConstantVelocityState(*repeated)

    def decide(self, context: ConstantVelocityContext, state: ConstantVelocityState) -> PointMass:
        """The velocity it has."""
        return PointMass(state.velocity)

    def advance(
        self,
        context: ConstantVelocityContext,
        state: ConstantVelocityState,
        decision: Float[Tensor, "B N A 2"],
        forced: AgentStates | None = None,
    ) -> ConstantVelocityState:
        """Move on by 0.1 s."""
        position, heading = state.position + decision * STEP_S, state.heading
        if forced is not None:
            imposed = forced.valid[..., 0]
            position = torch.where(imposed[..., None], forced.position[..., 0, :], position)
            heading = torch.where(imposed, forced.heading[..., 0], heading)
        poses = torch.cat([position, heading[..., None]], -1)[..., None, :]
        return ConstantVelocityState(position, heading, state.velocity, poses, state.draws)

    def score(self, context: ConstantVelocityContext, rollouts: Rollouts) -> PointMass:
        """The same velocity at every decision."""
        return PointMass(context.velocity[:, None, :, None].expand_as(rollouts.decision))
