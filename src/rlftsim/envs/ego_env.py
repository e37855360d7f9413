"""The Gymnasium environment: a planner drives the ego of a scenario, a traffic model all other agents."""

from dataclasses import replace
from typing import Any, ClassVar

import gymnasium
import numpy as np

from rlftsim.envs.episode import Episode, EpisodeState, advance, look
from rlftsim.envs.record import build_record
from rlftsim.envs.resets import EpisodeOrder, begin_episodes, build_config, describe_start, describe_step
from rlftsim.envs.result import Result, build_animation, build_page, build_result
from rlftsim.envs.snapshot import read_snapshot, write_snapshot
from rlftsim.envs.source import Source
from rlftsim.envs.spaces import action_space, format_observation, observation_space
from rlftsim.envs.world import Noise, fork
from rlftsim.errors import ConfigError
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.open import AnyScenarios
from rlftsim.viewer.film import Camera
from rlftsim.viewer.page import Panel
from rlftsim.viewer.scene import SceneMotion

RENDER_DOTS_PER_INCH = 100
"""Makes pictures 400 pixels wide."""


class EgoEnv(gymnasium.Env):
    """A scenario at a time; made by `gymnasium.make("rlftsim.envs:rlftsim/Ego-v0", ...)`.

    Args:
        scenarios: Scenario, list of scenarios or data set, in place of the setting `data`.
        policy: Traffic model in place of the model that the setting `model` names, in evaluation mode.
        settings: Fields of `EnvConfig` by name; all other fields have defaults.
        source: Scenarios, model and settings that are loaded already, in place of the other arguments.
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
        self.source = source or Source(build_config(settings), scenarios, policy)
        self.config = self.source.config
        self.render_mode = self.config.render_mode
        self.action_space = action_space(self.source.controls)
        self.observation_space = observation_space(self.config.observation)
        self._begun: tuple[Episode, EpisodeState] | None = None
        self._order: EpisodeOrder | None = None
        self._camera: Camera | None = None

    @property
    def episode(self) -> Episode:
        """The running episode.

        Raises:
            ConfigError: there is none yet.
        """
        return self._running[0]

    @property
    def state(self) -> EpisodeState:
        """The present state, a value."""
        return self._running[1]

    @property
    def _running(self) -> tuple[Episode, EpisodeState]:
        if self._begun is None:
            raise ConfigError("this environment has no episode yet: call reset() first.")
        return self._begun

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of the order of scenarios and of the traffic; equal seeds, equal episodes.
            options: Choices by name: "scenario" (an id; else drawn), "rollout" (a number; else 0, 1, ... since the last
                seed), "goals" ({object id: (x, y)} of agents that follow the policy, world frame).

        Raises:
            ConfigError: an unknown option or scenario.
        """
        if seed is not None or self._order is None:
            self._order = EpisodeOrder.from_seed(seed)
            super().reset(seed=self._order.seed)
        self._order.random = self.np_random  # Gymnasium lets users replace it
        episode, state = begin_episodes(self.source, [self._order], options or {})
        if episode.num_agents != 1:
            scenario_id = episode.world.scenes[0].scenario.scenario_id
            raise ConfigError(
                f"the planner drives {episode.num_agents} agents of scenario {scenario_id}, this environment has one: "
                "take rlftsim.envs.parallel_env."
            )
        self._begun = episode, state
        return self._look(), describe_start(episode, state, 0, self.source)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Carry out an action.

        Args:
            action: Planner action, a member of `action_space`.

        Raises:
            ConfigError: before `reset`, after the end, or an action with a NaN or of a wrong shape.
        """
        episode, state = self._running
        if state.ended[0]:
            raise ConfigError("this episode is over: call reset().")
        state, outcome = advance(episode, state, [action])
        self._begun = episode, state
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        return self._look(), float(outcome.reward[0]), terminated, truncated, describe_step(episode, state, outcome, 0)

    def fork(self, number: int, noise: Noise = "same") -> list["EgoEnv"]:
        """Environments that go on from here, which share all that does not change.

        Args:
            number: Number of branches to return.
            noise: "same" = all branches meet equal dice; "new" = new dice from the next decision of the traffic on.
        """
        episode, state = self._running
        branches = []
        for world in fork(episode.world, state.world, number, noise):
            branch = EgoEnv(source=self.source)
            branch._go_on(episode, replace(state, world=world))
            branches.append(branch)
        return branches

    def result(self) -> Result:
        """Scores of the episode so far."""
        return build_result(self.episode, self.state)

    def render(self) -> Any:
        """Picture of the scene [height, width, 3], or a page that plays the episode so far, by `render_mode`."""
        if self.render_mode is None:
            return None
        record = build_record(self.episode, self.state)
        if self.render_mode == "html":
            return build_page({"planner": record})
        if self._camera is None or self._camera.animation.scene.scenario_id != record.scene.scenario.scenario_id:
            self._camera = Camera(build_animation({"planner": record}), RENDER_DOTS_PER_INCH)
        present = record.motion[None, :, -1:].astype(np.float32)  # [1, A, 1, 5]
        motion = SceneMotion(present[..., :2], present[..., 2], record.is_present[None, :, -1:])
        score = self.result().planner.nuplan_style if self.state.ended[0] else None
        panel = Panel("planner", motion, [record.describe_step(record.steps, score)])
        return self._camera.frame([panel], 0, len(self.state.world.track) - 1)

    def snapshot(self) -> bytes:
        """The running episode as bytes, to be restored in this or any process with the same data and model."""
        return write_snapshot(self.episode, self.state, self.source.fingerprint)

    def restore(self, saved: bytes) -> tuple[Any, dict[str, Any]]:
        """Go on from a snapshot: the episode is run again with the planner's stored motion, which gives equal bits.

        Args:
            saved: Bytes that `snapshot` returned.

        Raises:
            ConfigError: A snapshot of a different model, or of other settings.
            DataError: no snapshot, or a damaged snapshot.
        """
        self._go_on(*read_snapshot(saved, self.source))
        return self._look(), describe_start(self.episode, self.state, 0, self.source)

    def _go_on(self, episode: Episode, state: EpisodeState) -> None:
        """Take over a running episode; the next episodes follow from the same seed, with the next rollouts."""
        dice = state.world.dice[-1][0]
        super().reset(seed=dice.seed)
        self._begun, self._order = (episode, state), EpisodeOrder(self.np_random, dice.seed, dice.rollout + 1)

    def _look(self) -> Any:
        return format_observation(look(self.episode, self.state), self.config.observation, 0)
