"""An adapter for Stable-Baselines3, which does not take Gymnasium's vector environments.

from rlftsim.envs.sb3 import SB3VecEnv
model = PPO("MlpPolicy", SB3VecEnv(8, observation="flat", action="bicycle"))
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from rlftsim.envs.vector_env import EgoVectorEnv
from rlftsim.errors import ConfigError


class SB3VecEnv(VecEnv):
    """Ego environments as a `VecEnv`, with one network call for scenes that were reset together.

    Args:
        num_envs: Number of environments that step together.
        settings: Arguments of `EgoVectorEnv` by name.
    """

    def __init__(self, num_envs: int = 1, **settings: Any):
        self.vector = EgoVectorEnv(num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **settings)
        super().__init__(num_envs, self.vector.single_observation_space, self.vector.single_action_space)
        self._actions = np.zeros(0)

    def reset(self) -> Any:
        """Observations of new episodes; `seed` and `set_options` hold for the next reset.

        Raises:
            ConfigError: options that are not the same for all environments.
        """
        if any(options != self._options[0] for options in self._options):
            raise ConfigError("set_options has different options: they must be the same for all environments.")
        observation, self.reset_infos = self.vector.reset_slots(self._seeds[0], self._options[0])
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Carry out the actions: observations, rewards, ends and infos."""
        observation, rewards, terminated, truncated, notes = self.vector.step_slots(self._actions)
        for i in np.flatnonzero(terminated | truncated):
            ends = {"terminal_observation": notes[i]["final_obs"], "TimeLimit.truncated": bool(truncated[i])}
            notes[i] = {**notes[i]["final_info"], **ends}
        return observation, rewards.astype(np.float32), terminated | truncated, notes

    def close(self) -> None:
        """Do nothing: no files or windows are open."""

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """An attribute of the vector environment, once for each environment.

        Args:
            attr_name: Name of the attribute of `EgoVectorEnv`.
            indices: Indices of environments, for the length of the result; None = all.
        """
        # the spaces are those of one environment
        name = f"single_{attr_name}" if attr_name in ("action_space", "observation_space") else attr_name
        value = None if attr_name == "render_mode" else getattr(self.vector, name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of the vector environment.

        Args:
            attr_name: Name of the attribute of `EgoVectorEnv`.
            value: New value, which all environments share.
            indices: Indices of environments, not used: all share the attribute.
        """
        setattr(self.vector, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment, once for each environment.

        Args:
            method_name: Name of the method of `EgoVectorEnv`.
            method_args: Arguments of the method by position.
            indices: Indices of environments, for the length of the result; None = all.
            method_kwargs: Arguments of the method by name.
        """
        return [getattr(self.vector, method_name)(*method_args, **method_kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: int | Iterable[int] | None = None) -> Sequence[bool]:
        """False: environments are not wrapped separately.

        Args:
            wrapper_class: Class of a wrapper, not used: the answer is False for each.
            indices: Indices of environments, for the length of the result; None = all.
        """
        return [False for _ in self._get_indices(indices)]
