"""What may happen: simulated futures of a batch of scenarios.

Frame: map (centred, metres). N rollouts, L decisions, T simulated steps of 0.1 s. A policy's decisions have event axes `*event`
(none for SMART's token ids, one of size 2 for two-dimensional actions).
"""

from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.goals.types import Goals


@dataclass(frozen=True, eq=False)
class AgentStates:
    """States imposed from outside. Where `valid` is False the policy moves the agent and the other fields mean nothing."""

    position: Float[Tensor, "B N A t 2"]
    heading: Float[Tensor, "B N A t"]
    valid: Bool[Tensor, "B N A t"]

    def steps(self, start: int, stop: int) -> "AgentStates":
        """The states of steps [start, stop)."""
        return AgentStates(
            self.position[..., start:stop, :], self.heading[..., start:stop], self.valid[..., start:stop]
        )

    def rollouts(self, selected: slice) -> "AgentStates":
        """The states of some of the rollouts."""
        return AgentStates(self.position[:, selected], self.heading[:, selected], self.valid[:, selected])


@dataclass(frozen=True, eq=False)
class Rollouts:
    """N simulated futures of each of B scenarios, with what was decided and how likely it was."""

    position: Float[Tensor, "B N A T 2"]
    heading: Float[Tensor, "B N A T"]
    decision: Tensor
    """[B, N, A, L, *event]; what was sampled, never recovered from poses."""
    decision_mask: Bool[Tensor, "B N A L"]
    """True = the policy chose it and it counts."""
    log_prob: Float[Tensor, "B N A L"]
    """Under the distribution that was sampled from, nats; 0 where the mask is False."""
    draws: Tensor | None = None
    """[B, N, ...] what the policy drew once per rollout; opaque to everybody else."""
    goals: Goals | None = None
    forced: AgentStates | None = None

    @property
    def num_rollouts(self) -> int:
        """N."""
        return self.position.shape[1]

    def select(self, selected: slice) -> "Rollouts":
        """Some of the rollouts of every scenario."""
        return replace(
            self,
            position=self.position[:, selected],
            heading=self.heading[:, selected],
            decision=self.decision[:, selected],
            decision_mask=self.decision_mask[:, selected],
            log_prob=self.log_prob[:, selected],
            goals=None if self.goals is None else self.goals.rollouts(selected),
            draws=None if self.draws is None else self.draws[:, selected],
            forced=None if self.forced is None else self.forced.rollouts(selected),
        )
