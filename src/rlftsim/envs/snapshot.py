"""Snapshots of episodes as bytes: numbers and JSON in the safetensors format and a checksum, no code.

An episode follows from scenarios, dice and the planner's motion, so these are all that is stored. Reading runs the
episode again, which gives equal bits: the same network calls on the same numbers.
"""

import hashlib
import json
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
from rlftsim.scenario.types import CURRENT_STEP

FORMAT = "rlftsim-snapshot-1"
CHECKSUM_BYTES = 32
IGNORED = ("data", "split", "model", "device", "render_mode", "observation", "frame")
"""Settings that may differ between writing and reading."""


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
        DataError: no snapshot, or a damaged snapshot.
        ConfigError: A snapshot of a different model, or of other settings.
    """
    if not isinstance(saved, bytes) or hashlib.sha256(saved[:-CHECKSUM_BYTES]).digest() != saved[-CHECKSUM_BYTES:]:
        raise DataError("not a snapshot of an episode, or a damaged one: take one with snapshot().")
    about, motion = _parse(saved[:-CHECKSUM_BYTES])
    if about["format"] != FORMAT:
        raise DataError("a snapshot of another version: take a new one with snapshot().")
    if about["model"] != source.fingerprint:
        raise ConfigError("the snapshot is of another traffic model: make the environment with the same one.")
    goals: Any = {name: {int(i): p for i, p in points.items()} for name, points in (about["goals"] or {}).items()}
    episode = source.episode([source.scenario(name) for name in about["scenarios"]], goals or None)
    differences = [name for name, value in _settings(episode).items() if about["settings"].get(name) != value]
    if differences:
        raise ConfigError(f"the snapshot was taken with another {differences[0]}: make the environment alike.")
    if motion.shape[1:] != (episode.num_agents, 5):
        raise ConfigError("the snapshot was taken with other planner-driven agents: make the environment alike.")
    try:
        dice = [tuple(Dice(**values) for values in row) for row in about["dice"]]
        for draw in chain.from_iterable(dice):
            check_types(draw)
            if min(draw.seed, draw.rollout) < 0:
                raise ConfigError(f"negative dice: {in_short([draw.seed, draw.rollout])}")
    except (TypeError, ConfigError) as error:
        raise DataError(f"a damaged snapshot ({error}): take a new one with snapshot().") from None
    return episode, repeat(episode, start(episode, dice[0]), motion[1:], dice)


def _parse(body: bytes) -> tuple[dict[str, Any], np.ndarray]:
    """Description and motion [T + 1, M, 5] of a snapshot.

    Raises:
        DataError: A value is missing, of the wrong type or not finite.
    """
    try:
        arrays = load(body)
        about = parse_json(arrays["about"].tobytes(), "take one with snapshot()", source="description of a snapshot")
        motion = arrays["motion"]
        types = {"format": str, "model": str, "scenarios": list, "dice": list, "settings": dict}
        bad_names = [name for name, value_type in types.items() if not isinstance(about.get(name), value_type)]
        goals = about["goals"] or {}
        if not all(isinstance(value, dict) for value in (goals, *goals.values())):
            bad_names.append("goals")
        is_motion = motion.ndim == 3 and motion.dtype.kind == "f" and np.isfinite(motion).all()
        if bad_names or not is_motion or not about["dice"]:
            raise ValueError(f"its {bad_names[0] if bad_names else 'dice' if is_motion else 'motion'} cannot be used")
    except (SafetensorError, KeyError, AttributeError, ValueError, TypeError) as error:
        raise DataError(f"a damaged snapshot ({error}): take a new one with snapshot().") from None
    return about, motion


def _settings(episode: Episode) -> dict[str, Any]:
    """Settings that an episode depends on, as JSON has them."""
    settings = {name: value for name, value in asdict(episode.config).items() if name not in IGNORED}
    return parse_json(json.dumps(settings), "give plain values", source="settings of the environment")
