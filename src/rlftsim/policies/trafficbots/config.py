"""Sizes, neighborhoods and training schedule of a TrafficBots model."""

from dataclasses import dataclass
from typing import ClassVar

from rlftsim.errors import (
    ConfigError,
    check_finiteness,
    check_limits,
    check_not_negative,
    check_positive,
    check_types,
    given,
)

WINDOW = 11
"""Steps of 0.1 s that an agent or a light is seen for, the current one included."""
LATENT_SIZE = 16
"""Numbers of a personality."""


@dataclass(frozen=True)
class TrafficBotsConfig:
    """Sizes, neighborhoods, exploration noise, training schedule. The defaults are TrafficBots V1.5 (7.9 M parameters
    without unused ones)."""

    fingerprint_name: ClassVar[str] = "rlftsim.policies.trafficbots.config.TrafficBotsConfig"
    free_fields: ClassVar[tuple[str, ...]] = (
        "max_map_tokens", "map_neighbors", "light_neighbors", "agent_map_neighbors", "agent_light_neighbors",
        "agent_neighbors", "radius_m", "light_radius_m", "dropout", "input_drop", "prior_probability", "free_nats",
        "forced_fractions", "forcing_updates", "steps_per_pass", "noise_acceleration_mps2", "noise_yaw_rate_radps",
        "noise_pedestrian_yaw_rate_radps", "noise_correlation",
    )  # fmt: skip
    """Fields that a trained model can be trained further with other values of."""

    dim: int = 128
    """Width of all features (D)."""
    num_heads: int = 4
    num_map_layers: int = 8
    num_light_layers: int = 4
    num_agent_layers: int = 4
    max_map_tokens: int | None = 1024
    """Map tokens of a scenario; those far from the evaluated agents are left out. None = all."""
    map_neighbors: int = 32
    """Map tokens that a map token attends to."""
    light_neighbors: int = 24
    """Lights, and map tokens, that a light attends to."""
    agent_map_neighbors: int = 64
    """Map tokens that an agent attends to."""
    agent_light_neighbors: int = 25
    """Lights that an agent attends to."""
    agent_neighbors: int = 25
    """Agents that an agent attends to."""
    radius_m: float = 500.0
    """Farthest neighbor of a map token or an agent."""
    light_radius_m: float = 250.0
    """Farthest neighbor of a light."""
    noise_acceleration_mps2: float = 0.3
    """Standard deviation of the acceleration in sampled rollouts. It is not trained: the kinematic terms of a reward
    would only shrink it."""
    noise_yaw_rate_radps: float = 0.03
    """Standard deviation of the yaw rate in sampled rollouts."""
    noise_pedestrian_yaw_rate_radps: float | None = None
    """The same for pedestrians; None = as for all. Their range of yaw rates is five times that of vehicles, so that the
    same noise is five times narrower in the network's output."""
    noise_correlation: float = 0.9
    """Correlation of an agent's noise from one decision to the next; 0 = white."""
    dropout: float = 0.1
    """Dropout probability in training mode, in all parts but those that decide: their rollouts have to be repeated
    exactly."""
    input_drop: float = 0.1
    """In pre-training: probability that a map node or a history step is hidden."""
    prior_probability: float = 0.1
    """In imitation, also beside rewards: probability that a micro batch draws personalities from the prior instead of
    the posterior."""
    free_nats: float = 1.0
    """A personality's KL from the prior below which it is not pulled towards it."""
    forced_fractions: tuple[float, ...] = (0.3, 0.2, 0.1, 0.0)
    """In pre-training: fraction of the agents that follow the log throughout, one after the other. The last one holds
    beside rewards, too."""
    forcing_updates: int = 12_175
    """Updates that each of these fractions lasts: 0.2 passes over WOMD with 8 scenarios each."""
    steps_per_pass: int = 8
    """Decisions that are scored with gradient at once; fewer need less memory, the result is the same."""

    def __post_init__(self) -> None:
        check_types(self)
        sizes = ("dim", "num_heads", "num_map_layers", "num_light_layers", "num_agent_layers")
        neighbors = ("map_neighbors", "light_neighbors", "agent_map_neighbors", "agent_light_neighbors")
        distances = ("radius_m", "light_radius_m", "noise_acceleration_mps2", "noise_yaw_rate_radps")
        distances += given(self, ("noise_pedestrian_yaw_rate_radps",))
        counts = ("agent_neighbors", "forcing_updates", "steps_per_pass", *given(self, ("max_map_tokens",)))
        check_positive(self, (*sizes, *neighbors, *distances, *counts))
        check_finiteness(self, (*distances, "free_nats"))
        check_not_negative(self, ("free_nats",))
        check_limits(self, dict.fromkeys(("num_map_layers", "num_light_layers", "num_agent_layers"), 256))
        check_limits(self, dict.fromkeys(("dim", "num_heads"), 65_536) | dict.fromkeys(distances, 100_000))
        check_limits(self, dict.fromkeys((*neighbors, *counts), 2**31 - 1))
        if self.dim % 16 or self.dim % self.num_heads:
            raise ConfigError(f"dim={self.dim} must be a multiple of 16 and of num_heads={self.num_heads}.")
        for name in ("dropout", "input_drop", "noise_correlation"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{name} is in [0, 1), got {getattr(self, name)}.")
        if not 0 <= self.prior_probability <= 1:
            raise ConfigError(f"prior_probability is in [0, 1], got {self.prior_probability}.")
        fractions = self.forced_fractions
        if not fractions or not all(0 <= fraction <= 1 for fraction in fractions):
            raise ConfigError(f"forced_fractions are one or more fractions in [0, 1], got {fractions}.")


def trafficbots_demo() -> TrafficBotsConfig:
    """A model small enough to train on two CPU cores in minutes, with noise that its kinematics gain by.

    Much narrower noise tells fine-tuning too little of how to accelerate.
    """
    return TrafficBotsConfig(
        dim=48, num_heads=4, num_map_layers=2, num_light_layers=1, num_agent_layers=2,
        map_neighbors=12, light_neighbors=8, agent_map_neighbors=24, agent_light_neighbors=4, agent_neighbors=8,
        radius_m=100.0, light_radius_m=100.0, noise_acceleration_mps2=1.2, dropout=0.0, forcing_updates=200,
        steps_per_pass=16,
    )  # fmt: skip
