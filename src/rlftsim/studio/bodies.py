"""Bodies of the requests. pydantic checks types and bounds before any of them is made."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

MAX_ROLLOUTS, MAX_GOALS, MAX_MODELS = 128, 128, 4
STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
Text = Annotated[str, Field(min_length=1, max_length=200)]
Stem = Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,80}$")]
"""Name of a file below `--out`, without its ending."""
Metric = Literal["2025", "2024"]
ExportKind = Literal["rollouts", "submission", "film-mp4", "film-webp", "page", "scores"]


@dataclass(frozen=True)
class GoalBody:
    """A point for an agent, world frame, m."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT
    agent: int
    x: float
    y: float
    label: Annotated[str, Field(max_length=200)] = ""


@dataclass(frozen=True)
class CheckBody:
    """Goals to be checked against their scenario."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT
    split: Text
    scenario: Text
    goals: Annotated[tuple[GoalBody, ...], Field(max_length=MAX_GOALS)]


@dataclass(frozen=True)
class RunBody:
    """Rollouts of a scenario by one or several models."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT
    split: Text
    scenario: Text
    models: Annotated[tuple[Text, ...], Field(min_length=1, max_length=MAX_MODELS)]
    goals: Annotated[tuple[GoalBody, ...], Field(max_length=MAX_GOALS)] = ()
    num_rollouts: Annotated[int, Field(ge=1, le=MAX_ROLLOUTS)] = 32
    seed: Annotated[int, Field(ge=0, lt=1 << 53)] = 0
    temperature: Annotated[float, Field(ge=0, le=10)] = 1.0
    top_k: Annotated[int, Field(ge=1)] | None = None
    guidance: Annotated[float, Field(ge=0, le=6)] = 1.0
    metric: Metric = "2025"


@dataclass(frozen=True)
class OpenGoalsBody:
    """Text of a goals file that the page has read."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT
    text: str
    name: Annotated[str, Field(max_length=200)] = "goals file"


@dataclass(frozen=True)
class SaveGoalsBody:
    """A goals file to be written below `--out`."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT
    name: Stem
    text: str
    replace: bool = False


@dataclass(frozen=True)
class ExportBody:
    """Rollouts of a run to be written below `--out`."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT
    kind: ExportKind
    name: Stem
    run: Text
    variant: Annotated[int, Field(ge=0)] = 0
    """Index among the run's variants, for kinds that hold the rollouts of one model."""
    rollout: Annotated[int, Field(ge=0)] = 0
    """First rollout of films and pages."""
    replace: bool = False


@dataclass(frozen=True)
class EmptyBody:
    """Body of a request that says everything in its address."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT
    nothing: None = field(default=None)
