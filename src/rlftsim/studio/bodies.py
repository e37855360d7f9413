"""Bodies of the requests. pydantic checks types and bounds before a body is made."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

MAX_ROLLOUTS, MAX_GOALS, MAX_MODELS = 128, 128, 4
USUAL_SECONDS, MAX_SECONDS = 8, 60
"""Goals, scores and submissions are defined for the usual length."""
Text = Annotated[str, Field(min_length=1, max_length=200)]
Stem = Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,80}$")]
"""Name of a file below `--out`, without the ending."""
Metric = Literal["2025", "2024"]
ExportForm = Literal["rollouts", "submission", "film-mp4", "film-webp", "page", "scores"]


@dataclass(frozen=True)
class Body:
    """Body of a request; unknown fields and infinite numbers are refused."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True)
class GoalBody(Body):
    """A point for an agent, world frame, m."""

    agent: int
    x: float
    y: float
    label: Annotated[str, Field(max_length=200)] = ""


@dataclass(frozen=True)
class CheckBody(Body):
    """Goals to be checked against the scenario."""

    split: Text
    scenario: Text
    goals: Annotated[tuple[GoalBody, ...], Field(max_length=MAX_GOALS)]


@dataclass(frozen=True)
class RunBody(Body):
    """Rollouts of a scenario by several models."""

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
    seconds: Annotated[int, Field(ge=USUAL_SECONDS, le=MAX_SECONDS)] = USUAL_SECONDS


@dataclass(frozen=True)
class OpenGoalsBody(Body):
    """Text of a goals file that the page has read."""

    text: str
    name: Annotated[str, Field(max_length=200)] = "goals file"


@dataclass(frozen=True)
class SaveGoalsBody(Body):
    """A goals file to be written below `--out`."""

    name: Stem
    text: str
    replace: bool = False


@dataclass(frozen=True)
class ExportBody(Body):
    """Rollouts of a run to be written below `--out`."""

    kind: ExportForm
    name: Stem
    run: Text
    variant: Annotated[int, Field(ge=0)] = 0
    """Index among the run's variants, for kinds that hold the rollouts of one model."""
    rollout: Annotated[int, Field(ge=0)] = 0
    """First rollout of films and pages."""
    replace: bool = False
