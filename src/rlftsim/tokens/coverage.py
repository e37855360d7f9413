"""How well a vocabulary, any vocabulary, stands for the motions of a data set. Memory does not grow with the data."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import box_corners, wrap_angle
from rlftsim.progress import progress_bar
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import STEP_S, Scenario, Scenarios
from rlftsim.tokens.agent_tokens import class_boxes, nearest_rows, tokenize_agents
from rlftsim.tokens.motions import Motions, drawn_scenarios, end_boxes, is_plausible, mirrored, motions_of
from rlftsim.tokens.vocabulary import CLASS_NAMES, STEPS_PER_TOKEN, Vocabulary, class_of_type

TOKEN_S = STEPS_PER_TOKEN * STEP_S
MAX_SPEED_BIN_MPS = 45
_EDGES = np.concatenate([[0.0], np.geomspace(1e-5, 1e3, 4001)])
"""Of bins that errors are counted in: a bin is 0.5 % wide."""


@dataclass(eq=False)
class Spread:
    """Mean, quantiles and maximum of a stream of numbers that are not negative."""

    count: int = 0
    total: float = 0.0
    max: float = 0.0
    histogram: Int64[np.ndarray, "4002"] = field(default_factory=lambda: np.zeros(len(_EDGES), np.int64))

    def add(self, values: Float[Tensor, "n"]) -> None:
        """Count numbers in."""
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

    def quantile(self, share: float) -> float:
        """A share of the numbers is at most this, to 0.5 %; 0 if there was no number."""
        if not self.count:
            return 0.0
        index = int(np.searchsorted(self.histogram.cumsum(), share * self.count))
        return min(float(_EDGES[min(index + 1, len(_EDGES) - 1)]), self.max)

    def curve(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Values and the share of numbers up to each: the cumulative distribution."""
        values = np.minimum(np.append(_EDGES[1:], np.inf), self.max)
        return values, self.histogram.cumsum() / max(self.count, 1)


@dataclass(eq=False)
class ClassCoverage:
    """How well the tokens of one class stand for its motions. An error is a mean distance of the four corners of two boxes."""

    class_name: str
    poses: Float[np.ndarray, "V 5 3"]
    """Of the tokens that exist, steps 1..5."""
    use: Int64[np.ndarray, "V"]
    """Motions, and mirror images of motions, that fall on each token."""
    radius_m: float | None
    """Of the disks the tokens were made from, where that is known."""
    is_implausible: Bool[np.ndarray, "V"]
    """The token does what nobody can, such as turning by 30 degrees within 0.1 s."""
    asymmetry_m: float
    """Error of the token whose mirror image is worst represented; 0 = left and right are the same."""
    single_m: Spread = field(default_factory=Spread)
    """A motion alone against the nearest token."""
    rolling_m: Spread = field(default_factory=Spread)
    """Whole tracks, token after token, each from where the last one led."""
    heading_rad: Spread = field(default_factory=Spread)
    """Of whole tracks."""
    speed_mps: Spread = field(default_factory=Spread)
    """Of the motions: way by time."""
    speed_counts: Int64[np.ndarray, "45"] = field(default_factory=lambda: np.zeros(MAX_SPEED_BIN_MPS, np.int64))
    """Motions by speed, a bin for each metre per second."""
    num_glitches: int = 0
    """Motions left out because nobody can move like that."""

    @property
    def num_tokens(self) -> int:
        """Tokens that exist."""
        return len(self.poses)

    @property
    def token_speed_mps(self) -> Float[np.ndarray, "V"]:
        """Way by time of each token."""
        return np.hypot(self.poses[:, -1, 0], self.poses[:, -1, 1]) / TOKEN_S

    @property
    def is_unused(self) -> Bool[np.ndarray, "V"]:
        """No motion falls on the token, nor a mirror image of one."""
        return self.use == 0

    @property
    def is_spare(self) -> Bool[np.ndarray, "V"]:
        """Unused, and there for a speed that the data lack: exactly straight ahead and even."""
        even = self.poses[:, -1:] * np.linspace(0.2, 1.0, STEPS_PER_TOKEN)[:, None]
        straight = (np.abs(self.poses - even).max((1, 2)) < 1e-4) & (np.abs(self.poses[:, -1, 1:]).max(1) < 1e-4)
        return self.is_unused & straight & (self.poses[:, -1, 0] > 0.05)

    @property
    def is_dead(self) -> Bool[np.ndarray, "V"]:
        """Unused and not spare."""
        return self.is_unused & ~self.is_spare

    @property
    def stands_still(self) -> bool:
        """Token 0 does not move at all."""
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
    """Compare every class of a vocabulary with the recorded motions.

    Args:
        scenarios: the data.
        vocabulary: built from these scenarios or from others.
        radii_m: what `build_vocabulary` returned, if it did.
        max_scenarios: look at so many, drawn evenly; None = at all.
        seed: of the draw.
        show_progress: say on standard error how far it is.
    """
    classes = tuple(_begin(vocabulary, index, radius) for index, radius in enumerate(radii_m))
    drawn = drawn_scenarios(len(scenarios), max_scenarios, seed)
    with progress_bar("tokens: check", len(drawn), show=show_progress) as advance:
        for position in drawn:
            scenario = scenarios[position]
            _add_motions(classes, motions_of(scenario), vocabulary)
            _add_tracks(classes, scenario, vocabulary)
            advance()
    return classes


def _begin(vocabulary: Vocabulary, index: int, radius_m: float | None) -> ClassCoverage:
    exists = vocabulary.token_mask[index]
    poses = vocabulary.poses()[index, exists].numpy()
    whole = np.concatenate([np.zeros_like(poses[:, :1]), poses], 1)
    table = vocabulary.end_corners()[index, exists]
    reflected = end_boxes(mirrored(poses), index)
    distance = (table[nearest_rows(reflected, table)] - reflected).norm(dim=-1).mean(-1)
    return ClassCoverage(
        class_name=CLASS_NAMES[index],
        poses=poses,
        use=np.zeros(len(poses), np.int64),
        radius_m=radius_m,
        is_implausible=~is_plausible(whole, index),
        asymmetry_m=float(distance.max()),
    )


def _add_motions(classes: tuple[ClassCoverage, ...], motions: Motions, vocabulary: Vocabulary) -> None:
    """Each motion alone."""
    for index, coverage in enumerate(classes):
        of_class = motions.of_class(index)
        coverage.num_glitches += int(((motions.class_id == index) & ~motions.is_plausible).sum())
        ends = end_boxes(of_class, index)
        table = vocabulary.end_corners()[index, vocabulary.token_mask[index]]
        nearest = nearest_rows(ends, table)
        reflected = nearest_rows(end_boxes(mirrored(of_class), index), table)
        for fallen in (nearest, reflected):
            coverage.use += np.bincount(fallen.numpy(), minlength=len(coverage.use))
        coverage.single_m.add((table[nearest] - ends).norm(dim=-1).mean(-1))
        speed = np.hypot(of_class[:, -1, 0], of_class[:, -1, 1]) / TOKEN_S
        coverage.speed_mps.add(torch.from_numpy(speed))
        slot = np.minimum(speed.astype(int), MAX_SPEED_BIN_MPS - 1)
        coverage.speed_counts += np.bincount(slot, minlength=MAX_SPEED_BIN_MPS)


def _add_tracks(classes: tuple[ClassCoverage, ...], scenario: Scenario, vocabulary: Vocabulary) -> None:
    """Whole tracks, token after token."""
    batch = collate([scenario])
    tokens = tokenize_agents(batch, vocabulary)
    length, width = (side[..., None].expand(tokens.valid.shape) for side in class_boxes(batch.object_type))
    led = box_corners(tokens.position, tokens.heading, length, width)
    logged = box_corners(tokens.logged_position, tokens.logged_heading, length, width)
    error = (led - logged).norm(dim=-1).mean(-1)
    turn = wrap_angle(tokens.heading - tokens.logged_heading).abs()
    class_id = class_of_type(batch.object_type)
    for index, coverage in enumerate(classes):
        where = (class_id == index)[..., None] & tokens.valid
        coverage.rolling_m.add(error[where])
        coverage.heading_rad.add(turn[where])
