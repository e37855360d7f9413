"""Sizes and radii of a SMART model."""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from rlftsim.errors import ConfigError, check_finiteness, check_limits, check_positive, check_types, given

GoalEncoding = Literal["concat", "indication"]
"""Encoding of an agent's goal, see `goal_conditioning`."""
FrequencyInit = Literal["normal", "log_spaced"]
"""Initial frequencies of the Fourier embeddings, see `embeddings.initialize`."""


@dataclass(frozen=True)
class SmartConfig:
    """SMART's architecture. The defaults are SMART-tiny (7 M parameters)."""

    fingerprint_name: ClassVar[str] = "rlftsim.policies.smart.config.SmartConfig"
    free_fields: ClassVar[tuple[str, ...]] = (
        "map_radius_m", "agent_map_radius_m", "agent_radius_m", "max_map_neighbors", "max_agent_map_neighbors",
        "max_agent_neighbors", "dropout", "history_drop",
    )  # fmt: skip
    """Fields that a trained model can be trained further with other values of."""

    dim: int = 128
    """Width of all features (D)."""
    num_heads: int = 8
    head_dim: int = 16
    num_map_layers: int = 3
    num_decoder_layers: int = 6
    num_frequencies: int = 64
    """Learned frequencies per input of the Fourier embeddings."""
    frequency_init: FrequencyInit = "normal"
    """Frequencies of a fresh model. normal: N(0, 0.02), as in the public code, which is one period in 50 m and more.
    log_spaced: from 1/64 to 1 per meter (and radian), with which a model learns to read the map far sooner."""
    map_radius_m: float = 10.0
    """Radius within which a map token attends to other map tokens."""
    agent_map_radius_m: float = 30.0
    """Radius within which an agent attends to map tokens."""
    agent_radius_m: float = 60.0
    """Radius within which an agent attends to other agents."""
    history_tokens: int = 6
    """Earlier token steps (0.5 s) of the same agent that an agent attends to."""
    max_map_neighbors: int | None = 100
    """Most map tokens that a map token attends to, the nearest ones; None = all within the radius."""
    max_agent_map_neighbors: int | None = None
    """Most map tokens that an agent attends to, the nearest ones; None = all within the radius."""
    max_agent_neighbors: int | None = None
    """Most agents that an agent attends to, the nearest ones; None = all within the radius."""
    dropout: float = 0.1
    """Dropout probability of attention weights and feed-forward layers, in training mode."""
    history_drop: float = 0.1
    """In training mode only: probability that an (agent, step) pair is hidden from the attention over time. In
    closed loop (CAT-K) each step draws anew which earlier ones are hidden."""
    head_per_class: bool = False
    """Each class has a head of its own, as large as its vocabulary. False = one head as wide as the largest
    vocabulary; an index then means a different motion in each class."""
    continuation_scores: bool = False
    """The head also scores tokens by how they change the agent's speed and where they turn, see
    `embeddings.ContinuationScores`: so a model learns from far fewer scenarios, and keeps its speed. False = the public
    code's head."""
    goal: GoalEncoding | None = None
    """Encoding of goals; None = goal-free, goals have no effect."""
    goal_logit_bias: bool = False
    """Add a goal-progress bias to the token logits of agents that have goals, see `goal_conditioning.GoalLogitBias`."""
    catk_compat: bool = False
    """Repeat what the public CAT-K code does where this package differs on purpose: an agent's first motion vector
    is its position, the sign of what lies exactly behind is left to rounding, and tokens are matched and placed in
    the order of operations of `tokens.catk_compat`. Models trained there need it."""

    @property
    def seam_rad(self) -> float:
        """Angles this near to -pi count as +pi.

        Bearings exactly behind are common (straight lanes, opposite directions) and must not depend on the last bit.
        """
        return 0.0 if self.catk_compat else 1e-3

    def __post_init__(self) -> None:
        check_types(self)
        depths = ("num_map_layers", "num_decoder_layers", "history_tokens")
        widths = ("dim", "num_heads", "head_dim", "num_frequencies")
        radii = ("map_radius_m", "agent_map_radius_m", "agent_radius_m")
        caps = ("max_map_neighbors", "max_agent_map_neighbors", "max_agent_neighbors")
        check_positive(self, (*widths, *depths, *radii, *given(self, caps)))
        check_finiteness(self, radii)
        check_limits(self, dict.fromkeys(depths, 256) | dict.fromkeys(widths, 65_536))
        check_limits(self, dict.fromkeys(radii, 100_000) | dict.fromkeys(caps, 2**31 - 1))
        if self.goal_logit_bias and self.goal is None:
            raise ConfigError("goal_logit_bias=True, but the model is goal-free: set goal to concat or indication.")
        if self.continuation_scores and self.head_per_class:
            raise ConfigError(
                "continuation_scores=True needs one head for all classes: set head_per_class=False, or "
                "continuation_scores=False."
            )
        if not 0 <= self.dropout < 1 or not 0 <= self.history_drop < 1:
            raise ConfigError(
                f"dropout and history_drop are probabilities in [0, 1), got {self.dropout} and {self.history_drop}."
            )

    def with_goal_conditioning(self, goal: GoalEncoding, logit_bias: bool | None) -> "SmartConfig":
        """The same model, goal-conditioned; the unchanged settings of a model that is conditioned in this way.

        Args:
            goal: Encoding of goals that the new model has, "concat" or "indication".
            logit_bias: Whether a goal-progress bias is added to the token logits; None = yes for a goal-free model,
                else as the model does.

        Raises:
            ConfigError: The model is conditioned in a different way.
        """
        if self.goal is None:
            return replace(self, goal=goal, goal_logit_bias=logit_bias is not False)
        if self.goal != goal:
            raise ConfigError(
                f"this model is goal-conditioned by {self.goal}, not by {goal}: start from a goal-free model."
            )
        if logit_bias not in (None, self.goal_logit_bias):
            has = "with" if self.goal_logit_bias else "without"
            raise ConfigError(
                f"this model is goal-conditioned {has} a goal logit bias: to change that start from a goal-free model."
            )
        return self


def smart_tiny() -> SmartConfig:
    """SMART-tiny, 7 001 024 parameters."""
    return SmartConfig()


def smart_mini() -> SmartConfig:
    """SMART-mini, 3 433 984 parameters."""
    return SmartConfig(num_heads=4, head_dim=8, num_map_layers=2, num_decoder_layers=4)


def smart_nano() -> SmartConfig:
    """SMART-nano, 1 161 344 parameters."""
    return SmartConfig(
        dim=64, num_heads=4, head_dim=8, num_map_layers=2, num_decoder_layers=4,
        agent_map_radius_m=20.0, agent_radius_m=20.0, history_tokens=4,
    )  # fmt: skip


def smart_demo() -> SmartConfig:
    """A model small enough to train on two CPU cores in minutes."""
    return SmartConfig(
        dim=48, num_heads=4, head_dim=12, num_map_layers=1, num_decoder_layers=2, num_frequencies=8,
        map_radius_m=11.0, agent_map_radius_m=30.0, agent_radius_m=30.0, history_tokens=4, frequency_init="log_spaced",
        max_map_neighbors=8, max_agent_map_neighbors=16, max_agent_neighbors=8, dropout=0.0, history_drop=0.0,
        continuation_scores=True,
    )  # fmt: skip


@dataclass(frozen=True)
class CompactConfig:
    """Architecture of a compact policy."""

    dim: int = 32
    """Width of the features of a neighbor; the maximum over neighbors is half as wide again."""
    hidden: int = 64
    """Width of the features of an agent."""
    map_radius_m: float = 25.0
    """Radius within which map tokens are seen, around a point ahead of the agent."""
    agent_radius_m: float = 60.0
    """Radius within which agents are seen, likewise."""
    max_map_neighbors: int = 6
    """Map tokens that are seen at each of three points ahead."""
    max_lights: int = 4
    """Map tokens with a traffic light that are seen beside."""
    max_agent_neighbors: int = 8
    """Agents that are seen."""

    def __post_init__(self) -> None:
        check_types(self)
        sizes, radii = ("dim", "hidden"), ("map_radius_m", "agent_radius_m")
        limits = ("max_map_neighbors", "max_lights", "max_agent_neighbors")
        check_positive(self, (*sizes, *limits, *radii))
        check_finiteness(self, radii)
        check_limits(self, dict.fromkeys((*sizes, *limits), 65_536))
