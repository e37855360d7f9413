"""CAT-K ("closest among top-K"): rollouts that keep near the record, and the loss along them.

In a CAT-K rollout each agent takes, among its K most likely tokens, the one that leads nearest to where it was recorded next;
where nothing was recorded, its most likely token. The loss is the cross-entropy of the token that leads nearest of all, seen from
where the rollout has led.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.rollout.policy import DecisionDistribution, Policy, Sampling
from rlftsim.rollout.simulate import Choose, simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens.agent_tokens import (
    HISTORY_TOKENS,
    AgentTokens,
    local_boxes,
    nearest_tokens,
    tokenize_agents,
)
from rlftsim.tokens.vocabulary import Vocabulary, class_of_type

DEFAULT_NUM_CANDIDATES = 32


class TokenPolicy(Policy, Protocol):
    """A policy whose decisions are tokens of a vocabulary."""

    vocabulary: Vocabulary


class TokenLogits(Protocol):
    """What CAT-K needs of a distribution over tokens: logits of the R elements where the mask is True, in the mask's order."""

    logits: Float[Tensor, "R V"]
    mask: Bool[Tensor, "B N A"]


@dataclass(frozen=True, eq=False)
class PursuingRollouts:
    """CAT-K rollouts and what should have been decided in them."""

    rollouts: Rollouts
    target: Int64[Tensor, "B N A L"]
    """Token that leads nearest to the record."""
    target_mask: Bool[Tensor, "B N A L"]
    """True = the next state was recorded."""


def roll_out_closest(
    policy: TokenPolicy,
    batch: ScenarioBatch,
    *,
    num_candidates: int = DEFAULT_NUM_CANDIDATES,
    num_rollouts: int = 1,
    seed: int = 0,
    context: Any = None,
) -> PursuingRollouts:
    """Simulate with CAT-K.

    Without dropout nothing is random: more than one rollout makes sense for a policy in training mode only.

    Args:
        policy: decides for every agent.
        batch: scenarios with their future.
        num_candidates: K.
        num_rollouts: N.
        seed: of what else is random in the policy.
        context: `policy.encode(batch)`, where it is at hand.

    Raises:
        ConfigError: no candidates.
    """
    if num_candidates < 1:
        raise ConfigError(f"num_candidates must be at least 1, got {num_candidates}.")
    tokens = tokenize_agents(batch, policy.vocabulary)
    targets: list[tuple[Tensor, Tensor]] = []
    choose = closest_among_top_k(batch, tokens, policy.vocabulary, num_candidates, targets)
    rollouts = simulate(policy, batch, num_rollouts=num_rollouts, seed=seed, context=context, choose=choose)
    target, mask = (torch.stack(part, -1) for part in zip(*targets))
    return PursuingRollouts(rollouts, target, mask)


def closest_among_top_k(
    batch: ScenarioBatch,
    tokens: AgentTokens,
    vocabulary: Vocabulary,
    num_candidates: int,
    targets: list[tuple[Tensor, Tensor]],
) -> Choose:
    """A `choose` for one call of `simulate`.

    Args:
        batch: the scenarios that are simulated.
        tokens: of their recorded tracks.
        vocabulary: the policy's.
        num_candidates: K.
        targets: receives, decision by decision, the nearest token of all [B, N, A] and whether the next state was recorded.
    """
    class_id = class_of_type(batch.object_type)[:, None]
    steps: Iterator[int] = iter(range(HISTORY_TOKENS, tokens.logged_valid.shape[-1]))

    def choose(
        distribution: DecisionDistribution, state: Any, sampling: Sampling, noise: Tensor
    ) -> Int64[Tensor, "B N A"]:
        step = next(steps)
        goal = (tokens.logged_position[:, None, :, step], tokens.logged_heading[:, None, :, step])
        classes = class_id.expand_as(state.heading)
        recorded = tokens.logged_valid[:, None, :, step].expand_as(state.heading)
        boxes = local_boxes(goal, (state.position, state.heading), classes)
        targets.append((nearest_tokens(boxes, classes, recorded, vocabulary), recorded))
        return _closest(distribution, boxes, classes, recorded, vocabulary, num_candidates)  # type: ignore[arg-type]

    return choose


def _closest(
    distribution: TokenLogits,
    boxes: Float[Tensor, "B N A 4 2"],
    class_id: Int64[Tensor, "B N A"],
    recorded: Bool[Tensor, "B N A"],
    vocabulary: Vocabulary,
    num_candidates: int,
) -> Int64[Tensor, "B N A"]:
    """Among the most likely tokens the one with the smallest mean corner distance; the most likely one where nothing is recorded."""
    mask = distribution.mask
    best = distribution.logits.topk(min(num_candidates, distribution.logits.shape[-1]), dim=-1).indices  # [R, K]
    ends = vocabulary.end_corners()[class_id[mask][:, None], best]
    distance = (ends - boxes[mask][:, None]).norm(dim=-1).mean(-1)
    nearest = best.gather(-1, distance.argmin(-1, keepdim=True))[:, 0]
    chosen = torch.where(recorded[mask], nearest, best[:, 0])
    return torch.zeros_like(class_id).masked_scatter(mask, chosen)


def catk_loss(
    policy: TokenPolicy, batch: ScenarioBatch, pursuing: PursuingRollouts, trained: Bool[Tensor, "B A"]
) -> Float[Tensor, ""]:
    """Mean cross-entropy of the targets along CAT-K rollouts, nats; 0 where nothing counts. Differentiable, one parallel pass.

    Args:
        policy: the policy that rolled out.
        batch: the same scenarios.
        pursuing: the rollouts.
        trained: True = the agent's decisions count.
    """
    scored = policy.score(policy.encode(batch), pursuing.rollouts)
    counts = pursuing.target_mask & pursuing.rollouts.decision_mask & trained[:, None, :, None]
    losses = torch.where(counts, -scored.log_prob(pursuing.target), 0.0)
    return losses.sum() / counts.sum().clamp(min=1)
