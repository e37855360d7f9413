"""SMART as a policy: every agent chooses a motion token of half a second, sixteen times.

The five methods of `rollout.policy.Policy`, with their contexts and states, and pre-training; `SmartModel` has weights
and files.

B scenarios, N rollouts, A agents, L decisions, K token steps, D width, R selected elements, V tokens.
"""

from collections import deque
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.goals.types import Goals
from rlftsim.policies.distributions import CategoricalDistribution, TokenDistribution
from rlftsim.policies.smart.attention import AttentionMaps
from rlftsim.policies.smart.goal_conditioning import NUM_DECISIONS, EncodedGoals, encode_goals
from rlftsim.policies.smart.model import SmartModel
from rlftsim.policies.smart.neighbors import Poses
from rlftsim.policies.smart.network import Past, Scene, View
from rlftsim.policies.smart.token_steps import TokenSteps, apply_decisions, begin_elsewhere, replay_decisions
from rlftsim.rollout.policy import DecisionDistribution, Prediction
from rlftsim.rollout.rows import pick_rows, place_rows
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens.agent_tokens import HISTORY_TOKENS, restart_at_log
from rlftsim.tokens.vocabulary import PADDING_CLASS, STEPS_PER_TOKEN, class_of_type


@dataclass(frozen=True, eq=False)
class Context:
    """Features and geometry that do not depend on the agents' decisions, computed once per scenario."""

    scene: Scene
    history: TokenSteps
    """The two history tokens of a single rollout. The last ends at the current step, near the logged pose or at it."""
    view: View
    """Of the history."""
    past: Past
    """Of the history."""
    features: Float[Tensor, "B A D"]
    """Decoder features at the current step of goal-free agents; zeros for padding."""
    object_type: Int64[Tensor, "B A"]
    token_class: Int64[Tensor, "B A"]
    """Class that an agent's token ids refer to."""
    agent_mask: Bool[Tensor, "B A"]
    model: nn.Module
    """The model that encoded the scenario."""

    @cached_property
    def maps(self) -> tuple[AttentionMaps, ...]:
        """Maps of the decoder's attention, folded once for all decisions."""
        return self.model.network.decoder.fold()  # type: ignore[union-attr, operator]

    @property
    def is_padded(self) -> bool:
        """True off the CPU: in closed loop padding is simulated, too. The host would wait to leave padding out."""
        return self.agent_mask.device.type != "cpu"


@dataclass(eq=False)
class DecoderCache:
    """Decoder outputs of a state, filled at the first use: a memo of values that follow from the state."""

    features: Float[Tensor, "B N A D"] | None = None
    """Decoder features at the state's last step."""
    past: Past | None = None
    """The past that includes the state's last step."""


@dataclass(frozen=True, eq=False)
class State:
    """Running simulations.

    Steps that have not been through the decoder wait in `pending`, and go through the decoder at most once.
    """

    position: Float[Tensor, "B N A 2"]
    heading: Float[Tensor, "B N A"]
    past: Past
    pending: TokenSteps | None
    poses: Float[Tensor, "B N A 5 3"] | None = None
    draws: Tensor | None = None
    goals: EncodedGoals | None = None
    """None = no agent has a goal, or the model is goal-free."""
    num_decisions: int = 0
    """Decisions taken so far."""
    cache: DecoderCache = field(default_factory=DecoderCache)


class SmartPolicy(SmartModel):
    """Next-token traffic model of all agents of a scenario.

    Holds weights and a vocabulary, and no state of a simulation.
    """

    fingerprint_name = "rlftsim.policies.smart.policy.SmartPolicy"
    steps_per_decision = STEPS_PER_TOKEN
    noise_size = 1
    initial_noise_size = 0

    # ---- the policy interface -------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        # torch would print every layer
        goals = "follows goals" if self.is_goal_conditioned else "follows no goals"
        return f"{type(self).__name__}({sum(weight.numel() for weight in self.parameters()):,} weights, {goals})"

    def encode(self, scenarios: ScenarioBatch) -> Context:
        """Map features, history tokens and decoder features, for goal-free agents."""
        past = scenarios.history()  # a minute of future would have to be tokenized
        tokens = restart_at_log(self._tokenize(past), past, self.vocabulary)
        scene = self._build_scene(scenarios)
        history = self._logged_steps(tokens, slice(HISTORY_TOKENS))
        view = self.network.decoder.look(scene, history, None)
        rows, past = self.network.decoder(scene, history, None, view)
        return Context(
            scene=scene,
            history=history,
            view=view,
            past=past,
            features=place_rows(rows, history.valid)[:, 0, :, -1],
            object_type=scenarios.object_type,
            token_class=torch.where(scenarios.agent_mask, scene.class_id, PADDING_CLASS),
            agent_mask=scenarios.agent_mask,
            model=self,
        )

    def relight(self, context: Context, scenarios: ScenarioBatch) -> Context:
        """The context with other traffic lights, for decisions of rollouts that have begun.

        Args:
            context: Result of `encode` for the same scenarios.
            scenarios: Scenarios, with the step of the lights.
        """
        scene = self.network.relight(context.scene, scenarios, self.vocabulary)
        return context if scene is context.scene else replace(context, scene=scene)

    def begin(self, context: Context, num_rollouts: int, goals: Goals | None, noise: Tensor) -> State:
        """The current step, N times, without copies of the history.

        Args:
            context: Result of `encode` for the scenarios.
            num_rollouts: Number N of futures that each scenario gets.
            goals: Goals [B, N, A] of all agents, map frame; ignored by a goal-free model. None = goal-free.
            noise: Empty tensor, since the start of a simulation is not random.
        """
        current = context.history.last.repeat(num_rollouts)
        position, heading = current.position[:, :, :, 0], current.heading[:, :, :, 0]
        if goals is None or not self.is_goal_conditioned or not goals.any:
            return State(position, heading, context.past.repeat(num_rollouts), pending=None)
        # the context is goal-free: the current step goes through the decoder again, with goals; earlier steps do not
        past = context.past.without_last_step().repeat(num_rollouts)
        return State(position, heading, past, current, goals=encode_goals(goals, context.scene.map_positions))

    def decide(self, context: Context, state: State) -> TokenDistribution:
        """Distributions [B, N, A] of the next token of every agent.

        Args:
            context: Result of `encode` for the scenarios.
            state: State before the decision; the cache of the state is filled.
        """
        mask = context.agent_mask[:, None].expand(state.heading.shape)
        num_left = torch.full_like(state.heading, NUM_DECISIONS - state.num_decisions, dtype=torch.int64)
        if context.is_padded:
            mask = torch.ones_like(mask)
        features = pick_rows(self._compute_features(context, state), mask, is_dense=context.is_padded)
        dist = self._build_distribution(context, state, features, mask, Poses(state.position, state.heading), num_left)
        return TokenDistribution(dist.logits, mask, dist.sampling)

    def advance(
        self, context: Context, state: State, decision: Int64[Tensor, "B N A"], forced: AgentStates | None = None
    ) -> State:
        """State after the chosen token's five poses. The decoder is not run, the step waits in `pending`.

        Args:
            context: Result of `encode` for the scenarios.
            state: State before the decision, which stays as it is.
            decision: Id of the token that each agent takes, within the agent's class.
            forced: States [B, N, A, 5] imposed from outside; only agents with five valid states are imposed.
        """
        start, is_elsewhere = (state.position, state.heading), None
        if forced is not None:
            start, is_elsewhere = begin_elsewhere(start, forced)
        poses, decision = apply_decisions(
            decision, *start, context.object_type, self.vocabulary, forced, catk_compat=self.config.catk_compat
        )
        position, heading = poses[..., -1, :2], poses[..., -1, 2]
        block = TokenSteps(
            position=position[..., None, :],
            heading=heading[..., None],
            motion=(position - start[0])[..., None, :],
            token_id=decision[..., None],
            valid=context.agent_mask[:, None, :, None].expand(*heading.shape, 1),
        )
        past, pending = state.past, block
        # while simulating, `decide` has filled the cache, so a single step is pending; in `score` steps pile up
        if state.cache.past is not None:
            past = state.cache.past
        elif state.pending is not None:
            pending = state.pending.append(block)
        if is_elsewhere is not None:
            past = replace(past, row=torch.where(is_elsewhere[..., None], -1, past.row))
        num_decisions = state.num_decisions + 1
        return State(position, heading, past, pending, poses, goals=state.goals, num_decisions=num_decisions)

    def score(self, context: Context, rollouts: Rollouts) -> CategoricalDistribution:
        """Distributions [B, N, A, L] along rollouts: a single pass of the decoder over all steps.

        Args:
            context: Result of `encode` for the scenarios.
            rollouts: Rollouts of the same scenarios, by this policy or another.
        """
        return self._score(context, *self._replay(context, rollouts))

    def _replay(self, context: Context, rollouts: Rollouts) -> tuple[State, View | None]:
        """State before the last decision of rollouts, and a view of the steps, all pending; None = there are none.

        The decoder is not run: but for the past, no value depends on weights that fine-tuning trains.
        """
        state = deque(replay_decisions(self, context, rollouts), maxlen=1).pop()  # no earlier one stays in memory
        steps = state.pending
        return state, None if steps is None else self.network.decoder.look(context.scene, steps, state.past)

    def _score(self, context: Context, state: State, view: View | None) -> CategoricalDistribution:
        """Distributions along rollouts that have been replayed, by this model or by a model that sees alike."""
        # 1. features [B, N, A, L, D]: of the current step, from the context for goal-free agents, and of later steps
        blocks = []
        if state.goals is None:
            blocks.append(context.features[:, None, :, None].expand(*state.heading.shape, 1, -1))
        if state.pending is not None:
            past = replace(state.past, sources=context.past.sources)
            rows, _ = self.network.decoder(context.scene, state.pending, past, view, state.goals)
            blocks.append(place_rows(rows, state.pending.valid))
        features = torch.cat(blocks, 3)
        # 2. distributions of the agents; padding is left out
        mask = context.agent_mask[:, None, :, None].expand(features.shape[:4])
        num_left = (NUM_DECISIONS - torch.arange(mask.shape[3], device=mask.device)).expand(mask.shape)
        # with goals even the current step was pending
        poses = None if state.pending is None else Poses(state.pending.position, state.pending.heading)
        return self._build_distribution(context, state, features[mask], mask, poses, num_left)

    # ---- passes that share scenes and views -------------------------------------------------------------------------

    def encode_like(self, scenarios: ScenarioBatch, context: Any) -> Context:
        """`encode(scenarios)`, with scene and history taken over from a context of a model that sees alike.

        Args:
            scenarios: Scenarios that `context` was encoded from, in the same order.
            context: Context of any policy with weights that have not changed since.
        """
        if not isinstance(context, Context) or not self.sees_as(context.model):
            return self.encode(scenarios)
        rows, past = self.network.decoder(context.scene, context.history, None, context.view)
        features = place_rows(rows, context.history.valid)[:, 0, :, -1]
        return replace(context, past=past, features=features, model=self)

    def score_with_reference(
        self, context: Context, rollouts: Rollouts, reference: Any, ref_context: Any, ref_rollouts: Rollouts
    ) -> tuple[CategoricalDistribution, DecisionDistribution]:
        """Distributions along rollouts of this policy and, without gradient, of a reference.

        Both look around once if the scene is shared and the rollouts are the same.

        Args:
            context: Context of this policy for the scenarios.
            rollouts: Rollouts of the same scenarios, to score under both policies.
            reference: Policy of any architecture, whose distributions get no gradient.
            ref_context: Context of the reference for the scenarios.
            ref_rollouts: The same rollouts, maybe with other goals.
        """
        replay = self._replay(context, rollouts)
        dist = self._score(context, *replay)
        with torch.no_grad():
            is_shared = isinstance(ref_context, Context) and ref_context.scene is context.scene
            if is_shared and ref_rollouts is rollouts:
                return dist, reference._score(ref_context, *replay)
            return dist, reference.score(ref_context, ref_rollouts)

    # ---- pre-training -------------------------------------------------------------------------------------------

    def teacher_forced(self, scenarios: ScenarioBatch, trained: Bool[Tensor, "B A"]) -> Prediction:
        """Predict every next token along the logged tracks.

        Args:
            scenarios: Scenarios with the logged future, which is predicted.
            trained: True = the agent's predictions count, False = the agent is context alone.
        """
        tokens = self._tokenize(scenarios)
        steps = self._logged_steps(tokens, slice(0, -1))
        # history drop: a pair that is hidden is so for all later steps of its agent
        hidden = None
        if self.training and self.config.history_drop:
            hidden = torch.rand(steps.valid.shape, device=steps.valid.device) < self.config.history_drop
        scene = self._build_scene(scenarios)
        rows, _ = self.network.decoder(scene, steps, None, self.network.decoder.look(scene, steps, None, hidden))
        # predictions start at the current step, as in a simulation
        decides = steps.valid.clone()  # [B, 1, A, K]
        decides[..., : HISTORY_TOKENS - 1] = False
        counts = (tokens.valid[..., 1:] & trained[..., None])[:, None][decides]
        class_id = class_of_type(scenarios.object_type)
        logits = self._predict(scene, rows[decides[steps.valid]], class_id, decides).logits
        class_id = class_id[:, None, :, None].expand(decides.shape)[decides]
        return Prediction(logits, tokens.next_token_id[:, None, :, :-1][decides], counts, class_id)

    # ---- passes of the decoder and the head -----------------------------------------------------------------------

    def _compute_features(self, context: Context, state: State) -> Float[Tensor, "B N A D"]:
        """Decoder features at the state's last step, from the cache after the first call."""
        cache = state.cache
        if cache.features is None:
            decoder, past = self.network.decoder, state.past
            if state.pending is None:
                cache.features, cache.past = context.features[:, None].expand(*state.heading.shape, -1), past
            else:
                if context.is_padded or past.row.shape[-1] >= 2 * self.config.history_tokens:
                    past = past.last(self.config.history_tokens)  # no row looks farther back
                view = decoder.look(context.scene, state.pending, past, padded=context.is_padded)
                maps = None if torch.is_grad_enabled() else context.maps
                rows, cache.past = decoder(context.scene, state.pending, past, view, state.goals, maps)
                cache.features = place_rows(rows, state.pending.valid)[..., -1, :]
        return cache.features

    def _build_distribution(
        self,
        context: Context,
        state: State,
        features: Float[Tensor, "R D"],
        mask: Bool[Tensor, "*batch"],
        poses: Poses | None,
        num_left: Int64[Tensor, "*batch"],
    ) -> CategoricalDistribution:
        """Distributions of the elements of a mask, given the poses before each decision where agents have goals."""
        dist = self._predict(context.scene, features, context.token_class, mask)
        bias = self.network.decoder.aim
        if bias is None or state.goals is None or poses is None:
            return dist
        return bias.apply_to(dist, state.goals, poses, num_left, class_of_type(context.object_type), self.vocabulary)
