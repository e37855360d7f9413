"""The Gymnasium environment: a planner drives the ego of a scenario, a traffic model everybody else."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from jaxtyping import Float

from rlftsim.envs.config import EnvConfig
from rlftsim.envs.episode import Episode, EpisodeState, advance, look, start
from rlftsim.envs.source import Source
from rlftsim.envs.spaces import action_space, observation_space, shown
from rlftsim.envs.world import Dice, Noise
from rlftsim.errors import ConfigError, whole_number
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.any_form import AnyScenarios
from rlftsim.scenario.types import CURRENT_STEP

class EgoEnv(gymnasium.Env):
    """One scenario at a time; `gymnasium.make("rlftsim.envs:rlftsim/Ego-v0", ...)` makes it.

    Args:
        scenarios: in place of the data set `data`: one, several or a data set.
        policy: in place of the traffic model `model`.
        settings: fields of `EnvConfig` by name.
        source: scenarios, model and settings that are loaded already, in place of all others.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array", "html"], "render_fps": 10}

    def __init__(
        self,
        *,
        scenarios: AnyScenarios | None = None,
        policy: Policy | None = None,
        source: Source | None = None,
        **settings: Any,
    ):
        self.source = source or Source(config_of(settings), scenarios, policy)
        self.config = self.source.config
        self.render_mode = self.config.render_mode
        self.action_space = action_space(self.source.controls)
        self.observation_space = observation_space(self.config.observation)
        self._begun: tuple[Episode, EpisodeState] | None = None
        self._seed, self._count = 0, 0

    @property
    def episode(self) -> Episode:
        """The running episode.

        Raises:
            ConfigError: there is none yet.
        """
        return self._running[0]

    @property
    def state(self) -> EpisodeState:
        """Its present state, a value."""
        return self._running[1]

    @property
    def _running(self) -> tuple[Episode, EpisodeState]:
        if self._begun is None:
            raise ConfigError("this environment has no episode yet: call reset() first.")
        return self._begun

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of the choice of scenarios and of the traffic. Same seed, same episode.
            options: "scenario" (an id; else one is drawn), "rollout" (a number; else 0, 1, ... since the last seed),
                "goals" ({object id: (x, y)} of agents that follow the policy, world frame).

        Raises:
            ConfigError: an unknown option or scenario.
        """
        super().reset(seed=seed)
        if seed is not None or self._begun is None:
            self._seed, self._count = int(self.np_random_seed or 0), 0
        scenario_id, dice, goals = chosen(self, self.source, options or {}, self._seed, self._count)
        self._count += 1
        scenario = self.source.scenario(scenario_id)
        episode = self.source.episode([scenario], {scenario_id: goals} if goals else None)
        if episode.num_agents != 1:
            raise ConfigError(
                f"the planner drives {episode.num_agents} agents of scenario {scenario_id}, this environment has one: "
                "take rlftsim.envs.parallel_env."
            )
        self._begun = episode, start(episode, (dice,))
        return self._look(), about(episode, self.state, 0, self.source)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Carry out one action.

        Args:
            action: of the action space.

        Raises:
            ConfigError: before `reset`, after the end, or an action with a NaN or of another shape.
        """
        episode, state = self._running
        if state.ended[0]:
            raise ConfigError("this episode is over: call reset().")
        state, outcome = advance(episode, state, np.asarray(action)[None])
        self._begun = episode, state
        info = {
            "step": state.world.step,
            "terms": {name: float(value[0]) for name, value in outcome.terms.items()},
            "clipped": bool(outcome.clipped[0]),
            "lights_held": lights_are_held(episode, state, 0),
        }
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        return self._look(), float(outcome.reward[0]), terminated, truncated, info

    def fork(self, number: int, noise: Noise = "same") -> list["EgoEnv"]:
        """Environments that go on from here, which share all that does not change.

        Args:
            number: of branches.
            noise: "same" = they meet the same dice; "new" = other ones from the next decision of the traffic on.
        """
        from rlftsim.envs.world import fork

        episode, state = self._running
        branches = []
        for world in fork(episode.world, state.world, number, noise):
            branch = EgoEnv(source=self.source)
            branch._begun = episode, EpisodeState(**{**vars(state), "world": world})
            branch._seed, branch._count = self._seed, self._count
            branches.append(branch)
        return branches

    def _look(self) -> Any:
        return shown(look(self.episode, self.state), self.config.observation, 0)


def config_of(settings: dict[str, Any]) -> EnvConfig:
    """Settings by name.

    Raises:
        ConfigError: one that there is not.
    """
    unknown = [name for name in settings if name not in EnvConfig.__dataclass_fields__]
    if unknown:
        raise ConfigError(f"no setting {unknown[0]!r}: known are {', '.join(EnvConfig.__dataclass_fields__)}.")
    return EnvConfig(**settings)


def chosen(env: Any, source: Source, options: dict[str, Any], seed: int, count: int) -> tuple[str, Dice, Any]:
    """Scenario, dice and goals of a reset.

    Args:
        env: supplies the random numbers.
        source: supplies the scenarios.
        options: of the reset.
        seed: of the traffic.
        count: episodes since the seed, the number of the rollout.

    Raises:
        ConfigError: an option that there is not.
    """
    unknown = [name for name in options if name not in ("scenario", "rollout", "goals")]
    if unknown:
        raise ConfigError(f"reset has no option {unknown[0]!r}: known are scenario, rollout, goals.")
    drawn = int(env.np_random.integers(len(source.scenario_ids)))
    scenario_id = options.get("scenario", source.scenario_ids[drawn])
    rollout = whole_number("rollout", options.get("rollout", count), 0)
    return scenario_id, Dice(seed, rollout), options.get("goals")


def about(episode: Episode, state: EpisodeState, row: int, source: Source) -> dict[str, Any]:
    """Information at the beginning of an episode.

    Args:
        episode: of the agent.
        state: its first.
        row: of the agent.
        source: of the environment.
    """
    scene_row, agent = episode.world.actors[row]
    scene, dice = episode.world.scenes[scene_row], state.world.dice[-1][scene_row]
    return {
        "scenario": scene.scenario.scenario_id,
        "agent": int(scene.object_id[agent]),
        "seed": dice.seed,
        "rollout": dice.rollout,
        "step": 0,
        "route": episode.atlas.routes[row].source,
        "model": source.fingerprint,
        "lights_held": lights_are_held(episode, state, row),
        "logged": logged_poses(episode, row),
    }


def logged_poses(episode: Episode, row: int) -> Float[np.ndarray, "81 3"]:
    """Logged poses of an agent from the current step on, map frame; NaN where there is no state.

    Args:
        episode: of the agent.
        row: of the agent.
    """
    scene, agent = episode.world.actors[row]
    poses = episode.world.logged[scene, agent, CURRENT_STEP:, :3].copy()
    poses[~episode.world.valid[scene, agent, CURRENT_STEP:]] = np.nan
    return poses


def lights_are_held(episode: Episode, state: EpisodeState, row: int) -> bool:
    """True where lights keep their last state as the log has no further ones.

    Args:
        episode: of the agent.
        state: the present one.
        row: of the agent.
    """
    lights = episode.world.scenes[episode.world.actors[row][0]].lights
    return 0 <= lights.last_observed < len(state.world.track) - 1
