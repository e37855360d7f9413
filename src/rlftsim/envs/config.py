"""Settings of the environments."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from rlftsim.envs.actions import ActionType, Tracker
from rlftsim.envs.drivers import Rules, Traffic
from rlftsim.envs.observations import Frame
from rlftsim.envs.rewards import parse_terms
from rlftsim.envs.route import RouteChoice
from rlftsim.errors import ConfigError, check_types, in_short
from rlftsim.policies.registry import Device
from rlftsim.rollout.policy import Sampling
from rlftsim.scenario.types import FUTURE_STEPS

StopReason = Literal["collision", "offroad", "goal"]
ObservationFormat = Literal["dict", "flat", "arrays"]
RenderMode = Literal["rgb_array", "html"]
MAX_STEPS = 6_000
"""Greatest length of an episode, ten minutes: logs and lights are held to its end."""


@dataclass(frozen=True)
class EnvConfig:
    """Settings of an environment; each is an argument of `gymnasium.make` by the same name."""

    data: str = "synthetic"
    """Data set by name or folder."""
    split: str | None = "validation"
    """Split of the data set; None = all scenarios."""
    model: str = "demo-base"
    """Traffic model: a run, a model folder or a registered name."""
    traffic: Traffic = "policy"
    """Driver of all agents but the ego: policy, replay, constant_velocity, idm or sumo."""
    entries: str | None = None
    """Model of who enters where lanes cross the border of a region around the ego, in traffic "policy": "fitted",
    "fixed-rate", "none", FILE.npz of `rlftsim entries fit`, or a plug-in; None = nobody enters or leaves."""
    drivers: Rules = field(default_factory=dict)
    """Drivers of some agents, the first match wins; see `assign_drivers`. They come before `traffic`."""
    action: ActionType = "bicycle"
    horizon: int = 5
    """Number of poses of a trajectory."""
    tracker: Tracker = "perfect"
    """Execution of a trajectory: puts the agent there, or steers a bicycle for it."""
    reverse: bool = False
    """True = a bicycle may drive backwards."""
    hard_braking: bool = False
    """True = a bicycle brakes with up to 8 m/s² in place of 4."""
    observation: ObservationFormat = "dict"
    """Named arrays; all numbers in one row; or the `Observation` itself."""
    frame: Frame = "ego"
    reward: str = "progress - 5*at_fault - 5*offroad"
    """Sum of terms, see `rewards.TERMS`; "none" for evaluation."""
    stop_on: tuple[StopReason, ...] = ("collision",)
    """Events of the planner's agent that end its episode."""
    max_steps: int = FUTURE_STEPS
    """Length of an episode in steps of 0.1 s; later than second 8 it ends where the map does."""
    route: RouteChoice = "logged"
    """"logged" (the lanes that the logged ego drove), "none", a maneuver, or lane ids."""
    temperature: float = 1.0
    top_k: int | None = None
    device: Device = "cpu"
    """Device of the traffic model."""
    render_mode: RenderMode | None = None

    def __post_init__(self) -> None:
        check_types(self)
        if not isinstance(self.drivers, Mapping):
            raise ConfigError(f"drivers must be {{who: driver}}, got {in_short(self.drivers)}.")
        parse_terms(self.reward)
        if not 1 <= self.max_steps <= MAX_STEPS:
            raise ConfigError(f"max_steps must lie between 1 and {MAX_STEPS}, ten minutes, got {self.max_steps}.")

    @property
    def sampling(self) -> Sampling:
        """Temperature and truncation of the traffic model's decisions."""
        return Sampling(self.temperature, self.top_k)
