"""Half-second motions of a data set, and samples of motions and map windows in bounded memory.

A *motion* is six poses (x, y, heading) at 10 Hz in the frame of the first: [6, 3].
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from rlftsim.geometry import box_corners, rotate, wrap_angle
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, Scenario
from rlftsim.tokens.agent_tokens import clean_tracks
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, STEPS_PER_TOKEN, class_of_type

MIN_VALID_STEPS = 30
"""Agents with fewer logged steps are left out, as in the public SMART code."""
MAX_SPEED_MPS = (45.0, 12.0, 25.0)
"""Greatest speed of each class; a faster step is a glitch of the log."""
MAX_STEP_TURN_RAD = np.deg2rad(30.0)
"""Greatest turn within 0.1 s; more is a glitch of the log."""
MAX_TURN_RAD = 1.2
"""Greatest turn within half a second."""
_MIRROR = np.array([1, -1, -1], np.float32)
_KEY_M = 0.01


@dataclass(frozen=True, eq=False)
class Motions:
    """Half-second motions of a scenario's agents."""

    poses: Float32[np.ndarray, "n 6 3"]
    class_id: Int64[np.ndarray, "n"]
    is_plausible: Bool[np.ndarray, "n"]
    """False = a glitch of the log, not to be learned from."""

    def select_class(self, index: int) -> Float32[np.ndarray, "m 6 3"]:
        """The plausible motions of a class."""
        return self.poses[self.is_plausible & (self.class_id == index)]


def extract_motions(scenario: Scenario) -> Motions:
    """Consecutive motions of the simulated agents with at least 30 logged steps, each in the frame of the start."""
    batch = collate([scenario])
    tracks = clean_tracks(batch)
    is_logged = batch.valid.sum(-1) >= MIN_VALID_STEPS if scenario.has_future else batch.valid[..., CURRENT_STEP]
    # [1, A, K]: True = all six steps are valid
    windows = tracks.valid.unfold(-1, STEPS_PER_TOKEN + 1, STEPS_PER_TOKEN).all(-1) & is_logged[..., None]
    position = tracks.position.unfold(2, STEPS_PER_TOKEN + 1, STEPS_PER_TOKEN)[windows].transpose(1, 2)  # [n, 6, 2]
    heading = tracks.heading.unfold(2, STEPS_PER_TOKEN + 1, STEPS_PER_TOKEN)[windows]
    local = rotate(position - position[:, :1], -heading[:, :1])
    poses = torch.cat([local, wrap_angle(heading - heading[:, :1])[..., None]], -1).numpy()
    class_id = class_of_type(batch.object_type)[..., None].expand_as(windows)[windows].numpy()
    return Motions(poses, class_id, is_plausible(poses, class_id))


def is_plausible(poses: Float32[np.ndarray, "n 6 3"], class_id: Int64[np.ndarray, "n"] | int) -> Bool[np.ndarray, "n"]:
    """True for motions that can be driven, walked or cycled: no step too fast, no turn too sharp.

    Args:
        poses: Poses of n motions: x, y (m) and heading (rad).
        class_id: Class of each motion, or of all.
    """
    step = np.diff(poses, axis=1)
    speed = np.hypot(step[..., 0], step[..., 1]).max(1) / STEP_S
    turn = np.abs((step[..., 2] + np.pi) % (2 * np.pi) - np.pi).max(1)
    limit = np.array(MAX_SPEED_MPS)[class_id]
    return (speed <= limit) & (turn <= MAX_STEP_TURN_RAD) & (np.abs(poses[..., 2]) <= MAX_TURN_RAD).all(1)


def mirror_poses(poses: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """The same poses with left and right exchanged."""
    return poses * _MIRROR


def with_mirror_images(motions: Float32[np.ndarray, "n 6 3"]) -> Float32[np.ndarray, "m 6 3"]:
    """Each motion followed by the mirror image."""
    return np.stack([motions, mirror_poses(motions)], 1).reshape(-1, *motions.shape[1:])


def straighten_motions(motions: Float32[np.ndarray, "n 6 3"]) -> Float32[np.ndarray, "n 6 3"]:
    """The motions projected onto the axis of the mirror: same x, y = 0, no turn."""
    return motions * np.array([1, 0, 0], np.float32)


def end_boxes(poses: Float[np.ndarray, "n t 3"], class_index: int) -> Float[Tensor, "n 4 2"]:
    """Corners of a class's box at the end of each motion.

    Args:
        poses: Poses of n motions: x, y (m) and heading (rad).
        class_index: Class, as an index into `CLASS_BOXES_M`.
    """
    return boxes(poses[:, -1:], class_index)[:, 0]


def boxes(poses: Float[np.ndarray, "n t 3"], class_index: int) -> Float[Tensor, "n t 4 2"]:
    """Corners of a class's box at each pose.

    Args:
        poses: Poses of n motions: x, y (m) and heading (rad).
        class_index: Class, as an index into `CLASS_BOXES_M`.
    """
    tensor = torch.from_numpy(np.ascontiguousarray(poses, dtype=np.float32))
    length, width = (torch.tensor(side) for side in CLASS_BOXES_M[class_index])
    return box_corners(tensor[..., :2], tensor[..., 2], length, width)


def motion_keys(poses: Float32[np.ndarray, "n 6 3"]) -> Int64[np.ndarray, "n 6"]:
    """Keys that are equal for motions that agree to 1 cm (at steps 2 and 5), and for mirror images."""
    key, mirror_key = (
        np.round(values[:, [2, 5]] / _KEY_M).astype(np.int64).reshape(len(poses), 6)
        for values in (poses, mirror_poses(poses))
    )
    # Of a key and that of the mirror image take the larger one in lexicographic order.
    first = np.argmax(key != mirror_key, axis=1)
    rows = np.arange(len(key))
    return np.where((key[rows, first] < mirror_key[rows, first])[:, None], mirror_key, key)


def sample_scenarios(num_scenarios: int, limit: int | None, seed: int) -> list[int]:
    """Positions of at most `limit` scenarios, sampled uniformly, in ascending order.

    Args:
        num_scenarios: Number of scenarios to sample from.
        limit: Greatest size of the sample; None = all scenarios.
        seed: Seed of the sample; equal seeds, equal samples.
    """
    if limit is None or num_scenarios <= limit:
        return list(range(num_scenarios))
    return sorted(np.random.default_rng(seed).choice(num_scenarios, limit, replace=False).tolist())


class DistinctSample:
    """Uniform sample of the distinct rows of a stream of any length, in the memory of twice the sample.

    A row's key is hashed; the rows with the smallest hashes stay. So every distinct key has the same probability,
    early or late, rare or frequent, and the same seed samples the same keys in any order.

    Args:
        capacity: Number of rows in the sample.
        seed: Seed of the hash; equal seeds sample equal keys.
    """

    def __init__(self, capacity: int, seed: int):
        self.capacity = capacity
        self.num_rows = 0
        self._seed = seed
        self._limit = np.uint64(2**64 - 1)
        self._hashes: list[np.ndarray] = []
        self._rows: list[np.ndarray] = []

    def add(self, rows: Float32[np.ndarray, "n ..."], keys: Int64[np.ndarray, "n k"]) -> None:
        """Add rows to the stream.

        Args:
            rows: Rows to sample from.
            keys: Key of each row, equal for rows that count as the same.
        """
        self.num_rows += len(rows)
        # splitmix64: 64 well-mixed bits of each row.
        hashes = np.full(len(keys), self._seed, np.uint64)
        for column in keys.astype(np.uint64).T:
            hashes = (hashes ^ column) + np.uint64(0x9E3779B97F4A7C15)
            hashes = (hashes ^ (hashes >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            hashes = (hashes ^ (hashes >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            hashes ^= hashes >> np.uint64(31)
        # Rows above the limit, the largest hash of a full sample, can never be in it.
        is_candidate = hashes < self._limit
        self._hashes.append(hashes[is_candidate])
        self._rows.append(rows[is_candidate])
        if sum(map(len, self._hashes)) > 2 * self.capacity:
            self._shrink()

    def rows(self) -> Float32[np.ndarray, "m ..."]:
        """The sample, ordered by hash."""
        self._shrink()
        return self._rows[0]

    def _shrink(self) -> None:
        hashes, first = np.unique(np.concatenate(self._hashes), return_index=True)
        if len(hashes) > self.capacity:
            self._limit = hashes[self.capacity]
        self._hashes = [hashes[: self.capacity]]
        self._rows = [np.concatenate(self._rows)[first[: self.capacity]]]
