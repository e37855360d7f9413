"""Values that `SmartPolicy` works on: contexts, states and predictions.

B scenarios, N rollouts, A agents, D width, R selected elements, V tokens. Map frame, meters and radians.
"""

from dataclasses import dataclass, field
from functools import cached_property

from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.policies.smart.attention import AttentionMaps
from rlftsim.policies.smart.goal_conditioning import EncodedGoals
from rlftsim.policies.smart.network import Past, Scene, View
from rlftsim.policies.smart.token_steps import TokenSteps


@dataclass(frozen=True, eq=False)
class SmartContext:
    """Features and geometry that do not depend on the agents' decisions, computed once per scenario."""

    scene: Scene
    history: TokenSteps
    """The two history tokens of a single rollout. The last ends at the current step, near the logged pose or at it."""
    view: View
    """Of the history."""
    past: Past
    """Of the history."""
    features: Float[Tensor, "B A D"]
    """Decoder features at the current step of goal-free agents; zeros for padding."""
    object_type: Int64[Tensor, "B A"]
    token_class: Int64[Tensor, "B A"]
    """Class that an agent's token ids refer to."""
    agent_mask: Bool[Tensor, "B A"]
    model: nn.Module
    """The model that encoded the scenario."""

    @cached_property
    def maps(self) -> tuple[AttentionMaps, ...]:
        """Maps of the decoder's attention, folded once for all decisions."""
        return self.model.network.decoder.fold()  # type: ignore[union-attr, operator]

    @property
    def is_padded(self) -> bool:
        """True off the CPU: in closed loop padding is simulated, too. The host would wait to leave padding out."""
        return self.agent_mask.device.type != "cpu"


@dataclass(eq=False)
class DecoderCache:
    """Decoder outputs of a state, filled at the first use: a memo of values that follow from the state."""

    features: Float[Tensor, "B N A D"] | None = None
    """Decoder features at the state's last step."""
    past: Past | None = None
    """The past that includes the state's last step."""


@dataclass(frozen=True, eq=False)
class SmartState:
    """Running simulations.

    Steps that have not been through the decoder wait in `pending`, and go through the decoder at most once.
    """

    position: Float[Tensor, "B N A 2"]
    heading: Float[Tensor, "B N A"]
    past: Past
    pending: TokenSteps | None
    poses: Float[Tensor, "B N A 5 3"] | None = None
    draws: Tensor | None = None
    goals: EncodedGoals | None = None
    """None = no agent has a goal, or the model is goal-free."""
    num_decisions: int = 0
    """Decisions taken so far."""
    cache: DecoderCache = field(default_factory=DecoderCache)


@dataclass(frozen=True, eq=False)
class TeacherForced:
    """Predictions along logged tracks, and the tokens of the log."""

    logits: Float[Tensor, "R V"]
    target: Int64[Tensor, "R"]
    """Token that came next."""
    target_mask: Bool[Tensor, "R"]
    """True = the next state was logged and the agent is trained on."""
    class_id: Int64[Tensor, "R"]
    """Agent class that each row's token ids refer to."""
