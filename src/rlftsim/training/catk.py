"""CAT-K ("closest among top-K"): rollouts that keep near the record, and the loss along them.

In a CAT-K rollout each agent takes, among its K most likely tokens, the one that leads nearest to where it was recorded next;
where nothing was recorded, its most likely token. The loss is the cross-entropy of the token that leads nearest of all, seen from
where the rollout has led.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.rollout.policy import DecisionDistribution, Policy, Sampling
from rlftsim.rollout.simulate import Choose, simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens import public_order
from rlftsim.tokens.agent_tokens import (
    HISTORY_TOKENS,
    AgentTokens,
    Pose,
    local_boxes,
    tokenize_agents,
    tokens_towards,
)
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, Vocabulary, class_of_type

DEFAULT_NUM_CANDIDATES = 32


@runtime_checkable
class TokenPolicy(Policy, Protocol):
    """A policy whose decisions are tokens of a vocabulary."""

    vocabulary: Vocabulary


@runtime_checkable
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
    public_order_of_operations: bool = False,
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
        public_order_of_operations: round where the public code rounds, see `tokens.public_order`.

    Raises:
        ConfigError: no candidates.
    """
    if num_candidates < 1:
        raise ConfigError(f"num_candidates must be at least 1, got {num_candidates}.")
    tokens = tokenize_agents(batch, policy.vocabulary, public_order_of_operations=public_order_of_operations)
    targets: list[tuple[Tensor, Tensor]] = []
    choose = closest_among_top_k(
        batch, tokens, policy.vocabulary, num_candidates, targets, distances_where_placed=public_order_of_operations
    )
    rollouts = simulate(policy, batch, num_rollouts=num_rollouts, seed=seed, context=context, choose=choose)
    target, mask = (torch.stack(part, -1) for part in zip(*targets))
    return PursuingRollouts(rollouts, target, mask)


def closest_among_top_k(
    batch: ScenarioBatch,
    tokens: AgentTokens,
    vocabulary: Vocabulary,
    num_candidates: int,
    targets: list[tuple[Tensor, Tensor]],
    *,
    distances_where_placed: bool = False,
) -> Choose:
    """A `choose` for one call of `simulate`.

    Args:
        batch: the scenarios that are simulated.
        tokens: of their recorded tracks.
        vocabulary: the policy's.
        num_candidates: K.
        targets: receives, decision by decision, the nearest token of all [B, N, A] and whether the next state was recorded.
        distances_where_placed: place the candidates before distances are taken, as the public code does.
    """
    steps: Iterator[int] = iter(range(HISTORY_TOKENS, tokens.logged_valid.shape[-1]))
    distances = _distances_where_placed if distances_where_placed else _distances_in_local_frame

    def choose(
        distribution: DecisionDistribution, state: Any, sampling: Sampling, noise: Tensor
    ) -> Int64[Tensor, "B N A"]:
        step = next(steps)
        pose = (state.position, state.heading)
        goal = (
            tokens.logged_position[:, None, :, step].expand_as(state.position),
            tokens.logged_heading[:, None, :, step].expand_as(state.heading),
        )
        class_id = class_of_type(batch.object_type)[:, None].expand_as(state.heading)
        recorded = tokens.logged_valid[:, None, :, step].expand_as(state.heading)
        targets.append((tokens_towards(goal, pose, class_id, recorded, vocabulary), recorded))
        best, mask = _most_likely(distribution, num_candidates)  # type: ignore[arg-type]
        ends = vocabulary.end_corners()[class_id[mask][:, None], best]
        goal, pose = ((position[mask], heading[mask]) for position, heading in (goal, pose))
        nearest = distances(ends, goal, pose, class_id[mask]).argmin(-1, keepdim=True)
        chosen = torch.where(recorded[mask], best.gather(-1, nearest)[:, 0], best[:, 0])
        return torch.zeros_like(class_id).masked_scatter(mask, chosen)

    return choose


def _most_likely(distribution: TokenLogits, num_candidates: int) -> tuple[Int64[Tensor, "R K"], Bool[Tensor, "B N A"]]:
    """Token ids of the agents that decide, the most likely one first; who decides."""
    count = min(num_candidates, distribution.logits.shape[-1])
    return distribution.logits.topk(count, dim=-1).indices, distribution.mask


def _distances_in_local_frame(
    ends: Float[Tensor, "R K 4 2"], goal: Pose, pose: Pose, class_id: Int64[Tensor, "R"]
) -> Float[Tensor, "R K"]:
    """Mean corner distances from tokens' end boxes to the box at a goal pose."""
    return (ends - local_boxes(goal, pose, class_id)[:, None]).norm(dim=-1).mean(-1)


def _distances_where_placed(
    ends: Float[Tensor, "R K 4 2"], goal: Pose, pose: Pose, class_id: Int64[Tensor, "R"]
) -> Float[Tensor, "R K"]:
    """As `_distances_in_local_frame`, in the public code's order of operations."""
    length, width = torch.tensor(CLASS_BOXES_M, device=class_id.device)[class_id].unbind(-1)
    aim = public_order.boxes_around(*goal, length, width)
    return (public_order.place_boxes(ends, *pose) - aim[:, None]).norm(dim=-1).mean(-1)


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
