"""REINFORCE with a reward per rollout and a KL penalty, as arithmetic on sums.

Every term is a sum over what this process and slice hold, divided by a global count: so slices of the rollouts and processes add up
to the one estimator. Source: RLFTSim section 4.1; the adaptive penalty is Ziegler et al., 2020.
"""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Reduction = Literal["mean", "sum"]


def agent_log_prob(
    log_prob: Float[Tensor, "B N A L"], mask: Bool[Tensor, "B N A L"], reduction: Reduction
) -> Float[Tensor, "B N A"]:
    """Each agent's part of the log-probability of its rollout, which is the mean (or sum) over all agents' decisions that count.

    Summed over agents it is the rollout's log-probability.
    """
    total = torch.where(mask, log_prob, 0.0).sum(-1)
    return total if reduction == "sum" else total / mask.sum((-1, -2)).clamp(min=1)[..., None]


def policy_gradient_loss(
    reward: Float[Tensor, "B N *A"], log_prob: Float[Tensor, "B N *A"], num_scenarios: int
) -> Float[Tensor, ""]:
    """Loss whose gradient is minus the policy gradient: - 1/B sum_b sum_i R[b, i] log pi(rollout i of b).

    Args:
        reward: of each rollout, or of each agent in it; with its baseline inside; no gradient flows through it.
        log_prob: of the same.
        num_scenarios: B over all slices and processes.
    """
    return -(reward.detach() * log_prob).sum() / num_scenarios


def masked_sum(values: Float[Tensor, "*shape"], mask: Bool[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Sum over what counts."""
    return torch.where(mask, values, 0.0).sum()
