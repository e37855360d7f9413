"""Vocabularies from data: motion tokens of each class, by k-disks or by a grid, and prototypes of map pieces."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32

from rlftsim.errors import (
    ConfigError,
    DataError,
    check_finiteness,
    check_not_negative,
    check_positive,
    check_types,
    given,
)
from rlftsim.jobs.progress import progress_bar
from rlftsim.scenario.types import STEP_S, Scenarios
from rlftsim.tokens.agent_tokens import nearest_rows
from rlftsim.tokens.kdisks import cluster_motions, cluster_windows, shape_distance
from rlftsim.tokens.map_tokens import split_map
from rlftsim.tokens.motions import (
    DistinctSample,
    boxes,
    end_boxes,
    extract_motions,
    mirror_poses,
    motion_keys,
    sample_scenarios,
    with_mirror_images,
)
from rlftsim.tokens.trajtok import GridMotions, TrajTokConfig, rule_tokens
from rlftsim.tokens.vocabulary import CLASS_NAMES, STEPS_PER_TOKEN, Vocabulary

MAX_GAP_M = 0.25
"""Greatest distance of a straight motion from a token: 0.5 m/s of speed."""
MAX_STRAIGHT_FRACTION = 0.125
"""Fraction of the tokens that may be used for speeds which the data lack."""


@dataclass(frozen=True)
class TokensConfig:
    """Settings of a vocabulary."""

    kind: Literal["kdisks", "trajtok"] = "kdisks"
    """kdisks: means of disks over the motions. trajtok: a token for each cell of a grid that the data use."""
    num_tokens: int = 2048
    """Greatest number of motion tokens of a class (V); kdisks only."""
    num_map_prototypes: int = 1024
    """Greatest number of map prototypes (P)."""
    coverage: float = 0.995
    """Fraction of the motions that lie within a disk."""
    max_scenarios: int | None = 20_000
    """Number of scenarios read, sampled uniformly; None = all."""
    max_segments: int = 200_000
    """Number of distinct motions of a class, and of distinct map windows, that are clustered; sampled uniformly."""
    mirror: bool = True
    """Add each motion's mirror image, so that tokens come in mirrored pairs. trajtok always does."""
    straight_up_to_mps: float = 45.0
    """Every straight vehicle motion up to this speed has a token, in the data or not; kdisks only."""
    trajtok: TrajTokConfig = field(default_factory=TrajTokConfig)
    seed: int = 2

    def __post_init__(self) -> None:
        check_types(self)
        if self.num_tokens < 2 or self.num_map_prototypes < 1:
            raise ConfigError(f"a vocabulary needs num_tokens >= 2 and num_map_prototypes >= 1, got {self}.")
        if not 0 < self.coverage <= 1:
            raise ConfigError(f"coverage is a fraction in (0, 1], got {self.coverage}.")
        check_positive(self, ("max_segments", *given(self, ("max_scenarios",))))
        check_not_negative(self, ("straight_up_to_mps", "seed"))
        check_finiteness(self, ("straight_up_to_mps",))


def build_vocabulary(
    scenarios: Scenarios, config: TokensConfig, *, origin: str = "", show_progress: bool = False
) -> tuple[Vocabulary, tuple[float | None, ...]]:
    """Motion tokens of each class and map prototypes from scenarios.

    Args:
        scenarios: Scenarios of the data set; each is read once at most.
        config: Sizes and seed; the same scenarios and the same seed give the same vocabulary.
        origin: Command, data and seed, to be stored in the vocabulary.
        show_progress: True = show a progress bar on standard error.

    Returns:
        The vocabulary, and the radius of the disks of each class in m (None without disks).

    Raises:
        DataError: No scenario, or no usable motion at all.
    """
    if not len(scenarios):
        raise DataError("no scenario to build a vocabulary from: is the data set empty, or the split misspelt?")
    # 1. Motions and map windows of the sampled scenarios, in bounded memory.
    samples, cells, windows = _collect_motions(scenarios, config, show_progress)
    if not any(sample.num_rows for sample in samples):
        raise DataError("no track moves for half a second in these scenarios: nothing to build a vocabulary from.")
    # 2. Tokens of each class [V, 6, 4, 2], then map prototypes [P, 11, 2].
    tables, radii = [], []
    with progress_bar("tokens: make classes and map pieces", len(CLASS_NAMES) + 1, show=show_progress) as advance:
        for index, name in enumerate(CLASS_NAMES):
            tokens, radius = _build_motion_tokens(samples[index], cells[index], index, config)
            tables.append(boxes(tokens, index))
            radii.append(radius)
            advance(note=f"{name}: {len(tokens)} tokens")
        # The classes have seeds [seed, 0..2], the map [seed, 3].
        rng = np.random.default_rng([config.seed, len(CLASS_NAMES)])
        limit, coverage = config.num_map_prototypes, config.coverage
        prototypes = cluster_windows(windows.rows(), limit=limit, coverage=coverage, rng=rng)
        advance(note=f"{len(prototypes)} map pieces")
    # 3. Classes with fewer tokens are padded with zeros.
    width = config.num_tokens if config.kind == "kdisks" else max(map(len, tables))
    corners = torch.zeros(len(tables), width, STEPS_PER_TOKEN + 1, 4, 2)
    exists = torch.zeros(len(tables), width, dtype=torch.bool)
    for row, mask, table in zip(corners, exists, tables):
        row[: len(table)], mask[: len(table)] = table, True
    return Vocabulary(corners, exists, torch.from_numpy(prototypes), origin), tuple(radii)


def _collect_motions(
    scenarios: Scenarios, config: TokensConfig, show_progress: bool
) -> tuple[list[DistinctSample], list[GridMotions], DistinctSample]:
    """Motions of each class, distinct and by cell of the grid, and map windows, of a sample of the scenarios."""
    *samples, windows = (DistinctSample(config.max_segments, config.seed) for _ in (*CLASS_NAMES, "map"))
    cells = [GridMotions(grid) for grid in config.trajtok.grids]
    positions = sample_scenarios(len(scenarios), config.max_scenarios, config.seed)
    with progress_bar("tokens: read", len(positions), show=show_progress) as advance:
        for position in positions:
            scenario = scenarios[position]
            motions = extract_motions(scenario)
            for index, (sample, grid) in enumerate(zip(samples, cells)):
                class_motions = motions.select_class(index)
                sample.add(class_motions, motion_keys(class_motions))
                grid.add(class_motions)
            map_windows = split_map(scenario).windows
            # windows that agree to 5 cm are the same
            windows.add(map_windows, np.round(map_windows.reshape(len(map_windows), 22) / 0.05).astype(np.int64))
            advance()
    return samples, cells, windows


def _build_motion_tokens(
    sample: DistinctSample, cells: GridMotions, index: int, config: TokensConfig
) -> tuple[Float32[np.ndarray, "V 6 3"], float | None]:
    """Tokens of a class, the first exactly still, and the radius of the disks."""
    if config.kind == "trajtok":
        return rule_tokens(cells, config.trajtok), None
    motions = sample.rows()
    # The data have few fast vehicles: without straight tokens of their own these would have no near token.
    straight = _fill_speed_gaps(motions, config) if index == 0 and len(motions) else motions[:0]
    tokens, radius = cluster_motions(
        motions,
        index,
        limit=config.num_tokens - len(straight),
        coverage=config.coverage,
        mirror=config.mirror,
        rng=np.random.default_rng([config.seed, index]),
    )
    tokens = _drop_unused_tokens(tokens, motions, index, config) if len(motions) else tokens
    return np.concatenate([tokens, straight]), radius


def _fill_speed_gaps(motions: Float32[np.ndarray, "n 6 3"], config: TokensConfig) -> Float32[np.ndarray, "s 6 3"]:
    """Straight motions at constant speeds that the data lack; with larger gaps where the motions would be too many."""
    ends = end_boxes(motions, 0).numpy()
    progress = np.linspace(0, 1, STEPS_PER_TOKEN + 1, dtype=np.float32)
    gap, max_tokens = MAX_GAP_M, int(MAX_STRAIGHT_FRACTION * config.num_tokens)
    while True:
        distance = np.arange(1, int(config.straight_up_to_mps * STEPS_PER_TOKEN * STEP_S / gap) + 1) * gap
        straight = np.zeros((len(distance), STEPS_PER_TOKEN + 1, 3), np.float32)
        straight[..., 0] = distance[:, None] * progress
        is_isolated = np.array([shape_distance(ends, box).min() > gap for box in end_boxes(straight, 0).numpy()], bool)
        if is_isolated.sum() <= max_tokens:
            return straight[is_isolated]
        gap *= 1.25


def _drop_unused_tokens(
    tokens: Float32[np.ndarray, "V 6 3"], motions: Float32[np.ndarray, "n 6 3"], class_index: int, config: TokensConfig
) -> Float32[np.ndarray, "W 6 3"]:
    """The first token and the tokens nearest to some motion; both or none of a mirrored pair."""
    ends = end_boxes(with_mirror_images(motions) if config.mirror else motions, class_index)
    # Repeated, because without a token's mirror image its motions fall on others.
    while True:
        table = end_boxes(tokens, class_index)
        is_used = torch.bincount(nearest_rows(ends, table), minlength=len(tokens)) > 0
        is_used[0] = True
        if config.mirror:
            is_used &= is_used[nearest_rows(end_boxes(mirror_poses(tokens), class_index), table)]
        if is_used.all():
            return tokens
        tokens = tokens[is_used.numpy()]
