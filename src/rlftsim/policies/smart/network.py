"""The network of SMART: a map encoder, and a decoder over agents and token steps.

B scenarios, N rollouts, A agents, K token steps of a block, P of the past, M map tokens, D width, C classes, V
tokens. A *row* attends: a valid (scenario, rollout, agent, step), flattened, R in all. The decoder works on a
block of steps given the past. So the history (once per scenario), a single step of a rollout and all steps of a scoring
pass go through the same code.

In closed loop off the CPU all elements of a block are rows, padding too. Then no shape depends on a value: the host
never waits inside a decision, and all decisions of a rollout are a single CUDA graph.
"""

import itertools
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.geometry import angle_between, heading_vector
from rlftsim.policies.smart.attention import (
    AttentionMaps,
    GoalEdges,
    Neighborhoods,
    RelationAttention,
    build_neighborhoods,
)
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.embeddings import (
    ClassHeads,
    ContinuationScores,
    FourierEmbedding,
    Grid,
    MlpEmbedding,
    MlpLayer,
    RelationEmbedding,
    TokenKeys,
    initialize,
    normalize,
    tabulate,
)
from rlftsim.policies.smart.goal_conditioning import (
    EncodedGoals,
    GoalEdgeEmbedding,
    GoalEmbedding,
    GoalLogitBias,
    build_goal_encoder,
    select_rows,
)
from rlftsim.policies.smart.neighbors import Poses, bound_neighbors, find_neighbors, group_rows, relative_pose
from rlftsim.policies.smart.token_steps import TokenSteps
from rlftsim.rollout.rows import find_rows, place_rows
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens.map_tokens import (
    NO_MAP_POSITION_M,
    NUM_FAMILIES,
    NUM_LIGHTS,
    NUM_TYPES,
    WINDOW,
    MapTokens,
    tokenize_lights,
    tokenize_map,
)
from rlftsim.tokens.vocabulary import CLASS_NAMES, Vocabulary, class_of_type

MAX_LOOK_BACK_M = 160.0
"""Largest distance between an agent and the remembered positions (3 s at 50 m/s), for tables."""
LIGHT_MARGIN_M = 1.0
"""Added to the reach of a light, as products of matrices give distances that are a few centimeters off."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Inputs of the decoder beside the agents' motion."""

    tokens: MapTokens
    map_features: Float[Tensor, "BM D"]
    """Normalized features of all map tokens, scenario after scenario."""
    class_id: Int64[Tensor, "B A"]
    agent_features: Float[Tensor, "B A D"]
    """Embedding of an agent's class and size."""
    token_features: Float[Tensor, "C V D"]
    """Embedding of every motion token."""
    time_relation: RelationEmbedding
    map_relation: RelationEmbedding
    agent_relation: RelationEmbedding
    max_map_tokens: int | None = None
    """No agent has more map tokens within reach, in any position. None on the CPU, which counts at every step."""
    token_keys: TokenKeys | None = None
    """For `ContinuationScores`; None = the head has none."""

    @property
    def map_poses(self) -> Poses:
        """Poses [B M] of all map tokens, scenario after scenario."""
        return Poses(self.tokens.position.flatten(0, 1), self.tokens.heading.flatten())

    @property
    def map_positions(self) -> Float[Tensor, "B M 2"]:
        """Positions of the map tokens, infinite for padding."""
        return mask_positions(self.tokens.token_mask, self.tokens.position)


@dataclass(frozen=True, eq=False)
class Past:
    """Steps of earlier blocks, as sources of the attention over time."""

    sources: tuple[Float[Tensor, "S D"], ...]
    """Normalized inputs of each layer's attention over time."""
    position: Float[Tensor, "B N A P 2"]
    heading: Float[Tensor, "B N A P"]
    row: Int64[Tensor, "B N A P"]
    """Row of `sources`, -1 where there is none."""

    def append(self, steps: TokenSteps, row: Int64[Tensor, "B N A K"]) -> "Past":
        """The past with a block's poses appended, and the sources unchanged.

        Args:
            steps: Block of steps that follows the past.
            row: Row of `sources` that the block's features will have, -1 where there is none.
        """
        pairs = ((self.position, steps.position), (self.heading, steps.heading), (self.row, row))
        return Past(self.sources, *(torch.cat(pair, 3) for pair in pairs))

    def repeat(self, num_rollouts: int) -> "Past":
        """The past of a single rollout, shared by N rollouts."""
        tensors = (self.position, self.heading, self.row)
        return Past(self.sources, *(values.expand(-1, num_rollouts, *values.shape[2:]) for values in tensors))

    def without_last_step(self) -> "Past":
        """The past before the last step. Rows of the sources that are no longer referred to stay."""
        return Past(self.sources, self.position[..., :-1, :], self.heading[..., :-1], self.row[..., :-1])

    def last(self, num_steps: int) -> "Past":
        """The last steps, with padding where there are fewer, and as many sources for every agent.

        So a past that grows at every decision keeps its shapes.
        """
        num_added = num_steps - self.row.shape[-1]  # steps to add in front, or minus those to drop
        row = functional.pad(self.row, (num_added, 0), value=-1)
        selected = row.flatten().clamp(min=0)
        return Past(
            tuple(source.index_select(0, selected) for source in self.sources),
            functional.pad(self.position, (0, 0, num_added, 0)),
            functional.pad(self.heading, (num_added, 0)),
            torch.where(row >= 0, torch.arange(len(selected), device=row.device).view_as(row), -1),
        )


@dataclass(frozen=True, eq=False)
class View:
    """The rows of a block of steps, and the neighbors of each with the relations."""

    rows: tuple[Tensor, ...]
    """Scenario, rollout, agent and step [R] of each row."""
    poses: Poses
    """Poses [R]."""
    past: Past
    """Poses and rows of the past, followed by the block; no sources."""
    history: Neighborhoods
    """Earlier steps of the same agent."""
    map_tokens: Neighborhoods
    agents: Neighborhoods


class MapEncoder(nn.Module):
    """Attention among the map tokens of a scenario."""

    def __init__(self, config: SmartConfig, num_map_points: int):
        super().__init__()
        self.config = config
        dim = config.dim
        self.token = MlpEmbedding(2 * num_map_points, dim)
        self.feature_type = nn.Embedding(NUM_TYPES, dim)
        self.kind = nn.Embedding(NUM_FAMILIES, dim)
        self.light = nn.Embedding(NUM_LIGHTS, dim)
        self.relation = FourierEmbedding(3, dim, config.num_frequencies)
        sizes = (dim, config.num_heads, config.head_dim, config.dropout)
        self.layers = nn.ModuleList(RelationAttention(*sizes) for _ in range(config.num_map_layers))

    def forward(self, tokens: MapTokens, prototypes: Float[Tensor, "P n 2"]) -> Float[Tensor, "BM D"]:
        """Features of all map tokens, scenario after scenario. Padding has arbitrary finite features.

        Args:
            tokens: Map tokens [B, M] of the scenarios, map frame.
            prototypes: Points of each prototype, meters, in the frame of the prototype.
        """
        x = self.token(prototypes.flatten(1))[tokens.token_id]  # [B, M, D]
        # categories are added to the shape's embedding: lane or edge, family, state of the light
        x = x + self.feature_type(tokens.type) + self.kind(tokens.family) + self.light(tokens.light)
        x = x.flatten(0, 1)
        # 1. rows: the tokens that are no padding; each attends to tokens of the same scenario within reach
        rows = tokens.token_mask.flatten().nonzero()[:, 0]
        poses = Poses(tokens.position.flatten(0, 1), tokens.heading.flatten())
        width = tokens.token_mask.shape[1]
        neighbors = find_neighbors(
            poses.position[rows], rows // width, mask_positions(tokens.token_mask, tokens.position), rows % width,
            radius_m=self.config.map_radius_m, limit=self.config.max_map_neighbors,
        )  # fmt: skip
        embedding = tabulate(self.relation, self.config.map_radius_m)
        values = relative_pose(poses[rows], poses[neighbors.index], seam_rad=self.config.seam_rad)  # [R, K, 3]
        neighborhoods = build_neighborhoods(embedding, values, neighbors.index, neighbors.mask, dim=self.config.dim)
        # 2. layers: sources are all tokens, as neighbors are named by the index among all
        updated = x[rows]
        for layer in self.layers:
            updated = layer(updated, x.index_copy(0, rows, normalize(updated)), neighborhoods)
        return x.index_copy(0, rows, updated)


def mask_positions(mask: Bool[Tensor, "*shape"], position: Float[Tensor, "*shape 2"]) -> Float[Tensor, "*shape 2"]:
    """Positions, infinite where the mask is False, so that these are within no radius.

    Args:
        mask: True = the position stays as it is, False = padding.
        position: Positions in any frame, meters; those of padding are not read.
    """
    return position.masked_fill(~mask[..., None], torch.inf)


class AgentDecoder(nn.Module):
    """Layers of attention over time, to the map and among agents; the head predicts the next token."""

    def __init__(self, config: SmartConfig, num_tokens: int, class_sizes: tuple[int, ...] = ()):
        super().__init__()
        self.config = config
        dim, frequencies = config.dim, config.num_frequencies
        self.class_embedding = nn.Embedding(len(CLASS_NAMES), dim)
        self.size = MlpLayer(3, dim, dim)
        self.tokens = nn.ModuleList(MlpEmbedding(8, dim) for _ in CLASS_NAMES)
        self.motion = FourierEmbedding(2, dim, frequencies)
        self.fusion = MlpEmbedding(2 * dim, dim)
        self.time_relation = FourierEmbedding(4, dim, frequencies)
        self.map_relation = FourierEmbedding(3, dim, frequencies)
        self.agent_relation = FourierEmbedding(3, dim, frequencies)
        sizes = (dim, config.num_heads, config.head_dim, config.dropout)
        layers = range(config.num_decoder_layers)
        self.time_layers = nn.ModuleList(RelationAttention(*sizes) for _ in layers)
        self.map_layers = nn.ModuleList(RelationAttention(*sizes, separate_source_norm=True) for _ in layers)
        self.agent_layers = nn.ModuleList(RelationAttention(*sizes) for _ in layers)
        self.head = ClassHeads(dim, class_sizes, num_tokens) if class_sizes else MlpLayer(dim, dim, num_tokens)
        self.scores = ContinuationScores(dim) if config.continuation_scores else None
        # the names `goal` and `aim` are keys of stored weights
        self.goal = build_goal_encoder(config.goal, dim, frequencies)
        self.aim = GoalLogitBias() if config.goal_logit_bias else None

    def goal_modules(self) -> tuple[GoalEmbedding | GoalEdgeEmbedding | GoalLogitBias, ...]:
        """Goal encoder and goal logit bias; empty in a goal-free model."""
        return tuple(module for module in (self.goal, self.aim) if module is not None)

    def relations(self) -> dict[str, RelationEmbedding]:
        """The relation embeddings by field of a scene, tabulated unless a gradient has to be exact."""
        # lags are whole numbers of tokens, so their grid has exactly these points
        lag = Grid(-float(self.config.history_tokens), 0.0, self.config.history_tokens + 1)
        return {
            "time_relation": tabulate(self.time_relation, MAX_LOOK_BACK_M, lag),
            "map_relation": tabulate(self.map_relation, self.config.agent_map_radius_m),
            "agent_relation": tabulate(self.agent_relation, self.config.agent_radius_m),
        }

    def embed_agents(self, class_id: Int64[Tensor, "B A"], size: Float[Tensor, "B A 3"]) -> Float[Tensor, "B A D"]:
        """Embedding of class and size.

        Args:
            class_id: Class of each agent: vehicle, pedestrian, cyclist or padding.
            size: Length, width and height of each agent, meters.
        """
        return self.class_embedding(class_id) + self.size(size)

    def embed_tokens(self, end_corners: Float[Tensor, "C V 4 2"]) -> Float[Tensor, "C V D"]:
        """Embedding of every motion token of every class."""
        return torch.stack([embed(table.flatten(1)) for embed, table in zip(self.tokens, end_corners)])

    def head_modules(self) -> tuple[nn.Module, ...]:
        """The modules that turn features into logits."""
        return (self.head,) if self.scores is None else (self.head, self.scores)

    def reader_modules(self) -> tuple[nn.Module, ...]:
        """Layers, head and goal modules, whose weights do not enter scenes and views."""
        return self.time_layers, self.map_layers, self.agent_layers, *self.head_modules(), *self.goal_modules()

    def fold(self) -> tuple[AttentionMaps, ...]:
        """Maps of the layers' attention, in the order in which the layers are applied."""
        layers = zip(self.time_layers, self.map_layers, self.agent_layers)
        return tuple(layer.fold() for block in layers for layer in block)  # type: ignore[operator]

    def look(
        self, scene: Scene, steps: TokenSteps, past: Past | None, hidden: Tensor | None = None, *, padded: bool = False
    ) -> View:
        """The rows of a block and their neighbors, which the layers only read.

        No weight of a layer takes part, so two models share the view where the other weights are frozen and equal.

        Args:
            scene: Map, agents and embeddings of relations, in the frame of the steps.
            steps: Block of steps whose valid elements become rows.
            past: Past of earlier blocks; None = the block begins the scenario.
            hidden: True = the (agent, step) pair, of [B, N, A, K], takes no part in the attention over time.
            padded: Whether padding has rows, too, which no row attends to, and lists have fixed widths.
        """
        # 1. rows, and the row of each element of the block (-1 = none)
        rows = scenario, rollout, agent, step = find_rows(steps.valid, padded)
        num_sources = 0 if past is None else past.sources[0].shape[0]
        index = torch.arange(len(agent), device=agent.device)
        element_row = torch.where(steps.valid, place_rows(index, steps.valid), -1)  # [B, N, A, K]
        source_row = torch.where(element_row >= 0, element_row + num_sources, -1)
        past = Past((), steps.position, steps.heading, source_row) if past is None else past.append(steps, source_row)
        poses = Poses(steps.position, steps.heading)[rows]
        build = partial(build_neighborhoods, dim=self.config.dim, padded=padded)
        # 2. map tokens. Agents that stand are at the same pose in many steps and rollouts, and share a list. But in
        # training every row has a dropout mask; and a device would have to be waited for
        is_shared = not (padded or self.training) and agent.device.type == "cpu"
        groups = group_rows(scenario, poses) if is_shared else None
        first = slice(None) if groups is None else groups.first
        tokens = find_neighbors(
            poses.position[first], scenario[first], scene.map_positions, None,
            radius_m=self.config.agent_map_radius_m, limit=self.config.max_agent_map_neighbors,
            max_neighbors=scene.max_map_tokens,
        )  # fmt: skip
        map_relation = relative_pose(poses[first], scene.map_poses[tokens.index], seam_rad=self.config.seam_rad)
        # 3. agents: the candidates of a row are the agents of the same scenario, rollout and step
        candidates = mask_positions(steps.valid, steps.position).transpose(2, 3)  # [B, N, K, A, 2]
        _, num_rollouts, num_steps, num_agents, _ = candidates.shape
        agents = find_neighbors(
            poses.position, (scenario * num_rollouts + rollout) * num_steps + step, candidates.flatten(0, 2), agent,
            radius_m=self.config.agent_radius_m, limit=self.config.max_agent_neighbors, max_neighbors=num_agents,
        )  # fmt: skip
        # from candidates to rows; padding is clamped to any row, its mask is False
        agent_row = element_row.transpose(2, 3).flatten()[agents.index].clamp(min=0)
        agent_relation = relative_pose(poses, poses[agent_row], seam_rad=self.config.seam_rad)
        return View(
            rows, poses, past,
            history=build(scene.time_relation, *self._find_history(past, steps, rows, poses, hidden)),
            map_tokens=build(
                scene.map_relation, map_relation, tokens.index, tokens.mask, features=scene.map_features, groups=groups
            ),
            agents=build(scene.agent_relation, agent_relation, agent_row, agents.mask),
        )  # fmt: skip

    def forward(
        self,
        scene: Scene,
        steps: TokenSteps,
        past: Past | None,
        view: View | None = None,
        goals: EncodedGoals | None = None,
        maps: tuple[AttentionMaps, ...] | None = None,
    ) -> tuple[Float[Tensor, "R E"], Past]:
        """Features of the valid (agent, step) pairs of a block, and the new past.

        Args:
            scene: Map, agents and embeddings of relations, in the frame of the steps.
            steps: Block of steps to decide after.
            past: Past of earlier blocks; None = the block begins the scenario.
            view: Result of `look` for the block; None = looked at here.
            goals: Goals [B, N, A] of all agents; None = all agents are goal-free.
            maps: `fold()` of weights that get no gradient, computed once for many blocks.

        Returns:
            Features in the order of `steps.valid.nonzero()`, with continuation scores followed by the phase of the
            token that led to the step (E = D + F); and the past, followed by the block.
        """
        view = self.look(scene, steps, past) if view is None else view
        x = self._embed(scene, steps, view, goals)
        goal_edges = self._build_goal_edges(scene, view, goals)
        # inputs of the attention over time are stored: later blocks attend to them
        sources, folded = [], itertools.repeat(None) if maps is None else iter(maps)
        for index, layers in enumerate(zip(self.time_layers, self.map_layers, self.agent_layers)):
            time_layer, map_layer, agent_layer = layers
            source = normalize(x)
            source = source if past is None else torch.cat([past.sources[index], source])
            sources.append(source)
            x = time_layer(x, source, view.history, maps=next(folded))
            x = map_layer(x, None, view.map_tokens, goal_edges=goal_edges, maps=next(folded))
            x = agent_layer(x, normalize(x), view.agents, maps=next(folded))
        if scene.token_keys is not None:
            scenario, _, agent, _ = view.rows
            class_id, token_id = scene.class_id[scenario, agent], steps.token_id[view.rows]
            x = torch.cat([x, scene.token_keys.last_phase[class_id, token_id]], -1)
        return x, replace(view.past, sources=tuple(sources))

    def _embed(self, scene: Scene, steps: TokenSteps, view: View, goals: EncodedGoals | None) -> Float[Tensor, "R D"]:
        """Initial features: the token that led to a step, and motion, class, size and goal of the agent."""
        scenario, _, agent, _ = view.rows
        motion = steps.motion[view.rows]
        # length of the motion, and the direction relative to the heading
        bearing = angle_between(heading_vector(view.poses.heading), motion)
        motion_values = torch.stack([motion.norm(dim=-1), bearing], -1)
        agent_features = scene.agent_features[scenario, agent]
        if goals is not None and isinstance(self.goal, GoalEmbedding):
            conditioned, embedded = self.goal.embed(goals, view.poses, view.rows, seam_rad=self.config.seam_rad)
            agent_features = agent_features.index_add(0, conditioned, embedded.to(agent_features.dtype))
        state = self.motion(motion_values, agent_features)
        token = scene.token_features[scene.class_id[scenario, agent], steps.token_id[view.rows]]
        return self.fusion(torch.cat([token, state], -1))

    def _find_history(
        self, past: Past, steps: TokenSteps, rows: tuple[Tensor, ...], poses: Poses, hidden: Tensor | None
    ) -> tuple[Float[Tensor, "R W 4"], Int64[Tensor, "R W"], Bool[Tensor, "R W"]]:
        """Relations, rows and mask of up to `history_tokens` earlier steps of the same agent."""
        step = rows[-1]
        lag = torch.arange(1, self.config.history_tokens + 1, device=step.device)
        column = past.row.shape[-1] - steps.valid.shape[-1] + step[:, None] - lag  # [R, W], in the past and the block
        past_index = (*(index[:, None] for index in rows[:3]), column.clamp(min=0))
        row = past.row[past_index]
        mask = (row >= 0) & (column >= 0)
        # in pre-training a pair is hidden from all rows alike; in closed loop the steps are not known at once, each
        # row draws anew
        if hidden is not None:
            mask = mask & ~hidden[past_index] & ~hidden[rows][:, None]
        elif self.training and self.config.history_drop:
            mask = mask & (torch.rand(mask.shape, device=mask.device) >= self.config.history_drop)
        values = relative_pose(poses, Poses(past.position, past.heading)[past_index], seam_rad=self.config.seam_rad)
        # the time between, in tokens, is the fourth value of the relation
        values = torch.cat([values, -lag[:, None].expand(len(step), -1, 1).to(values.dtype)], -1)
        return values, row.clamp(min=0), mask

    def _build_goal_edges(self, scene: Scene, view: View, goals: EncodedGoals | None) -> GoalEdges | None:
        """Relations to each agent's goal polyline; None with a different encoding, or if no agent has a goal."""
        if goals is None or not isinstance(self.goal, GoalEdgeEmbedding):
            return None
        polyline = goals.polyline[view.rows[:3]]
        has_goal = polyline >= 0
        conditioned = select_rows(has_goal)  # [g]
        token = polyline[conditioned].clamp(min=0)
        goal_poses = scene.map_poses[token[:, None]]
        values = relative_pose(view.poses[conditioned], goal_poses, seam_rad=self.config.seam_rad)[:, 0]
        # not the table of the embedding, which ends at the radius of ordinary relations
        relation, goal_relation = self.goal.embed(self.map_relation, values)
        # where all rows are conditioned, those without a goal get a relation that changes nothing
        goal_relation = torch.where(has_goal[conditioned, None], goal_relation, relation)
        return GoalEdges(conditioned, relation, goal_relation, scene.map_features[token])


class SmartNetwork(nn.Module):
    """Map encoder and agent decoder.

    Args:
        config: Sizes, radii and options of the architecture.
        num_tokens: Largest number of tokens V of a class, the width of the logits.
        class_sizes: Number of tokens of each class, each with a head; empty = all classes share a single head.
        num_map_points: Points n of a map prototype.
    """

    def __init__(
        self, config: SmartConfig, num_tokens: int, class_sizes: tuple[int, ...] = (), num_map_points: int = WINDOW
    ):
        super().__init__()
        self.map_encoder = MapEncoder(config, num_map_points)
        self.decoder = AgentDecoder(config, num_tokens, class_sizes)
        initialize(self, config.frequency_init)
        if self.decoder.goal is not None:
            self.decoder.goal.zero_init()

    def build_scene(self, scenarios: ScenarioBatch, vocabulary: Vocabulary) -> Scene:
        """Inputs of the decoder beside the agents' motion, from the maps and agents of a batch.

        Args:
            scenarios: Scenarios with maps and agents, map frame.
            vocabulary: Motion tokens of the agents, and prototypes of map tokens.
        """
        tokens = tokenize_map(scenarios, vocabulary.map_prototypes)
        class_id = class_of_type(scenarios.object_type)
        decoder = self.decoder
        max_map_tokens = None
        if decoder.config.max_agent_map_neighbors is None and tokens.position.device.type != "cpu":
            # the host waits for the bound once, and not at every decision
            candidates = mask_positions(tokens.token_mask, tokens.position)
            max_map_tokens = bound_neighbors(candidates, decoder.config.agent_map_radius_m)
        return Scene(
            tokens=tokens,
            map_features=normalize(self.map_encoder(tokens, vocabulary.map_prototypes)),
            class_id=class_id,
            agent_features=decoder.embed_agents(class_id, scenarios.size),
            token_features=decoder.embed_tokens(vocabulary.end_corners()),
            token_keys=None if decoder.scores is None else decoder.scores.keys(vocabulary.poses[:, :, -1]),
            **decoder.relations(),
            max_map_tokens=max_map_tokens,
        )

    def relight(self, scene: Scene, scenarios: ScenarioBatch, vocabulary: Vocabulary) -> Scene:
        """The scene with other traffic lights; features are computed anew as far as a light that changes reaches.

        Args:
            scene: Scene of the same maps.
            scenarios: Scenarios of the scene, with the step of the lights.
            vocabulary: Prototypes of map tokens.
        """
        light = tokenize_lights(scenarios, vocabulary.map_prototypes.shape[1])
        is_changed = light != scene.tokens.light
        if not is_changed.any():
            return scene
        # each layer carries a light as far as its radius; features within reach depend on tokens up to twice as far
        reach_m = len(self.map_encoder.layers) * self.map_encoder.config.map_radius_m + LIGHT_MARGIN_M
        tokens, local = replace(scene.tokens, light=light), scene.tokens.position - scene.tokens.position[:, :1]
        distance = torch.stack(
            [
                torch.cdist(functional.pad(points[changed], (0, 0, 0, 1), value=NO_MAP_POSITION_M), points).amin(0)
                for points, changed in zip(local, is_changed)
            ]
        )
        is_around, is_reached = (tokens.token_mask & (distance < factor * reach_m) for factor in (2, 1))  # [B, M]
        around, features = tokens.select(is_around), scene.map_features.clone()
        rows = normalize(self.map_encoder(around, vocabulary.map_prototypes))[around.token_mask.flatten()]
        features[is_reached.flatten()] = rows[is_reached[is_around]]
        return replace(scene, tokens=tokens, map_features=features)

    def scene_weights(self) -> list[Tensor]:
        """Weights that scenes and views are made with: all but those of the decoder's `reader_modules`."""
        ids = {id(weight) for module in self.decoder.reader_modules() for weight in module.parameters()}
        return [weight for weight in self.parameters() if id(weight) not in ids]
