"""TrafficBots as a policy: every agent chooses an acceleration and a yaw rate, eighty times.

The network gives the mean mu_t of an action u_t (before tanh). The noise around the mean is correlated in time:

    u_t | past ~ N(mu_t + rho (u_{t-1} - mu_{t-1}), (1 - rho^2) sigma^2),   at first N(mu_t, sigma^2)

B scenarios, N rollouts, A agents, T decisions, L lights, M map tokens, D width.
"""

import math
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.goals.types import Goals
from rlftsim.policies.checkpoint import are_frozen_alike, load_network, read_model, save_model
from rlftsim.policies.distributions import GaussianDistribution, standard_normal
from rlftsim.policies.trafficbots.config import LATENT_SIZE, TrafficBotsConfig
from rlftsim.policies.trafficbots.imitation import imitation_loss
from rlftsim.policies.trafficbots.network import NUM_CLASSES, TrafficBotsNetwork, history_windows
from rlftsim.policies.trafficbots.scene import PEDESTRIAN, VEHICLE, Scene, build_scene
from rlftsim.policies.trafficbots.state import (
    Context,
    Memo,
    Record,
    State,
    compute_imposed_states,
    join_history,
    max_action,
    move,
    start_traffic,
)
from rlftsim.rollout.policy import DecisionDistribution, ImitationLoss
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import FUTURE_STEPS, HISTORY_STEPS

Model = TypeVar("Model", bound="TrafficBotsPolicy")


class TrafficBotsPolicy(nn.Module):
    """Continuous-action traffic model of all agents of a scenario.

    The policy holds weights, and no state of a simulation. At temperature 0 agents take the mean action, as in the
    public code: rollouts then differ by personality and destination alone.
    """

    architecture = "trafficbots"
    fingerprint_name = "rlftsim.policies.trafficbots.policy.TrafficBotsPolicy"
    steps_per_decision = 1
    noise_size = 2
    initial_noise_size = LATENT_SIZE + 1
    noise_std: Tensor
    """[3, 2] exploration noise of each class, before tanh."""

    def __init__(self, config: TrafficBotsConfig):
        super().__init__()
        self.config = config
        self.network = TrafficBotsNetwork(config)
        noise = torch.tensor([[config.noise_acceleration_mps2, config.noise_yaw_rate_radps]] * NUM_CLASSES)
        if config.noise_pedestrian_yaw_rate_radps is not None:
            noise[PEDESTRIAN, 1] = config.noise_pedestrian_yaw_rate_radps
        self.register_buffer("noise_std", noise / max_action(torch.arange(NUM_CLASSES)), persistent=False)

    # ---- the policy interface -------------------------------------------------------------------------------------

    def encode(self, scenarios: ScenarioBatch) -> Context:
        """Features of the map, and of the lights at all decisions."""
        return self.encode_scene(build_scene(scenarios, HISTORY_STEPS, self.config.max_map_tokens))

    def relight(self, context: Context, scenarios: ScenarioBatch) -> Context:
        """The context: lights of the future are those that the model expects, as they are at second 8.

        Args:
            context: Result of `encode` for the same scenarios.
            scenarios: Scenarios, with the step of the lights.
        """
        return context

    def begin(
        self, context: Context, num_rollouts: int, goals: Goals | None, noise: Float[Tensor, "B N A 17"]
    ) -> State:
        """The current step, N times, with a personality and a destination for each agent.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            num_rollouts: Number N of simulations of each scenario, all in a single state.
            goals: Goals of agents, ignored: TrafficBots draws destinations.
            noise: Uniform numbers in [0, 1): 16 for the personality, the last for the destination.
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

    def start(self, context: Context, draws: Float[Tensor, "B N A 17"]) -> State:
        """The current step, with personalities and destinations that have been drawn.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            draws: Personality (16 numbers) and map token of the destination, -1 = none.
        """
        personality, destination = draws[..., :LATENT_SIZE], draws[..., LATENT_SIZE].long()
        conditioning = self.network.conditioning(context.scene, context.map_features, personality, destination)
        traffic = start_traffic(context.scene, destination)
        return State(traffic, conditioning, draws, continues=torch.zeros_like(traffic.alive))

    def decide(self, context: Context, state: State) -> GaussianDistribution:
        """Distributions [B, N, A] of the next action.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            state: State before the decision; the memo in it is filled.
        """
        mean = self._compute_mean(context, state)
        residual = torch.zeros_like(mean)
        if state.previous is not None and state.decision is not None:
            residual = state.decision - self._compute_mean(context, state.previous)
        return self._distribution(context, mean, residual, state.continues, state.traffic.alive)

    def advance(
        self, context: Context, state: State, decision: Float[Tensor, "B N A 2"], forced: AgentStates | None = None
    ) -> State:
        """State after 0.1 s of the chosen actions.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            state: State before the decision.
            decision: Actions before tanh: acceleration and yaw rate.
            forced: States of a single step imposed from outside; None = no agent is forced.
        """
        scene, traffic = context.scene, state.traffic
        imposed, continues, windows = None, traffic.alive, traffic.windows
        if forced is not None:
            last = scene.to_batch_frame(windows.pose[..., -1, :]) if state.poses is None else state.poses[..., 0, :]
            imposed = compute_imposed_states(last, windows.motion[..., -1, 0], forced, scene)
            continues = continues & ~imposed.mask
        traffic = traffic.advance(decision, scene, imposed)
        poses = scene.to_batch_frame(traffic.windows.pose[..., -1, :])
        if forced is not None:
            # Exactly the imposed poses, not to the ego frame and back.
            pose = torch.cat([forced.position[..., 0, :], forced.heading], -1)
            poses = torch.where(forced.valid, pose, poses)
        return replace(
            state,
            traffic=traffic,
            poses=poses[..., None, :],
            num_decisions=state.num_decisions + 1,
            previous=replace(state, previous=None, decision=None),
            decision=decision,
            continues=continues,
            memo=Memo(),
        )

    def score(self, context: Context, rollouts: Rollouts) -> GaussianDistribution:
        """Distributions [B, N, A, T] along rollouts, in parallel over time.

        Args:
            context: Context of the scenarios, from `encode`, shared by all rollouts.
            rollouts: Rollouts of the same scenarios, with decisions, forced states and draws.
        """
        replay = self._replay(context, rollouts)
        return self._score_states(context, replay, rollouts.decision, self._encode_agents(context, replay))

    def encode_like(self, scenarios: ScenarioBatch, context: Any) -> Context:
        """`encode(scenarios)`, with map and lights taken over from a model with the same features of both.

        Args:
            scenarios: Scenarios that `context` was encoded from, in the same order.
            context: Context from any policy whose weights have not been changed since; None = nothing to take over.
        """
        if not isinstance(context, Context) or not self.shares_scene_features(context.model):
            return self.encode(scenarios)
        agent_context = self.network.agents.context(context.scene, context.map_features, context.light_features)
        record = context.record if self.shares_agent_features(context.model) else None
        return replace(context, agent_context=agent_context, model=self, record=record)

    def score_with_reference(
        self, context: Context, rollouts: Rollouts, reference: Any, ref_context: Any, ref_rollouts: Rollouts
    ) -> tuple[GaussianDistribution, DecisionDistribution]:
        """Distributions along rollouts of this policy and, without gradient, of a reference.

        The features of agents are computed once where only `actions` differs, and never along recorded rollouts.

        Args:
            context: Context of the scenarios under this policy.
            rollouts: Rollouts of the same scenarios, with decisions, forced states and draws.
            reference: Policy of any class, scored without gradient.
            ref_context: Context of the scenarios under the reference.
            ref_rollouts: The same rollouts, maybe with goals, which TrafficBots ignores.
        """
        if not self.shares_agent_features(reference):
            dist = self.score(context, rollouts)
            with torch.no_grad():
                return dist, reference.score(ref_context, ref_rollouts)
        replay = self._replay(context, rollouts)
        with torch.no_grad():
            features = None if context.record is None else context.record.find_features(replay)
            features = self._encode_agents(context, replay) if features is None else features
            ref_dist = reference._score_states(ref_context, replay, rollouts.decision, features)
        return self._score_states(context, replay, rollouts.decision, features), ref_dist

    def predict_pose(
        self, class_id: Int64[Tensor, "*#g"], speed: Float[Tensor, "*#g"], action: Float[Tensor, "*g 2"], seconds: float
    ) -> Float[Tensor, "*g 3"]:
        """Where an action leads that is kept up: x, y and heading in the agent's frame.

        Args:
            class_id: 0 vehicle, 1 pedestrian, 2 cyclist.
            speed: Speeds of the agents, m/s, negative backwards.
            action: Actions before tanh: acceleration and yaw rate.
            seconds: Time from now.
        """
        start = action.new_zeros(*action.shape[:-1], 3)
        return move(start, speed.expand(action.shape[:-1]), action, max_action(class_id), seconds)[0]

    def encode_scene(self, scene: Scene) -> Context:
        """Features of the map, and of the lights at all decisions.

        Args:
            scene: Scene of the batch; only the history is read.
        """
        map_features = self.network.map(scene, scene.node_mask)
        light_features = self._roll_lights(scene, map_features)
        agent_context = self.network.agents.context(scene, map_features, light_features)
        trains_actions = any(weight.requires_grad for weight in self.network.actions.parameters())
        record = Record() if trains_actions and self.shares_agent_features(self) else None
        return Context(scene, map_features, light_features, agent_context, self, record)

    def _roll_lights(self, scene: Scene, map_features: Float[Tensor, "B M D"]) -> Float[Tensor, "B T L D"]:
        """Features of the lights at all 80 decisions; each next state is the most likely state.

        Lights do not see agents, so that the features are the same in all rollouts of a scene.
        """
        encoder = self.network.lights
        neighborhoods = encoder.neighborhoods(scene, map_features)
        window = scene.light_state[:, None, :, : encoder.window]  # [B, 1, L, W]
        if not scene.light_mask.any():
            return encoder(window, neighborhoods).expand(-1, FUTURE_STEPS, -1, -1)
        features = []
        for step in range(1, FUTURE_STEPS + 1):
            features.append(encoder(window, neighborhoods))
            state = self.network.next_light_logits(features[-1]).argmax(-1)
            last, window = window, torch.cat([window[..., 1:], state[..., None]], -1)
            if torch.equal(window, last) and not encoder.training:  # lights have settled: no feature changes any more
                features.append(features[-1].expand(-1, FUTURE_STEPS - step, -1, -1))
                break
        return torch.cat(features, 1)

    # ---- training -----------------------------------------------------------------------------------------------

    def fine_tuned_modules(self) -> tuple[nn.Module, ...]:
        """All layers that decide actions.

        The destination predictor and the map stay unchanged: destinations are drawn once per rollout, and draws must
        not depend on trained weights. Lights stay with the map; the posterior belongs to pre-training.
        """
        network = self.network
        destination = (network.destination_map, network.destination_pose, network.add_destination)
        return network.agents, *destination, network.add_personality, network.actions

    def head_modules(self) -> tuple[nn.Module, ...]:
        """The last layer that decides how vehicles accelerate.

        Yaw rates have so narrow a noise that rollouts hardly tell good from bad: training would be a random walk.
        """
        return (self.network.actions.acceleration[VEHICLE],)

    def shares_scene_features(self, model: nn.Module) -> bool:
        """True if map and lights have the same features in a model, without gradient in both.

        Args:
            model: Model of any class; only the same class, settings and weights give True.
        """
        return self._shares_weights(model, lambda name: name.startswith(("map.", "lights.", "light_state.")))

    def shares_agent_features(self, model: nn.Module) -> bool:
        """True if a model decides actions by the same features, without gradient in both.

        Args:
            model: Model of any class; only the same class, settings and weights give True.
        """
        return self._shares_weights(model, lambda name: not name.startswith("actions."))

    def _shares_weights(self, model: nn.Module, is_shared: Callable[[str], bool]) -> bool:
        """True if the weights of such names are frozen alike, without dropout."""
        if type(model) is not type(self) or self.config != model.config or self.training or model.training:
            return False
        networks = (self.network, model.network)
        return are_frozen_alike(*([w for name, w in n.named_parameters() if is_shared(name)] for n in networks))

    # ---- pre-training -------------------------------------------------------------------------------------------

    def imitation_loss(self, scenarios: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> ImitationLoss:
        """Loss of closed-loop imitation.

        Args:
            scenarios: Scenarios with logged futures, the targets of imitation.
            trained: True = the agent counts; other agents are context.
            update: Number of the update from 0; in training mode the fraction of agents that follow the log falls.
        """
        return imitation_loss(self.network, scenarios, trained, update)

    # ---- states, means and distributions -----------------------------------------------------------------------------

    def _replay(self, context: Context, rollouts: Rollouts) -> list[State]:
        """States before each of T decisions, without the network."""
        assert rollouts.draws is not None
        states = [self.start(context, rollouts.draws)]
        with torch.no_grad():
            for index in range(rollouts.decision.shape[3] - 1):
                forced = rollouts.forced and rollouts.forced.steps(index, index + 1)
                state = replace(states[-1], previous=None)
                states.append(self.advance(context, state, rollouts.decision[:, :, :, index], forced))
        return states

    def _encode_agents(self, context: Context, states: list[State]) -> Float[Tensor, "B T N A D"]:
        """Features of agents in each of T states."""
        traffic = [state.traffic for state in states]
        return self.network.features_over_time(
            join_history(traffic), torch.stack([t.active for t in traffic], 3), context.agent_context,
            states[0].conditioning,
        )  # fmt: skip

    def _score_states(
        self,
        context: Context,
        states: list[State],
        decision: Float[Tensor, "B N A T 2"],
        features: Float[Tensor, "B T N A D"],
    ) -> GaussianDistribution:
        """Distributions around the means of T decisions; the noise goes on from the decisions before."""
        mean = self.network.mean_actions(features, context.scene).movedim(1, 3)  # [B, N, A, T, 2]
        alive = torch.stack([state.traffic.alive for state in states], 3)  # [B, N, A, T]
        residual = torch.cat([torch.zeros_like(mean[:, :, :, :1]), (decision - mean)[:, :, :, :-1]], 3)
        return self._distribution(context, mean, residual, torch.stack([state.continues for state in states], 3), alive)

    def _compute_mean(self, context: Context, state: State) -> Float[Tensor, "B N A 2"]:
        """Mean actions in a state, from the state's memo after the first call."""
        mean, scene = state.memo.mean, context.scene
        if mean is None:
            windows, active = state.traffic.windows.add_decision_axis(), state.traffic.active[:, None]
            # later than 8 s lights stay as they are then
            step = min(state.num_decisions, FUTURE_STEPS - 1)
            agent_context = context.agent_context.select_steps(slice(step, step + 1))
            features = self.network.features(windows, agent_context, state.conditioning, active)
            state.memo.mean = mean = self.network.mean_actions(features, scene)[:, 0]
            if context.record is not None:
                context.record.add(state, features)
        return mean

    def _distribution(
        self,
        context: Context,
        mean: Float[Tensor, "B N A *T 2"],
        residual: Float[Tensor, "B N A *T 2"],
        continues: Bool[Tensor, "B N A *T"],
        alive: Bool[Tensor, "B N A *T"],
    ) -> GaussianDistribution:
        """Distributions around means; noise goes on from the residual of the decision before, where it continues."""
        agent_class = context.scene.agent_class
        shape = (len(agent_class), 1, agent_class.shape[1], *[1] * (mean.dim() - 4), 2)
        std = self.noise_std[agent_class].view(shape).expand_as(mean)
        rho = self.config.noise_correlation
        noisy_mean = mean + rho * torch.where(continues[..., None], residual, 0.0)
        std = torch.where(continues[..., None], std * math.sqrt(1 - rho**2), std)
        return GaussianDistribution(noisy_mean, std, alive, aim=mean)

    # ---- files ----------------------------------------------------------------------------------------------------

    def save_pretrained(self, folder: str | os.PathLike, *, card: str = "") -> None:
        """Write config.json, model.safetensors and README.md.

        Args:
            folder: Folder of the model, created where it is missing.
            card: Text of README.md; empty = a line that says that the origin is unknown.
        """
        save_model(folder, self, asdict(self.config), card=card, weights=self.network.state_dict())

    @classmethod
    def from_pretrained(cls: type[Model], folder: str | os.PathLike) -> Model:
        """Model of a model folder as `save_pretrained` writes, or of a run's folder, in training mode.

        Args:
            folder: Model folder, or folder of a finished run.

        Raises:
            ConfigError: There is no such folder, or the settings are contradictory.
            CheckpointError: A file is missing or damaged, the architecture is different, or keys and shapes do not fit;
                the message names the first.
        """
        stored = read_model(folder, architecture=cls.architecture)
        config, weights = stored.build(TrafficBotsConfig), stored.read_weights()
        return load_network(lambda: cls(config), weights, source=stored.folder)
