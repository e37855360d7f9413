"""Traffic around a planner in the window of a world: the world itself, and kinds of simulated traffic."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from rlftsim.envs.config import EnvConfig
from rlftsim.envs.conflicts import find_conflicts
from rlftsim.envs.drivers import Traffic
from rlftsim.envs.episode import Episode, ScenarioGoals
from rlftsim.envs.source import Source
from rlftsim.errors import ConfigError, in_short
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.dataset import ScenarioDataset, dataset_folder
from rlftsim.scenario.types import Scenario


@dataclass(frozen=True)
class Surroundings:
    """Drivers of the others, with the name in tables."""

    name: str
    traffic: Traffic
    model: str = "demo-base"
    """Traffic model; with IDM of pedestrians and cyclists alone."""
    temperature: float = 1.0
    ahead_m: float | None = 0.0
    """Of SUMO's ego before the planner's, see `SumoScene`."""

    @property
    def has_model(self) -> bool:
        """True where a model drives some of the others: all, or with IDM those that are no vehicles."""
        return self.traffic in ("policy", "idm")

    @classmethod
    def parse(cls, text: str) -> "Surroundings":
        """Traffic by a model, of "demo-tuned", "NAME=MODEL" or "MODEL@TEMPERATURE".

        Raises:
            ConfigError: A temperature that is no number.
        """
        name, _, model = text.strip().rpartition("=")
        model, _, temperature = model.partition("@")
        try:
            return cls(name or text.strip(), "policy", model, float(temperature or 1))
        except ValueError:
            raise ConfigError(f"model {in_short(text)}: write a temperature as a number, MODEL@1.3.") from None


class _WorldSource(Source):
    """A scenario with SUMO's ego ahead of the planner's, or with an ego of SUMO's own."""

    ahead_m: float | None = 0.0
    """See `Surroundings`."""

    def episode(self, scenarios: list[Scenario], goals: ScenarioGoals | None = None) -> Episode:
        """An episode, see `Source`."""
        episode = super().episode(scenarios, goals)
        sumo_scenes = tuple(replace(scene, ahead_m=self.ahead_m) for scene in episode.world.sumo_scenes)
        return replace(episode, world=replace(episode.world, sumo_scenes=sumo_scenes))


@lru_cache(maxsize=2)
def load_source(data: str, window: str, surroundings: Surroundings, settings: tuple[Any, ...]) -> Source:
    """Scenario and model of a window, which planners with the same type of action share: encoding takes long.

    Args:
        data: Data set with worlds.
        window: Id of a scenario.
        surroundings: Drivers of the others.
        settings: Names and values of the planner's type of action, sorted.
    """
    config = EnvConfig(
        data=data, split=None, model=surroundings.model, traffic=surroundings.traffic, stop_on=(), reward="none",
        temperature=surroundings.temperature, **dict(settings),
    )  # fmt: skip
    policy = load_model(surroundings.model) if surroundings.has_model else None
    source = _WorldSource(config, [load_scenario(data, window)], policy)
    source.ahead_m = surroundings.ahead_m
    return source


load_model = lru_cache(maxsize=8)(load_policy)
"""Traffic model of a name, loaded once in each process."""


@lru_cache(maxsize=2)
def load_scenario(data: str, window: str) -> Scenario:
    """Scenario of a window.

    Args:
        data: Data set with worlds.
        window: Id of a scenario.
    """
    return ScenarioDataset(dataset_folder(data))[window]


@lru_cache(maxsize=2)
def list_conflicts(data: str, window: str) -> frozenset[str]:
    """Conflicts at the current step, see `find_conflicts`.

    Args:
        data: Data set with worlds.
        window: Id of a scenario.
    """
    return find_conflicts(load_scenario(data, window), dataset_folder(data))
