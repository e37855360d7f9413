"""Snapshots of episodes as bytes: numbers and JSON in the safetensors format and a checksum, no code.

An episode follows from scenarios, dice and the planner's motion, so these are all that is stored. Reading runs the
episode again, which gives equal bits: the same network calls on the same numbers.
"""

import hashlib
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from itertools import chain
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from rlftsim.envs.episode import Episode, EpisodeState, repeat, start
from rlftsim.envs.source import Source
from rlftsim.envs.world import Dice
from rlftsim.errors import ConfigError, DataError, check_types, in_short
from rlftsim.jobs.documents import parse_json
from rlftsim.rollout.entries import identify_entries
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS, STEP_S

FORMAT = "rlftsim-snapshot-1"
CHECKSUM_BYTES = 32
IGNORED = ("data", "split", "model", "device", "render_mode", "observation", "frame")
"""Settings that may differ between writing and reading."""
MAX_COORDINATE_M = 1e7
"""Largest number of a motion, in meters, meters per second or radians."""
SAME_M, JUMP_M = 1e-3, 0.5
"""Difference from the log that another machine may make at the start, and way of a step beyond that of its speed."""


def write_snapshot(episode: Episode, state: EpisodeState, fingerprint: str) -> bytes:
    """Bytes of an episode.

    Args:
        episode: Episode whose world, map and settings do not change.
        state: Present state of the episode.
        fingerprint: Fingerprint of the traffic model, which a reader must have, too.
    """
    scene, agent = episode.world.actors.T
    about = {
        "format": FORMAT,
        "model": fingerprint,
        "scenarios": [view.scenario.scenario_id for view in episode.world.scenes],
        "dice": [[asdict(scene_dice) for scene_dice in dice] for dice in state.world.dice],
        "settings": _settings(episode),
        "goals": episode.goals,
    }
    motion = np.stack([step[scene, agent] for step in state.world.track[CURRENT_STEP:]])  # [T + 1, M, 5]
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    body = save({"motion": motion, "about": text})
    return body + hashlib.sha256(body).digest()


def read_snapshot(saved: bytes, source: Source) -> tuple[Episode, EpisodeState]:
    """Episode and state of a snapshot.

    Args:
        saved: Bytes that `write_snapshot` returned.
        source: Source of the environment that continues the episode.

    Raises:
        DataError: no snapshot, or a damaged snapshot, such as motion that does not begin as the log.
        ConfigError: A snapshot of a different model, or of other settings.
    """
    if not isinstance(saved, bytes) or hashlib.sha256(saved[:-CHECKSUM_BYTES]).digest() != saved[-CHECKSUM_BYTES:]:
        raise DataError("not a snapshot of an episode, or a damaged one: take one with snapshot().")
    about, motion = _parse(saved[:-CHECKSUM_BYTES])
    if about["format"] != FORMAT:
        raise DataError("a snapshot of another version: take a new one with snapshot().")
    if about["model"] != source.fingerprint:
        raise ConfigError("the snapshot is of another traffic model: make the environment with the same one.")
    episode = source.episode([source.scenario(name) for name in about["scenarios"]], about["goals"] or None)
    differences = [name for name, value in _settings(episode).items() if about["settings"].get(name) != value]
    if differences:
        raise ConfigError(f"the snapshot was taken with another {differences[0]}: make the environment alike.")
    if motion.shape[1:] != (episode.num_agents, 5):
        raise ConfigError("the snapshot was taken with other planner-driven agents: make the environment alike.")
    with _damage_named():
        _check_motion(motion, episode)
        dice = _parse_dice(about["dice"], len(motion) - 1, episode)
    return episode, repeat(episode, start(episode, dice[0]), motion[1:], dice)


@contextmanager
def _damage_named() -> Iterator[None]:
    """Turn any error about a value of a snapshot into a line that says the snapshot is damaged."""
    try:
        yield
    except (SafetensorError, KeyError, AttributeError, ValueError, TypeError) as error:  # a ConfigError is a ValueError
        raise DataError(f"a damaged snapshot ({error}): take a new one with snapshot().") from None


def _parse(body: bytes) -> tuple[dict[str, Any], np.ndarray]:
    """Description, with goals by object id, and motion [T + 1, M, 5] of a snapshot.

    Raises:
        DataError: A value is missing, of the wrong type or not finite.
    """
    with _damage_named():
        arrays = load(body)
        about = parse_json(arrays["about"].tobytes(), "take one with snapshot()", source="description of a snapshot")
        motion = arrays["motion"]
        types = {"format": str, "model": str, "scenarios": list, "dice": list, "settings": dict}
        bad_names = [name for name, value_type in types.items() if not isinstance(about.get(name), value_type)]
        goals = about["goals"] or {}
        if not all(isinstance(value, dict) for value in (goals, *goals.values())):
            bad_names.append("goals")
        if not (about["scenarios"] and all(isinstance(name, str) for name in about["scenarios"])):
            bad_names.append("scenarios")
        if motion.ndim != 3 or motion.dtype != np.float64 or not (np.abs(motion) <= MAX_COORDINATE_M).all():
            bad_names.append("motion")
        if bad_names:
            raise ValueError(f"its {bad_names[0]} cannot be used")
        about["goals"] = {name: {int(i): point for i, point in points.items()} for name, points in goals.items()}
    return about, motion


def _check_motion(motion: np.ndarray, episode: Episode) -> None:
    """Check that motion [T + 1, M, 5] begins as the log of the scenarios and goes on without a jump.

    Raises:
        ValueError: A wrong number of steps, another beginning, or a step farther than the speed explains.
    """
    max_steps = episode.world.valid.shape[2] - HISTORY_STEPS
    if not 1 <= len(motion) <= max_steps + 1:
        raise ValueError(f"its motion has {len(motion) - 1} steps, not 0 to {max_steps}")
    scene, agent = episode.world.actors.T
    if not np.allclose(motion[0], episode.world.logged[scene, agent, CURRENT_STEP], rtol=0.0, atol=SAME_M):
        raise ValueError("its motion does not begin as the log of its scenario")
    speed = np.linalg.norm(motion[..., 3:], axis=-1)  # [T + 1, M], m/s
    distance = np.linalg.norm(np.diff(motion[..., :2], axis=0), axis=-1)  # [T, M], m
    jumps = np.argwhere(distance > np.maximum(speed[1:], speed[:-1]) * STEP_S + JUMP_M)
    if len(jumps):
        step, row = jumps[0].tolist()
        raise ValueError(f"{episode.agent_name(row)} jumps by {distance[step, row]:.3g} m at step {step + 1}")


def _parse_dice(rows: list[Any], num_steps: int, episode: Episode) -> list[tuple[Dice, ...]]:
    """Dice of each scene at the start and at each decision.

    Raises:
        ValueError, TypeError: Dice of other scenes or decisions, or no whole numbers of at least 0.
    """
    policy, num_scenes = episode.world.policy, len(episode.world.scenes)
    num_rows = 1 if policy is None else 1 + math.ceil(num_steps / policy.steps_per_decision)
    dice = [tuple(Dice(**values) for values in row) for row in rows]
    if [len(row) for row in dice] != [num_scenes] * num_rows:
        raise ValueError(f"its dice are not of {num_scenes} scenarios and {num_rows} decisions")
    for draw in chain.from_iterable(dice):
        check_types(draw)
        if min(draw.seed, draw.rollout) < 0:
            raise ValueError(f"negative dice: {in_short([draw.seed, draw.rollout])}")
    return dice


def _settings(episode: Episode) -> dict[str, Any]:
    """Settings that an episode depends on, as JSON has them."""
    settings = {name: value for name, value in asdict(episode.config).items() if name not in IGNORED}
    settings["entries"] = identify_entries(settings["entries"])
    return parse_json(json.dumps(settings), "give plain values", source="settings of the environment")
