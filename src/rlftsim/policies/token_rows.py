"""Log-probability, KL and entropy of rows of tokens, without a tensor of size rows x vocabulary.

In fine-tuning R is tens of thousands: logits, log-probabilities and their gradients, [R, V] each, take more memory than
the rest of the update and more time to page in than to compute. So the last map of the head is applied block by block,
and again in the backward pass.

R rows, D width of the hidden features, V tokens, C classes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.policies.precision import at_least_float32

NEVER = -1e9
"""Logit of a token that does not exist."""
ROWS_PER_BLOCK = {"cpu": 256}
"""Rows whose tokens are processed together: on a processor they fit its cache."""
ROWS_PER_DEVICE_BLOCK = 1 << 14


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
    hidden: Float[Tensor, "r D"],
    weight: Float[Tensor, "V D"],
    offset: Float[Tensor, "C V"],
    class_id: Int64[Tensor, "r"],
) -> Float[Tensor, "r V"]:
    """Logits of rows, at least float32 also where autocast multiplies in bfloat16."""
    logits = torch.addmm(offset.index_select(0, class_id), hidden, weight.mT)
    return at_least_float32(logits)


class _RowStatistics(torch.autograd.Function):
    """Statistics block by block, and their gradients by the logits, which are

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


def _blocks(
    hidden: Float[Tensor, "R D"],
    weight: Float[Tensor, "V D"],
    offset: Float[Tensor, "C V"],
    class_id: Int64[Tensor, "R"],
    token: Int64[Tensor, "R"],
    *reference: Tensor,
) -> Iterator[tuple[slice, Float[Tensor, "r V"], Float[Tensor, "r V"]]]:
    """Log-probabilities of policy and reference, a block of rows at a time."""
    size = ROWS_PER_BLOCK.get(hidden.device.type, ROWS_PER_DEVICE_BLOCK)
    for start in range(0, len(hidden), size):
        rows = slice(start, start + size)
        log_p = _logits(hidden[rows], weight, offset, class_id[rows]).log_softmax(-1)
        if not reference:
            yield rows, log_p, log_p
            continue
        ref_hidden, ref_weight, ref_offset = reference
        yield rows, log_p, _logits(ref_hidden[rows], ref_weight, ref_offset, class_id[rows]).log_softmax(-1)
