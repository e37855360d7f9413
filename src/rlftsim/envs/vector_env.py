"""Many ego environments at once: scenes that are reset together step together, with a single network call for all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Int64

from rlftsim.envs.actions import validate_actions
from rlftsim.envs.config import EnvConfig
from rlftsim.envs.episode import Episode, EpisodeState, advance, look
from rlftsim.envs.resets import (
    EpisodeOrder,
    begin_episodes,
    build_config,
    describe_start,
    describe_step,
    describe_steps,
    pick_row,
)
from rlftsim.envs.source import Source
from rlftsim.envs.spaces import action_space, format_observation, observation_space
from rlftsim.errors import ConfigError, in_short, whole_number
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.open import AnyScenarios


@dataclass(eq=False)
class _Group:
    """Scenes that were reset together. A scene is carried along after the slot has gone on to a new group."""

    episode: Episode
    state: EpisodeState
    slots: Int64[np.ndarray, "B"]
    """Slot of each scene; -1 = none any more."""

    @property
    def live(self) -> Int64[np.ndarray, "b"]:
        """Scenes with a slot."""
        return np.flatnonzero(self.slots >= 0)


class EgoVectorEnv(VectorEnv):
    """Ego environments side by side: slot i seeded with s + i is `EgoEnv` seeded with s + i.

    A group of scenes that were reset together makes one network call for all of them every half second. Scenes that
    end early are reset on their own and form smaller groups, so `stop_on=()` is fastest.

    Args:
        num_envs: Number of slots, each with an episode of its own.
        autoreset_mode: Time of Gymnasium's automatic resets: at the next step, in the same step, or by
            `reset(options={"reset_mask": ...})`.
        scenarios: Scenario, list of scenarios or data set, in place of the setting `data`.
        policy: Traffic model in place of the model that the setting `model` names, in evaluation mode.
        settings: Fields of `EnvConfig` by name; pictures and pages exist only for `EgoEnv`.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        scenarios: AnyScenarios | None = None,
        policy: Policy | None = None,
        **settings: Any,
    ):
        config: EnvConfig = build_config(settings)
        if config.render_mode is not None or config.observation == "arrays":
            raise ConfigError("a vector of environments renders nothing and observes 'dict' or 'flat': change these.")
        self.source = Source(config, scenarios, policy)
        self.num_envs = whole_number("num_envs", num_envs, 1)
        modes = [mode.value for mode in AutoresetMode]
        if autoreset_mode not in [*modes, *AutoresetMode]:
            raise ConfigError(f"autoreset_mode must be one of {', '.join(modes)}, got {in_short(autoreset_mode)}.")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.single_action_space = action_space(self.source.controls)
        self.single_observation_space = observation_space(config.observation)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._slots: list[EpisodeOrder] = []
        self._groups: list[_Group] = []
        self._over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes in all slots, or in those of `options["reset_mask"]`.

        Args:
            seed: Number s, which gives slot i the seed s + i; or a list with a seed per slot.
            options: Options of `EgoEnv.reset`, the same for all slots.

        Raises:
            ConfigError: an unknown option or scenario.
        """
        observation, notes = self.reset_slots(seed, options)
        return observation, self._join_infos(notes, {})

    def reset_slots(
        self, seed: int | Sequence[int | None] | None, options: dict[str, Any] | None = None
    ) -> tuple[Any, list[dict[str, Any]]]:
        """As `reset`, with the infos of each slot apart.

        Args:
            seed: Number s, which gives slot i the seed s + i; or a list with a seed per slot.
            options: Options of `EgoEnv.reset`, the same for all slots, and "reset_mask" [num_envs].

        Raises:
            ConfigError: an unknown option or scenario.
        """
        if not isinstance(options, Mapping | None):
            raise ConfigError(
                f"options is one dictionary for all slots, got {in_short(options)}: for different scenarios reset the "
                "slots in turn, with reset_mask."
            )
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ConfigError(f"reset_mask must be {self.num_envs} truth values, got {mask.dtype} {mask.shape}.")
        if not self._groups and not mask.all():
            raise ConfigError("the first reset begins an episode in every slot: leave out reset_mask.")
        if isinstance(seed, list | tuple | np.ndarray):
            seeds = [None if number is None else whole_number("seed", number, 0) for number in seed]
        else:
            seeds = [None if seed is None else whole_number("seed", seed, 0) + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ConfigError(f"seed has {len(seeds)} numbers, it must be one number or {self.num_envs}.")
        for i, slot_seed in enumerate(seeds):
            if len(self._slots) <= i or slot_seed is not None:
                self._slots[i : i + 1] = [EpisodeOrder.from_seed(slot_seed)]
        notes: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._reset(np.flatnonzero(mask), options, notes)
        return self._observe(), notes

    def step(
        self, actions: Any
    ) -> tuple[Any, np.ndarray, Bool[np.ndarray, "n"], Bool[np.ndarray, "n"], dict[str, Any]]:
        """Carry out an action in every slot.

        Args:
            actions: Planner actions [num_envs, ...], in the units of the action space.

        Raises:
            ConfigError: as `step_slots`.
        """
        *results, steps, notes = self._step(actions)
        infos: dict[str, Any] = {}
        for columns, rows, slots in steps:
            self._add_columns(infos, columns, rows, slots)
        return *results, self._join_infos(notes, infos)

    def step_slots(
        self, actions: Any
    ) -> tuple[Any, np.ndarray, Bool[np.ndarray, "n"], Bool[np.ndarray, "n"], list[dict[str, Any]]]:
        """As `step`, with the infos of each slot apart.

        Args:
            actions: Planner actions [num_envs, ...], in the units of the action space.

        Raises:
            ConfigError: before `reset`, or an action with a NaN or of a wrong shape; with autoreset disabled a slot
                whose episode is over.
        """
        *results, steps, notes = self._step(actions)
        for columns, rows, slots in steps:
            for row, slot in zip(rows, slots):
                notes[slot] = pick_row(columns, int(row))
        return *results, notes

    def _step(self, actions: Any) -> tuple[Any, ...]:
        """As `step_slots`; before the infos of slots that begin or end an episode stand those of all others, in arrays:
        columns by name, and rows and slots that have them."""
        if not self._groups:
            raise ConfigError("these environments have no episodes yet: call reset() first.")
        controls = self.source.controls
        # all slots before any of them moves
        actions = validate_actions(actions, controls, self._describe_slot, self.num_envs)
        over = np.flatnonzero(self._over)
        if self.autoreset_mode == AutoresetMode.DISABLED and len(over):
            raise ConfigError(f"the episode of slot {over[0]} is over: reset it with options={{'reset_mask': ...}}.")
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, bool)
        notes: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        # 1. slots whose episode ended in the last step begin another one and take no action
        begun: list[_Group] = []
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and len(over):
            self._reset(over, {}, notes)
            begun = self._groups[-1:]
        # 2. all others act, a group at a time
        steps: list[tuple[dict[str, Any], np.ndarray, np.ndarray]] = []
        for group in self._groups:
            if group in begun:
                continue
            slots = group.slots[group.live]
            action = np.zeros((len(group.slots), *controls.limits.shape), actions.dtype)
            action[group.live] = actions[slots]
            group.state, outcome = advance(group.episode, group.state, action)
            rewards[slots] = outcome.reward[group.live]
            terminated[slots], truncated[slots] = outcome.terminated[group.live], outcome.truncated[group.live]
            is_over = terminated[slots] | truncated[slots]
            for row, slot in zip(group.live[is_over], slots[is_over]):
                notes[slot] = describe_step(group.episode, group.state, outcome, int(row))
            columns = describe_steps(group.episode, group.state, outcome)
            steps.append((columns, group.live[~is_over], slots[~is_over]))
        self._over = terminated | truncated
        # 3. the same step resets at once and hands over the last observation beside the first
        ended = np.flatnonzero(self._over)
        if self.autoreset_mode == AutoresetMode.SAME_STEP and len(ended):
            last, final = self._observe(), {slot: notes[slot] for slot in ended}
            self._reset(ended, {}, notes)
            for slot in ended:
                is_dict = isinstance(last, dict)
                final_observation = {name: values[slot] for name, values in last.items()} if is_dict else last[slot]
                notes[slot] |= {"final_obs": final_observation, "final_info": final[slot]}
        return self._observe(), rewards, terminated, truncated, steps, notes

    def _add_columns(self, infos: dict[str, Any], columns: dict[str, Any], rows: np.ndarray, slots: np.ndarray) -> None:
        """Add infos of some rows of a group in Gymnasium's form for vectors, as `_add_info` does for a slot."""
        for name, column in columns.items():
            if isinstance(column, dict):
                self._add_columns(infos.setdefault(name, {}), column, rows, slots)
            else:
                infos.setdefault(name, np.zeros(self.num_envs, column.dtype))[slots] = column[rows]
            infos.setdefault(f"_{name}", np.zeros(self.num_envs, bool))[slots] = True

    def _join_infos(self, notes: list[dict[str, Any]], infos: dict[str, Any]) -> dict[str, Any]:
        """Infos of all slots in Gymnasium's form for vectors, added to others."""
        for slot, note in enumerate(notes):
            infos = self._add_info(infos, note, slot)
        return infos

    def _describe_slot(self, slot: int) -> str:
        group = next(group for group in self._groups if slot in group.slots)
        return f"slot {slot}, {group.episode.agent_name(int(np.flatnonzero(group.slots == slot)[0]))}"

    def _reset(self, slots: np.ndarray, options: dict[str, Any], notes: list[dict[str, Any]]) -> None:
        """Begin episodes of some slots, which form a group, and note the infos of each episode."""
        episode, state = begin_episodes(self.source, [self._slots[i] for i in slots], options)
        if episode.num_agents != len(slots):
            raise ConfigError("the planner drives more than the egos: take rlftsim.envs.parallel_env.")
        # groups lose the slots that went on, and are dropped when they have none left
        for group in self._groups:
            group.slots[np.isin(group.slots, slots)] = -1
        self._groups = [*(group for group in self._groups if len(group.live)), _Group(episode, state, np.array(slots))]
        self._over[slots] = False
        for row, i in enumerate(slots):
            notes[i] = describe_start(episode, state, row, self.source)

    def _observe(self) -> Any:
        """Observations of all slots in order."""
        form = self.source.config.observation
        observations: list[Any] = [format_observation(look(group.episode, group.state), form) for group in self._groups]
        if len(observations) == 1 and len(self._groups[0].live) == self.num_envs:
            return observations[0]  # a group of all slots has them in order
        order = np.argsort(np.concatenate([group.slots[group.live] for group in self._groups]))

        def joined(arrays: list[np.ndarray]) -> np.ndarray:
            return np.concatenate([array[group.live] for array, group in zip(arrays, self._groups)])[order]

        if form == "flat":
            return joined(observations)
        return {name: joined([arrays[name] for arrays in observations]) for name in observations[0]}
