"""Parts that all environments share: settings by name, the choice of a scenario, `info` of resets and steps."""

from typing import Any

import numpy as np
from jaxtyping import Bool

from rlftsim.envs.config import EnvConfig
from rlftsim.envs.episode import Episode, EpisodeState, Outcome
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


def draw_seed() -> int:
    """A random seed, which fits an array of int64 and gives the same episodes again."""
    return int(np.random.default_rng().integers(2**31))


def choose_scenario(
    random: np.random.Generator, source: Source, options: dict[str, Any], seed: int, count: int
) -> tuple[str, Dice, Any]:
    """Scenario, dice and goals of a reset.

    Args:
        random: Generator that draws the scenario, also where the options name one.
        source: Scenarios to choose from.
        options: Options of the reset by name; other names than `OPTIONS` are refused.
        seed: Seed of the traffic, a whole number.
        count: Number of episodes since the seed, which is the number of the rollout.

    Raises:
        ConfigError: an option that there is not.
    """
    unknown_options = [name for name in options if name not in OPTIONS]
    if unknown_options:
        raise ConfigError(f"reset has no option {unknown_options[0]!r}: known are {', '.join(OPTIONS)}.")
    index = int(random.integers(len(source.scenario_ids)))
    scenario_id = options.get("scenario", source.scenario_ids[index])
    rollout = whole_number("rollout", options.get("rollout", count), 0)
    return scenario_id, Dice(seed, rollout), options.get("goals")


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
