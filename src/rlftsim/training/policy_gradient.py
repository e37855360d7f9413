"""REINFORCE with a reward per rollout (or agent) and a KL penalty, as arithmetic on sums.

Every term is a sum over the agents and decisions of this process and slice, divided by a global count. So slices of the
rollouts, micro batches and processes add up to the same estimator.

Source: RLFTSim, section 4.1; the adaptive penalty is from Ziegler et al., "Fine-Tuning Language Models from Human
Preferences", 2020.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.rollout.policy import compute_statistics, encode_like, score_with_reference
from rlftsim.training.config import FinetuneConfig, Reduction
from rlftsim.training.imitation import accumulate_imitation
from rlftsim.training.parallel import Fabric, all_reduce_sum
from rlftsim.training.scored_rollouts import ScoredRollouts


def agent_log_prob(
    log_prob: Float[Tensor, "B N A L"], mask: Bool[Tensor, "B N A L"], reduction: Reduction
) -> Float[Tensor, "B N A"]:
    """Each agent's part of the log-probability of a rollout; the sum over agents is the rollout's.

    Args:
        log_prob: Log-probability of each decision, nats.
        mask: True = the decision counts.
        reduction: "sum" over all decisions of the rollout, or the "mean": the sum over L decisions of each agent that
            decides at all.
    """
    total = torch.where(mask, log_prob, 0.0).sum(-1)  # [B, N, A]
    # Not over the decisions that were made: where they depend on the rollout, as of agents that leave the map, dividing
    # by their number would weigh rollouts by their outcome and bias the gradient.
    deciding = mask.any(-1).sum(-1, keepdim=True)  # [B, N, 1]
    return total if reduction == "sum" else total / (deciding * mask.shape[-1]).clamp(min=1)


def policy_gradient_loss(
    reward: Float[Tensor, "B N *A"], log_prob: Float[Tensor, "B N *A"], num_scenarios: int
) -> Float[Tensor, ""]:
    """Loss whose gradient is minus the policy gradient: - 1/B sum_b sum_i R[b, i] log pi(rollout i of b).

    Args:
        reward: Reward of each rollout, or of each agent in a rollout, minus the baseline; a constant of the gradient.
        log_prob: Log-probability of the same rollouts or agents, nats.
        num_scenarios: B, over all slices and processes.
    """
    # By agent the reward of each multiplies its own part of the log-probability; by rollout all have the same.
    return -(reward.detach() * log_prob).sum() / num_scenarios


def masked_sum(values: Float[Tensor, "*shape"], mask: Bool[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Sum of the values that count.

    Args:
        values: any numbers; those that do not count may be infinite or NaN.
        mask: True = the value counts.
    """
    return torch.where(mask, values, 0.0).sum()


@dataclass(frozen=True)
class LossTerms:
    """Coefficients of the fine-tuning loss in one update, and the global counts that sums are divided by."""

    num_scenarios: int
    num_decisions: float
    beta: float
    """Strength of the KL penalty."""
    update: int
    """Counted from 0."""
    config: FinetuneConfig
    """All other coefficients."""


@dataclass(frozen=True, eq=False)
class GradientSums:
    """Statistics of a pass over the rollouts, beside the gradients that the pass leaves in the parameters."""

    kl: float
    """From the reference, nats per decision; mean over all processes."""
    entropy: float
    """Nats per decision; mean over all processes."""
    score_gap: float
    """Largest difference between a log-probability as sampled and as scored, in this process."""
    imitation: dict[str, float]
    """Metric `imitation_loss`, the pre-training loss: nats per prediction, mean over all processes. Empty where it has
    no weight."""
    agent_log_prob: list[list[Float[Tensor, "_ _ _"]]]
    """Summed log-probability of each agent's decisions, by micro batch and slice; no gradient."""


def accumulate_gradients(
    policy: Any, reference: Any, scored: Sequence[ScoredRollouts], terms: LossTerms, fabric: Fabric
) -> GradientSums:
    """Add this process's gradient of the loss to the policy's parameters.

    The loss is
    policy_gradient_loss + (beta * KL - entropy_bonus * entropy) / decisions + imitation_weight * pre-training loss.

    Args:
        policy: scores the rollouts with gradient; gradients are zero before.
        reference: scores the rollouts without gradient; under the same goals, unless the setting
            `kl.condition_reference` is False. A reference whose goal encoder was added for this run is still goal-free;
            an already conditioned reference anchors the policy to the reference's goal-following.
        scored: Rollouts of this process with rewards, an entry per micro batch.
        terms: Coefficients of the loss, and the global counts that sums are divided by.
        fabric: precision, and the processes that the statistics are summed over.
    """
    sums = torch.zeros(2, device=fabric.device, dtype=torch.float64)  # KL, entropy
    gaps: list[Tensor] = []
    by_entry: list[list[Tensor]] = []
    config, num_decisions = terms.config, max(terms.num_decisions, 1.0)
    imitation: dict[str, float] = {}
    if config.imitation_weight:
        batches = [entry.batch for entry in scored]
        imitation["imitation_loss"] = accumulate_imitation(
            policy, batches, config.imitation_weight, fabric, update=terms.update, seed=config.seed
        )
    for entry in scored:
        by_entry.append([])
        with fabric.autocast(), torch.no_grad():
            ref_context = encode_like(reference, entry.batch, entry.context)
        for rows, rollouts in entry.slices(config.rollouts_per_pass):
            mask = rollouts.decision_mask  # [B, n, A, L]
            ref_rollouts = rollouts if config.kl.condition_reference else replace(rollouts, goals=None)
            with fabric.autocast():
                # Encoded anew for every slice: each slice's graph is freed by its own backward pass.
                context = encode_like(policy, entry.batch, entry.context)
                dist, ref_dist = score_with_reference(policy, context, rollouts, reference, ref_context, ref_rollouts)
            statistics = compute_statistics(dist, rollouts.decision, ref_dist)  # [B, n, A, L] each
            weight = entry.weight[:, rows, None]  # [B, n, 1]
            kl = masked_sum(statistics.kl * weight[..., None], mask)
            entropy = masked_sum(statistics.entropy * weight[..., None], mask)
            by_agent = agent_log_prob(statistics.log_prob, mask, config.log_prob_reduction)  # [B, n, A]
            loss = policy_gradient_loss(entry.reward[:, rows] * weight, by_agent, terms.num_scenarios)
            loss = loss + (terms.beta * kl - config.entropy_bonus * entropy) / num_decisions
            # Every slice adds its part; nothing is divided by the number of slices.
            fabric.backward(loss)
            sums += torch.stack([kl.detach(), entropy.detach()])
            log_prob = statistics.log_prob.detach()
            gaps.append(torch.where(mask, log_prob - rollouts.log_prob, 0.0).abs().max())
            by_entry[-1].append(agent_log_prob(log_prob, mask, "sum"))
    kl_sum, entropy_sum = all_reduce_sum(sums, fabric).tolist()
    gap = float(torch.stack(gaps).max())
    return GradientSums(kl_sum / num_decisions, entropy_sum / num_decisions, gap, imitation, by_entry)
