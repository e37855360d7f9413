"""The reward of an update: a weighted sum of registered rewards, and the credit assignment.

By rollout, every decision of a rollout earns the rollout's reward R, the estimator of RLFTSim's proposition 1. By
agent, a decision of agent a earns

    W[a] = own[a] + credit_mixing * (R - own[a]),        sum_a own[a] = R,

the agent's share own[a] in full, and the shares of the other agents times `credit_mixing` in [0, 1]. An agent that is
not evaluated has no share and earns credit_mixing * R. credit_mixing = 1 is credit by rollout.

Where each share depends on the decisions of a single agent, the estimate is unbiased for any `credit_mixing`, and a
smaller `credit_mixing` means a smaller variance: the other agents' chance no longer adds to an agent's reward. Where
agents act on each other, that influence is weighted by `credit_mixing`. A reward without a split over agents is
credited to all in full. In a sum of rewards W is the weighted sum of the terms' W.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import agent_rewards_by_name, reward_by_name
from rlftsim.rewards.expression import Term
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch


@dataclass(frozen=True, eq=False)
class Rewards:
    """Rewards of the rollouts of a batch. A scenario in which a term is not finite earns 0 from the term."""

    terms: tuple[Term, ...]
    by_term: Float[Tensor, "K B N"]
    """Before the weights."""
    is_missing: Bool[Tensor, "K B"]
    """True where a term is not finite in a scenario."""
    total: Float[Tensor, "B N"]
    """Weighted sum of the terms."""
    by_agent: Float[Tensor, "B N A"]
    """Reward of each agent's decisions: `total` for all agents, or W."""


def compute_rewards(
    terms: tuple[Term, ...],
    realism: RealismResult,
    rollouts: Rollouts,
    batch: ScenarioBatch,
    agents: AgentScores | None = None,
    credit_mixing: float = 1.0,
) -> Rewards:
    """Rewards of rollouts with computed scores.

    Args:
        terms: Terms of the sum, from `parse_reward`.
        realism: Scores of the same rollouts, a row per scenario.
        rollouts: N rollouts of each scenario, in the frame of the batch.
        batch: Scenarios that were simulated, in the order of the rollouts.
        agents: Scores of the same rollouts split over agents; None = credit by rollout.
        credit_mixing: Weight in [0, 1] of the other agents' shares; 1 = credit by rollout.

    Raises:
        ConfigError: A reward or a split gives no tensor, or a tensor of the wrong shape.
    """
    by_term, missing_masks, by_agent = [], [], torch.zeros_like(rollouts.heading[..., 0])  # [B, N, A]
    for term in terms:
        reward, is_missing = _call(reward_by_name(term.name), term, realism, rollouts, batch, shape=by_agent.shape[:2])
        credit = reward[..., None]  # [B, N, 1]: for all agents alike
        split = agent_rewards_by_name(term.name)
        # Without a split W is R for all agents, whatever the mixing.
        if agents is not None and split is not None:
            share, is_split_missing = _call(split, term, agents, rollouts, batch, shape=by_agent.shape)
            is_missing = is_missing | is_split_missing
            credit = share + credit_mixing * (credit - share)
        # a term that is missing in a scenario, for itself or in its split, says nothing there
        by_term.append(reward.masked_fill(is_missing[:, None], 0.0))
        missing_masks.append(is_missing)
        by_agent = by_agent + term.weight * credit.masked_fill(is_missing[:, None, None], 0.0)
    rewards = torch.stack(by_term)  # [terms, B, N]
    weights = torch.tensor([term.weight for term in terms], device=rewards.device)
    return Rewards(terms, rewards, torch.stack(missing_masks), (weights[:, None, None] * rewards).sum(0), by_agent)


def _call(
    function: Callable[..., object], term: Term, *arguments: object, shape: torch.Size
) -> tuple[Tensor, Bool[Tensor, "B"]]:
    """Values of a reward or of a split, 0 in scenarios where a value is not finite, and True for those scenarios."""
    # Arguments by position: a reward of another package may name them as it likes.
    values = function(*arguments, **dict(term.options))
    if not isinstance(values, Tensor) or values.shape != shape:
        result = f"shape {list(values.shape)}" if isinstance(values, Tensor) else f"a {type(values).__name__}"
        raise ConfigError(
            f"reward {term}: {getattr(function, '__name__', function)} gives {result}, expected {list(shape)}: a "
            "tensor with one number per rollout [B, N], a split one per agent, too [B, N, A]."
        )
    values = values.float()
    # A whole scenario at once: a leave-one-out reward of which one number is missing has no baseline.
    is_missing = ~values.isfinite().flatten(1).all(1)
    return values.masked_fill(is_missing.view(-1, *[1] * (values.dim() - 1)), 0.0), is_missing
