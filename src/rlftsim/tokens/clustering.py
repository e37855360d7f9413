"""Vocabularies from data: disks of a radius laid over what agents and maps really do (k-disks).

The published recipe draws disk centres at random until V tokens exist, at a fixed radius. Here the radius is searched: the
smallest at which V disks cover a wanted share of all motions. So a small vocabulary has wide disks instead of holes.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from rlftsim.errors import ConfigError, DataError
from rlftsim.geometry import box_corners, rotate, wrap_angle
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP, Scenario
from rlftsim.tokens.agent_tokens import clean_tracks, tokenize_agents
from rlftsim.tokens.map_tokens import split_map
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, CLASS_NAMES, STEPS_PER_TOKEN, Vocabulary, class_of_type

MIN_VALID_STEPS = 30
MAX_SPEED_MPS = 45.0
MAX_TURN_RAD = 1.2
"""A motion that turns by more within half a second is a glitch of the record."""
MIN_RADIUS_M = 0.02
"""Finer disks than the jitter of recorded labels would tell noise from noise."""
RADIUS_STEPS = 7


@dataclass(frozen=True)
class TokensConfig:
    """How a vocabulary is built."""

    num_tokens: int = 2048
    """Motion tokens a class (V)."""
    num_map_prototypes: int = 1024
    coverage: float = 0.995
    """Share of all motions that lie within a disk."""
    max_segments: int = 60_000
    """Motions a class that are looked at; more are thinned out evenly."""
    mirror: bool = True
    """Add each motion's mirror image, so that left and right are alike."""
    seed: int = 2

    def __post_init__(self) -> None:
        if self.num_tokens < 2 or self.num_map_prototypes < 1:
            raise ConfigError(f"a vocabulary needs num_tokens >= 2 and num_map_prototypes >= 1, got {self}.")
        if not 0 < self.coverage <= 1:
            raise ConfigError(f"coverage is a share in (0, 1], got {self.coverage}.")


@dataclass(frozen=True)
class CoverageReport:
    """How well the tokens of one class stand for the data they were built from."""

    class_name: str
    num_segments: int
    num_tokens: int
    radius_m: float
    mean_error_m: float
    p95_error_m: float
    max_error_m: float
    """Mean corner distance between a motion's end and the nearest token's."""
    max_speed_mps: float
    unused_tokens: int
    """Tokens that are nearest to no motion."""


def build_vocabulary(
    scenarios: Iterable[Scenario],
    config: TokensConfig,
    *,
    origin: str = "",
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[Vocabulary, tuple[CoverageReport, ...]]:
    """Motion tokens of each class and map prototypes from scenarios.

    Args:
        scenarios: read once.
        config: sizes and seed; the same scenarios in the same order and the same seed give the same vocabulary.
        origin: written into the vocabulary.
        progress: told what is being done.

    Raises:
        DataError: no scenario, or no usable motion at all.
    """
    rng = np.random.default_rng(config.seed)
    segments, windows = _collect(scenarios, config)
    if not sum(len(s) for s in segments):
        raise DataError("no track moves for half a second in these scenarios: nothing to build a vocabulary from.")
    corners = torch.zeros(len(CLASS_NAMES), config.num_tokens, STEPS_PER_TOKEN + 1, 4, 2)
    exists = torch.zeros(len(CLASS_NAMES), config.num_tokens, dtype=torch.bool)
    reports = []
    for index, (name, found) in enumerate(zip(CLASS_NAMES, segments)):
        progress(f"{name}: {len(found)} motions")
        tokens, radius = _cluster(found, index, config, rng)
        corners[index, : len(tokens)] = _to_corners(tokens, index)
        exists[index, : len(tokens)] = True
        reports.append(_report(name, found, tokens, radius, index))
    progress(f"map: {len(windows)} pieces")
    prototypes = _cluster_map(windows, config, rng)
    return Vocabulary(corners, exists, torch.from_numpy(prototypes), origin), tuple(reports)


def _collect(scenarios: Iterable[Scenario], config: TokensConfig) -> tuple[list[np.ndarray], np.ndarray]:
    """Motions [n, 6, 3] (x, y, heading in the start frame) of each class, and map windows [w, 11, 2]."""
    by_class: list[list[np.ndarray]] = [[], [], []]
    windows = []
    count = 0
    for scenario in scenarios:
        count += 1
        motions, class_id = _motions_of(scenario)
        for index, part in enumerate(by_class):
            part.append(motions[class_id == index])
        windows.append(split_map(scenario).windows)
    if not count:
        raise DataError("no scenario to build a vocabulary from: is the data set empty, or the split misspelt?")
    return [_thin(_mirrored(np.concatenate(p), config.mirror), config) for p in by_class], np.concatenate(windows)


def _motions_of(scenario: Scenario) -> tuple[Float32[np.ndarray, "n 6 3"], Int64[np.ndarray, "n"]]:
    """Half-second motions of the simulated agents with at least 30 recorded steps, in the frame of their start."""
    batch = collate([scenario])
    tracks = clean_tracks(batch)
    enough = batch.valid.sum(-1) >= MIN_VALID_STEPS if scenario.has_future else batch.valid[..., CURRENT_STEP]
    windows = tracks.valid.unfold(-1, STEPS_PER_TOKEN + 1, STEPS_PER_TOKEN).all(-1) & enough[..., None]
    position = tracks.position.unfold(2, STEPS_PER_TOKEN + 1, STEPS_PER_TOKEN)[windows].transpose(1, 2)  # [n, 6, 2]
    heading = tracks.heading.unfold(2, STEPS_PER_TOKEN + 1, STEPS_PER_TOKEN)[windows]
    local = rotate(position - position[:, :1], -heading[:, :1])
    motions = torch.cat([local, wrap_angle(heading - heading[:, :1])[..., None]], -1).numpy()
    class_id = class_of_type(batch.object_type)[..., None].expand_as(windows)[windows].numpy()
    seconds = STEPS_PER_TOKEN * 0.1
    plausible = np.hypot(motions[:, -1, 0], motions[:, -1, 1]) <= MAX_SPEED_MPS * seconds
    plausible &= (np.abs(motions[..., 2]) <= MAX_TURN_RAD).all(-1)
    return motions[plausible], class_id[plausible]


def _mirrored(motions: Float32[np.ndarray, "n 6 3"], mirror: bool) -> Float32[np.ndarray, "m 6 3"]:
    """The motions and, if asked for, their mirror images."""
    if not mirror:
        return motions
    return np.stack([motions, motions * np.array([1, -1, -1], np.float32)], 1).reshape(-1, *motions.shape[1:])


def _thin(motions: Float32[np.ndarray, "n 6 3"], config: TokensConfig) -> Float32[np.ndarray, "m 6 3"]:
    """Drop motions that repeat another one to the centimetre, then keep at most `max_segments`, evenly spread."""
    _, first = np.unique(np.round(motions[:, [2, 5]].reshape(len(motions), -1) / 0.01), axis=0, return_index=True)
    distinct = motions[np.sort(first)]
    if len(distinct) <= config.max_segments:
        return distinct
    return distinct[np.linspace(0, len(distinct) - 1, config.max_segments).astype(int)]


def _to_corners(motions: Float[np.ndarray, "n t 3"], class_index: int) -> Float[torch.Tensor, "n t 4 2"]:
    poses = torch.from_numpy(np.ascontiguousarray(motions, dtype=np.float32))
    length, width = (torch.tensor(side) for side in CLASS_BOXES_M[class_index])
    return box_corners(poses[..., :2], poses[..., 2], length, width)


def _cluster(
    motions: Float32[np.ndarray, "n 6 3"], class_index: int, config: TokensConfig, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "V 6 3"], float]:
    """Tokens of one class, the first exactly still, and the disk radius that was found."""
    still = np.zeros((1, STEPS_PER_TOKEN + 1, 3), np.float32)
    if not len(motions):
        return still, 0.0
    ends = _to_corners(motions[:, -1:], class_index)[:, 0].flatten(1).numpy()  # [n, 8]
    start = _to_corners(still[:, -1:], class_index)[:, 0].flatten(1).numpy()
    order = rng.permutation(len(motions))
    radius = _smallest_radius(ends, order, start, config)
    disks = _disks(ends, order, start, radius, config.num_tokens)
    tokens = [_mean_motion(motions[disk]) for disk in disks[1:]]
    return np.concatenate([still, *[t[None] for t in tokens]]), radius


def _smallest_radius(
    ends: Float32[np.ndarray, "n c"], order: np.ndarray, start: np.ndarray, config: TokensConfig
) -> float:
    """Radius at which `num_tokens` disks cover the wanted share of motions, to about 5 %."""
    low, high = MIN_RADIUS_M, 2.0
    for _ in range(RADIUS_STEPS):
        middle = float(np.sqrt(low * high))
        covered = sum(len(d) for d in _disks(ends, order, start, middle, config.num_tokens))
        low, high = (low, middle) if covered >= config.coverage * len(ends) else (middle, high)
    return high


def _disks(
    points: Float32[np.ndarray, "n c"], order: np.ndarray, start: np.ndarray, radius_m: float, limit: int
) -> list[np.ndarray]:
    """Up to `limit` disks (member indices): around `start`, then around the first point in `order` that none holds yet."""
    left = order.copy()
    disks = []
    centre = start[0]
    while True:
        inside = _corner_distance(points[left], centre) <= radius_m
        if disks and not inside.any():
            raise AssertionError("a disk holds at least its centre")
        disks.append(left[inside])
        left = left[~inside]
        if not len(left) or len(disks) == limit:
            return disks
        centre = points[left[0]]


def _corner_distance(rows: Float32[np.ndarray, "n c"], centre: Float32[np.ndarray, "c"]) -> Float[np.ndarray, "n"]:
    """Mean distance of the points (x, y in turns) of each row to those of the centre."""
    difference = (rows - centre).reshape(len(rows), -1, 2)
    return np.sqrt(np.square(difference).sum(-1)).mean(-1)


def _mean_motion(motions: Float32[np.ndarray, "n 6 3"]) -> Float32[np.ndarray, "6 3"]:
    """Mean of positions; of headings, the circular mean."""
    mean = motions.mean(0)
    mean[:, 2] = np.arctan2(np.sin(motions[..., 2]).mean(0), np.cos(motions[..., 2]).mean(0))
    return mean


def _cluster_map(
    windows: Float32[np.ndarray, "w 11 2"], config: TokensConfig, rng: np.random.Generator
) -> Float32[np.ndarray, "P 11 2"]:
    """Prototypes of map pieces: a straight one, and one for each disk over the windows."""
    straight = np.stack([np.arange(11) * 0.5, np.zeros(11)], -1).astype(np.float32)
    flat = windows.reshape(len(windows), -1)
    _, first = np.unique(np.round(flat / 0.05), axis=0, return_index=True)
    distinct = flat[np.sort(first)][: config.max_segments]
    if not len(distinct):
        return straight[None]
    order = rng.permutation(len(distinct))
    start = straight.reshape(1, -1)
    map_config = TokensConfig(num_tokens=max(config.num_map_prototypes, 2), coverage=config.coverage)
    radius = _smallest_radius(distinct, order, start, map_config)
    disks = _disks(distinct, order, start, radius, config.num_map_prototypes)
    means = [distinct[disk].mean(0).reshape(11, 2) for disk in disks[1:]]
    return np.stack([straight, *means]).astype(np.float32)


def _report(
    name: str,
    motions: Float32[np.ndarray, "n 6 3"],
    tokens: Float32[np.ndarray, "V 6 3"],
    radius: float,
    class_index: int,
) -> CoverageReport:
    reach = np.hypot(tokens[:, -1, 0], tokens[:, -1, 1]).max() / (STEPS_PER_TOKEN * 0.1)
    if not len(motions):
        return CoverageReport(name, 0, len(tokens), 0.0, 0.0, 0.0, 0.0, float(reach), 0)
    ends = _to_corners(motions[:, -1:], class_index)[:, 0].flatten(1)
    table = _to_corners(tokens[:, -1:], class_index)[:, 0].flatten(1)
    errors, nearest = [], []
    for part in ends.split(512):
        difference = (part[:, None] - table).unflatten(-1, (4, 2))
        best = difference.norm(dim=-1).mean(-1).min(-1)
        errors.append(best.values)
        nearest.append(best.indices)
    error = torch.cat(errors).numpy()
    unused = len(tokens) - len(torch.cat(nearest).unique())
    return CoverageReport(
        name, len(motions), len(tokens), radius, float(error.mean()), float(np.quantile(error, 0.95)), float(error.max()),
        float(reach), unused,
    )  # fmt: skip


def reconstruction_error(
    scenarios: Iterable[Scenario], vocabulary: Vocabulary
) -> tuple[tuple[str, int, float, float], ...]:
    """Rolling tokenisation error of recorded tracks: (class, tokens seen, mean, 95th percentile of the distance in metres)."""
    errors: list[list[np.ndarray]] = [[], [], []]
    for scenario in scenarios:
        batch = collate([scenario])
        tokens = tokenize_agents(batch, vocabulary)
        distance = (tokens.position - tokens.logged_position).norm(dim=-1)
        class_id = class_of_type(batch.object_type)
        for index, part in enumerate(errors):
            part.append(distance[(class_id == index)[..., None] & tokens.valid].numpy())
    joined = [np.concatenate(part) if part else np.zeros(0) for part in errors]
    return tuple(
        (name, len(e), float(e.mean()) if len(e) else 0.0, float(np.quantile(e, 0.95)) if len(e) else 0.0)
        for name, e in zip(CLASS_NAMES, joined)
    )
