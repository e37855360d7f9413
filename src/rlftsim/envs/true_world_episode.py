"""An episode of a planner in a world that made a log, or in other traffic, as a row of scores."""

import math
import re
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from rlftsim.envs.config import EnvConfig
from rlftsim.envs.conflicts import find_conflicts
from rlftsim.envs.drivers import Traffic
from rlftsim.envs.ego_env import EgoEnv
from rlftsim.envs.episode import Episode, ScenarioGoals
from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planner_scores import PlannerScores
from rlftsim.envs.planners.registry import load_planner, read_action_settings
from rlftsim.envs.result import Result
from rlftsim.envs.source import Source
from rlftsim.envs.sumo_traffic import SumoState
from rlftsim.errors import ConfigError, EpisodeFailure, in_short
from rlftsim.jobs.progress import log
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.dataset import ScenarioDataset, dataset_folder
from rlftsim.scenario.types import CURRENT_STEP, Scenario

PLANNERS = {
    "log": "replay", "constant_velocity": "constant_velocity", "idm": "idm", "pdm": "pdm",
    "timid": "rlftsim.envs.planners.flawed:Timid", "rush": "rlftsim.envs.planners.flawed:Rush",
    "late_braker": "rlftsim.envs.planners.flawed:LateBraker", "hard_braker": "rlftsim.envs.planners.flawed:HardBraker",
}  # fmt: skip
"""Planners from good to bad by name: among planners of one quality a ranking means nothing."""
SCORES = tuple(field.name for field in fields(PlannerScores))
COUNTS = ("distance_m", "off_lane_steps", "num_strangers", "seconds")
"""Distance from the log at the end, steps at which SUMO did not see the ego, road users of SUMO alone that came near,
and CPU time of this process."""
TEXTS = ("network", "window", "conflicts", "planner", "traffic")


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


@dataclass(frozen=True)
class Trip:
    """An episode to drive."""

    data: str
    window: str
    """Id of a scenario with a world."""
    network: str
    surroundings: Surroundings
    planner: str
    """Name of `PLANNERS`, or any that `load_planner` takes."""
    seed: int
    is_random: bool = True
    """False = the window was chosen for its conflict."""
    rollout: int = 0
    """Number of the rollout, each with dice of its own."""

    @property
    def name(self) -> str:
        """Stem of the file."""
        rollout = f"-{self.rollout}" if self.rollout else ""
        return re.sub(r"[^\w.()=,+-]+", ".", f"{self.window}-{self.surroundings.name}-{self.planner}{rollout}")

    @property
    def planner_name(self) -> str:
        """Name that `load_planner` takes."""
        return PLANNERS.get(self.planner, self.planner)

    def run(self) -> tuple[Result, tuple[SumoState, ...]]:
        """Result of the episode, and the last states of SUMO if it drives.

        Raises:
            EpisodeFailure: The planner or SUMO fails.
        """
        planner, scenario = load_planner(self.planner_name), _load_scenario(self.data, self.window)
        settings = tuple(sorted(read_action_settings(planner).items()))
        env = _make_environment(self.data, self.window, self.surroundings, settings)
        result = run_planner(env, planner, scenario, seed=self.seed, rollout=self.rollout)
        return result, env.state.world.sumo_states

    def drive(self) -> dict[str, object]:
        """Row of the episode; NaN where the planner fails, or SUMO."""
        begin = time.process_time()
        row: dict[str, object] = {
            "network": self.network, "window": self.window,
            "conflicts": " ".join(sorted(list_conflicts(self.data, self.window))), "planner": self.planner,
            "traffic": self.surroundings.name, "rollout": self.rollout,
        }  # fmt: skip
        try:
            result, sumo_states = self.run()
        except EpisodeFailure as failure:
            log.warning(str(failure))
            return {"row": row | dict.fromkeys((*SCORES, *COUNTS), math.nan)}
        record = result.record
        offset = record.agent_motion[-1, :2] - record.scene.logged[record.agent, CURRENT_STEP + record.steps, :2]
        counts = {
            "distance_m": float(np.hypot(*offset)),
            "off_lane_steps": float(sum(state.off_lane_steps for state in sumo_states)),
            "num_strangers": float(sum(state.num_strangers for state in sumo_states)),
            "seconds": time.process_time() - begin,
        }
        return {"row": row | asdict(result.planner) | counts}


def read_row(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Row of an episode's file.

    Args:
        name: Stem of the file.
        values: Contents of the file.

    Raises:
        KeyError, TypeError, ValueError: The file was cut or edited.
    """
    row = values["row"]
    numbers = {column: float(row[column]) for column in (*SCORES, *COUNTS)}
    texts = {column: str(row[column]) for column in TEXTS}
    return {**texts, "rollout": int(row["rollout"]), **numbers}


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
def _make_environment(data: str, window: str, surroundings: Surroundings, settings: tuple[Any, ...]) -> EgoEnv:
    """Environment of a window, which planners with the same type of action share: encoding takes long."""
    config = EnvConfig(
        data=data, split=None, model=surroundings.model, traffic=surroundings.traffic, stop_on=(), reward="none",
        temperature=surroundings.temperature, **dict(settings),
    )  # fmt: skip
    policy = load_model(surroundings.model) if surroundings.traffic in ("policy", "idm") else None
    source = _WorldSource(config, [_load_scenario(data, window)], policy)
    source.ahead_m = surroundings.ahead_m
    return EgoEnv(source=source)


load_model = lru_cache(maxsize=8)(load_policy)
"""Traffic model of a name, loaded once in each process."""


@lru_cache(maxsize=2)
def _load_scenario(data: str, window: str) -> Scenario:
    return ScenarioDataset(dataset_folder(data))[window]


@lru_cache(maxsize=2)
def list_conflicts(data: str, window: str) -> frozenset[str]:
    """Conflicts at the current step, see `find_conflicts`.

    Args:
        data: Data set with worlds.
        window: Id of a scenario.
    """
    return find_conflicts(_load_scenario(data, window), dataset_folder(data))
