"""Coverage: the error of any vocabulary on the motions of a data set. Memory does not grow with the data."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import box_corners, wrap_angle
from rlftsim.jobs.progress import progress_bar
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import STEP_S, Scenario, Scenarios
from rlftsim.tokens.agent_tokens import class_boxes, nearest_rows, tokenize_agents
from rlftsim.tokens.motions import Motions, end_boxes, extract_motions, is_plausible, mirror_poses, sample_scenarios
from rlftsim.tokens.vocabulary import CLASS_NAMES, STEPS_PER_TOKEN, Vocabulary, class_of_type

TOKEN_S = STEPS_PER_TOKEN * STEP_S
_EDGES = np.concatenate([[0.0], np.geomspace(1e-5, 1e3, 4001)])
"""Edges of the bins that errors are counted in: a bin is 0.5 % wide."""


@dataclass(eq=False)
class Spread:
    """Mean, quantiles and maximum of a stream of numbers that are not negative."""

    count: int = 0
    total: float = 0.0
    max: float = 0.0
    histogram: Int64[np.ndarray, "4002"] = field(default_factory=lambda: np.zeros(len(_EDGES), np.int64))

    def add(self, values: Float[Tensor, "n"]) -> None:
        """Add numbers to the stream."""
        if not len(values):
            return
        numbers = values.double().numpy()
        self.count += len(numbers)
        self.total += float(numbers.sum())
        self.max = max(self.max, float(numbers.max()))
        self.histogram += np.bincount(np.searchsorted(_EDGES, numbers, "right") - 1, minlength=len(_EDGES))

    @property
    def mean(self) -> float:
        """0 if there was no number."""
        return self.total / max(self.count, 1)

    @property
    def p95(self) -> float:
        """95 % of the numbers are at most this, to 0.5 %."""
        return self.quantile(0.95)

    def quantile(self, fraction: float) -> float:
        """Value that a fraction of the numbers does not exceed, to 0.5 %; 0 if there was no number."""
        if not self.count:
            return 0.0
        index = int(np.searchsorted(self.histogram.cumsum(), fraction * self.count))
        return min(float(_EDGES[min(index + 1, len(_EDGES) - 1)]), self.max)

    def curve(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Cumulative distribution: values, and the fraction of the numbers up to each."""
        values = np.minimum(np.append(_EDGES[1:], np.inf), self.max)
        return values, self.histogram.cumsum() / max(self.count, 1)


@dataclass(eq=False)
class ClassCoverage:
    """Coverage of a class's motions by the tokens. Errors are mean distances of the four corners of two boxes."""

    class_name: str
    poses: Float[np.ndarray, "V 5 3"]
    """Poses of the tokens that exist, steps 1..5."""
    use: Int64[np.ndarray, "V"]
    """Number of motions, and of their mirror images, whose nearest token this is."""
    radius_m: float | None
    """Radius of the disks that the tokens were made from, if known."""
    is_implausible: Bool[np.ndarray, "V"]
    """True for tokens that cannot be driven or walked, such as a turn of 30 degrees within 0.1 s."""
    asymmetry_m: float
    """Error of the token with the worst represented mirror image; 0 = left and right are the same."""
    single_m: Spread = field(default_factory=Spread)
    """Error of single motions: distance to the nearest token."""
    rolling_m: Spread = field(default_factory=Spread)
    """Error of whole tracks in rolling tokenization, at the end of each token."""
    heading_rad: Spread = field(default_factory=Spread)
    """Error of the heading in rolling tokenization."""
    speed_mps: Spread = field(default_factory=Spread)
    """Mean speed of each motion."""
    num_glitches: int = 0
    """Number of motions left out as glitches of the log."""

    @property
    def num_tokens(self) -> int:
        """Tokens that exist."""
        return len(self.poses)

    @property
    def token_speed_mps(self) -> Float[np.ndarray, "V"]:
        """Mean speed of each token."""
        return np.hypot(self.poses[:, -1, 0], self.poses[:, -1, 1]) / TOKEN_S

    @property
    def is_unused(self) -> Bool[np.ndarray, "V"]:
        """True for tokens that are nearest to no motion, and to no mirror image of a motion."""
        return self.use == 0

    @property
    def is_spare(self) -> Bool[np.ndarray, "V"]:
        """True for unused tokens that exist for a speed which the data lack: exactly straight at constant speed."""
        even = self.poses[:, -1:] * np.linspace(0.2, 1.0, STEPS_PER_TOKEN)[:, None]
        is_straight = (np.abs(self.poses - even).max((1, 2)) < 1e-4) & (np.abs(self.poses[:, -1, 1:]).max(1) < 1e-4)
        return self.is_unused & is_straight & (self.poses[:, -1, 0] > 0.05)

    @property
    def is_dead(self) -> Bool[np.ndarray, "V"]:
        """True for tokens that are unused and not spare."""
        return self.is_unused & ~self.is_spare

    @property
    def stands_still(self) -> bool:
        """True if token 0 does not move at all."""
        return not np.abs(self.poses[0]).max() > 1e-6


def measure_coverage(
    scenarios: Scenarios,
    vocabulary: Vocabulary,
    *,
    radii_m: tuple[float | None, ...] = (None, None, None),
    max_scenarios: int | None = None,
    seed: int = 0,
    show_progress: bool = False,
) -> tuple[ClassCoverage, ...]:
    """Coverage of each class: a vocabulary compared with logged motions.

    Args:
        scenarios: Scenarios of the data set that the motions come from.
        vocabulary: Vocabulary to measure, built from these or from different scenarios.
        radii_m: Radius of the disks of each class, m, from `build_vocabulary`; None = unknown.
        max_scenarios: Number of scenarios that are read, sampled uniformly; None = all.
        seed: Seed of the sample of scenarios.
        show_progress: True = show a progress bar on standard error.
    """
    classes = tuple(_start_coverage(vocabulary, index, radius) for index, radius in enumerate(radii_m))
    positions = sample_scenarios(len(scenarios), max_scenarios, seed)
    with progress_bar("tokens: check", len(positions), show=show_progress) as advance:
        for position in positions:
            scenario = scenarios[position]
            _add_motions(classes, extract_motions(scenario), vocabulary)
            _add_tracks(classes, scenario, vocabulary)
            advance()
    return classes


def _start_coverage(vocabulary: Vocabulary, index: int, radius_m: float | None) -> ClassCoverage:
    exists = vocabulary.token_mask[index]
    poses = vocabulary.poses[index, exists].numpy()
    # The pose at step 0 is the origin.
    motions = np.concatenate([np.zeros_like(poses[:, :1]), poses], 1)
    # Distance of each token's mirror image to the nearest token.
    table = vocabulary.end_corners()[index, exists]  # [V, 4, 2]
    reflected = end_boxes(mirror_poses(poses), index)
    distance = (table[nearest_rows(reflected, table)] - reflected).norm(dim=-1).mean(-1)
    return ClassCoverage(
        class_name=CLASS_NAMES[index],
        poses=poses,
        use=np.zeros(len(poses), np.int64),
        radius_m=radius_m,
        is_implausible=~is_plausible(motions, index),
        asymmetry_m=float(distance.max()),
    )


def _add_motions(classes: tuple[ClassCoverage, ...], motions: Motions, vocabulary: Vocabulary) -> None:
    """Add the single motions of a scenario."""
    for index, coverage in enumerate(classes):
        class_motions = motions.select_class(index)
        coverage.num_glitches += int(((motions.class_id == index) & ~motions.is_plausible).sum())
        ends = end_boxes(class_motions, index)
        table = vocabulary.end_corners()[index, vocabulary.token_mask[index]]
        nearest = nearest_rows(ends, table)
        reflected = nearest_rows(end_boxes(mirror_poses(class_motions), index), table)
        for token_id in (nearest, reflected):
            coverage.use += np.bincount(token_id.numpy(), minlength=len(coverage.use))
        coverage.single_m.add((table[nearest] - ends).norm(dim=-1).mean(-1))
        speed = np.hypot(class_motions[:, -1, 0], class_motions[:, -1, 1]) / TOKEN_S
        coverage.speed_mps.add(torch.from_numpy(speed))


def _add_tracks(classes: tuple[ClassCoverage, ...], scenario: Scenario, vocabulary: Vocabulary) -> None:
    """Add the whole tracks of a scenario, rolling."""
    batch = collate([scenario])
    tokens = tokenize_agents(batch, vocabulary)
    length, width = (side[..., None].expand(tokens.valid.shape) for side in class_boxes(batch.object_type))
    # Boxes where the tokens end and where the log is [1, A, K, 4, 2].
    token_boxes = box_corners(tokens.position, tokens.heading, length, width)
    logged_boxes = box_corners(tokens.logged_position, tokens.logged_heading, length, width)
    error = (token_boxes - logged_boxes).norm(dim=-1).mean(-1)
    turn = wrap_angle(tokens.heading - tokens.logged_heading).abs()
    class_id = class_of_type(batch.object_type)
    for index, coverage in enumerate(classes):
        mask = (class_id == index)[..., None] & tokens.valid
        coverage.rolling_m.add(error[mask])
        coverage.heading_rad.add(turn[mask])
