"""A categorical distribution over motion tokens for every agent that decides."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.rollout.policy import Sampling


@dataclass(frozen=True, eq=False)
class TokenDistribution:
    """Distributions of the R elements whose mask is True, in the order of `mask.nonzero()`; everybody else decides 0 for sure."""

    logits: Float[Tensor, "R V"]
    """float32; tokens that do not exist hold a large negative number."""
    mask: Bool[Tensor, "*batch"]

    @cached_property
    def log_probs(self) -> Float[Tensor, "R V"]:
        """Log-probabilities of all tokens."""
        return torch.log_softmax(self.logits, -1)

    @torch.no_grad()
    def sample(self, sampling: Sampling, noise: Float[Tensor, "*batch 1"]) -> Int64[Tensor, "*batch"]:
        """Token ids, by inverting the cumulative distribution at the noise."""
        if sampling.temperature == 0:
            return self._dense(self.logits.argmax(-1))
        cumulative = torch.softmax(self._truncated(sampling), -1).cumsum(-1)
        level = noise[self.mask] * cumulative[:, -1:]
        chosen = torch.searchsorted(cumulative, level, right=True)[:, 0]
        return self._dense(chosen.clamp(max=self.logits.shape[-1] - 1))

    def log_prob(
        self,
        decision: Int64[Tensor, "*batch"],
        sampling: Sampling = Sampling(),  # noqa: B008
    ) -> Float[Tensor, "*batch"]:
        """Log-probability of token ids under the distribution that `sampling` draws from."""
        if sampling.temperature == 0:
            return self._dense(torch.zeros_like(self.logits[:, 0]))
        log_probs = self.log_probs if sampling.is_full else torch.log_softmax(self._truncated(sampling), -1)
        return self._dense(log_probs.gather(-1, decision[self.mask][:, None])[:, 0])

    def kl(self, other: "TokenDistribution") -> Float[Tensor, "*batch"]:
        """KL(self || other), nats."""
        return self._dense((self.log_probs.exp() * (self.log_probs - other.log_probs)).sum(-1))

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Entropy, nats."""
        return self._dense(-(self.log_probs.exp() * self.log_probs).sum(-1))

    def _truncated(self, sampling: Sampling) -> Float[Tensor, "R V"]:
        logits = self.logits / sampling.temperature
        if sampling.top_k is None or sampling.top_k >= logits.shape[-1]:
            return logits
        kept = logits.topk(sampling.top_k, dim=-1)
        return torch.full_like(logits, -torch.inf).scatter(-1, kept.indices, kept.values)

    def _dense(self, values: Tensor) -> Tensor:
        """Values of the R elements at their places, zero elsewhere."""
        return values.new_zeros(self.mask.shape).masked_scatter(self.mask, values)
