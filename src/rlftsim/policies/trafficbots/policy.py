"""TrafficBots as a policy: every agent chooses an acceleration and a yaw rate, eighty times.

The network gives the mean mu_t of an action u_t (before tanh). The noise around it is correlated in time:

    u_t | past ~ N(mu_t + rho (u_{t-1} - mu_{t-1}), (1 - rho^2) sigma^2),   at first N(mu_t, sigma^2)

B scenarios, N rollouts, A agents, T decisions, M map tokens.
"""

import math
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.goals.types import Goals
from rlftsim.policies.distributions import GaussianDistribution, standard_normal
from rlftsim.policies.trafficbots.config import LATENT_SIZE, TrafficBotsConfig
from rlftsim.policies.trafficbots.destinations import PEDESTRIAN
from rlftsim.policies.trafficbots.dynamics import max_action
from rlftsim.policies.trafficbots.imitation import imitation_loss
from rlftsim.policies.trafficbots.model import TrafficBotsModel
from rlftsim.policies.trafficbots.network import NUM_CLASSES, history_windows
from rlftsim.policies.trafficbots.scene import build_scene
from rlftsim.policies.trafficbots.scoring import features_over_time
from rlftsim.policies.trafficbots.state import (
    Memo,
    TrafficBotsContext,
    TrafficBotsState,
    imposed_after,
    traffic_at_start,
    whole_history,
)
from rlftsim.rollout.policy import DecisionDistribution, ImitationLoss
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import HISTORY_STEPS


class TrafficBotsPolicy(TrafficBotsModel):
    """Continuous-action traffic model of all agents of a scenario.

    It holds weights, and no state of a simulation. At temperature 0 it takes the mean action, as in the public code:
    rollouts then differ by personality and destination alone.
    """

    steps_per_decision = 1
    noise_size = 2
    initial_noise_size = LATENT_SIZE + 1
    noise_std: Tensor
    """[3, 2] exploration noise of each class, before tanh."""

    def __init__(self, config: TrafficBotsConfig):
        super().__init__(config)
        noise = torch.tensor([[config.noise_acceleration_mps2, config.noise_yaw_rate_radps]] * NUM_CLASSES)
        if config.noise_pedestrian_yaw_rate_radps is not None:
            noise[PEDESTRIAN, 1] = config.noise_pedestrian_yaw_rate_radps
        self.register_buffer("noise_std", noise / max_action(torch.arange(NUM_CLASSES)), persistent=False)

    # ---- the policy interface -------------------------------------------------------------------------------------

    def encode(self, scenarios: ScenarioBatch) -> TrafficBotsContext:
        """Features of the map, and of the lights at all decisions."""
        return self.encode_scene(build_scene(scenarios, HISTORY_STEPS, self.config.max_map_tokens))

    def begin(
        self, context: TrafficBotsContext, num_rollouts: int, goals: Goals | None, noise: Float[Tensor, "B N A 17"]
    ) -> TrafficBotsState:
        """The current step, N times, with a personality and a destination for each agent.

        Args:
            context: of `encode`.
            num_rollouts: N.
            goals: ignored.
            noise: uniform in [0, 1).
        """
        scene = context.scene
        with torch.no_grad():
            log_prob = self.network.destination_predictor(history_windows(scene), scene, context.map_features)
            cumulative = log_prob.double().exp().cumsum(-1)[:, None]  # [B, 1, A, M]
            total = cumulative[..., -1:]  # 1 up to rounding; 0 where there is no destination at all
            level = noise[..., LATENT_SIZE:].double() * total  # [B, N, A, 1]
            repeated = cumulative.expand(-1, num_rollouts, -1, -1).contiguous()
            index = torch.searchsorted(repeated, level, right=True).clamp(max=log_prob.shape[-1] - 1)
            index = torch.where(total > 0, index, -1)
            personality = standard_normal(noise[..., :LATENT_SIZE])
        return self.start(context, torch.cat([personality, index], -1).to(log_prob.dtype))

    def start(self, context: TrafficBotsContext, draws: Float[Tensor, "B N A 17"]) -> TrafficBotsState:
        """The current step, with given personalities and destinations.

        Args:
            context: of `encode`.
            draws: personality (16 numbers) and map token of the destination, -1 = none.
        """
        personality, destination = draws[..., :LATENT_SIZE], draws[..., LATENT_SIZE].long()
        given = self.network.conditioning(context.scene, context.map_features, personality, destination)
        return TrafficBotsState(traffic_at_start(context.scene, destination), given, draws)

    def decide(self, context: TrafficBotsContext, state: TrafficBotsState) -> GaussianDistribution:
        """Distributions [B, N, A] of the next action.

        Args:
            context: of `encode`.
            state: before the decision. Its memo is filled.
        """
        mean, residual, continues = self._mean(context, state), None, state.continues
        if state.before is not None and state.decision is not None:
            residual = state.decision - self._mean(context, state.before)
        return self._distribution(context, mean, residual, continues, state.traffic.alive)

    def advance(
        self,
        context: TrafficBotsContext,
        state: TrafficBotsState,
        decision: Float[Tensor, "B N A 2"],
        forced: AgentStates | None = None,
    ) -> TrafficBotsState:
        """State after 0.1 s of the chosen actions.

        Args:
            context: of `encode`.
            state: before the decision.
            decision: actions before tanh.
            forced: states imposed from outside, of a single step.
        """
        scene, now = context.scene, state.traffic
        imposed, continues = None, now.alive
        if forced is not None:
            last = scene.to_batch_frame(now.windows.pose[..., -1, :]) if state.poses is None else state.poses[..., 0, :]
            imposed = imposed_after(last, now.windows.motion[..., -1, 0], forced, scene)
            continues = continues & ~imposed.mask
        traffic = now.after(decision, scene, imposed)
        poses = scene.to_batch_frame(traffic.windows.pose[..., -1, :])
        if forced is not None:
            # Exactly where it says, not there and back.
            pose = torch.cat([forced.position[..., 0, :], forced.heading], -1)
            poses = torch.where(forced.valid, pose, poses)
        return replace(
            state,
            traffic=traffic,
            poses=poses[..., None, :],
            num_decisions=state.num_decisions + 1,
            before=replace(state, before=None, decision=None),
            decision=decision,
            continues=continues,
            memo=Memo(),
        )

    def score(self, context: TrafficBotsContext, rollouts: Rollouts) -> GaussianDistribution:
        """Distributions [B, N, A, T] along rollouts, in parallel over time.

        Args:
            context: of `encode`.
            rollouts: of the same scenarios.
        """
        replay = self._replay(context, rollouts)
        return self._scored(context, replay, rollouts.decision, self._features(context, replay))

    def encode_like(self, scenarios: ScenarioBatch, context: Any) -> TrafficBotsContext:
        """`encode(scenarios)`, with map and lights taken over from a context of a model that sees alike.

        Args:
            scenarios: of the context.
            context: of any policy, whose weights are still those that made it.
        """
        if not isinstance(context, TrafficBotsContext) or not self.sees_as(context.model):
            return self.encode(scenarios)
        around = self.network.agents.context(context.map_features, context.light_features)
        record = context.record if self.has_features_of(context.model) else None
        return replace(context, around=around, model=self, record=record)

    def score_with_reference(
        self, context: TrafficBotsContext, rollouts: Rollouts, reference: Any, ref_context: Any, ref_rollouts: Rollouts
    ) -> tuple[GaussianDistribution, DecisionDistribution]:
        """Distributions along rollouts of this policy and, without gradient, of a reference.

        The features of agents are computed once where only `actions` differs, and not at all along rollouts that the
        context has a record of.

        Args:
            context: of this policy.
            rollouts: of the same scenarios.
            reference: any policy.
            ref_context: of the reference.
            ref_rollouts: the same rollouts, maybe with goals, which are ignored.
        """
        if not self.has_features_of(reference):
            dist = self.score(context, rollouts)
            with torch.no_grad():
                return dist, reference.score(ref_context, ref_rollouts)
        replay = self._replay(context, rollouts)
        with torch.no_grad():
            features = None if context.record is None else context.record.along(replay)
            features = self._features(context, replay) if features is None else features
            ref_dist = reference._scored(ref_context, replay, rollouts.decision, features)
        return self._scored(context, replay, rollouts.decision, features), ref_dist

    # ---- pre-training -------------------------------------------------------------------------------------------

    def imitation_loss(self, scenarios: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> ImitationLoss:
        """Loss of closed-loop imitation.

        Args:
            scenarios: with their futures.
            trained: True = the agent counts; the others are context.
            update: counted from 0; in training mode the fraction of agents that follow the log falls with it.
        """
        return imitation_loss(self.network, self.config, scenarios, trained, update)

    # ---- parts ----------------------------------------------------------------------------------------------------

    def _replay(self, context: TrafficBotsContext, rollouts: Rollouts) -> list[TrafficBotsState]:
        """States before each of T decisions, without the network."""
        assert rollouts.draws is not None
        states = [self.start(context, rollouts.draws)]
        with torch.no_grad():
            for index in range(rollouts.decision.shape[3] - 1):
                forced = rollouts.forced and rollouts.forced.steps(index, index + 1)
                before = replace(states[-1], before=None)
                states.append(self.advance(context, before, rollouts.decision[:, :, :, index], forced))
        return states

    def _features(self, context: TrafficBotsContext, states: list[TrafficBotsState]) -> Float[Tensor, "B T N A D"]:
        """Features of agents in each of T states."""
        return features_over_time(
            self.network, whole_history([one.traffic for one in states]),
            torch.stack([one.traffic.active for one in states], 3), context.scene, context.around, states[0].given,
            steps_per_pass=self.config.steps_per_pass,
        )  # fmt: skip

    def _scored(
        self,
        context: TrafficBotsContext,
        states: list[TrafficBotsState],
        decision: Float[Tensor, "B N A T 2"],
        features: Float[Tensor, "B T N A D"],
    ) -> GaussianDistribution:
        """Distributions around the means of T decisions, whose noise the means of the decisions before are part of."""
        mean = self.network.mean_actions(features, context.scene).movedim(1, 3)  # [B, N, A, T, 2]
        alive = torch.stack([one.traffic.alive for one in states], 3)  # [B, N, A, T]
        residual = torch.cat([torch.zeros_like(mean[:, :, :, :1]), (decision - mean)[:, :, :, :-1]], 3)
        goes_on = [torch.zeros_like(alive[..., 0]), *(s.continues for s in states if s.continues is not None)]
        return self._distribution(context, mean, residual, torch.stack(goes_on, 3), alive)

    def _mean(self, context: TrafficBotsContext, state: TrafficBotsState) -> Float[Tensor, "B N A 2"]:
        """Mean actions in a state, from its memo after the first call."""
        mean = state.memo.mean
        if mean is None:
            traffic, index = state.traffic, state.num_decisions
            windows, around = traffic.windows.as_one_decision(), context.around.steps(index, index + 1)
            features = self.network.features(windows, context.scene, around, state.given, traffic.active[:, None])
            state.memo.mean = mean = self.network.mean_actions(features, context.scene)[:, 0]
            if context.record is not None:
                context.record.add(state, features)
        return mean

    def _distribution(
        self,
        context: TrafficBotsContext,
        mean: Float[Tensor, "B N A *T 2"],
        residual: Float[Tensor, "B N A *T 2"] | None,
        continues: Bool[Tensor, "B N A *T"] | None,
        alive: Bool[Tensor, "B N A *T"],
    ) -> GaussianDistribution:
        """Distributions around means; noise goes on from the residual of the decision before, where it continues."""
        agent_class = context.scene.agent_class
        shape = (len(agent_class), 1, agent_class.shape[1], *[1] * (mean.dim() - 4), 2)
        std = self.noise_std[agent_class].view(shape).expand_as(mean)
        if residual is not None and continues is not None:
            rho = self.config.noise_correlation
            mean = mean + rho * torch.where(continues[..., None], residual, 0.0)
            std = torch.where(continues[..., None], std * math.sqrt(1 - rho**2), std)
        return GaussianDistribution(mean, std, alive)
