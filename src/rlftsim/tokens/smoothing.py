"""Spatial label smoothing (TrajTok): the smoothed probability goes to the tokens that end near the target.

Each other token of the class gets a share in proportion to 1 / (1e-4 + d)^2, with d the mean distance in m between the
corners of the token's end box and those of the target's. (TrajTok's code divides by the sum twice and so hardly
smooths; this is the formula as intended.) The weights fall off so slowly that a short list of neighbors would lose
most of the probability. So rows are computed for the distinct targets of a batch.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from rlftsim.tokens.agent_tokens import corner_distances
from rlftsim.tokens.vocabulary import Vocabulary

SOFTNESS_M = 1e-4
_ROWS_PER_CHUNK = 256


@torch.no_grad()
def neighbor_weights(
    vocabulary: Vocabulary, class_id: Int64[Tensor, "U"], token_id: Int64[Tensor, "U"]
) -> Float[Tensor, "U V"]:
    """Distribution of the smoothed probability of target tokens: each row sums to 1 over the other tokens of the class.

    A target that is the only token of the class gets all of the probability.

    Args:
        vocabulary: Motion tokens of each class.
        class_id: Class of each of the U targets.
        token_id: Token of each of the U targets.
    """
    ends = vocabulary.end_corners()
    weights = ends.new_zeros(len(token_id), vocabulary.num_tokens)
    for index, (table, exists) in enumerate(zip(ends, vocabulary.token_mask)):
        for rows in (class_id == index).nonzero()[:, 0].split(_ROWS_PER_CHUNK):
            distance = corner_distances(table[token_id[rows]], table) / 4
            weights[rows] = exists / (SOFTNESS_M + distance).square()
    # The target itself has d = 0 and gets nothing, unless it is alone.
    weights.scatter_(1, token_id[:, None], 0.0)
    total = weights.sum(1, keepdim=True)
    weights.scatter_(1, token_id[:, None], (total == 0).to(weights.dtype))
    return weights / torch.where(total == 0, 1.0, total)


def summed_log_prob_nearby(
    log_probs: Float[Tensor, "R V"], target: Int64[Tensor, "R"], class_id: Int64[Tensor, "R"], vocabulary: Vocabulary
) -> Float[Tensor, ""]:
    """Sum over rows of the expected log-probability under `neighbor_weights` of the row's target, nats.

    Args:
        log_probs: Log-probabilities of all tokens, for R rows, nats.
        target: Target token of each row.
        class_id: Class of each row.
        vocabulary: Motion tokens of each class.
    """
    # Rows with the same target are added up first, so that the weights need memory for the U distinct targets only.
    targets, group = (class_id * vocabulary.num_tokens + target).unique(return_inverse=True)
    log_prob_sums = log_probs.new_zeros(len(targets), log_probs.shape[-1]).index_add(0, group, log_probs)
    weights = neighbor_weights(vocabulary, targets // vocabulary.num_tokens, targets % vocabulary.num_tokens)
    # 0 * -inf would be NaN: masked tokens have log-probability -inf and weight 0.
    return (weights * torch.where(weights > 0, log_prob_sums, 0.0)).sum()
