"""Features of a state and a token, by name. A calibrated policy adds a weighted sum of selected features to the logits.

    @register_feature("braking", low=-1.5, high=0.0)
    def braking(candidates: Candidates) -> Float[Tensor, "P"]:
        return candidates.speed_change * candidates.where(candidates.is_vehicle)

A feature is a function on tensors, of all pairs of agents and tokens at once, and has bounds, to which values are
clipped: without bounds rare tokens with an extreme value would win. A feature is computed before the decision, and
may not read the logged future. A separate package announces features as entry points:

    [project.entry-points."rlftsim.features"]
    braking = "my_package.features:braking"
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint
from rlftsim.policies.calibrated.candidates import SUPPORT_NATS, Candidates


@dataclass(frozen=True)
class Feature:
    """A named, bounded function of a state and a token."""

    name: str
    compute: Callable[[Candidates], Float[Tensor, "P"]]
    low: float
    high: float

    def __call__(self, candidates: Candidates) -> Float[Tensor, "P"]:
        """Values of all pairs, within the bounds.

        Raises:
            ConfigError: The function gives no tensor with a number for each pair.
        """
        values = self.compute(candidates)
        if not isinstance(values, Tensor) or values.shape != candidates.row.shape:
            shape = list(values.shape) if isinstance(values, Tensor) else type(values).__name__
            raise ConfigError(
                f"feature {self.name!r} gives {shape} for {len(candidates.row)} pairs of an agent and a token: return "
                "a tensor with a number for each of them."
            )
        return values.clamp(self.low, self.high)


FEATURES: ExtensionPoint[Feature] = ExtensionPoint(
    "feature", "rlftsim.features", use=lambda name: features_by_name([name])
)
"""Features by name, this package's and others'."""


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


@register_feature("speed_gap_under_2s", low=-1.5, high=1.5)
def speed_gap_under_2s(c: Candidates) -> Float[Tensor, "P"]:
    """Change of speed, m/s, where the leader is less than 2 s ahead."""
    return c.speed_change * c.where(c.is_moving & (c.time_gap < 2))


@register_feature("speed_gap_2_to_4s", low=-1.5, high=1.5)
def speed_gap_2_to_4s(c: Candidates) -> Float[Tensor, "P"]:
    """Change of speed, m/s, where the leader is 2 to 4 s ahead."""
    return c.speed_change * c.where(c.is_moving & (c.time_gap >= 2) & (c.time_gap < 4))


@register_feature("turn_to_lane_direction", low=-2.0, high=2.0)
def turn_to_lane_direction(c: Candidates) -> Float[Tensor, "P"]:
    """Change of turn times the angle of the lane to the heading; positive = towards the lane's direction."""
    return 10 * c.turn_change * c.of_pairs(c.lane_turn * c.is_moving)


@register_feature("turn_to_lane_center", low=-2.0, high=2.0)
def turn_to_lane_center(c: Candidates) -> Float[Tensor, "P"]:
    """Change of turn times the lateral offset of the lane's center; positive = towards the center."""
    return 2 * c.turn_change * c.of_pairs(c.lane_offset * c.is_moving)


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
        lambda c, seconds=_seconds: c.overlap(seconds) * c.where(c.is_vehicle)
    )
    register_feature(f"overlap_{_seconds:g}s_walking_cycling", low=0.0, high=2.0)(
        lambda c, seconds=_seconds: c.overlap(seconds) * c.where(~c.is_vehicle)
    )
    register_feature(f"edge_{_seconds:g}s", low=0.0, high=3.0)(
        lambda c, seconds=_seconds: c.road_edge(seconds) * c.where(c.is_vehicle)
    )


@register_feature("edge_0.5s_walking_cycling", low=0.0, high=3.0)
def edge_walking_cycling(c: Candidates) -> Float[Tensor, "P"]:
    """Nearness of the road edge in half a second, of pedestrians and cyclists."""
    return c.road_edge(0.5) * c.where(~c.is_vehicle)
