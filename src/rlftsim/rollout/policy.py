"""What the closed loop needs from a model. A policy implements this page and imports nothing else of ours.

Differences from a classical policy API, each for a reason:

* A policy holds weights only; its states are values. Policy and reference can run side by side, rollouts can interleave.
* Randomness is handed in as uniform noise, one value or a few for every (scenario, rollout, agent, decision), drawn from
  the seed and the scenario's id (`rollout.noise`). So the same seed gives the same rollouts however a batch is composed, sliced or
  moved between devices, and nothing random has to be stored to resume a run.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rlftsim.errors import ConfigError
from rlftsim.goals.types import Goals
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch


@dataclass(frozen=True)
class Sampling:
    """How decisions are drawn. RL samples with the defaults, so that the estimator is unbiased."""

    temperature: float = 1.0
    """The density is raised to 1 / temperature; 0 takes the mode."""
    top_k: int | None = None
    """Keep only this many of the most likely decisions; None keeps all."""

    def __post_init__(self) -> None:
        if not self.temperature >= 0:
            raise ConfigError(
                f"sampling temperature must be >= 0, got {self.temperature}: 1 samples, 0 takes the mode."
            )
        if self.top_k is not None and self.top_k < 1:
            raise ConfigError(f"sampling top_k must be >= 1, got {self.top_k}: leave it out to keep all decisions.")

    @property
    def is_full(self) -> bool:
        """Whether the whole, untempered distribution is sampled."""
        return self.temperature == 1.0 and self.top_k is None


@runtime_checkable
class DecisionDistribution(Protocol):
    """One independent distribution per leading element: [B, N, A] while simulating, [B, N, A, L] when scored. float32, nats."""

    def sample(self, sampling: Sampling, noise: Float[Tensor, "... noise"]) -> Tensor:
        """Decisions [..., *event] from uniform noise in [0, 1); never a gradient."""
        ...

    def log_prob(self, decision: Tensor, sampling: Sampling = Sampling()) -> Float[Tensor, "..."]:
        """Log-probability under the distribution that `sampling` draws from, event axes summed."""
        ...

    def kl(self, other: Any) -> Float[Tensor, "..."]:
        """KL(self || other) to a distribution of the same kind, between the full ones, closed form."""
        ...

    def entropy(self) -> Float[Tensor, "..."]:
        """Entropy of the full distribution."""
        ...


@runtime_checkable
class PolicyState(Protocol):
    """A policy's own state of B x N running simulations."""

    poses: Float[Tensor, "B N A t 3"] | None
    """x, y, heading of the steps of the last decision, map frame; None before the first."""
    draws: Tensor | None
    """[B, N, ...] drawn once per rollout."""


@runtime_checkable
class Policy(Protocol):
    """A model that decides for all agents of a scenario."""

    steps_per_decision: int
    """Steps of 0.1 s a decision lasts; divides 80."""
    noise_size: int
    """Uniform numbers a decision consumes (0 = deterministic)."""
    initial_noise_size: int
    """Uniform numbers `begin` consumes per agent."""

    def encode(self, scenarios: ScenarioBatch) -> Any:
        """Everything that does not depend on what agents will do: map, lights, history. Once per scenario, never per rollout."""
        ...

    def begin(self, context: Any, num_rollouts: int, goals: Goals | None, noise: Float[Tensor, "B N A k"]) -> Any:
        """State of N simulations at the current step."""
        ...

    def decide(self, context: Any, state: Any) -> DecisionDistribution:
        """Distributions [B, N, A] of the next decision."""
        ...

    def advance(self, context: Any, state: Any, decision: Tensor, forced: AgentStates | None = None) -> Any:
        """State after the decision: kinematics only. Agents whose forced states are all valid are put there instead."""
        ...

    def score(self, context: Any, rollouts: Rollouts) -> DecisionDistribution:
        """What `decide` would have said at each decision of these rollouts [B, N, A, L]; differentiable, one parallel pass."""
        ...


def device_of(policy: object) -> torch.device:
    """Where a policy computes: with its weights; the CPU if it has none."""
    weights = policy.parameters() if isinstance(policy, nn.Module) else ()
    return next((w.device for w in weights), torch.device("cpu"))


def sees_goals(policy: object) -> bool:
    """Whether goals have an effect on a policy: it says so by an attribute of this name."""
    return bool(getattr(policy, "sees_goals", False))
