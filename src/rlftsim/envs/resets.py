"""Parts that all environments share: settings by name, the choice of a scenario, `info` of resets and steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from jaxtyping import Bool

from rlftsim.envs.config import EnvConfig
from rlftsim.envs.episode import Episode, EpisodeState, Outcome, start
from rlftsim.envs.result import build_result
from rlftsim.envs.source import Source
from rlftsim.envs.world import Dice
from rlftsim.errors import ConfigError, whole_number
from rlftsim.scenario.types import CURRENT_STEP

OPTIONS = ("scenario", "rollout", "goals")
"""Options of a reset."""


def build_config(settings: dict[str, Any]) -> EnvConfig:
    """Settings by name.

    Raises:
        ConfigError: No setting of that name.
    """
    unknown_fields = [name for name in settings if name not in EnvConfig.__dataclass_fields__]
    if unknown_fields:
        raise ConfigError(f"no setting {unknown_fields[0]!r}: known are {', '.join(EnvConfig.__dataclass_fields__)}.")
    return EnvConfig(**settings)


@dataclass(eq=False)
class EpisodeOrder:
    """Order of the episodes since a seed."""

    random: np.random.Generator
    """Draws the scenarios, also where the options of a reset name one."""
    seed: int
    """Seed of the traffic."""
    count: int = 0
    """Number of episodes since the seed, which is the number of the next rollout."""

    @classmethod
    def from_seed(cls, seed: int | None) -> "EpisodeOrder":
        """The order of a seed; None = of a random one, which fits an array of int64 and gives the same episodes."""
        seed = int(np.random.default_rng().integers(2**31)) if seed is None else seed
        return cls(seeding.np_random(seed)[0], seed)


def begin_episodes(
    source: Source, orders: Sequence[EpisodeOrder], options: dict[str, Any]
) -> tuple[Episode, EpisodeState]:
    """Episode in the next scenario of each order, which step together, and its first state.

    Args:
        source: Scenarios to choose from.
        orders: Order of each scene; it goes on by an episode.
        options: Options of the reset by name; other names than `OPTIONS` are refused.

    Raises:
        ConfigError: an option that there is not, or an unknown scenario.
    """
    unknown_options = [name for name in options if name not in OPTIONS]
    if unknown_options:
        raise ConfigError(f"reset has no option {unknown_options[0]!r}: known are {', '.join(OPTIONS)}.")
    scenarios, dice = [], []
    for order in orders:
        index = int(order.random.integers(len(source.scenario_ids)))
        dice.append(Dice(order.seed, whole_number("rollout", options.get("rollout", order.count), 0)))
        order.count += 1
        scenarios.append(source.scenario(options.get("scenario", source.scenario_ids[index])))
    goals = options.get("goals")
    episode = source.episode(scenarios, {s.scenario_id: goals for s in scenarios} if goals else None)
    return episode, start(episode, tuple(dice))


def describe_start(episode: Episode, state: EpisodeState, row: int, source: Source) -> dict[str, Any]:
    """Information at the beginning of an episode.

    Args:
        episode: Episode that the agent drives in.
        state: First state of the episode.
        row: Index of the agent among the planner-driven agents [M].
        source: Source of the environment, for the fingerprint of the traffic model.
    """
    scene_row, agent = episode.world.actors[row]
    scene, dice = episode.world.scenes[scene_row], state.world.dice[-1][scene_row]
    # map frame, from the current step on; NaN where there is no state
    logged = episode.world.logged[scene_row, agent, CURRENT_STEP:, :3].copy()  # [S - 10, 3]
    logged[~episode.world.valid[scene_row, agent, CURRENT_STEP:]] = np.nan
    return {
        "scenario": scene.scenario.scenario_id,
        "agent": int(scene.object_id[agent]),
        "seed": dice.seed,
        "rollout": dice.rollout,
        "step": 0,
        "route": episode.atlas.routes[row].source,
        "model": source.fingerprint,
        "lights_held": bool(has_frozen_lights(episode, state)[row]),
        "logged": logged,
    }


def describe_step(episode: Episode, state: EpisodeState, outcome: Outcome, row: int) -> dict[str, Any]:
    """Information after an action; at the end of the agent's episode with the `Result`.

    Args:
        episode: Episode that the agent drives in.
        state: State of the episode after the action.
        outcome: Rewards and ends that the action led to.
        row: Index of the agent among the planner-driven agents [M].
    """
    note = pick_row(describe_steps(episode, state, outcome), row)
    if outcome.terminated[row] or outcome.truncated[row]:
        note["result"] = build_result(episode, state, row)
    return note


def describe_steps(episode: Episode, state: EpisodeState, outcome: Outcome) -> dict[str, Any]:
    """Information of all agents after an action, in arrays [M].

    Args:
        episode: Episode that the agents drive in.
        state: State of the episode after the action.
        outcome: Rewards and ends that the action led to.
    """
    return {
        "step": np.full(episode.num_agents, state.world.step),
        "terms": outcome.terms,
        "clipped": outcome.is_clipped,
        "lights_held": has_frozen_lights(episode, state),
    }


def pick_row(columns: dict[str, Any], row: int) -> dict[str, Any]:
    """Numbers of an agent by name, from arrays of all agents.

    Args:
        columns: Arrays by name, or dictionaries of arrays.
        row: Index of the agent among the planner-driven agents [M].
    """
    return {
        name: pick_row(column, row) if isinstance(column, dict) else column[row].item()
        for name, column in columns.items()
    }


def has_frozen_lights(episode: Episode, state: EpisodeState) -> Bool[np.ndarray, "M"]:
    """True where lights keep the last state as the log has no further states.

    Args:
        episode: Episode that the agents drive in.
        state: Present state of the episode.
    """
    last_observed = episode.last_light_step
    return (last_observed >= 0) & (last_observed < len(state.world.track) - 1)
