"""Token distributions with a weighted sum of features on their logits.

R elements, P pairs of an element and a candidate token, K features, V tokens.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.policies.calibrated.candidates import SUPPORT_NATS, Candidates
from rlftsim.policies.calibrated.features import Feature
from rlftsim.policies.calibrated.traffic import Scene, Traffic
from rlftsim.policies.distributions import CategoricalDistribution
from rlftsim.rollout.rows import row_places
from rlftsim.tokens.vocabulary import Vocabulary


@dataclass(frozen=True, eq=False)
class TiltedDistribution(CategoricalDistribution):
    """p(token) proportional to base(token) exp(eta · f(state, token)); the base itself, bit for bit, where eta is 0.

    Features are 0 for tokens that are no candidates, see `Candidates`.
    """

    base: CategoricalDistribution
    eta: Float[Tensor, "K"]
    features: Sequence[Feature]
    scene: Scene
    traffic: Traffic
    vocabulary: Vocabulary
    seconds: float
    """Duration of a decision."""

    @property
    def mask(self) -> Bool[Tensor, "*batch"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """True = the element decides."""
        return self.base.mask

    @cached_property
    def logits(self) -> Float[Tensor, "R V"]:
        """float32."""
        if not self.eta.any():
            return self.base.logits
        return self.base.logits.index_put(self._pairs, self.values @ self.eta, accumulate=True)

    @cached_property
    def values(self) -> Float[Tensor, "P K"]:
        """Features of all candidates."""
        candidates = self._candidates
        return torch.stack([feature(candidates) for feature in self.features], -1) * candidates.weight[:, None]

    def score_function(self, decision: Int64[Tensor, "*batch"]) -> Float[Tensor, "*batch K"]:
        """Gradient of the decisions' log-probability by eta: the features of what was chosen minus their mean.

        Args:
            decision: Token ids.
        """
        row, token = self._pairs
        weight = (token == self._rows(decision)[row]).float() - self.log_probs.detach().exp()[row, token]
        centered = self.values.new_zeros(self._num_rows, len(self.features))
        return self._dense(centered.index_add(0, row, weight[:, None] * self.values.detach()))

    @property
    def _num_rows(self) -> int:
        return self.base._num_rows

    @cached_property
    def _peak(self) -> Float[Tensor, "R 1"]:
        return self.base.logits.amax(-1, keepdim=True)

    @cached_property
    def _pairs(self) -> tuple[Int64[Tensor, "P"], Int64[Tensor, "P"]]:
        """Row and token of each candidate; rows with a single one have none."""
        is_likely = self.base.logits > self._peak - SUPPORT_NATS
        row, token = is_likely.nonzero(as_tuple=True)
        has_choice = (torch.bincount(row, minlength=self._num_rows) > 1)[row]
        return row[has_choice], token[has_choice]

    @cached_property
    def _candidates(self) -> Candidates:
        row, token = self._pairs
        has_choice, index = row.unique_consecutive(return_inverse=True)
        place = tuple(axis[has_choice] for axis in row_places(self.mask, has_all=self._num_rows == self.mask.numel()))
        place = (*place, torch.zeros_like(has_choice))[:4]  # while simulating there is a single moment
        end = self.vocabulary.poses[self.scene.class_id[place[0], place[2]][index], token, -1]
        log_ratio = self.base.logits[row, token] - self._peak[row, 0]
        return Candidates(self.scene, self.traffic, place, index, end, log_ratio, self.seconds)
