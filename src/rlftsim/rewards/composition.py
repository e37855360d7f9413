"""The reward of an update: a weighted sum of registered rewards, and its credit assignment.

By rollout, every decision of a rollout earns the rollout's reward R, the estimator of RLFTSim's proposition 1. By
agent, a decision of agent a earns

    W[a] = own[a] + credit_mixing * (R - own[a]),        sum_a own[a] = R,

its own part in full, and what the others earned times `credit_mixing` in [0, 1]. An agent that is not evaluated
has no part of its own and earns credit_mixing * R. credit_mixing = 1 is credit by rollout.

Where each part depends on its own agent's decisions alone, the estimate is unbiased for any `credit_mixing`, and
the smaller it is the smaller is the variance: the other agents' chance no longer adds to an agent's reward. Where
agents act on each other, that influence is weighted by `credit_mixing`. A reward without a split over agents is
credited to all in full. In a sum of rewards W is the weighted sum of theirs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import agent_rewards_by_name, finite_or_zero, reward_by_name
from rlftsim.rewards.expression import Term
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch

CreditTo = Literal["rollout", "agent"]


@dataclass(frozen=True, eq=False)
class Rewards:
    """Rewards of the rollouts of a batch. A scenario in which a term is not finite earns 0 of it."""

    terms: tuple[Term, ...]
    by_term: Float[Tensor, "K B N"]
    """Before the weights."""
    is_missing: Bool[Tensor, "K B"]
    """True where a term is not finite in a scenario."""
    total: Float[Tensor, "B N"]
    """Their weighted sum."""
    by_agent: Float[Tensor, "B N A"]
    """Earned by each agent's decisions: `total` for all agents, or W."""


def compute_rewards(
    terms: tuple[Term, ...],
    realism: RealismResult,
    rollouts: Rollouts,
    batch: ScenarioBatch,
    agents: AgentScores | None = None,
    credit_mixing: float = 1.0,
) -> Rewards:
    """Rewards of rollouts whose realism is known.

    Args:
        terms: see `parse_reward`.
        realism: of the rollouts.
        rollouts: N of each scenario.
        batch: the scenarios.
        agents: the same by agent; None = credit by rollout.
        credit_mixing: weight of what the other agents earned.

    Raises:
        ConfigError: a reward or its split gives no tensor, or one of the wrong shape.
    """
    by_term, missing, by_agent = [], [], torch.zeros_like(rollouts.heading[..., 0])  # [B, N, A]
    for term in terms:
        reward, is_missing = _call(reward_by_name(term.name), term, realism, rollouts, batch, shape=by_agent.shape[:2])
        credit = reward[..., None]  # [B, N, 1]: for all agents alike
        split = agent_rewards_by_name(term.name)
        # Without a split W is R for all agents, whatever the mixing.
        if agents is not None and split is not None:
            own, is_split_missing = _call(split, term, agents, rollouts, batch, shape=by_agent.shape)
            is_missing = is_missing | is_split_missing
            credit = own + credit_mixing * (credit - own)
        # a term that is missing in a scenario, for itself or in its split, says nothing there
        by_term.append(reward.masked_fill(is_missing[:, None], 0.0))
        missing.append(is_missing)
        by_agent = by_agent + term.weight * credit.masked_fill(is_missing[:, None, None], 0.0)
    stacked = torch.stack(by_term)  # [terms, B, N]
    weights = torch.tensor([term.weight for term in terms], device=stacked.device)
    return Rewards(terms, stacked, torch.stack(missing), (weights[:, None, None] * stacked).sum(0), by_agent)


def _call(
    function: Callable[..., object], term: Term, *arguments: object, shape: torch.Size
) -> tuple[Tensor, Bool[Tensor, "B"]]:
    """Values of a reward or of its split, checked as it may come from another package, and the scenarios without."""
    # Arguments by position: a reward of another package may name them as it likes.
    values = function(*arguments, **dict(term.options))
    if not isinstance(values, Tensor) or values.shape != shape:
        found = f"shape {list(values.shape)}" if isinstance(values, Tensor) else f"a {type(values).__name__}"
        raise ConfigError(
            f"reward {term}: {getattr(function, '__name__', function)} gives {found}, expected {list(shape)}: a tensor "
            "with one number per rollout [B, N], a split one per agent, too [B, N, A]."
        )
    return finite_or_zero(values.float())
