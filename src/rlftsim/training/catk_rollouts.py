"""CAT-K rollouts and RoaD rollouts: simulations that stay near the log, with a target for each decision."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.goals.types import Goals
from rlftsim.rollout.noise import draw_noise
from rlftsim.rollout.policy import DecisionDistribution, Sampling, TokenPolicy
from rlftsim.rollout.rows import pick_rows, place_rows
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens import catk_compat
from rlftsim.tokens.agent_tokens import HISTORY_TOKENS, AgentTokens, Pose, local_boxes, tokenize_agents, tokens_towards
from rlftsim.tokens.vocabulary import Vocabulary, box_of_class, class_of_type
from rlftsim.training.config import Choice, Targets
from rlftsim.training.imitation import TargetedRollouts, TokenLogits


def roll_out_closest(
    policy: TokenPolicy,
    batch: ScenarioBatch,
    *,
    num_candidates: int = 32,
    choice: Choice = "closest",
    targets: Targets = "nearest",
    max_distance_lengths: float | None = None,
    num_rollouts: int = 1,
    seed: int = 0,
    context: Any = None,
    goals: Goals | None = None,
    catk_compat: bool = False,
) -> TargetedRollouts:
    """Simulate with CAT-K.

    Without dropout "closest" is not random: several rollouts make sense for a policy in training mode only.

    Args:
        policy: decides for every agent.
        batch: scenarios with futures.
        num_candidates: Number K of candidate tokens of each decision, at least 1.
        choice: see `Choice`.
        targets: see `Targets`.
        max_distance_lengths: see `CatkConfig`.
        num_rollouts: Number N of rollouts of each scenario.
        seed: Seed of the samples and of all other randomness in the policy.
        context: `policy.encode(batch)`, if computed already.
        goals: Goals of the agents, as in `simulate`; None = goal-free.
        catk_compat: round where the public code rounds, see `tokens.catk_compat`.

    Returns:
        The rollouts with targets, where the next logged state is valid and the present state is not too far off the
        log.
    """
    # The log in steps of one token, 0.5 s: poses and validity, [B, A, tokens].
    tokens = tokenize_agents(batch, policy.vocabulary, catk_compat=catk_compat)
    decision_targets: list[tuple[Tensor, Tensor]] = []  # target token and its mask of each decision, [B, N, A]
    # `simulate` decides in the order of time.
    steps = iter(range(HISTORY_TOKENS, tokens.logged_valid.shape[-1]))
    # K numbers for each decision of an agent in place of one, as independent of the batch as those of `simulate`
    num_draws = num_candidates if choice == "sampled" else 0
    num_decisions = tokens.logged_valid.shape[-1] - HISTORY_TOKENS
    draws = draw_noise(batch, range(num_rollouts), seed=seed, purpose="candidates", per_agent=num_decisions * num_draws)
    draw = iter(draws.unflatten(-1, (num_decisions, num_draws)).unbind(-2))  # [B, N, A, K] of each decision

    def choose(
        distribution: DecisionDistribution, state: Any, sampling: Sampling, noise: Tensor
    ) -> Int64[Tensor, "B N A"]:
        pose = state.position, state.heading
        target = _find_target(batch, tokens, next(steps), pose, policy.vocabulary, catk_compat)
        if choice == "sampled":
            noise = next(draw)
        decision = _CHOICES[choice](distribution, target, num_candidates, noise)  # type: ignore[arg-type]
        best = decision if targets == "taken" else target.best_token()
        decision_targets.append((best, target.logged_valid & target.is_near_log(max_distance_lengths)))
        return decision

    rollouts = simulate(
        policy, batch, num_rollouts=num_rollouts, seed=seed, context=context, goals=goals, choose=choose,
        may_be_nan=True,
    )  # fmt: skip
    target, mask = (torch.stack(steps, -1) for steps in zip(*decision_targets))  # [B, N, A, L]
    return TargetedRollouts(rollouts, target, mask, batch.object_type)


@dataclass(frozen=True, eq=False)
class _Target:
    """Poses of the agents in a simulation, and the logged poses of the same step and of the next."""

    pose: Pose
    logged_start: Pose
    logged_start_valid: Bool[Tensor, "B N A"]
    logged: Pose
    """Of the next step: where the decision should lead."""
    logged_valid: Bool[Tensor, "B N A"]
    class_id: Int64[Tensor, "B N A"]
    vocabulary: Vocabulary
    catk_compat: bool
    """Place the candidates in the map before distances are taken, as the public code does."""

    def best_token(self) -> Int64[Tensor, "B N A"]:
        """Token of the whole vocabulary that leads nearest to the log."""
        return tokens_towards(self.logged, self.pose, self.class_id, self.logged_valid, self.vocabulary)

    def is_near_log(self, max_lengths: float | None) -> Bool[Tensor, "B N A"]:
        """True for agents within so many lengths of the class's box from the logged position; also without a log."""
        if max_lengths is None:
            return torch.ones_like(self.logged_valid)
        length, _ = box_of_class(self.class_id)
        distance = (self.pose[0] - self.logged_start[0]).norm(dim=-1)  # [B, N, A]
        return (distance <= max_lengths * length) | ~self.logged_start_valid

    def distances(self, ids: Int64[Tensor, "R K"], mask: Bool[Tensor, "B N A"]) -> Float[Tensor, "R K"]:
        """Mean corner distances, m, between the boxes that tokens lead to and the logged boxes.

        Args:
            ids: K candidate tokens of each agent.
            mask: True = an agent among the R agents.
        """
        pick = partial(pick_rows, mask=mask, is_dense=len(ids) == mask.numel())
        class_id = pick(self.class_id)  # [R]
        ends = self.vocabulary.end_corners()[class_id[:, None], ids]  # [R, K, 4, 2], in the agents' frames
        logged, pose = ((pick(position), pick(heading)) for position, heading in (self.logged, self.pose))
        if not self.catk_compat:
            return (ends - local_boxes(logged, pose, class_id)[:, None]).norm(dim=-1).mean(-1)
        # The public code compares in the map frame, where float32 rounds coarser: another candidate may win.
        length, width = box_of_class(class_id)
        boxes = catk_compat.build_boxes(*logged, length, width)
        return (catk_compat.place_boxes(ends, *pose) - boxes[:, None]).norm(dim=-1).mean(-1)


def _find_target(
    batch: ScenarioBatch, tokens: AgentTokens, step: int, pose: Pose, vocabulary: Vocabulary, catk_compat: bool
) -> _Target:
    """Target of a decision, which leads from the token before `step` to that at `step`; `pose` is the simulation's."""

    def at(values: Tensor, step: int) -> Tensor:
        values = values[:, None, :, step]  # the log is the same for all N rollouts
        return values.expand(-1, pose[1].shape[1], *values.shape[2:])

    start, end = ((at(tokens.logged_position, k), at(tokens.logged_heading, k)) for k in (step - 1, step))
    start_valid, end_valid = at(tokens.logged_valid, step - 1), at(tokens.logged_valid, step)
    class_id = class_of_type(batch.object_type)[:, None].expand(pose[1].shape)
    return _Target(pose, start, start_valid, end, end_valid, class_id, vocabulary, catk_compat)


def _take_closest(distribution: TokenLogits, target: _Target, count: int, noise: Tensor) -> Int64[Tensor, "B N A"]:
    logits, mask = distribution.logits, distribution.mask  # [R, V], [B, N, A]
    likely = logits.topk(min(count, logits.shape[-1]), dim=-1).indices  # [R, K]
    nearest = target.distances(likely, mask).argmin(-1, keepdim=True)
    # topk sorts, so the first candidate is the most likely token.
    is_logged = pick_rows(target.logged_valid, mask, is_dense=len(logits) == mask.numel())
    return place_rows(torch.where(is_logged, likely.gather(-1, nearest)[:, 0], likely[:, 0]), mask)


def _draw_likely(distribution: Any, target: _Target, count: int, noise: Tensor) -> Int64[Tensor, "B N A"]:
    return distribution.sample(Sampling(top_k=count), noise)


def _draw_neighbor(distribution: Any, target: _Target, count: int, noise: Tensor) -> Int64[Tensor, "B N A"]:
    logits, mask = distribution.logits, distribution.mask  # [R, V], [B, N, A]
    ids = torch.arange(logits.shape[-1], device=logits.device).expand_as(logits)
    # a class may have fewer tokens than the table has rows
    exists = target.vocabulary.token_mask[pick_rows(target.class_id, mask, is_dense=len(logits) == mask.numel())]
    neighbors = target.distances(ids, mask).masked_fill(~exists, torch.inf)
    neighbors = neighbors.topk(min(count, logits.shape[-1]), dim=-1, largest=False).indices  # [R, K]
    is_candidate = torch.zeros_like(logits, dtype=torch.bool).scatter(-1, neighbors, True)
    # -inf removes a token from the softmax; the others keep their relative probabilities.
    neighbor = replace(distribution, logits=logits.masked_fill(~is_candidate, -torch.inf)).sample(Sampling(), noise)
    return torch.where(target.logged_valid, neighbor, _draw_likely(distribution, target, count, noise))


def _take_nearest_sample(
    distribution: TokenLogits, target: _Target, count: int, noise: Tensor
) -> Int64[Tensor, "B N A"]:
    logits, mask = distribution.logits, distribution.mask  # [R, V], [B, N, A]
    cumulative = logits.softmax(-1).cumsum(-1)  # [R, V]
    # Its last entry is 1 up to rounding: scaled by it, no number lies beyond the last token.
    ids = torch.searchsorted(cumulative, noise[mask] * cumulative[:, -1:], right=True)  # [R, K]
    ids = ids.clamp(max=logits.shape[-1] - 1)
    nearest = target.distances(ids, mask).argmin(-1, keepdim=True)
    decision = torch.where(target.logged_valid[mask], ids.gather(-1, nearest)[:, 0], ids[:, 0])
    return torch.zeros_like(target.class_id).masked_scatter(mask, decision)


_CHOICES = {
    "closest": _take_closest, "top_k": _draw_likely, "trajeglish": _draw_neighbor, "sampled": _take_nearest_sample,
}  # fmt: skip
