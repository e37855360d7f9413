"""Sizes and radii of a SMART model."""

from dataclasses import dataclass
from typing import Literal, get_args

from rlftsim.errors import ConfigError, given, require_finite, require_positive

GoalSight = Literal["concat", "indication"]
"""How agents see their goals, see `goal_sight`."""


@dataclass(frozen=True)
class SmartConfig:
    """SMART's architecture. The defaults are SMART-tiny (7 M parameters)."""

    dim: int = 128
    """Width of all features (D)."""
    num_heads: int = 8
    head_dim: int = 16
    num_map_layers: int = 3
    num_decoder_layers: int = 6
    num_frequencies: int = 64
    """Learned frequencies an input of the Fourier embeddings."""
    map_radius_m: float = 10.0
    """Between map tokens."""
    agent_map_radius_m: float = 30.0
    agent_radius_m: float = 60.0
    history_tokens: int = 6
    """Token steps (0.5 s) an agent looks back."""
    max_map_neighbors: int | None = 100
    """Nearest map tokens a map token attends to; None = all within the radius."""
    max_agent_map_neighbors: int | None = None
    """Nearest map tokens an agent attends to; None = all within the radius."""
    max_agent_neighbors: int | None = None
    """Nearest agents an agent attends to; None = all within the radius."""
    dropout: float = 0.1
    history_drop: float = 0.1
    """In training mode only: share of (agent, step) pairs that are hidden from the attention over time. In closed loop (CAT-K) each step
    forgets earlier ones anew."""
    head_per_class: bool = False
    """Each class has a head of its own, as large as its vocabulary. False = one head as wide as the largest, an index means another
    motion in each class."""
    goal: GoalSight | None = None
    """How agents see their goals; None = they do not, and goals have no effect."""
    goal_aim: bool = False
    """Whoever sees a goal also weighs tokens by where they lead, see `goal_sight.GoalAim`."""
    public_code_quirks: bool = False
    """Repeat what the public code does where this package differs on purpose: an agent's first motion vector is its position,
    the sign of what lies exactly behind is left to rounding, and tokens are matched and placed in the order of operations of
    `tokens.public_order`. Models trained there need it."""

    @property
    def seam_rad(self) -> float:
        """Angles this near to -pi count as +pi: what lies exactly behind is common (straight lanes, opposite directions) and must
        not be one or the other by the last bit."""
        return 0.0 if self.public_code_quirks else 1e-3

    def __post_init__(self) -> None:
        sizes = (
            "dim",
            "num_heads",
            "head_dim",
            "num_map_layers",
            "num_decoder_layers",
            "num_frequencies",
            "history_tokens",
        )
        radii = ("map_radius_m", "agent_map_radius_m", "agent_radius_m")
        caps = ("max_map_neighbors", "max_agent_map_neighbors", "max_agent_neighbors")
        require_positive(self, (*sizes, *radii, *given(self, caps)))
        require_finite(self, radii)
        if self.goal is not None and self.goal not in get_args(GoalSight):
            raise ConfigError(f"goal={self.goal!r} is no way to see goals: known are {', '.join(get_args(GoalSight))}.")
        if self.goal_aim and self.goal is None:
            raise ConfigError("goal_aim=True, but nobody sees goals: set goal to concat or indication.")
        if not 0 <= self.dropout < 1 or not 0 <= self.history_drop < 1:
            raise ConfigError(
                f"dropout and history_drop are shares in [0, 1), got {self.dropout} and {self.history_drop}."
            )


def smart_tiny() -> SmartConfig:
    """7 001 024 parameters."""
    return SmartConfig()


def smart_mini() -> SmartConfig:
    """3 433 984 parameters."""
    return SmartConfig(num_heads=4, head_dim=8, num_map_layers=2, num_decoder_layers=4)


def smart_nano() -> SmartConfig:
    """1 161 344 parameters."""
    return SmartConfig(
        dim=64, num_heads=4, head_dim=8, num_map_layers=2, num_decoder_layers=4,
        agent_map_radius_m=20.0, agent_radius_m=20.0, history_tokens=4,
    )  # fmt: skip


def smart_demo() -> SmartConfig:
    """Small enough to train on two CPU cores in minutes."""
    return SmartConfig(
        dim=48, num_heads=4, head_dim=12, num_map_layers=1, num_decoder_layers=2, num_frequencies=8,
        map_radius_m=11.0, agent_map_radius_m=30.0, agent_radius_m=30.0, history_tokens=4,
        max_map_neighbors=8, max_agent_map_neighbors=16, max_agent_neighbors=8, dropout=0.0, history_drop=0.0,
    )  # fmt: skip
