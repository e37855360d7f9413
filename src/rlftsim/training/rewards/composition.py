"""The reward of an update: a weighted sum of registered rewards, and whom it is owed to.

By rollout, every decision of a rollout earns the rollout's reward R, the estimator of RLFTSim's proposition 1. By agent, a decision of
agent a earns

    W[a] = own[a] + shared * (R - own[a]),        sum_a own[a] = R,

its own share in full, what the others earned times `shared` in [0, 1]. An agent that is not evaluated has no own share and earns
shared * R. shared = 1 is by rollout. Where each share depends on its own agent's decisions alone, the estimate is unbiased for any
`shared`, and the less is shared the less it scatters: the others' luck is no longer taken for the agent's merit. Where agents act on
each other, that influence counts `shared` times. A reward without a split over agents is owed to all in full. In a sum of rewards W is
the weighted sum of theirs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.rewards.base import finite_or_zero, reward_by_name, shares_by_name
from rlftsim.training.rewards.expression import Term

CreditTo = Literal["rollout", "agent"]


@dataclass(frozen=True, eq=False)
class Rewards:
    """What the rollouts of a batch earned. A scenario in which a term is not finite earns 0 of it."""

    terms: tuple[Term, ...]
    by_term: Float[Tensor, "K B N"]
    """Before the weights."""
    total: Float[Tensor, "B N"]
    """Their weighted sum."""
    by_agent: Float[Tensor, "B N A"]
    """What each agent's decisions earn: `total` for everybody, or W."""


def compute_rewards(
    terms: tuple[Term, ...],
    scores: RealismResult,
    rollouts: Rollouts,
    batch: ScenarioBatch,
    agents: AgentScores | None = None,
    shared: float = 1.0,
) -> Rewards:
    """Rewards of rollouts that are scored.

    Args:
        terms: see `parse_reward`.
        scores: of the rollouts.
        rollouts: N of each scenario.
        batch: the scenarios.
        agents: the same scores by agent; None = credit by rollout.
        shared: the share of what the others earned.

    Raises:
        ConfigError: a reward or its split has the wrong shape.
    """
    by_term, by_agent = [], torch.zeros_like(rollouts.heading[..., 0])
    for term in terms:
        reward = _call(reward_by_name(term.name), term, scores, rollouts, batch, shape=by_agent.shape[:2])
        credit = reward[..., None]
        shares = shares_by_name(term.name)
        if agents is not None and shares is not None:
            own = _call(shares, term, agents, rollouts, batch, shape=by_agent.shape)
            credit = own + shared * (credit - own)
        by_term.append(reward)
        by_agent = by_agent + term.weight * credit
    stacked = torch.stack(by_term)
    weights = torch.tensor([term.weight for term in terms], device=stacked.device)
    return Rewards(terms, stacked, (weights[:, None, None] * stacked).sum(0), by_agent)


def _call(function: Callable[..., Tensor], term: Term, *arguments: object, shape: torch.Size) -> Tensor:
    """A reward or its split, checked: it may come from anybody."""
    values = function(*arguments, **dict(term.options))
    if values.shape != shape:
        raise ConfigError(
            f"reward {term}: {getattr(function, '__name__', function)} gives shape {list(values.shape)}, "
            f"expected {list(shape)}: one number per rollout [B, N], a split one per agent, too [B, N, A]."
        )
    return finite_or_zero(values.float())
