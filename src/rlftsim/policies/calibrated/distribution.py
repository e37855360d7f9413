"""Token distributions with a weighted sum of features on the logits.

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
from rlftsim.rollout.rows import find_rows
from rlftsim.tokens.vocabulary import Vocabulary


@dataclass(frozen=True, eq=False)
class TiltedDistribution(CategoricalDistribution):
    """p(token) proportional to base(token) exp(eta · f(state, token)); the base, bit for bit, where eta is 0.

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
        """Logits in float32: those of the base, shifted for candidates."""
        logits = self.base.logits
        if not self.eta.any():
            return logits
        return logits.flatten().index_add(0, self._pairs[2], self.values @ self.eta).view_as(logits)

    @cached_property
    def values(self) -> Float[Tensor, "P K"]:
        """Features of all candidates."""
        candidates = self._candidates
        return torch.stack([feature(candidates) for feature in self.features], -1) * candidates.weight[:, None]

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

    @cached_property
    def _pairs(self) -> tuple[Int64[Tensor, "P"], Int64[Tensor, "P"], Int64[Tensor, "P"]]:
        """Row and token of each candidate, and the index into the flattened logits; rows with a single candidate have
        none."""
        num_tokens = self.base.logits.shape[1]
        logit_index = (self.base.logits > self._peak - SUPPORT_NATS).flatten().nonzero()[:, 0]
        row = logit_index.div(num_tokens, rounding_mode="floor")
        has_choice = (torch.bincount(row, minlength=self._num_rows) > 1).index_select(0, row)
        row, logit_index = row[has_choice], logit_index[has_choice]
        return row, logit_index - row * num_tokens, logit_index

    @cached_property
    def _candidates(self) -> Candidates:
        row, token, logit_index = self._pairs
        has_choice, index = row.unique_consecutive(return_inverse=True)
        agent = tuple(axis[has_choice] for axis in find_rows(self.mask, is_dense=self._num_rows == self.mask.numel()))
        agent = (*agent, torch.zeros_like(has_choice))[:4]  # while simulating there is a single moment
        class_id = self.scene.class_id[agent[0], agent[2]].index_select(0, index)
        ends = self.vocabulary.poses[:, :, -1]  # [C, V, 3]
        end = ends.flatten(0, 1).index_select(0, class_id * ends.shape[1] + token)
        log_ratio = self.base.logits.flatten().index_select(0, logit_index) - self._peak[:, 0].index_select(0, row)
        return Candidates(self.scene, self.traffic, agent, index, end, log_ratio, self.seconds)
