"""A test of any policy against the contract of `rollout.policy`.

    report = check_policy(my_policy, scenarios)
    print(report)

Hand over scenarios with several kinds of agents, a map and, if possible, traffic lights: a violated rule shows only
where the rule applies.
"""

import copy
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from rlftsim.errors import DataError, RlftsimError
from rlftsim.geometry import rotate, wrap_angle
from rlftsim.goals.types import Goals
from rlftsim.rollout import edge_scenes
from rlftsim.rollout.contract import (
    CheckReport,
    CheckResult,
    RuleBroken,
    RuleNotApplicable,
    check_gap,
    check_limit,
    check_rules,
    check_worst,
    compute_gap,
)
from rlftsim.rollout.noise import draw_noise
from rlftsim.rollout.policy import (
    DecisionDistribution,
    Policy,
    Sampling,
    compute_statistics,
    encode_like,
    get_device,
    score_with_reference,
)
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S, Scenario

NUM_ROLLOUTS = 3
SEED = 0
SCORE_TOLERANCE = 1e-4
"""Nats, between sampled and scored log-probabilities."""
PADDING_TOLERANCE = 1e-5
ROUNDING = 1e-6
"""Error of a continuous decision: float32 after some tens of layers."""
POSE_TOLERANCE_M = 1e-3
MONTE_CARLO_DRAWS = 4096
MONTE_CARLO_ERRORS = 5.0
"""Standard errors that a Monte Carlo mean may be off."""
LEAD_TURN_RATE_RADPS = 0.2
SHIFT_M = (137.0, -52.0)


def check_policy(policy: Policy, scenarios: Sequence[Scenario], *, reference: Policy | None = None) -> CheckReport:
    """Try every rule of the policy contract that applies.

    The policy is left as before: a module is copied and put into evaluation mode. Takes seconds for a small policy.

    Args:
        policy: Policy of any architecture, with or without weights.
        scenarios: Scenarios that the rules are tried on, at least one; best of different sizes, with agents of all
            classes.
        reference: Policy of the same architecture for KL divergences; None = a copy with perturbed weights.

    Returns:
        A result per rule. A rule with an error in the check counts as failed, with the error as detail. A policy that
        cannot be simulated fails at that alone.
    """
    rules, name = Rules(_copy_for_evaluation(policy), tuple(scenarios), reference), type(policy).__name__
    with suppress(Exception):  # any other error is told by each rule
        try:
            _ = rules.rollouts
        except DataError as error:  # which every rule would repeat
            return CheckReport(name, (CheckResult("can be simulated", "failed", str(error)),))
    return check_rules(rules, name)


def _copy_for_evaluation(policy: Policy) -> Policy:
    return copy.deepcopy(policy).eval() if isinstance(policy, nn.Module) else policy


@dataclass(frozen=True, eq=False)
class _Subject:
    """A policy, scenarios to test with, and rollouts that several rules share."""

    policy: Policy
    scenarios: tuple[Scenario, ...]
    custom_reference: Policy | None

    @cached_property
    def batch(self) -> ScenarioBatch:
        return self.collate(self.scenarios)

    @cached_property
    def smallest_batch(self) -> ScenarioBatch:
        return self.collate([min(self.scenarios, key=lambda s: len(s.simulated_indices))])

    @cached_property
    def rollouts(self) -> Rollouts:
        return self.simulate(self.batch)

    @cached_property
    def with_forced(self) -> Rollouts:
        """Rollouts in which some agents are forced along arcs for a while."""
        return self.simulate(self.batch, force=_lead_agents(self.batch, self.policy.steps_per_decision))

    @cached_property
    def with_goals(self) -> Rollouts:
        """Rollouts in which some agents have goals."""
        batch = self.batch
        index = torch.arange(batch.agent_mask.shape[1], device=batch.device)
        shift = torch.tensor([20.0, 5.0], device=batch.device)
        goals = Goals.of_scenarios(batch.position[:, :, CURRENT_STEP] + shift, batch.agent_mask & (index % 2 == 0))
        return self.simulate(batch, goals=goals)

    @cached_property
    def rounding(self) -> float:
        """Nats that log-probabilities change by when continuous decisions move by `ROUNDING`; 0 for categories.

        Of a Gaussian with a standard deviation of 0.002, rounding of the mean is worth more than the tolerances of
        scores that are computed along different ways.
        """
        rollouts = self.rollouts
        if not rollouts.decision.is_floating_point():
            return 0.0
        dist = self.score(self.batch, rollouts)
        change = dist.log_prob(rollouts.decision + ROUNDING) - dist.log_prob(rollouts.decision)
        return float(change[rollouts.decision_mask].abs().max())

    @property
    def module(self) -> nn.Module:
        if not isinstance(self.policy, nn.Module) or not any(True for _ in self.policy.parameters()):
            raise RuleNotApplicable("the policy has no weights")
        return self.policy

    def copy_module(self, is_trained: bool) -> Policy:
        module = copy.deepcopy(self.module).requires_grad_(is_trained)
        assert isinstance(module, Policy)
        return module

    @property
    def is_random(self) -> bool:
        return self.policy.noise_size > 0

    @cached_property
    def reference(self) -> Policy:
        """A different policy of the same architecture."""
        if self.custom_reference is not None:
            return _copy_for_evaluation(self.custom_reference)
        perturbed = copy.deepcopy(self.module)
        generator = torch.Generator().manual_seed(1)
        with torch.no_grad():
            for weight in perturbed.parameters():
                noise = torch.randn(weight.shape, generator=generator).to(weight)
                # relative to the weights' size, so that a policy of any scale changes visibly but stays finite
                weight.add_(0.1 * noise * (weight.abs().mean() + 0.01))
        assert isinstance(perturbed, Policy)
        return perturbed

    def collate(self, scenarios: Sequence[Scenario], max_agents: int | None = None) -> ScenarioBatch:
        return collate(scenarios, max_agents=max_agents).to(get_device(self.policy))

    def simulate(self, batch: ScenarioBatch, num_rollouts: int | range = NUM_ROLLOUTS, **options) -> Rollouts:
        return simulate(self.policy, batch, num_rollouts=num_rollouts, seed=SEED, **options)

    def score(self, batch: ScenarioBatch, rollouts: Rollouts, policy: Policy | None = None) -> DecisionDistribution:
        policy = self.policy if policy is None else policy
        with torch.no_grad():
            return policy.score(policy.encode(batch), rollouts)

    def log_prob(self, batch: ScenarioBatch, rollouts: Rollouts, policy: Policy | None = None) -> Tensor:
        """Scored log-probabilities [B, N, A, L], 0 where the policy did not decide.

        Args:
            batch: Scenarios of the rollouts, in the same order.
            rollouts: Rollouts whose decisions are scored.
            policy: Policy that scores; None = the policy under test.
        """
        scored = self.score(batch, rollouts, policy).log_prob(rollouts.decision)
        return torch.where(rollouts.decision_mask, scored, 0.0)


def _lead_agents(batch: ScenarioBatch, stride: int) -> Callable[[object, int], AgentStates]:
    """A `force` along arcs: of the first agent throughout, of every third from the second on for two seconds."""
    states = (batch.position, batch.velocity, batch.heading)
    position, velocity, heading = (values[:, :, CURRENT_STEP] for values in states)
    index = torch.arange(batch.agent_mask.shape[1], device=batch.device)

    def force(state: object, step: int) -> AgentStates:
        time = torch.arange(step + 1, step + stride + 1, device=batch.device) * STEP_S
        turn = LEAD_TURN_RATE_RADPS * time
        # constant speed along a chord of the arc
        offset = rotate(velocity[:, :, None] * time[:, None], (turn / 2).expand(*heading.shape, stride))
        # On the grid of `place_on_grid`, so that these poses can be turned without rounding.
        path = ((position[:, :, None] + offset) / edge_scenes.GRID_M).round() * edge_scenes.GRID_M
        led = batch.agent_mask & ((index == 0) | ((index % 3 == 1) & (step < 20)))
        shape = (-1, NUM_ROLLOUTS, -1, stride)
        return AgentStates(
            path[:, None].expand(*shape, 2),
            wrap_angle(heading[:, :, None] + turn)[:, None].expand(shape),
            led[:, None, :, None].expand(shape),
        )

    return force


def _move_rollouts(rollouts: Rollouts, turn: float, offset: Tensor) -> Rollouts:
    def moved(position: Tensor) -> Tensor:
        # In float64, rounded once at the end.
        angle = torch.full(position.shape[:-1], turn, dtype=torch.float64, device=position.device)
        return (rotate(position.double(), angle) + offset.view(-1, *[1] * (position.dim() - 2), 2)).to(position.dtype)

    forced, goals = rollouts.forced, rollouts.goals
    if forced is not None:
        forced = AgentStates(moved(forced.position), wrap_angle(forced.heading + turn), forced.valid)
    return replace(
        rollouts,
        position=moved(rollouts.position),
        heading=wrap_angle(rollouts.heading + turn),
        forced=forced,
        goals=goals and replace(goals, position=moved(goals.position)),
    )


class Rules(_Subject):
    """The contract: a public method for each rule.

    A rule returns the measurement as a text, or raises `RuleBroken` or `RuleNotApplicable`.
    """

    def _check_scores(self, rollouts: Rollouts) -> str:
        """Text of the largest difference between scored and sampled log-probabilities; `RuleBroken` if too large."""
        return check_gap(self.log_prob(self.batch, rollouts), rollouts.log_prob, SCORE_TOLERANCE)

    # ---- rules: scores ----------------------------------------------------------------------------------------------

    def scored_log_probs_equal_sampled_ones(self) -> str:
        """Scored log-probabilities equal sampled log-probabilities."""
        return self._check_scores(self.rollouts)

    def scored_log_probs_equal_sampled_ones_with_forced_agents(self) -> str:
        """Scored log-probabilities equal sampled log-probabilities where agents are forced for a while."""
        rollouts = self.with_forced
        assert rollouts.forced is not None
        offset = (rollouts.position - rollouts.forced.position)[rollouts.forced.valid]
        check_limit(float(offset.abs().max()), 0.0, "distance of forced agents from their imposed positions (m)")
        return self._check_scores(rollouts)

    def scored_log_probs_equal_sampled_ones_with_goals(self) -> str:
        """Scored log-probabilities equal sampled log-probabilities where agents have goals."""
        return self._check_scores(self.with_goals)

    def empty_goals_equal_no_goals(self) -> str:
        """Goals that no agent has (mask False, position NaN) change neither rollouts nor scores."""
        position = torch.full_like(self.batch.position[:, :, CURRENT_STEP], math.nan)
        empty = Goals.of_scenarios(position, torch.zeros_like(self.batch.agent_mask))
        rollouts = self.simulate(self.batch, goals=empty)
        check_gap(rollouts.position, self.rollouts.position, 0.0, "rollouts apart (m)")
        return self._check_scores(rollouts)

    def scores_of_slices_equal_slices_of_scores(self) -> str:
        """Scores do not depend on which rollouts are scored together."""
        gaps = []
        for rollouts in (self.rollouts, self.with_forced, self.with_goals):
            scored = self.log_prob(self.batch, rollouts)
            for selected in (slice(0, 1), slice(1, NUM_ROLLOUTS)):
                gaps.append(compute_gap(self.log_prob(self.batch, rollouts.select(selected)), scored[:, selected]))
        return check_limit(max(gaps), SCORE_TOLERANCE)

    # ---- rules: the distribution ------------------------------------------------------------------------------------

    def kl_from_itself_is_zero(self) -> str:
        """The KL divergence of a policy from itself is 0."""
        scored = self.score(self.batch, self.rollouts)
        return check_limit(float(scored.kl(scored).detach().abs().max()), 1e-6, "largest KL")

    def kl_from_another_policy_is_positive(self) -> str:
        """The KL divergence from a second policy is not negative, and somewhere positive."""
        reference = self.reference
        scored = self.score(self.batch, self.rollouts)
        kl = scored.kl(self.score(self.batch, self.rollouts, reference)).detach()
        if self.is_random and not float(kl.max()) > 0:
            raise RuleBroken("the KL from another policy is 0 everywhere")
        return check_limit(-float(kl.min()), 1e-6, "most negative KL: minus")

    def padding_has_zero_log_prob_kl_and_entropy(self) -> str:
        """Padding has log-probability, KL and entropy of exactly 0."""
        width = self.batch.agent_mask.shape[1] + 2
        batch = self.collate(self.scenarios, max_agents=width)
        rollouts = self.simulate(batch)
        scored = self.score(batch, rollouts)
        # two more agents than there are: even the largest scenario has padding
        padding = ~batch.agent_mask[:, None, :, None].expand(rollouts.log_prob.shape)
        values = (scored.log_prob(rollouts.decision), scored.kl(scored), scored.entropy())
        return check_limit(max(float(v[padding].detach().abs().max()) for v in values), 0.0, "largest value")

    def entropy_matches_monte_carlo(self) -> str:
        """The entropy is the mean of minus the log-probability of draws."""
        distribution, _, log_prob = self._draw_decisions()
        return self._check_means(-log_prob, distribution.entropy()[0])

    def kl_matches_monte_carlo(self) -> str:
        """The KL divergence from a second policy is the mean log-ratio of draws."""
        distribution, decisions, log_prob = self._draw_decisions()
        if not getattr(self.policy, "sampling", Sampling()).is_full:
            raise RuleNotApplicable("the model excludes decisions, and the KL is over those that are left")
        reference = self._decide_first(self.reference)
        # KL(p || q) is the mean of log p - log q over draws from p
        ratio = torch.stack([log_p - reference.log_prob(d)[0] for log_p, d in zip(log_prob, decisions)])
        return self._check_means(ratio, distribution.kl(reference)[0])

    def probabilities_sum_to_one(self) -> str:
        """Probabilities add up to 1 (as importance weights of draws at temperature 1.5)."""
        distribution, decisions, log_prob = self._draw_decisions(temperature=1.5)
        # the mean of p / p_warm over draws from p_warm is the sum of p over all decisions that p_warm can draw
        log_p = torch.stack([distribution.log_prob(d)[0] for d in decisions])
        weight = (log_p - log_prob).exp()
        return self._check_means(weight, torch.ones_like(weight[0]))

    def _decide_first(self, policy: Policy, num_rollouts: int = 64) -> DecisionDistribution:
        """Distributions of the first decision in the smallest scenario, for N equal rollouts [1, N, A]."""
        batch = self.smallest_batch
        shape = (1, num_rollouts, batch.agent_mask.shape[1], policy.initial_noise_size)
        noise = torch.full(shape, 0.5, device=batch.device)
        with torch.no_grad():
            context = policy.encode(batch)
            return policy.decide(context, policy.begin(context, num_rollouts, None, noise))

    def _check_means(self, draws: Tensor, expected: Tensor) -> str:
        """Text of how far Monte Carlo means of draws [K, N, A] lie from values [N, A]; `RuleBroken` if too far."""
        # agents differ, rollouts are equal: draws and rollouts together are one sample per agent
        mask = self.smallest_batch.agent_mask[0]
        flat = draws.double().flatten(0, 1)[:, mask]  # [K N, agents]
        error = flat.std(0) / math.sqrt(len(flat)) + 1e-6
        gap = (flat.mean(0) - expected.double().mean(0)[mask]).abs() / error
        return check_limit(float(gap.max()), MONTE_CARLO_ERRORS, f"standard errors off, over {len(flat)} draws:")

    def _draw_decisions(self, temperature: float = 1.0) -> tuple[DecisionDistribution, list[Tensor], Tensor]:
        """Many draws of the first decision of the smallest scenario.

        Args:
            temperature: Temperature of the draws; 1 draws from the untempered distribution.

        Returns:
            Distribution [1, N, A], K draws of it, and their log-probabilities [K, N, A] under the distribution that
            was drawn from.
        """
        if not self.is_random:
            raise RuleNotApplicable("decisions are deterministic (noise_size is 0)")
        distribution, sampling = self._decide_first(self.policy), Sampling(temperature=temperature)
        mask = self.smallest_batch.agent_mask[0]
        generator = torch.Generator().manual_seed(0)
        decisions = []
        for _ in range(MONTE_CARLO_DRAWS // 64):
            noise = torch.rand(1, 64, len(mask), self.policy.noise_size, generator=generator).to(mask.device)
            decisions.append(distribution.sample(sampling, noise))
        log_prob = torch.stack([distribution.log_prob(d, sampling)[0] for d in decisions])
        return distribution, decisions, log_prob

    # ---- rules: sampling and kinematics -----------------------------------------------------------------------------

    def temperature_zero_is_deterministic(self) -> str:
        """At temperature 0 every rollout is the same, twice, up to the draws made once per rollout."""
        first, second = (self.simulate(self.batch, sampling=Sampling(temperature=0.0)) for _ in range(2))
        if not self.policy.initial_noise_size:
            repeated = first.position[:, :1].expand_as(first.position)
            check_gap(first.position, repeated, POSE_TOLERANCE_M, "rollouts apart (m)")
        return check_gap(first.position, second.position, 0.0, "runs apart (m)")

    def same_seed_gives_same_rollouts(self) -> str:
        """The same seed gives the same rollouts, whole or in slices."""
        repeated = self.simulate(self.batch)
        check_gap(repeated.position, self.rollouts.position, 0.0, "runs apart (m)")
        last = self.simulate(self.batch, range(1, NUM_ROLLOUTS))
        return check_gap(last.position, self.rollouts.position[:, 1:], POSE_TOLERANCE_M, "slices apart (m)")

    def top_k_truncates_or_is_refused(self) -> str:
        """Top-k keeps the most likely decisions, or is refused where there are no categories."""
        if self.rollouts.decision.is_floating_point():
            try:
                self.simulate(self.batch, sampling=Sampling(top_k=3))
            except RlftsimError as error:
                return f"refused: {error}"
            raise RuleBroken("decisions are not categorical, and yet top_k=3 is accepted")
        # top-1 is the mode; and log-probabilities are those of the truncated, renormalized distribution
        greedy = self.simulate(self.batch, sampling=Sampling(temperature=0.0))
        first = self.simulate(self.batch, sampling=Sampling(top_k=1))
        check_gap(first.position, greedy.position, POSE_TOLERANCE_M, "top-1 apart from the mode (m)")
        truncated = self.simulate(self.batch, sampling=Sampling(top_k=3))
        scored = self.score(self.batch, truncated).log_prob(truncated.decision, Sampling(top_k=3))
        scored = torch.where(truncated.decision_mask, scored, 0.0)
        return check_gap(scored, truncated.log_prob, SCORE_TOLERANCE, "largest gap of truncated log-probabilities")

    def replayed_decisions_give_same_poses(self) -> str:
        """Replaying decisions through `advance` gives the same poses, bit for bit."""
        gaps = [self._measure_replay_gap(rollouts) for rollouts in (self.rollouts, self.with_forced)]
        return check_limit(max(gaps), 0.0, "largest gap (m, rad)")

    def _measure_replay_gap(self, rollouts: Rollouts) -> float:
        policy, stride = self.policy, self.policy.steps_per_decision
        # The numbers that `simulate` gave to `begin`. Those of the decisions are not needed: the decisions are known.
        ids = range(rollouts.num_rollouts)
        size = policy.initial_noise_size
        noise = draw_noise(self.batch, ids, seed=SEED, purpose="begin", per_agent=size)  # [B, N, A, size]
        poses = []
        with torch.no_grad():
            context = policy.encode(self.batch)
            state = policy.begin(context, rollouts.num_rollouts, rollouts.goals, noise)
            for index in range(FUTURE_STEPS // stride):
                forced = rollouts.forced and rollouts.forced.steps(index * stride, (index + 1) * stride)
                state = policy.advance(context, state, rollouts.decision[:, :, :, index], forced)
                poses.append(state.poses)
        path = torch.cat(poses, 3)
        return max(compute_gap(path[..., :2], rollouts.position), compute_gap(path[..., 2], rollouts.heading))

    # ---- rules: gradients -------------------------------------------------------------------------------------------

    def gradients_reach_all_trained_weights(self) -> str:
        """Gradients of the score reach the trained weights and no frozen weights, and are finite."""
        weights = self._back_propagate(scale=1.0)
        gradients = {name: p.grad for name, p in weights.items() if p.grad is not None}
        # a gradient may be zero (no light in these scenarios), but never absent
        trained = [name for name, p in weights.items() if p.requires_grad]
        missing = [name for name in trained if name not in gradients]
        strays = [name for name in gradients if not weights[name].requires_grad]
        broken = [name for name, gradient in gradients.items() if not gradient.isfinite().all()]
        if missing or strays or broken:
            raise RuleBroken(f"not reached: {missing}; reached though not trained: {strays}; not finite: {broken}")
        flat = [name for name, gradient in gradients.items() if not gradient.any()]
        return f"{len(trained)} weights reached" + (f", zero on these scenarios: {', '.join(flat)}" if flat else "")

    def zero_reward_gives_zero_gradient(self) -> str:
        """With a reward of 0 the policy gradient is exactly 0."""
        gradients = [weight.grad for weight in self._back_propagate(scale=0.0).values() if weight.grad is not None]
        largest = max(compute_gap(gradient, torch.zeros_like(gradient)) for gradient in gradients)
        return check_limit(largest, 0.0, "largest gradient")

    def _back_propagate(self, *, scale: float) -> dict[str, nn.Parameter]:
        """Weights with gradients of a policy-gradient loss, with rewards of `scale` times 1, 2, ... by rollout."""
        module = copy.deepcopy(self.module)
        if not any(weight.requires_grad for weight in module.parameters()):
            raise RuleNotApplicable("no weight is trained")
        assert isinstance(module, Policy)
        module.zero_grad(set_to_none=True)
        rollouts = self.with_goals  # so that weights for goals take part
        scored = module.score(module.encode(self.batch), rollouts).log_prob(rollouts.decision)
        reward = scale * torch.arange(1.0, NUM_ROLLOUTS + 1, device=scored.device)[None, :, None, None]
        (-reward * torch.where(rollouts.decision_mask, scored, 0.0)).sum().backward()
        return dict(module.named_parameters())

    def freezing_weights_changes_no_score(self) -> str:
        """Freezing the weights changes no score."""
        policies = [self.copy_module(is_trained) for is_trained in (False, True)]
        frozen, trained = (self.log_prob(self.batch, self.rollouts, policy) for policy in policies)
        return check_gap(frozen, trained, SCORE_TOLERANCE)

    def shared_passes_change_no_number(self) -> str:
        """Passes that share features, and statistics in one pass, give the numbers of separate passes."""
        frozen = self.copy_module(is_trained=False)
        twin, gaps = copy.deepcopy(frozen), []
        for rollouts in (self.rollouts, self.with_goals):
            expected, decision = self.score(self.batch, rollouts, frozen), rollouts.decision
            for reference in (twin, self.reference):
                with torch.no_grad():
                    context = frozen.encode(self.batch)
                    contexts = [encode_like(policy, self.batch, context) for policy in (frozen, reference)]
                    dist, ref = score_with_reference(frozen, contexts[0], rollouts, reference, contexts[1], rollouts)
                    statistics = compute_statistics(dist, decision, ref)
                kl = expected.kl(self.score(self.batch, rollouts, reference))
                values = (expected.log_prob(decision), kl, expected.entropy())
                gaps += map(compute_gap, (statistics.log_prob, statistics.kl, statistics.entropy), values)
        return check_limit(max(gaps), SCORE_TOLERANCE)

    # ---- rules: scenarios -------------------------------------------------------------------------------------------

    def scores_are_invariant_to_rotation_and_translation(self) -> str:
        """Scenarios and rollouts turned and shifted together have the same scores."""
        gaps = {}
        # on a grid that stays exact under the turns below: gaps are then the policy's rounding
        still = replace(self, scenarios=tuple(edge_scenes.place_on_grid(s) for s in self.scenarios))
        turns = {"shifted": 0.0, "turned by 90 degrees": math.pi / 2}
        turns["turned by 53.13 degrees"] = edge_scenes.EXACT_TURN_RAD
        unmoved = [(r, self.log_prob(still.batch, r)) for r in (still.rollouts, still.with_forced, still.with_goals)]
        for name, turn in turns.items():
            moved = [edge_scenes.move_scenario(s, turn, SHIFT_M) for s in still.scenarios]
            batch = self.collate(moved)
            # origins of map frames lie on whole meters, so no origin follows a scenario exactly
            origins = [a.origin + np.array(SHIFT_M) - b.origin for a, b in zip(still.scenarios, moved)]
            offset = torch.from_numpy(np.stack(origins).astype(np.float32)).to(get_device(self.policy))  # [B, 2]
            for rollouts, expected in unmoved:
                scored = self.log_prob(batch, _move_rollouts(rollouts, turn, offset))
                gaps[name] = max(gaps.get(name, 0.0), compute_gap(scored, expected))
        return check_worst(gaps, SCORE_TOLERANCE + self.rounding, "largest gap")

    def rollouts_are_independent_of_batch_composition(self) -> str:
        """A scenario alone has the same scores as in a batch with a larger scenario, and the same rollouts."""
        batch, gaps, distances = self.batch, [], []
        if len(self.scenarios) < 2:
            raise RuleNotApplicable("a single scenario was handed over")
        # a policy that draws once per rollout gets as many agents as in the batch: its draws have that shape
        scored = self.log_prob(batch, self.rollouts)
        for b, scenario in enumerate(self.scenarios):
            count = batch.agent_mask.shape[1] if self.rollouts.draws is not None else len(scenario.simulated_indices)
            single = self.collate([scenario], max_agents=count)
            rollouts = self.rollouts.select_scenario(b, count)
            gaps.append(compute_gap(self.log_prob(single, rollouts), scored[b : b + 1, :, :count]))
            distances.append(compute_gap(self.simulate(single).position, rollouts.position))
        check_limit(max(distances), POSE_TOLERANCE_M, "rollouts apart (m)")
        return check_limit(max(gaps), PADDING_TOLERANCE + self.rounding)

    def rollouts_do_not_depend_on_the_logged_future(self) -> str:
        """The rollouts are the same where tracks and lights end at the current step, as in a test split."""
        if not all(scenario.has_future for scenario in self.scenarios):
            raise RuleNotApplicable("a scenario has no logged future")
        batch = self.collate([edge_scenes.without_future(scenario) for scenario in self.scenarios])
        return check_gap(self.simulate(batch).position, self.rollouts.position, POSE_TOLERANCE_M, "apart (m)")

    def edge_cases_can_be_simulated_and_scored(self) -> str:
        """Simulations and scores succeed: one agent, 128, no map, no lights, agents first seen now or never, NaN."""
        gaps = {}
        for name, scenario in edge_scenes.edge_scenes(self.scenarios[0]).items():
            batch = self.collate([scenario])
            rollouts = self.simulate(batch)
            if not (rollouts.position.isfinite().all() and rollouts.heading.isfinite().all()):
                raise RuleBroken(f"{name}: poses are not finite")
            gaps[name] = compute_gap(self.log_prob(batch, rollouts), rollouts.log_prob)
        return check_worst(gaps, SCORE_TOLERANCE, f"{len(gaps)} scenes, largest gap")
