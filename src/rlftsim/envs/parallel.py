"""The PettingZoo environment: a planner for each of several agents, in the same scene."""

from collections.abc import Mapping, Sequence
from operator import index
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Space
from pettingzoo import ParallelEnv

from rlftsim.envs.actions import validate_actions
from rlftsim.envs.drivers import Driver, assign_drivers
from rlftsim.envs.episode import Episode, EpisodeState, advance, look
from rlftsim.envs.resets import OPTIONS, EpisodeOrder, begin_episodes, build_config, describe_start, describe_step
from rlftsim.envs.scene import build_env_scene
from rlftsim.envs.source import Source
from rlftsim.envs.spaces import action_space, format_observation, observation_space
from rlftsim.errors import ConfigError, in_short
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.open import AnyScenarios
from rlftsim.scenario.types import TOTAL_STEPS


class TrafficParallelEnv(ParallelEnv):
    """A PettingZoo environment: planner-driven agents of a scene, named by object ids.

    Args:
        controlled: Planner-driven agents: "ego", "tracks_to_predict", "vehicles", or object ids.
        scenarios: Scenario, list of scenarios or data set, in place of the setting `data`.
        policy: Traffic model in place of the model that the setting `model` names, in evaluation mode.
        settings: Fields of `EnvConfig` by name; all other fields have defaults.

    Raises:
        ConfigError: settings that do not fit each other, or no agents.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "rlftsim/Traffic-v0", "render_modes": [], "is_parallelizable": True}

    def __init__(
        self,
        *,
        controlled: str | Sequence[int | str] = "ego",
        scenarios: AnyScenarios | None = None,
        policy: Policy | None = None,
        **settings: Any,
    ):
        if not isinstance(controlled, str):
            try:
                # names of agents are their ids as text
                ids = (int(name) if isinstance(name, str) else index(name) for name in controlled)
                controlled = list(dict.fromkeys(ids))
            except (TypeError, ValueError):
                raise ConfigError("controlled must be a group such as 'vehicles', or a list of object ids.") from None
            if not controlled:
                raise ConfigError("controlled is empty: name at least one object id, or a group such as 'vehicles'.")
        rules = dict.fromkeys([controlled] if isinstance(controlled, str) else controlled, "planner")
        self.source, self.render_mode = Source(build_config(settings), scenarios, policy, rules), None
        config = self.source.config
        if config.render_mode is not None or config.observation == "arrays":
            raise ConfigError("this environment renders nothing and observes 'dict' or 'flat': change these.")
        self._spaces = observation_space(config.observation), action_space(self.source.controls)
        self._order = EpisodeOrder.from_seed(None)
        self._begun: tuple[Episode, EpisodeState] | None = None
        self.agents: list[str] = []
        self._names: list[str] = []
        # all agents that there may be: PettingZoo wants to know them before the first reset
        self.possible_agents = self._list_group() if isinstance(controlled, str) else list(map(str, controlled))

    def _list_group(self) -> list[str]:
        names: dict[str, None] = {}
        for scenario_id in self.source.scenario_ids:
            scene = build_env_scene(self.source.scenario(scenario_id), TOTAL_STEPS)
            planner_ids = scene.object_id[assign_drivers(scene, self.source.rules) == Driver.PLANNER]
            names.update(dict.fromkeys(map(str, planner_ids.tolist())))
        return list(names)

    def observation_space(self, agent: str) -> Space:
        """Space of an agent's observations, the same for all."""
        return self._spaces[0]

    def action_space(self, agent: str) -> Space:
        """Space of an agent's actions, the same for all."""
        return self._spaces[1]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin an episode.

        Args:
            seed: Seed of the order of scenarios and of the traffic; equal seeds, equal episodes.
            options: Choices "scenario", "rollout" and "goals", as of `EgoEnv`; further names are ignored, as PettingZoo
                allows.

        Raises:
            ConfigError: an unknown scenario, or a scenario without a planner-driven agent.
        """
        if seed is not None:
            self._order = EpisodeOrder.from_seed(seed)
        environment_options = {name: value for name, value in (options or {}).items() if name in OPTIONS}
        self._begun = episode, state = begin_episodes(self.source, [self._order], environment_options)
        scene = episode.world.scenes[0]
        self._names = [str(scene.object_id[agent]) for _, agent in episode.world.actors]
        self.agents = list(self._names)
        infos = {name: describe_start(episode, state, row, self.source) for row, name in enumerate(self._names)}
        return self._observe(self.agents), infos

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """Carry out an action of every agent that is left; agents whose episode is over stand still.

        Args:
            actions: Agent name to planner action, for every name in `agents`.

        Raises:
            ConfigError: before `reset`, after the end, an agent without an action, or an action with a NaN or of a
                wrong shape.
        """
        if self._begun is None:
            raise ConfigError("this environment has no episode yet: call reset() first.")
        episode, state = self._begun
        acting, controls = self.agents, self.source.controls
        if not acting:
            raise ConfigError("this episode is over: call reset().")
        if not isinstance(actions, Mapping):
            raise ConfigError(f"actions must be {{agent: action}}, got {in_short(actions)}.")
        missing = [name for name in acting if name not in actions]
        if missing:
            raise ConfigError(f"agent {missing[0]} has no action: every agent in env.agents needs one.")
        array = np.zeros((len(self._names), *controls.limits.shape))
        rows = {name: self._names.index(name) for name in acting}
        for name, row in rows.items():
            action, agent_name = [actions[name]], lambda _, row=row: episode.agent_name(row)
            array[row : row + 1] = validate_actions(action, controls, agent_name, 1)
        state, outcome = advance(episode, state, array)
        self._begun = episode, state
        terminated = {name: bool(outcome.terminated[row]) for name, row in rows.items()}
        truncated = {name: bool(outcome.truncated[row]) for name, row in rows.items()}
        infos = {name: describe_step(episode, state, outcome, row) for name, row in rows.items()}
        self.agents = [name for name in acting if not (terminated[name] or truncated[name])]
        rewards = {name: float(outcome.reward[row]) for name, row in rows.items()}
        return self._observe(acting), rewards, terminated, truncated, infos

    def _observe(self, names: list[str]) -> dict[str, Any]:
        assert self._begun is not None
        observation, form = look(*self._begun), self.source.config.observation
        return {name: format_observation(observation, form, self._names.index(name)) for name in names}


parallel_env = TrafficParallelEnv
"""PettingZoo's name for what makes such an environment."""
