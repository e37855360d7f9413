"""Types of arguments that several verbs share: values in Python, and what a command line takes in their place.

`Annotated[Any, T]` is read as T on the command line, and stands for any value in Python. No torch is imported.
"""

import os
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import tyro

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlftsim.evaluation.drive_results import DriveResult
    from rlftsim.evaluation.results import Evaluation
    from rlftsim.goals.types import Goals, PointById
    from rlftsim.recipes.base import Recipe
    from rlftsim.rollout.policy import Policy
    from rlftsim.rollout.types import Rollouts
    from rlftsim.scenario.open import AnyScenarios
    from rlftsim.tokens.clustering import TokensConfig
    from rlftsim.training.method import TrainingSettings
    from rlftsim.training.run import OnUpdate as OnUpdate

    Model: TypeAlias = Policy | str | os.PathLike[str]
    Data: TypeAlias = AnyScenarios
    ModelOrRecipe: TypeAlias = Model | Recipe
    AnyRecipe: TypeAlias = Recipe | str | os.PathLike[str]
    RecipeOption: TypeAlias = AnyRecipe
    Settings: TypeAlias = TrainingSettings | TokensConfig
    File: TypeAlias = str | os.PathLike[str]
    Name: TypeAlias = str | os.PathLike[str]
    Metric: TypeAlias = str | int
    ScoreMetric: TypeAlias = str | int
    GoalPoints: TypeAlias = Goals | PointById | Mapping[str, PointById] | str | os.PathLike[str]
    Simulated: TypeAlias = Rollouts | str | os.PathLike[str]
    Result: TypeAlias = Evaluation | DriveResult | str | os.PathLike[str]
    Results: TypeAlias = Sequence[Result]
    Reported: TypeAlias = Evaluation | str | os.PathLike[str] | Results
    Models: TypeAlias = Sequence[Model]
    Runs: TypeAlias = Sequence[str | os.PathLike[str]]
else:
    from pathlib import Path

    Model = Data = Name = Metric = ModelOrRecipe = AnyRecipe = Annotated[Any, str]
    RecipeOption = Annotated[Any, Annotated[str, tyro.conf.arg(metavar="RECIPE")]]
    OnUpdate = Any
    File = Settings = GoalPoints = Simulated = Result = Annotated[Any, Path]
    Results = Reported = Annotated[Any, tuple[Path, ...]]
    Models = Runs = Annotated[Any, tuple[str, ...]]
    ScoreMetric = Annotated[Any, Literal["2025", "2024", "2024_original_code", "2023"]]

Device = Literal["auto", "cpu", "cuda"]
Processes = Annotated[int | Literal["auto"] | None, tyro.conf.arg(metavar="INT|auto")]
