"""Calibration of policies whose decisions are continuous actions: features shift the mean of a Gaussian.

    mean' = mean + std · eta · slope,   slope of a feature = (f(mean + std) - f(mean - std)) / 2 for each number

To first order in f this is a Gaussian p(action) tilted by exp(eta · f(state, action)). Features are those of tokens: an
action is kept up for half a second, and the pose at the end takes the place of a token's end. The likelihood of a
token, which temperatures weigh, becomes the likelihood of an action against the action 0: temperatures scale the action
that a policy aims at. Standard deviations stay unchanged. Where noise goes on from decision to decision, so does a
shift: with a correlation of 0.9 a constant shift adds up to ten times as much.

R agents that decide, D numbers of an action, K features.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.policies.calibrated.candidates import Candidates, Scene, Traffic
from rlftsim.policies.calibrated.features import Feature
from rlftsim.policies.distributions import GaussianDistribution
from rlftsim.rollout.rows import find_rows, place_rows

LOOKAHEAD_S = 0.5
"""Time that an action is kept up for; the duration of a token."""


@dataclass(frozen=True, eq=False)
class Slopes:
    """Change of features with actions, around the means of a distribution.

    Raises:
        ConfigError: A distribution that is no Gaussian.
    """

    base: GaussianDistribution
    features: Sequence[Feature]
    scene: Scene
    traffic: Traffic
    predict_pose: Callable[[Tensor, Tensor, Tensor, float], Tensor]
    """See `rollout.policy.ActionPolicy`."""
    seconds: float
    """Duration of a decision."""

    def __post_init__(self) -> None:
        if not isinstance(self.base, GaussianDistribution):
            raise ConfigError(
                f"actions of a {type(self.base).__name__} cannot be calibrated: decide by a GaussianDistribution."
            )

    @cached_property
    def values(self) -> Float[Tensor, "*batch D K"]:
        """Slope of each feature, per standard deviation of each number of the action."""
        mask, size = self.base.mask, self.base.mean.shape[-1]
        with torch.autocast(mask.device.type, enabled=False):  # shifts of hundredths count
            candidates = self._find_candidates()
            values = torch.stack([feature(candidates) for feature in self.features], -1)
            low, high = values.view(-1, 2, size, len(self.features)).unbind(1)
            return place_rows((high - low) / 2, mask)

    def shift(self, eta: Float[Tensor, "K"]) -> "ShiftedDistribution":
        """The distribution with shifted means; those of the base, bit for bit, where eta is 0.

        Args:
            eta: Weights of the features.
        """
        mean = self.base.mean
        if eta.any():
            with torch.autocast(mean.device.type, enabled=False):
                mean = mean + self.base.std * (self.values @ eta)
        return ShiftedDistribution(mean, self.base.std, self.base.mask, slopes=self)

    def _find_candidates(self) -> Candidates:
        """Two actions of each agent for each of the D numbers: a standard deviation below the mean, and above."""
        base, agent = self.base, find_rows(self.base.mask, is_dense=False)
        mean, std = base.mean[agent], base.std[agent]  # [R, D]
        aim = mean if base.aim is None else base.aim[agent]
        count, size = mean.shape
        moment = (*agent, torch.zeros_like(agent[0]))[:4]  # while simulating there is a single moment
        sides = torch.cat([-torch.eye(size), torch.eye(size)]).to(mean)  # [2D, D]
        class_id, speed = self.scene.class_id[agent[0], agent[2]], self.traffic.speed[moment]
        action = mean[:, None] + sides * std[:, None]  # [R, 2D, D]
        end = self.predict_pose(class_id[:, None], speed[:, None], action, LOOKAHEAD_S)
        if not isinstance(end, Tensor) or end.shape != (count, 2 * size, 3) or not end.isfinite().all():
            shape = list(end.shape) if isinstance(end, Tensor) else type(end).__name__
            raise ConfigError(
                f"predict_pose gives {shape} for actions {list(action.shape)}: return x, y and heading of each, finite "
                f"numbers {[count, 2 * size, 3]}."
            )
        ratio = (aim / std).repeat(1, 2) * sides.sum(-1)
        log_ratio = ratio - ratio.abs()  # of the likelier side 0
        return Candidates(
            self.scene,
            # the turn of a decision, as if it had lasted as long as the look ahead
            replace(self.traffic, turn=self.traffic.turn * (LOOKAHEAD_S / self.seconds)),
            moment,
            torch.arange(count, device=mean.device).repeat_interleave(2 * size),
            end.to(mean).flatten(0, 1),
            log_ratio.flatten(),
            LOOKAHEAD_S,
        )


@dataclass(frozen=True, eq=False)
class ShiftedDistribution(GaussianDistribution):
    """Diagonal Gaussians around means that features have shifted."""

    slopes: Slopes = field(kw_only=True)

    def with_eta(self, eta: Float[Tensor, "K"]) -> "ShiftedDistribution":
        """The distribution of the same base with other weights.

        Args:
            eta: Weights of the features.
        """
        return self.slopes.shift(eta)

    def score_function(self, decision: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch K"]:
        """Gradient of the decisions' log-density by eta.

        Args:
            decision: Actions, drawn from the distribution.
        """
        deviation = self._masked((decision - self.mean.detach()) / self.std)
        with torch.autocast(deviation.device.type, enabled=False):
            return torch.einsum("...d,...dk->...k", deviation, self.slopes.values.detach())
