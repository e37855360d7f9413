"""Features of a state and a token, by name. A calibrated policy adds a weighted sum of selected features to the logits.

    @register_feature("braking", low=-1.5, high=0.0)
    def braking(candidates: Candidates) -> Float[Tensor, "P"]:
        return candidates.speed_change * candidates.where(candidates.is_vehicle)

A feature is a function on tensors, of all pairs of agents and tokens at once (or actions, see `calibrated.actions`),
and has bounds, to which values are clipped: without bounds rare tokens with an extreme value would win. A feature is
computed before the decision, and may not read the logged future. A separate package announces features as entry points:

    [project.entry-points."rlftsim.features"]
    braking = "my_package.features:braking"

R elements, P pairs of an element and a candidate token, K features, V tokens.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint
from rlftsim.policies.calibrated.candidates import SUPPORT_NATS, Candidates, Scene, Traffic
from rlftsim.policies.distributions import FULL, CategoricalDistribution
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.rows import find_rows
from rlftsim.tokens.vocabulary import Vocabulary


@dataclass(frozen=True)
class Feature:
    """A named, bounded function of a state and a token."""

    name: str
    compute: Callable[[Candidates], Float[Tensor, "P"]]
    low: float
    high: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "__module__", self.compute.__module__)  # for `is_ours`: that of the function

    def __call__(self, candidates: Candidates) -> Float[Tensor, "P"]:
        """Values of all pairs, within the bounds and of the type of the logits.

        Raises:
            ConfigError: The function gives no tensor with a number for each pair, or NaN.
        """
        values = self.compute(candidates)
        if not isinstance(values, Tensor) or values.shape != candidates.row.shape:
            shape = list(values.shape) if isinstance(values, Tensor) else type(values).__name__
            raise ConfigError(
                f"feature {self.name!r} gives {shape} for {len(candidates.row)} pairs of an agent and a token: return "
                "a tensor with a number for each of them."
            )
        values = values.to(candidates.log_ratio.dtype).clamp(self.low, self.high)
        if not values.isfinite().all():
            raise ConfigError(
                f"feature {self.name!r} gives NaN for {int(values.isnan().sum())} of {len(values)} pairs of an agent "
                "and a token: mend its divisions and roots, or calibrate without it."
            )
        return values

    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        """Other processes look the feature up by name: a function in a line is not pickled."""
        return find_feature, (self.name,)


FEATURES = ExtensionPoint[Feature](
    "feature",
    "rlftsim.features",
    use=lambda name: features_by_name([name]),
    more="that of another package, once that is installed or imported",
)
"""Features by name, this package's and others'."""


def find_feature(name: str) -> Feature:
    """The feature of a name.

    Raises:
        ConfigError: There is none.
    """
    return FEATURES.get(name)


def register_feature(
    name: str, *, low: float, high: float
) -> Callable[[Callable[[Candidates], Float[Tensor, "P"]]], Feature]:
    """Decorator that registers a function of `Candidates` as a feature.

    Args:
        name: Name in recipes, model folders and tables; an earlier feature of yours is replaced with a warning.
        low: Least value; lower values are clipped to this bound.
        high: Greatest value; higher values are clipped to this bound.

    Raises:
        ConfigError: The name is that of a shipped feature, or the bounds are in the wrong order.
    """
    if not -math.inf < low < high < math.inf:
        raise ConfigError(f"feature {name!r}: bounds are two finite numbers, low < high, got {low} and {high}.")

    def register(compute: Callable[[Candidates], Float[Tensor, "P"]]) -> Feature:
        feature = Feature(name, compute, low, high)
        FEATURES.add(name, feature, stacklevel=3)
        return feature

    return register


def features_by_name(names: Sequence[str]) -> tuple[Feature, ...]:
    """The features of some names.

    Raises:
        ConfigError: No name at all, a repeated or an unknown name, or a name under which there is no feature.
    """
    if not names or len(set(names)) < len(names):
        raise ConfigError(f"features are different names, at least one, got {', '.join(names) or 'none'}.")
    features = tuple(FEATURES.get(name) for name in names)
    for name, feature in zip(names, features):
        if not isinstance(feature, Feature):
            raise ConfigError(
                f"feature {name!r} is of type {type(feature).__name__}: decorate it with register_feature."
            )
    return features


# ---- speed and direction of vehicles that move ----------------------------------------------------------------------


for _name, _limit, _compute in (
    # change of speed, m/s, where the leader is less than 2 s ahead, or 2 to 4 s
    ("speed_gap_under_2s", 1.5, lambda c: c.speed_change * c.where(c.is_moving & (c.time_gap < 2))),
    ("speed_gap_2_to_4s", 1.5, lambda c: c.speed_change * c.where(c.is_moving & (c.time_gap >= 2) & (c.time_gap < 4))),
    # change of turn times the angle of the lane to the heading; positive = towards the lane's direction
    ("turn_to_lane_direction", 2.0, lambda c: 10 * c.turn_change * c.of_pairs(c.lane_turn * c.is_moving)),
    # change of turn times the lateral offset of the lane's center; positive = towards the center
    ("turn_to_lane_center", 2.0, lambda c: 2 * c.turn_change * c.of_pairs(c.lane_offset * c.is_moving)),
):
    register_feature(_name, low=-_limit, high=_limit)(_compute)


# ---- by speed: slow below 4 m/s, middle, fast from 9 m/s -------------------------------------------------------------


def _is_between(c: Candidates, low_mps: float, high_mps: float) -> Float[Tensor, "P"]:
    return c.where(c.is_moving & (c.speed >= low_mps) & (c.speed < high_mps))


for _band, _low, _high in (("slow", 0.0, 4.0), ("middle", 4.0, 9.0), ("fast", 9.0, math.inf)):
    register_feature(f"temperature_{_band}", low=-SUPPORT_NATS, high=0.0)(
        lambda c, low=_low, high=_high: c.log_ratio * _is_between(c, low, high)
    )
    register_feature(f"speed_{_band}", low=-1.5, high=1.5)(
        lambda c, low=_low, high=_high: c.speed_change * _is_between(c, low, high)
    )


# ---- where the token leads ------------------------------------------------------------------------------------------

for _seconds in (0.5, 1.0):
    register_feature(f"overlap_{_seconds:g}s", low=0.0, high=2.0)(
        lambda c, seconds=_seconds: c.overlap(seconds) * c.of_vehicles
    )
    register_feature(f"overlap_{_seconds:g}s_walking_cycling", low=0.0, high=2.0)(
        lambda c, seconds=_seconds: c.overlap(seconds) * (1 - c.of_vehicles)
    )
    register_feature(f"edge_{_seconds:g}s", low=0.0, high=3.0)(
        lambda c, seconds=_seconds: c.road_edge(seconds) * c.of_vehicles
    )
register_feature("edge_0.5s_walking_cycling", low=0.0, high=3.0)(lambda c: c.road_edge(0.5) * (1 - c.of_vehicles))


@dataclass(frozen=True, eq=False)
class TiltedDistribution(CategoricalDistribution):
    """p(token) proportional to base(token) exp(eta · f(state, token)); the base, bit for bit, where eta is 0.

    Features are 0 for tokens that are no candidates, see `Candidates`.
    """

    base: CategoricalDistribution
    mask: Bool[Tensor, "*batch"]
    """That of the base, True = the element decides; as is the sampling."""
    eta: Float[Tensor, "K"]
    features: Sequence[Feature]
    scene: Scene
    traffic: Traffic
    vocabulary: Vocabulary
    seconds: float
    """Duration of a decision."""
    sampling: Sampling = FULL

    @cached_property
    def logits(self) -> Float[Tensor, "R V"]:
        """Logits in float32: those of the base, shifted for candidates."""
        logits = self.base.logits
        if not self.eta.any():
            return logits
        with torch.autocast(logits.device.type, enabled=False):  # tilts of hundredths count
            terms = (weight * feature(self._candidates) for weight, feature in zip(self.eta, self.features))
            tilt = sum(terms, start=self.eta.new_zeros(()))  # no [P, K] in a rollout
            return logits.flatten().index_add(0, self._pairs[2], self._relate(tilt)).view_as(logits)

    @cached_property
    def values(self) -> Float[Tensor, "P K"]:
        """Features of all candidates, as the tilt is made of them: see `_relate`."""
        return self._relate(torch.stack([feature(self._candidates) for feature in self.features], -1))

    def with_eta(self, eta: Float[Tensor, "K"]) -> "TiltedDistribution":
        """The distribution of the same base with other weights.

        Args:
            eta: Weights of the features.
        """
        return replace(self, eta=eta)

    def score_function(self, decision: Int64[Tensor, "*batch"]) -> Float[Tensor, "*batch K"]:
        """Gradient of the decisions' log-probability by eta: the features of the chosen token minus the mean of all.

        Args:
            decision: Id of the token that each element chose, drawn from the full distribution.
        """
        row, token, logit_index = self._pairs
        is_chosen = token == self._rows(decision).index_select(0, row)
        weight = is_chosen.float() - self.log_probs.detach().flatten().index_select(0, logit_index).exp()
        centered = self.values.new_zeros(self._num_rows, len(self.features))
        return self._dense(centered.index_add(0, row, weight[:, None] * self.values.detach()))

    @property
    def _num_rows(self) -> int:
        return self.base._num_rows

    @cached_property
    def _peak(self) -> Float[Tensor, "R 1"]:
        return self.base.logits.amax(-1, keepdim=True)

    def _relate(self, values: Float[Tensor, "P *more"]) -> Float[Tensor, "P *more"]:
        """Values minus those of the agent's likeliest token: what all candidates of an agent share would else lift the
        tokens that are none."""
        candidates = self._candidates
        # of tokens that are equally likely the first, whatever the device
        likeliest = (candidates.log_ratio == 0).nonzero()[:, 0]
        first = likeliest.new_full((len(self._choices[0]),), len(values))
        first = first.scatter_reduce(0, candidates.row[likeliest], likeliest, "amin")  # position among the pairs: [R]
        centered = values - candidates.of_pairs(values.index_select(0, first))
        return centered * candidates.weight.view(-1, *[1] * (values.dim() - 1))

    @cached_property
    def _choices(self) -> tuple[Int64[Tensor, "_"], Int64[Tensor, "P"], Int64[Tensor, "P"]]:
        """Rows with more than a single candidate; of each candidate the position among these rows, and the token."""
        logits, num_tokens = self.base.logits.detach(), self.base.logits.shape[1]
        logit_index = _find_greater(logits, self._peak.detach() - SUPPORT_NATS)
        row = logit_index.div(num_tokens, rounding_mode="floor")
        has_choice = torch.bincount(row, minlength=self._num_rows) > 1
        pairs = has_choice.index_select(0, row).nonzero()[:, 0]
        row, logit_index = row.index_select(0, pairs), logit_index.index_select(0, pairs)
        index = (has_choice.cumsum(0) - 1).index_select(0, row)
        return has_choice.nonzero()[:, 0], index, logit_index - row * num_tokens

    @cached_property
    def _pairs(self) -> tuple[Int64[Tensor, "P"], Int64[Tensor, "P"], Int64[Tensor, "P"]]:
        """Row and token of each candidate, and the index into the flattened logits; rows with a single candidate have
        none."""
        has_choice, index, token = self._choices
        row = has_choice.index_select(0, index)
        return row, token, row * self.base.logits.shape[1] + token

    @cached_property
    def _candidates(self) -> Candidates:
        (has_choice, index, token), (row, _, logit_index) = self._choices, self._pairs
        agent = find_rows(self.mask, is_dense=self._num_rows == self.mask.numel())
        agent = tuple(axis.index_select(0, has_choice) for axis in agent)
        agent = (*agent, torch.zeros_like(has_choice))[:4]  # while simulating there is a single moment
        class_id = self.scene.class_id[agent[0], agent[2]].index_select(0, index)
        ends = self.vocabulary.poses[:, :, -1]  # [C, V, 3]
        end = ends.flatten(0, 1).index_select(0, class_id * ends.shape[1] + token)
        log_ratio = self.base.logits.flatten().index_select(0, logit_index) - self._peak[:, 0].index_select(0, row)
        return Candidates(self.scene, self.traffic, agent, index, end, log_ratio, self.seconds)


def _find_greater(values: Float[Tensor, "R V"], limit: Float[Tensor, "R 1"]) -> Int64[Tensor, "_"]:
    """Indices of the flattened values that exceed the limit of their row."""
    if values.device.type != "cpu":
        return (values > limit).flatten().nonzero()[:, 0]
    return torch.from_numpy(np.flatnonzero(values.numpy() > limit.numpy()))  # three times as fast as torch
