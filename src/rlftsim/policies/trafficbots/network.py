"""TrafficBots' networks: map, lights, agents, personality, destination, actions.

Source: Zhang et al., "TrafficBots V1.5", 2024 (arXiv 2406.10898).

Shapes: B scenarios, T decisions, N rollouts, A agents, W steps of a window, M map tokens, L lights, D width.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from typing import cast

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from rlftsim.policies.distributions import at_least_float32
from rlftsim.policies.trafficbots.attention import (
    DecoderLayer,
    KeyValues,
    Neighbors,
    PolylineEncoder,
    SelfLayer,
    find_neighbors,
    pose_embedding,
    relative_pose,
)
from rlftsim.policies.trafficbots.config import LATENT_SIZE, WINDOW, TrafficBotsConfig
from rlftsim.policies.trafficbots.map_tokens import NUM_LIGHT_STATES, NUM_NODES, VEHICLE_LANES, MapTokenType
from rlftsim.policies.trafficbots.scene import Scene
from rlftsim.scenario.types import TOTAL_STEPS

POSTERIOR_STRIDE = 5
POSTERIOR_WINDOW = len(range(0, TOTAL_STEPS, POSTERIOR_STRIDE))
"""Steps 0, 5, ..., 90 of the log."""
LIGHT_LOGIT_LIMIT = 3.0
NUM_CLASSES, NUM_GEOMETRY, NUM_MOTION = 3, 7, 3
RING_M = 1e-3
"""Distance from a token's origin within which a point has no direction."""
NEVER = -torch.inf


def mlp(*sizes: int, end_activation: bool = False, norm: bool = False) -> nn.Sequential:
    """Linear layers with ReLU between them.

    Args:
        sizes: Widths of the input and of each layer's output.
        end_activation: True puts an activation after the last layer, too.
        norm: True puts a layer norm before each activation.
    """
    layers: list[nn.Module] = []
    for k, (in_size, out_size) in enumerate(pairwise(sizes)):
        layers.append(nn.Linear(in_size, out_size))
        if k < len(sizes) - 2 or end_activation:
            layers += [nn.LayerNorm(out_size), nn.ReLU()] if norm else [nn.ReLU()]
    return nn.Sequential(*layers)


def decoder_layers(layers: nn.ModuleList) -> list[DecoderLayer]:
    """The layers of a list, typed."""
    return [cast(DecoderLayer, layer) for layer in layers]


class MapEncoder(nn.Module):
    """Encoder of map tokens."""

    def __init__(self, config: TrafficBotsConfig):
        super().__init__()
        width = config.dim - NUM_GEOMETRY
        self.config = config
        self.nodes = mlp(len(MapTokenType) + NUM_NODES, width, width, width)
        self.polyline = PolylineEncoder(config.dim, config.dropout)
        sizes = (config.dim, config.num_heads, config.dropout)
        self.layers = nn.ModuleList(SelfLayer(*sizes) for _ in range(config.num_map_layers))

    def forward(self, scene: Scene, node_mask: Bool[Tensor, "B M 20"]) -> Float[Tensor, "B M D"]:
        """Features of all map tokens, 0 for padding.

        Args:
            scene: Scene with the map.
            node_mask: True = the node is looked at; imitation hides some.
        """
        config = self.config
        map_type = functional.one_hot(scene.map_type, len(MapTokenType)).to(scene.map_pose)[..., None, :]
        node_index = torch.eye(NUM_NODES, device=map_type.device)
        shape = scene.node_mask.shape
        attributes = torch.cat([v.expand(*shape, -1) for v in (map_type, node_index)], -1)  # [B, M, 20, 31]
        geometry = segment_features(relative_pose(scene.node_pose, scene.map_pose[..., None, :]))
        x = self.polyline(torch.cat([self.nodes(attributes), geometry], -1), node_mask)
        poses, mask = scene.map_pose, scene.map_mask
        neighbors = find_neighbors(
            poses, poses, mask, count=config.map_neighbors, radius_m=config.radius_m, size=config.dim
        )
        for layer in self.layers:
            x = layer(x, mask, neighbors)
        return x


def segment_features(pose: Float[Tensor, "*g 3"]) -> Float[Tensor, "*g 7"]:
    """Seven numbers of a segment of 1 m: distance and bearing from the origin, and direction.

    Args:
        pose: Start and direction of each segment, relative to the origin.
    """
    start, towards = pose[..., :2], torch.stack([pose[..., 2].cos(), pose[..., 2].sin()], -1)
    offset = -(start * towards).sum(-1, keepdim=True).clamp(-1, 0)  # [*g, 1] of the point nearest to the origin
    nearest = start + offset * towards
    distance = nearest.norm(dim=-1, keepdim=True)
    bearing = torch.where(distance < RING_M, 0.0, nearest / distance.clamp(min=RING_M))
    remaining_length = (start + towards - nearest).norm(dim=-1, keepdim=True)
    return torch.cat([distance, bearing, towards, torch.ones_like(distance), remaining_length], -1)


@dataclass(frozen=True, eq=False)
class LightNeighbors:
    """Lights and the neighbors of lights."""

    base: Float[Tensor, "B L D"]
    """Feature of each light's map token."""
    mask: Bool[Tensor, "B L"]
    lights: Neighbors
    map: Neighbors
    map_tokens: tuple[KeyValues, ...]
    """Keys and values of the map, by layer."""


class LightEncoder(nn.Module):
    """Encoder of lights, from the states in a window and the map in the neighborhood."""

    def __init__(self, config: TrafficBotsConfig, window: int):
        super().__init__()
        dim = config.dim
        self.config = config
        self.window = window
        self.states = mlp(NUM_LIGHT_STATES + window, dim, dim, dim)
        self.polyline = PolylineEncoder(dim, config.dropout)
        sizes = (dim, config.num_heads, config.dropout)
        self.layers = nn.ModuleList(DecoderLayer(*sizes) for _ in range(config.num_light_layers))

    def neighborhoods(self, scene: Scene, map_features: Float[Tensor, "B M D"]) -> LightNeighbors:
        """Values that the states of lights do not change, computed once.

        Args:
            scene: Scene with lights and map.
            map_features: Features of the map tokens, from `MapEncoder`; receive no gradient from lights.
        """
        config, map_features = self.config, map_features.detach()
        lights = scene.light_pose
        find = partial(find_neighbors, count=config.light_neighbors, radius_m=config.light_radius_m, size=config.dim)
        return LightNeighbors(
            base=map_features.gather(1, scene.light_token[..., None].expand(-1, -1, config.dim)),
            mask=scene.light_mask,
            lights=find(lights, lights, scene.light_mask),
            map=find(lights, scene.map_pose, scene.map_mask),
            map_tokens=tuple(layer.project(map_features) for layer in decoder_layers(self.layers)),
        )

    def forward(
        self, state: Int64[Tensor, "B T L W"], neighbors: LightNeighbors, step_mask: Bool[Tensor, "T W"] | None = None
    ) -> Float[Tensor, "B T L D"]:
        """Features of all lights at T decisions, 0 for padding.

        Args:
            state: States of the lights in each window, the newest last.
            neighbors: Result of `neighborhoods` for the same scene.
            step_mask: True = the step of the window exists; None = all steps exist.
        """
        base, num_decisions = neighbors.base, state.shape[1]
        step_index = torch.eye(self.window, device=state.device).expand(*state.shape, -1)
        attributes = torch.cat([functional.one_hot(state, NUM_LIGHT_STATES).to(base), step_index], -1)
        mask = neighbors.mask[:, None].expand(state.shape[:3])  # [B, T, L]
        x = self.states(attributes) + base[:, None, :, None]
        steps = mask[..., None].expand(state.shape)
        x = self.polyline(x, steps if step_mask is None else steps & step_mask[:, None])
        lights, map_neighbors = (n.over_time(num_decisions) for n in (neighbors.lights, neighbors.map))
        for layer, map_tokens in zip(self.layers, neighbors.map_tokens):
            x = layer(x, mask, lights, [(map_tokens, map_neighbors)])
        return x


@dataclass(frozen=True, eq=False)
class Windows:
    """Last steps of agents, the newest last: the network's input about agents."""

    valid: Bool[Tensor, "*g A W"]
    pose: Float[Tensor, "*g A W 3"]
    motion: Float[Tensor, "*g A W 3"]

    def apply(self, function: Callable[[Tensor], Tensor]) -> "Windows":
        """Windows with a function applied to each tensor, such as a selection along the common axes."""
        return Windows(function(self.valid), function(self.pose), function(self.motion))

    def add_decision_axis(self) -> "Windows":
        """Windows [B, N, A, W] as windows of a single decision [B, 1, N, A, W]."""
        return self.apply(lambda v: v[:, None])

    @property
    def token_mask(self) -> Bool[Tensor, "*g A"]:
        """True = there is a valid step, so that other agents attend to this agent."""
        return self.valid.any(-1)

    @property
    def token_pose(self) -> Float[Tensor, "*g A 3"]:
        """Pose at the last valid step."""
        steps = torch.arange(1, self.valid.shape[-1] + 1, device=self.valid.device)
        last = (self.valid * steps).argmax(-1)  # [*g, A]
        return self.pose.gather(-2, last[..., None, None].expand(*last.shape, 1, 3))[..., 0, :]


def join_windows(windows: Sequence[Windows]) -> Windows:
    """Windows [B, N, A, W] joined along the steps."""
    return Windows(*(torch.cat([getattr(w, f.name) for w in windows], 3) for f in fields(Windows)))


class WindowEncoder(nn.Module):
    """Encoder of each agent's window in a single feature."""

    def __init__(self, dim: int, window: int, dropout: float):
        super().__init__()
        self.window = window
        self.steps = mlp(3 + NUM_CLASSES + NUM_MOTION + window, dim // 2, dim // 2, dim // 2)
        self.polyline = PolylineEncoder(dim, dropout)

    def forward(
        self, windows: Windows, agents: Float[Tensor, "*#g A 6"], step_mask: Bool[Tensor, "*g A W"] | None = None
    ) -> Float[Tensor, "*g A D"]:
        """Features of windows, 0 for those without a valid step.

        Args:
            windows: Windows of the agents.
            agents: Size and class (one-hot) of each agent, from `agent_attributes`.
            step_mask: Steps to look at; None = all valid steps.
        """
        shape = windows.valid.shape
        step_index = torch.eye(self.window, device=windows.pose.device).expand(*shape, -1)
        attributes = torch.cat([agents[..., None, :].expand(*shape, -1), windows.motion, step_index], -1)
        hidden = self.steps(attributes)  # [*g, A, W, D/2]
        relative = relative_pose(windows.pose, windows.token_pose[..., None, :])
        x = torch.cat([hidden, pose_embedding(relative, hidden.shape[-1]).to(hidden.dtype)], -1)
        return self.polyline(x, windows.valid if step_mask is None else step_mask)


def history_windows(scene: Scene) -> Windows:
    """Windows [B, A, 11] of the agents up to the current step."""
    return Windows(scene.valid, scene.pose, scene.motion).apply(lambda v: v[:, :, :WINDOW])


def agent_attributes(scene: Scene) -> Float[Tensor, "B A 6"]:
    """Size and class (one-hot) of each agent."""
    return torch.cat([scene.size, functional.one_hot(scene.agent_class, NUM_CLASSES).to(scene.size)], -1)


@dataclass(frozen=True, eq=False)
class AgentContext:
    """Scene of agents, with map and lights as keys and values of an agent encoder, by layer."""

    scene: Scene
    map_tokens: tuple[KeyValues, ...]
    """Keys and values [B, H, M, d]."""
    light_tokens: tuple[KeyValues, ...]
    """Keys and values [B, T, H, L, d]."""

    def select_steps(self, steps: slice) -> "AgentContext":
        """The same context with the lights of a range of decisions."""
        return replace(self, light_tokens=tuple(lights.select_steps(steps) for lights in self.light_tokens))


class AgentEncoder(nn.Module):
    """Encoder of agents, from the agents' windows, the map and the lights."""

    def __init__(self, config: TrafficBotsConfig, window: int, dropout: float):
        super().__init__()
        self.config = config
        self.windows = WindowEncoder(config.dim, window, dropout)
        sizes = (config.dim, config.num_heads, dropout)
        self.layers = nn.ModuleList(DecoderLayer(*sizes) for _ in range(config.num_agent_layers))

    def context(
        self, scene: Scene, map_features: Float[Tensor, "B M D"], light_features: Float[Tensor, "B T L D"]
    ) -> AgentContext:
        """Keys and values of map and lights for each layer, computed once for all rollouts.

        Args:
            scene: Scene with poses of map and lights, sizes and classes of agents.
            map_features: Features of the map tokens, from `MapEncoder`.
            light_features: Features of the lights at T decisions, from `LightEncoder`.
        """
        layers = decoder_layers(self.layers)
        map_tokens, light_tokens = ([layer.project(f) for layer in layers] for f in (map_features, light_features))
        return AgentContext(scene, tuple(map_tokens), tuple(light_tokens))

    def forward(self, windows: Windows, context: AgentContext) -> Float[Tensor, "B T N A D"]:
        """Features of all agents at T decisions of N rollouts, 0 for agents without a valid step in the window.

        Args:
            windows: Windows [B, T, N, A, W] of the agents.
            context: Result of `context` for the same T decisions.
        """
        config, scene, mask, pose = self.config, context.scene, windows.token_mask, windows.token_pose
        num_decisions = mask.shape[1]
        find = partial(find_neighbors, pose, radius_m=config.radius_m, size=config.dim)
        map_neighbors = find(scene.map_pose, scene.map_mask, count=config.agent_map_neighbors)
        lights = scene.light_pose[:, None].expand(-1, num_decisions, -1, -1)
        light_mask = scene.light_mask[:, None].expand(-1, num_decisions, -1)
        light_neighbors = find(lights, light_mask, count=config.agent_light_neighbors)
        agent_neighbors = find(pose, mask, count=config.agent_neighbors)
        x = self.windows(windows, agent_attributes(scene)[:, None, None])
        for layer, map_tokens, light_tokens in zip(self.layers, context.map_tokens, context.light_tokens):
            x = layer(x, mask, agent_neighbors, [(map_tokens, map_neighbors), (light_tokens, light_neighbors)])
        return x


class Conditioning(nn.Module):
    """Layers that add an agent's destination or personality to the agent's feature."""

    def __init__(self, size: int, dim: int):
        super().__init__()
        self.given = mlp(size, dim, dim, dim, end_activation=True)
        self.joint = mlp(2 * dim, dim, dim, dim, end_activation=True)

    def forward(
        self, x: Float[Tensor, "*g D"], condition: Float[Tensor, "*#g C"], mask: Bool[Tensor, "*#g"] | None = None
    ) -> Float[Tensor, "*g D"]:
        """Features after conditioning.

        Args:
            x: Features of the agents.
            condition: Values that the features are conditioned on, C per agent.
            mask: False = no condition, the feature passes unchanged; None = True for all agents.
        """
        hidden = self.given(condition).expand_as(x)
        change = self.joint(torch.cat([x, hidden.to(x.dtype)], -1))
        return x + (change if mask is None else torch.where(mask[..., None], change, 0.0))


class DestinationPredictor(nn.Module):
    """Predictor of the map token that is an agent's destination."""

    def __init__(self, config: TrafficBotsConfig):
        super().__init__()
        dim = config.dim
        self.windows = WindowEncoder(dim, WINDOW, config.dropout)
        self.pairs = mlp(3 * dim, dim, dim, 1, norm=True)

    def forward(
        self,
        windows: Windows,
        scene: Scene,
        map_features: Float[Tensor, "B M D"],
        step_mask: Bool[Tensor, "B A W"] | None = None,
    ) -> Float[Tensor, "B A M"]:
        """Log-probabilities; -inf for tokens that are no destination of the agent's class.

        All are -inf for an agent that has no destination at all.

        Args:
            windows: History [B, A, W] of the agents.
            scene: Scene with map and agents.
            map_features: Features of the map tokens, from `MapEncoder`; receive no gradient from the predictor.
            step_mask: Steps to look at; None = all valid steps.
        """
        agents = self.windows(windows, agent_attributes(scene), step_mask)  # [B, A, D]
        relative = relative_pose(scene.map_pose[:, None], windows.token_pose[:, :, None])  # [B, A, M, 3]
        # The first layer of [agent, map token, relative pose] in three terms: only the last is computed per pair.
        first, *further_layers = self.pairs
        assert isinstance(first, nn.Linear)
        agent_weight, map_weight, pose_weight = first.weight.chunk(3, dim=-1)
        x = functional.linear(pose_embedding(relative, agents.shape[-1]), pose_weight, first.bias)
        x = x + functional.linear(agents, agent_weight)[:, :, None]
        x = x + functional.linear(map_features.detach(), map_weight)[:, None]
        for layer in further_layers:
            x = layer(x)
        logits = at_least_float32(x[..., 0]).masked_fill(~mask_destinations(scene), NEVER)
        has_no_token = logits.isneginf().all(-1, keepdim=True)
        return torch.log_softmax(logits.masked_fill(has_no_token, 0.0), -1).masked_fill(has_no_token, NEVER)


def mask_destinations(scene: Scene) -> Bool[Tensor, "B A M"]:
    """True = a map token that agents of this class may be heading for."""
    edge, bike_lane = MapTokenType.EDGE_BOUNDARY, MapTokenType.BIKE_LANE
    table = torch.zeros(NUM_CLASSES, len(MapTokenType), dtype=torch.bool, device=scene.map_type.device)
    for row, types in zip(table, ((*VEHICLE_LANES, edge), (edge,), (bike_lane, edge))):
        row[list(types)] = True
    by_type = table[scene.agent_class]  # [B, A, 11]
    index = scene.map_type[:, None].expand(-1, by_type.shape[1], -1)
    return by_type.gather(-1, index) & scene.map_mask[:, None]


class ActionHead(nn.Module):
    """Means of the actions before tanh, by a network for each class: vehicles, pedestrians, cyclists.

    Acceleration and yaw rate have separate last layers, so that either can be trained alone.
    """

    def __init__(self, dim: int):
        super().__init__()
        self.features = nn.ModuleList(mlp(dim, dim, dim, end_activation=True) for _ in range(NUM_CLASSES))
        self.acceleration = nn.ModuleList(nn.Linear(dim, 1) for _ in range(NUM_CLASSES))
        self.yaw_rate = nn.ModuleList(nn.Linear(dim, 1) for _ in range(NUM_CLASSES))

    def forward(self, x: Float[Tensor, "*g A D"], agent_class: Int64[Tensor, "*#g A"]) -> Float[Tensor, "*g A 2"]:
        """Means of acceleration and yaw rate, in float32 or better.

        Args:
            x: Features of the agents.
            agent_class: Class of each agent, 0 to 2.
        """
        by_class = []
        for features, acceleration, yaw_rate in zip(self.features, self.acceleration, self.yaw_rate):
            hidden = features(x)
            by_class.append(at_least_float32(torch.cat([acceleration(hidden), yaw_rate(hidden)], -1)))
        means = torch.stack(by_class, -2)  # [*g, A, 3, 2]
        index = agent_class.expand(x.shape[:-1])[..., None, None].expand(*x.shape[:-1], 1, 2)
        return means.gather(-2, index)[..., 0, :]


class Posterior(nn.Module):
    """Encoder of each agent's personality from the whole log; used in pre-training only."""

    def __init__(self, config: TrafficBotsConfig):
        super().__init__()
        self.lights = LightEncoder(config, POSTERIOR_WINDOW)
        self.agents = AgentEncoder(config, POSTERIOR_WINDOW, config.dropout)
        self.mean = mlp(config.dim, config.dim, config.dim, LATENT_SIZE)
        self.log_std = nn.Parameter(torch.zeros(LATENT_SIZE))

    def forward(
        self, windows: Windows, states: Int64[Tensor, "B 1 L W"], scene: Scene, map_features: Float[Tensor, "B M D"]
    ) -> Float[Tensor, "B A 16"]:
        """Means of a diagonal Gaussian with log standard deviations `log_std`.

        Args:
            windows: Windows [B, 1, 1, A, 19] of every fifth step of the log.
            states: States of the lights at the same steps.
            scene: Scene with map, sizes and classes.
            map_features: Features from `MapEncoder`; receive gradient from agents, none from lights.
        """
        lights = self.lights(states, self.lights.neighborhoods(scene, map_features))
        context = self.agents.context(scene, map_features, lights)
        return at_least_float32(self.mean(self.agents(windows, context)[:, 0, 0]))


@dataclass(frozen=True, eq=False)
class AgentConditioning:
    """Values that are drawn once for the agents of N rollouts."""

    personality: Float[Tensor, "B N A 16"]
    destination_feature: Float[Tensor, "B N A D"]
    """Projected feature of the destination's map token."""
    destination_pose: Float[Tensor, "B N A 3"]


class TrafficBotsNetwork(nn.Module):
    """All weights of a TrafficBots model."""

    def __init__(self, config: TrafficBotsConfig):
        super().__init__()
        self.config, dim = config, config.dim
        self.map = MapEncoder(config)
        self.lights = LightEncoder(config, WINDOW)
        self.light_state = mlp(dim, dim, dim, NUM_LIGHT_STATES)
        # No dropout in the parts that decide: rollouts are scored again, and the same features must come out.
        self.agents = AgentEncoder(config, WINDOW, dropout=0.0)
        self.posterior = Posterior(config)
        self.destination_map = nn.Linear(dim, dim)
        self.destination_pose = nn.Linear(dim, dim)
        self.destination_predictor = DestinationPredictor(config)
        self.add_destination = Conditioning(dim, dim)
        self.add_personality = Conditioning(LATENT_SIZE, dim)
        self.actions = ActionHead(dim)

    def conditioning(
        self,
        scene: Scene,
        map_features: Float[Tensor, "B M D"],
        personality: Float[Tensor, "B N A 16"],
        destination: Int64[Tensor, "B N A"],
    ) -> AgentConditioning:
        """Personalities and destinations of agents, as the features are conditioned on them.

        Args:
            scene: Scene with the map.
            map_features: Features of the map tokens, from `MapEncoder`; receive no gradient from here.
            personality: Personality of each agent, 16 numbers.
            destination: Map token of each agent, negative = none.
        """
        token = destination.clamp(min=0)
        rows = torch.arange(len(token), device=token.device)[:, None, None]
        # Projected before it is gathered: a scene has fewer map tokens than rollouts have agents.
        projected = self.destination_map(map_features.detach())
        return AgentConditioning(personality, projected[rows, token], scene.map_pose[rows, token])

    def next_light_logits(self, light_features: Float[Tensor, "*g D"]) -> Float[Tensor, "*g 5"]:
        """Logits of a light's next state; the features receive no gradient."""
        logits = at_least_float32(self.light_state(light_features.detach()))
        return logits.clamp(-LIGHT_LOGIT_LIMIT, LIGHT_LOGIT_LIMIT)

    def features(
        self, windows: Windows, context: AgentContext, conditioning: AgentConditioning, active: Bool[Tensor, "B T N A"]
    ) -> Float[Tensor, "B T N A D"]:
        """Features of agents that `mean_actions` decides by.

        Args:
            windows: Windows [B, T, N, A, 11] of the agents.
            context: Scene with the map, and lights at the same T decisions.
            conditioning: Personality and destination of each agent.
            active: True = the agent has not reached the destination yet.
        """
        x = self.agents(windows, context)
        relative = relative_pose(conditioning.destination_pose[:, None], windows.pose[..., -1, :])  # [B, T, N, A, 3]
        pose = self.destination_pose(pose_embedding(relative, x.shape[-1]))
        x = self.add_destination(x, conditioning.destination_feature[:, None] + pose, active)
        return self.add_personality(x, conditioning.personality[:, None])

    def features_over_time(
        self, history: Windows, active: Bool[Tensor, "B N A T"], context: AgentContext, conditioning: AgentConditioning
    ) -> Float[Tensor, "B T N A D"]:
        """`features` at all decisions of finished rollouts, in passes of `steps_per_pass`; differentiable.

        The network has no state: a decision depends on the last 11 steps alone.

        Args:
            history: Agents [B, N, A, W - 1 + T] from the first step of the first decision's window on.
            active: True = the agent has not reached the destination yet at this decision.
            context: Scene with the map, and lights at the same T decisions.
            conditioning: Personality and destination of each agent.
        """
        # [B, N, A, T, ..., W] -> [B, T, N, A, W, ...]
        windows = history.apply(lambda v: v.unfold(3, WINDOW, 1).movedim(3, 1).movedim(-1, 4))
        size = self.config.steps_per_pass
        passes = [slice(start, start + size) for start in range(0, active.shape[-1], size)]
        features = []
        for steps in passes:
            selected = windows.apply(lambda v, steps=steps: v[:, steps])
            inputs = (selected, context.select_steps(steps), conditioning, active.movedim(3, 1)[:, steps])
            if torch.is_grad_enabled() and len(passes) > 1:
                # Each pass is computed again in the backward pass, so that memory holds a single pass.
                result = checkpoint(self.features, *inputs, use_reentrant=False, preserve_rng_state=False)
            else:
                result = self.features(*inputs)
            features.append(cast(Tensor, result))
        return torch.cat(features, 1)

    def mean_actions(self, features: Float[Tensor, "B T N A D"], scene: Scene) -> Float[Tensor, "B T N A 2"]:
        """Means of the actions before tanh, in float32 or better: what an agent does without exploration noise.

        Args:
            features: Features of the agents, from `features`.
            scene: Scene with the classes of agents.
        """
        return self.actions(features, scene.agent_class[:, None, None])
