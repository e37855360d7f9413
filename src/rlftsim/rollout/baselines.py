"""Policies without weights: a lower bound for every model, and the smallest example of the interface."""

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
        """The only possible decision.

        Args:
            sampling: Sampling of any temperature; `top_k` is refused, as there are no categories.
            noise: Noise of any size, not used: `Policy.noise_size` may be 0.

        Raises:
            ConfigError: `sampling.top_k` is set.
        """
        check_no_top_k(sampling)
        return self.decision

    def log_prob(self, decision: Tensor, sampling: Sampling = Sampling()) -> Float[Tensor, "*batch"]:  # noqa: B008
        """Zeros: the only possible decision has probability 1.

        Args:
            decision: Decisions [*batch, event], not compared with the possible decision.
            sampling: Sampling of any temperature; `top_k` is refused, as in `sample`.
        """
        check_no_top_k(sampling)
        return torch.zeros_like(decision[..., 0])

    def kl(self, reference: "PointMass") -> Float[Tensor, "*batch"]:
        """Zeros."""
        return torch.zeros_like(self.decision[..., 0])

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Zeros."""
        return torch.zeros_like(self.decision[..., 0])


def check_no_top_k(sampling: Sampling) -> None:
    """Check that no truncation is set, for decisions that are not categories.

    Args:
        sampling: Sampling of a draw or of the draw's log-probability; the temperature may be any.

    Raises:
        ConfigError: `sampling.top_k` is set.
    """
    if sampling.top_k is not None:
        raise ConfigError(f"top_k={sampling.top_k} needs a policy with categories, this one has none: leave top_k out.")


@dataclass(frozen=True, eq=False)
class State:
    """Poses and velocities of running simulations [B, N, A], map frame; as a context at the current step [B, A]."""

    position: Float[Tensor, "*batch 2"]
    heading: Float[Tensor, "*batch"]
    velocity: Float[Tensor, "*batch 2"]
    poses: Float[Tensor, "B N A 1 3"] | None = None
    draws: Tensor | None = None


class ConstantVelocity:
    """Every agent keeps the velocity and heading of the current step.

    A decision is a velocity, kept for 0.1 s.
    """

    architecture = "constant_velocity"
    fingerprint_name = "rlftsim.rollout.baselines.ConstantVelocity"
    steps_per_decision = 1
    noise_size = 0
    initial_noise_size = 0

    def __repr__(self) -> str:
        return "ConstantVelocity()"

    def encode(self, scenarios: ScenarioBatch) -> State:
        """States at the current step."""
        states = (scenarios.position, scenarios.heading, scenarios.velocity)
        return State(*(values[:, :, CURRENT_STEP] for values in states))

    def begin(self, context: State, num_rollouts: int, goals: Goals | None, noise: Tensor) -> State:
        """The current state, N times.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            num_rollouts: Number N of simulations of each scenario, all in a single state.
            goals: Goals of agents, ignored: a constant velocity has no goals.
            noise: Noise [B, N, A, 0], empty since no numbers are drawn.
        """
        states = (context.position, context.heading, context.velocity)
        return State(*(v[:, None].expand(-1, num_rollouts, *v.shape[1:]) for v in states))

    def decide(self, context: State, state: State) -> PointMass:
        """Distributions [B, N, A] with all mass on the present velocity.

        Args:
            context: Context from `encode`, not used.
            state: State before the decision, whose velocity is the decision.
        """
        return PointMass(state.velocity)

    def advance(
        self, context: State, state: State, decision: Float[Tensor, "B N A 2"], forced: AgentStates | None = None
    ) -> State:
        """State after 0.1 s at the chosen velocity; the heading stays.

        Args:
            context: Context from `encode`, not used.
            state: State before the decision.
            decision: Velocities in m/s, map frame.
            forced: States of a single step imposed from outside; None = no agent is forced.
        """
        position, heading = state.position + decision * STEP_S, state.heading
        if forced is not None:
            imposed = forced.valid[..., 0]  # [B, N, A]; a decision lasts a single step
            position = torch.where(imposed[..., None], forced.position[..., 0, :], position)
            heading = torch.where(imposed, forced.heading[..., 0], heading)
        poses = torch.cat([position, heading[..., None]], -1)[..., None, :]
        return State(position, heading, state.velocity, poses, state.draws)

    def score(self, context: State, rollouts: Rollouts) -> PointMass:
        """Distributions [B, N, A, L]: the same velocity at every decision.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            rollouts: Rollouts of the same scenarios; only the shape of the decisions is read.
        """
        return PointMass(context.velocity[:, None, :, None].expand_as(rollouts.decision))
