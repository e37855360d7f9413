"""Distributions of decisions: categorical over motion tokens, Gaussian over continuous actions.

In fine-tuning R is tens of thousands: logits, log-probabilities and their gradients, [R, V] each, take more memory than
the rest of the update and more time to page in than to compute. So `compute_row_statistics` applies the last map of the
head block by block, and again in the backward pass.

R rows, D width of the hidden features, V tokens, C classes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.rollout.baselines import check_no_top_k
from rlftsim.rollout.policy import DecisionStatistics, Sampling
from rlftsim.rollout.rows import pick_rows, place_rows

FULL = Sampling()
"""The whole, untempered distribution."""
NEVER = -1e9
"""Logit of a token that does not exist."""
TIE_NATS = 1e-3
"""Logits this close to that of the last token kept by a truncation are ties."""
ROWS_PER_BLOCK = {"cpu": 256}
"""Rows whose tokens are processed together: on a processor they fit its cache."""
ROWS_PER_DEVICE_BLOCK = 1 << 14


def at_least_float32(x: Float[Tensor, "*g"]) -> Float[Tensor, "*g"]:
    """The same numbers, in float32 where autocast has made a coarser type of the input."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


@dataclass(frozen=True, eq=False)
class TokenRows:
    """Rows whose logits are a linear map of hidden features."""

    hidden: Float[Tensor, "R D"]
    """Features that the last map of the head reads."""
    weight: Float[Tensor, "V D"]
    """Weights of the last map of the head."""
    bias: Float[Tensor, "V"]
    class_id: Int64[Tensor, "R"]
    exists: Bool[Tensor, "C V"]
    """True = a token of that class; any other token gets the logit `NEVER`."""

    def logits(self) -> Float[Tensor, "R V"]:
        """float32 logits of all tokens of all rows."""
        return _logits(self.hidden, self.weight, self.offset(), self.class_id)

    def offset(self) -> Float[Tensor, "C V"]:
        """Term of the logits that depends on the class alone: the bias of the last map, and `NEVER`."""
        return self.bias.masked_fill(~self.exists, NEVER)


def compute_row_statistics(
    rows: TokenRows, token: Int64[Tensor, "R"], reference: TokenRows | None = None
) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"], Float[Tensor, "R"]]:
    """Log-probability of a token, KL(rows || reference) and entropy of each row, nats.

    Differentiable in `rows`; no gradient flows into the reference.

    Args:
        rows: Distributions of the policy, a row per decision.
        token: Token id of each row, whose log-probability is computed.
        reference: Distributions over the same tokens; None = those of the policy, so that the KL is zero.
    """
    ref = () if reference is None else (reference.hidden, reference.weight, reference.offset())
    inputs = (rows.hidden, rows.weight, rows.offset(), rows.class_id, token, *(value.detach() for value in ref))
    return _RowStatistics.apply(*inputs)  # type: ignore[return-value]


def _logits(
    hidden: Float[Tensor, "r D"], weight: Float[Tensor, "V D"], bias: Float[Tensor, "C V"], class_id: Int64[Tensor, "r"]
) -> Float[Tensor, "r V"]:
    """Logits of rows, at least float32 also where autocast multiplies in bfloat16."""
    logits = torch.addmm(bias.index_select(0, class_id), hidden, weight.mT)
    return at_least_float32(logits)


class _RowStatistics(torch.autograd.Function):
    """Statistics block by block, of hidden features, weight, offset, class and token of rows; and hidden features,
    weight and offset of a reference if there is one. Their gradients by the logits are

    * 1[token] - p of the log-probability,
    * p (log p - log q - KL) of KL = sum p (log p - log q), where q are the probabilities of the reference,
    * -p (log p + H) of the entropy H = -sum p log p.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        hidden, _, _, _, token, *_ = inputs
        # At least float32, as the logits of `_logits`: hidden features are bfloat16 under autocast.
        dtype = torch.promote_types(hidden.dtype, torch.float32)
        log_prob, kl, entropy = hidden.new_empty(3, len(hidden), dtype=dtype)
        for rows, log_p, log_q in _blocks(*inputs):
            p = log_p.exp()
            log_prob[rows] = log_p.gather(-1, token[rows, None])[:, 0]
            kl[rows] = (log_p - log_q).mul_(p).sum(-1)
            entropy[rows] = -log_p.mul_(p).sum(-1)
        ctx.save_for_backward(*inputs, kl, entropy)
        device = hidden.device.type
        ctx.autocast = device, torch.get_autocast_dtype(device), torch.is_autocast_enabled(device)
        return log_prob, kl, entropy

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, kl, entropy = ctx.saved_tensors
        hidden, weight, offset, class_id, token, *_ = inputs
        by_log_prob, by_kl, by_entropy = (gradient[:, None] for gradient in gradients)  # [R, 1]
        by_hidden, by_weight, by_offset = map(torch.zeros_like, (hidden, weight, offset))
        with torch.autocast(*ctx.autocast):  # logits as they were in the forward pass
            for rows, log_p, log_q in _blocks(*inputs):
                by_logits = (log_p - log_q).sub_(kl[rows, None]).mul_(by_kl[rows])
                by_logits -= (log_p + entropy[rows, None]).mul_(by_entropy[rows])
                by_logits.sub_(by_log_prob[rows]).mul_(log_p.exp_())
                by_logits.scatter_add_(-1, token[rows, None], by_log_prob[rows])
                by_hidden[rows] = by_logits @ weight
                by_weight += by_logits.mT @ hidden[rows]
                by_offset.index_add_(0, class_id[rows], by_logits)
        return by_hidden, by_weight, by_offset, *[None] * (len(inputs) - 3)


def _blocks(*inputs: Tensor) -> Iterator[tuple[slice, Float[Tensor, "r V"], Float[Tensor, "r V"]]]:
    """Log-probabilities of policy and reference, a block of rows at a time, from the inputs of `_RowStatistics`."""
    hidden, weight, offset, class_id, _, *reference = inputs
    size = ROWS_PER_BLOCK.get(hidden.device.type, ROWS_PER_DEVICE_BLOCK)
    for start in range(0, len(hidden), size):
        rows = slice(start, start + size)
        log_p = log_q = _logits(hidden[rows], weight, offset, class_id[rows]).log_softmax(-1)
        if reference:
            log_q = _logits(reference[0][rows], *reference[1:], class_id[rows]).log_softmax(-1)
        yield rows, log_p, log_q


class CategoricalDistribution:
    """Distributions of the R elements whose mask is True, in the order of `mask.nonzero()`.

    All other elements (padding) decide 0 with probability 1. Off the CPU padding may have rows that say so.

    The model's sampling is a part of the distribution: a token that it excludes has no probability. The KL divergence
    is over the tokens that are left here, so that a reference which excludes others leaves it finite.
    """

    logits: Float[Tensor, "R V"]
    """float32; tokens that do not exist have a large negative logit."""
    mask: Bool[Tensor, "*batch"]
    sampling: Sampling = FULL

    @cached_property
    def log_probs(self) -> Float[Tensor, "R V"]:
        """Log-probabilities of all tokens; about `NEVER` for those that the model's sampling excludes."""
        return self._normalize(self)

    @torch.no_grad()
    def sample(self, sampling: Sampling, noise: Float[Tensor, "*batch 1"]) -> Int64[Tensor, "*batch"]:
        """Token ids, by inverting the cumulative distribution at the noise.

        Args:
            sampling: Temperature and truncation of the draw, on top of the model's; temperature 0 takes the mode.
            noise: Uniform numbers in [0, 1), one per element.
        """
        sampling = self.sampling.narrow(sampling)
        if sampling.temperature == 0:
            return self._dense(self.logits.argmax(-1))
        logits, token_id = self._truncate(sampling)
        cumulative = torch.softmax(logits, -1).cumsum(-1)
        # the sum of float32 probabilities is 1 up to rounding: scaled by it, no noise lies beyond the last token
        level = self._rows(noise) * cumulative[:, -1:]  # [R, 1]
        index = torch.searchsorted(cumulative, level, right=True).clamp(max=logits.shape[-1] - 1)
        return self._dense((index if token_id is None else token_id.gather(-1, index))[:, 0])

    def log_prob(self, decision: Int64[Tensor, "*batch"], sampling: Sampling = FULL) -> Float[Tensor, "*batch"]:
        """Log-probability of token ids under the distribution that `sampling` draws from.

        Args:
            decision: Token ids in the vocabulary, as `sample` returns.
            sampling: Temperature and truncation of the draw, on top of the model's. A token that truncation excludes
                has -inf.
        """
        sampling = self.sampling.narrow(sampling)
        if sampling.temperature == 0:
            return self._dense(torch.zeros_like(self.logits[:, 0]))
        token = self._rows(decision)[:, None]  # [R, 1]
        if sampling.is_full:
            return self._dense(self.log_probs.gather(-1, token)[:, 0])
        logits, token_id = self._truncate(sampling)
        # log p = logit of the token - logsumexp of the logits after truncation, at the temperature
        logit = self.logits.gather(-1, token) / sampling.temperature
        if token_id is not None:
            # a draw on the edge stays one where rounding, as of another batch, puts its rival before it
            logit = logit.masked_fill(logit < logits.amin(-1, keepdim=True) - TIE_NATS, -torch.inf)
        return self._dense(logit[:, 0] - logits.logsumexp(-1))

    def kl(self, reference: "CategoricalDistribution") -> Float[Tensor, "*batch"]:
        """KL(self || reference), nats."""
        is_full = self.sampling.is_full and reference.sampling.is_full
        log_q = reference.log_probs if is_full else self._normalize(reference)
        return self._dense((self.log_probs.exp() * (self.log_probs - log_q)).sum(-1))

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Entropy, nats."""
        return self._dense(-(self.log_probs.exp() * self.log_probs).sum(-1))

    def _normalize(self, dist: "CategoricalDistribution") -> Float[Tensor, "R V"]:
        """Log-probabilities of a distribution of the same elements, over the tokens that this one may draw."""
        if self.sampling.is_full:
            return torch.log_softmax(dist.logits, -1)
        logits = dist.logits / dist.sampling.temperature
        token_id = self._truncate(self.sampling)[1]
        if token_id is not None:
            is_excluded = torch.ones_like(logits, dtype=torch.bool).scatter_(-1, token_id, False)
            logits = logits.masked_fill(is_excluded, NEVER)
        return torch.log_softmax(logits, -1)

    @cached_property
    def _likeliest(self) -> dict[int, Int64[Tensor, "R K"]]:
        """Ids of the K most likely tokens, by K: a memo for repeated calls."""
        return {}

    def _truncate(self, sampling: Sampling) -> tuple[Float[Tensor, "R K"], Int64[Tensor, "R K"] | None]:
        """Logits of the tokens that may be drawn, at the temperature, and the token ids in increasing order.

        The ids are None if all tokens may be drawn.
        """
        if sampling.top_k is None or sampling.top_k >= self.logits.shape[-1]:
            return self.logits / sampling.temperature, None
        if sampling.top_k not in self._likeliest:
            # sorted by id, so that sampling walks through tokens in the same order as without truncation
            self._likeliest[sampling.top_k] = self.logits.topk(sampling.top_k, dim=-1).indices.sort(-1).values
        token_id = self._likeliest[sampling.top_k]
        return self.logits.gather(-1, token_id) / sampling.temperature, token_id

    @property
    def _num_rows(self) -> int:
        return len(self.logits)

    def _rows(self, values: Tensor) -> Tensor:
        """Values of the R elements."""
        return pick_rows(values, self.mask, is_dense=self._num_rows == self.mask.numel())

    def _dense(self, values: Tensor) -> Tensor:
        """Values of the R elements as [*batch], zero elsewhere."""
        return place_rows(values, self.mask)


@dataclass(frozen=True, eq=False)
class TokenDistribution(CategoricalDistribution):
    """Distributions with logits that have been computed already.

    Raises:
        DataError: The logits have no row for each element that the mask names.
    """

    logits: Float[Tensor, "R V"]
    mask: Bool[Tensor, "*batch"]
    sampling: Sampling = FULL

    def __post_init__(self) -> None:
        # counted only where rows are left out, so that the host waits for no device
        is_dense = len(self.logits) == self.mask.numel()
        if self.logits.dim() != 2 or not (is_dense or len(self.logits) == int(self.mask.sum())):
            raise DataError(
                f"logits are {list(self.logits.shape)}, and the mask {list(self.mask.shape)} is True for "
                f"{int(self.mask.sum())} agents: logits are [R, V], a row for each of these, in the order of the mask."
            )


@dataclass(frozen=True, eq=False)
class LazyTokenDistribution(CategoricalDistribution):
    """Distributions with logits that are computed on first use, and not for the statistics of an update."""

    rows: TokenRows
    mask: Bool[Tensor, "*batch"]
    sampling: Sampling = FULL

    @cached_property
    def logits(self) -> Float[Tensor, "R V"]:
        """float32; tokens that do not exist have a large negative logit."""
        return self.rows.logits()

    @property
    def _num_rows(self) -> int:
        return len(self.rows.hidden)

    def log_prob(self, decision: Int64[Tensor, "*batch"], sampling: Sampling = FULL) -> Float[Tensor, "*batch"]:
        """Log-probability as of any `CategoricalDistribution`; without logits for the full distribution.

        Args:
            decision: Token ids in the vocabulary, as `sample` returns.
            sampling: Temperature and truncation of the draw; the defaults draw from the full distribution.
        """
        if not self.sampling.narrow(sampling).is_full:
            return super().log_prob(decision, sampling)
        return self._dense(compute_row_statistics(self.rows, self._rows(decision))[0])

    def statistics(self, decision: Int64[Tensor, "*batch"], reference: CategoricalDistribution) -> DecisionStatistics:
        """Log-probability, KL and entropy of all elements, block by block if both distributions are lazy.

        Args:
            decision: Token ids, drawn from the full distribution.
            reference: Distribution of the same elements; receives no gradient.
        """
        if not (isinstance(reference, LazyTokenDistribution) and self.sampling.is_full):
            return DecisionStatistics(self.log_prob(decision), self.kl(reference), self.entropy())
        statistics = compute_row_statistics(self.rows, self._rows(decision), reference.rows)
        return DecisionStatistics(*(self._dense(values) for values in statistics))


def standard_normal(noise: Float[Tensor, "*shape"]) -> Float64[Tensor, "*shape"]:
    """Draws of N(0, 1), by the inverse of the cumulative distribution at noise that is uniform in [0, 1)."""
    # The noise is a multiple of 2^-24: half of that stands for 0, where the inverse is infinite.
    return math.sqrt(2) * torch.erfinv(2 * noise.clamp(min=2**-25).double() - 1)


@dataclass(frozen=True, eq=False)
class GaussianDistribution:
    """Diagonal Gaussians, in float32 or better. Elements whose mask is False (padding) decide 0 with probability 1."""

    mean: Float[Tensor, "*batch D"]
    std: Float[Tensor, "*batch D"]
    mask: Bool[Tensor, "*batch"]
    aim: Float[Tensor, "*batch D"] | None = None
    """Mean without what goes on of earlier noise, for calibration; None = the mean."""

    @torch.no_grad()
    def sample(self, sampling: Sampling, noise: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """Draws, by the inverse of the cumulative distribution at the noise.

        Args:
            sampling: Temperature, a factor of the variance: a density to the power 1/T; 0 = the mean.
            noise: Uniform numbers in [0, 1), one per number of a decision.

        Raises:
            ConfigError: `sampling.top_k` is set, and there are no categories.
        """
        check_no_top_k(sampling)
        deviation = math.sqrt(sampling.temperature) * standard_normal(noise)
        return self._masked(self.mean + self.std * deviation.to(self.mean.dtype))

    def log_prob(self, decision: Float[Tensor, "*batch D"], sampling: Sampling = FULL) -> Float[Tensor, "*batch"]:
        """Log-density under the distribution that `sampling` draws from, summed over the D numbers; 0 at the mode.

        Args:
            decision: Decisions, as `sample` returns.
            sampling: Temperature of the draw; `top_k` is refused, as in `sample`.
        """
        check_no_top_k(sampling)
        if sampling.temperature == 0:
            return torch.zeros_like(self.mean[..., 0])
        std = self.std * math.sqrt(sampling.temperature)
        log_density = -0.5 * ((decision - self.mean) / std).square() - std.log() - 0.5 * math.log(2 * math.pi)
        return self._masked(log_density).sum(-1)

    def kl(self, reference: "GaussianDistribution") -> Float[Tensor, "*batch"]:
        """KL(self || reference), nats."""
        ratio = (self.std / reference.std).square()
        distance = ((self.mean - reference.mean) / reference.std).square()
        return self._masked(0.5 * (ratio + distance - 1 - ratio.log())).sum(-1)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Differential entropy, nats."""
        return self._masked(self.std.log() + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)

    def _masked(self, values: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        return torch.where(self.mask[..., None], values, 0.0)
