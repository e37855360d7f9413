"""The network of SMART: a map encoder and a decoder over agents and token steps.

B scenarios, N rollouts, A agents, K token steps of a block, M map tokens, D width. Everything that attends is a *row*: one valid
(scenario, rollout, agent, step), flattened. The decoder works on a block of steps given what came before, so the history (once per
scenario), a single step of a rollout and all steps of a scoring pass go through the same code.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.geometry import angle_between, heading_vector
from rlftsim.policies.layers import (
    FourierEmbedding,
    Grid,
    MlpEmbedding,
    MlpLayer,
    Pointers,
    RelationAttention,
    RelationEmbedding,
    Surroundings,
    TabulatedEmbedding,
    initialize,
    normalize,
    surround,
)
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.goal_sight import GoalAim, GoalMark, GoalState, SeenGoals
from rlftsim.policies.smart.heads import ClassHeads
from rlftsim.policies.smart.neighbors import Neighbors, Poses, relative_pose, within
from rlftsim.tokens.map_tokens import NUM_KINDS, NUM_LIGHTS, NUM_TYPES, MapTokens
from rlftsim.tokens.vocabulary import CLASS_NAMES

MAX_LOOK_BACK_M = 160.0
"""Farthest that anybody gets while it is remembered (3 s at 50 m/s), for tables."""

DISTANCES_PER_ROOT_M = 768


@dataclass(frozen=True, eq=False)
class Scene:
    """What the decoder knows of a scenario beside the agents' motion."""

    map_position: Float[Tensor, "B M 2"]
    map_heading: Float[Tensor, "B M"]
    map_mask: Bool[Tensor, "B M"]
    map_features: Float[Tensor, "BM D"]
    """Normalised features of all map tokens, scenarios one after the other."""
    class_id: Int64[Tensor, "B A"]
    agent_features: Float[Tensor, "B A D"]
    """Embedding of an agent's class and size."""
    token_features: Float[Tensor, "C V D"]
    """Embedding of every motion token."""
    relations: "Relations"

    @property
    def map_poses(self) -> Poses:
        """Of all map tokens, scenarios one after the other."""
        return Poses(self.map_position.flatten(0, 1), self.map_heading.flatten())


@dataclass(frozen=True, eq=False)
class Relations:
    """How the decoder embeds relations."""

    time: RelationEmbedding
    map: RelationEmbedding
    agent: RelationEmbedding


@dataclass(frozen=True, eq=False)
class TokenSteps:
    """States of agents at a block of token steps and the tokens that led there. Map frame."""

    position: Float[Tensor, "B N A K 2"]
    heading: Float[Tensor, "B N A K"]
    motion: Float[Tensor, "B N A K 2"]
    """Position minus the position one token before."""
    token_id: Int64[Tensor, "B N A K"]
    valid: Bool[Tensor, "B N A K"]

    def then(self, other: "TokenSteps") -> "TokenSteps":
        """This block followed by another one."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return TokenSteps(*(torch.cat(pair, 3) for pair in pairs))

    def repeat(self, num_rollouts: int) -> "TokenSteps":
        """The steps of a single rollout, shared by N of them; no copies."""
        fields = (getattr(self, name) for name in self.__dataclass_fields__)
        return TokenSteps(*(v.expand(-1, num_rollouts, *v.shape[2:]) for v in fields))


@dataclass(frozen=True, eq=False)
class Past:
    """What earlier blocks left for the attention over time."""

    position: Float[Tensor, "B N A P 2"]
    heading: Float[Tensor, "B N A P"]
    row: Int64[Tensor, "B N A P"]
    """Row of `sources`, -1 where there is none."""
    sources: tuple[Float[Tensor, "S D"], ...]
    """Normalised inputs of each layer's attention over time."""

    def repeat(self, num_rollouts: int) -> "Past":
        """The past of a single rollout, shared by N of them."""
        shapes = ((v, (-1, num_rollouts, *v.shape[2:])) for v in (self.position, self.heading, self.row))
        position, heading, row = (v.expand(shape) for v, shape in shapes)
        return Past(position, heading, row, self.sources)

    def without_last_step(self) -> "Past":
        """The past before its last step. (Rows of the sources that nobody refers to stay.)"""
        return Past(self.position[..., :-1, :], self.heading[..., :-1], self.row[..., :-1], self.sources)


class MapEncoder(nn.Module):
    """Attention among the map tokens of a scenario."""

    def __init__(self, config: SmartConfig):
        super().__init__()
        self.config = config
        dim = config.dim
        self.token = MlpEmbedding(22, dim)
        self.feature_type = nn.Embedding(NUM_TYPES, dim)
        self.kind = nn.Embedding(NUM_KINDS, dim)
        self.light = nn.Embedding(NUM_LIGHTS, dim)
        self.relation = FourierEmbedding(3, dim, config.num_frequencies)
        self.layers = nn.ModuleList(
            RelationAttention(dim, config.num_heads, config.head_dim, config.dropout)
            for _ in range(config.num_map_layers)
        )

    def forward(self, tokens: MapTokens, prototypes: Float[Tensor, "P 11 2"]) -> Float[Tensor, "BM D"]:
        """Features of all map tokens, scenarios one after the other; padded ones hold finite nonsense."""
        x = self.token(prototypes.flatten(1))[tokens.token_id]
        x = x + self.feature_type(tokens.type) + self.kind(tokens.kind) + self.light(tokens.light)
        x = x.flatten(0, 1)
        rows = tokens.token_mask.flatten().nonzero()[:, 0]
        poses = Poses(tokens.position.flatten(0, 1), tokens.heading.flatten())
        around = self._look_around(tokens, poses, rows)
        updated = x[rows]
        for layer in self.layers:
            updated = layer(updated, x.index_copy(0, rows, normalize(updated)), around)
        return x.index_copy(0, rows, updated)

    def _look_around(self, tokens: MapTokens, poses: Poses, rows: Int64[Tensor, "R"]) -> Surroundings:
        """Other tokens of the same scenario within reach."""
        width = tokens.token_mask.shape[1]
        neighbors = within(
            poses.position[rows], rows // width, nowhere_unless(tokens.token_mask, tokens.position), rows % width,
            radius_m=self.config.map_radius_m, limit=self.config.max_map_neighbors,
        )  # fmt: skip
        embedding = _tabulated(self.relation, self.config.map_radius_m)
        values = relative_pose(poses[rows], poses[neighbors.index], seam_rad=self.config.seam_rad)
        return surround(embedding, values, neighbors.index, neighbors.mask, dim=self.config.dim)


def nowhere_unless(mask: Bool[Tensor, "*shape"], position: Float[Tensor, "*shape 2"]) -> Float[Tensor, "*shape 2"]:
    """Positions, infinite where the mask is False, so that nobody is near."""
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
        self.goal = _goal_sight(config)
        self.aim = GoalAim() if config.goal_aim else None

    def goal_parts(self) -> tuple[GoalState | GoalMark | GoalAim, ...]:
        """What sees goals and what aims at them; nothing in a model that does not."""
        return tuple(part for part in (self.goal, self.aim) if part is not None)

    def relations(self) -> Relations:
        """The relation embeddings, tabulated where that does no harm."""
        lag = Grid(-float(self.config.history_tokens), 0.0, self.config.history_tokens + 1)
        return Relations(
            time=_tabulated(self.time_relation, MAX_LOOK_BACK_M, lag),
            map=_tabulated(self.map_relation, self.config.agent_map_radius_m),
            agent=_tabulated(self.agent_relation, self.config.agent_radius_m),
        )

    def embed_agents(self, class_id: Int64[Tensor, "B A"], size: Float[Tensor, "B A 3"]) -> Float[Tensor, "B A D"]:
        """Embedding of class and size (length, width, height)."""
        return self.class_embedding(class_id) + self.size(size)

    def embed_tokens(self, end_corners: Float[Tensor, "C V 4 2"]) -> Float[Tensor, "C V D"]:
        """Embedding of every motion token of every class."""
        return torch.stack([embed(table.flatten(1)) for embed, table in zip(self.tokens, end_corners)])

    def forward(
        self,
        scene: Scene,
        steps: TokenSteps,
        past: Past | None,
        hidden: Bool[Tensor, "B N A K"] | None = None,
        goals: SeenGoals | None = None,
    ) -> tuple[Float[Tensor, "R D"], Past]:
        """Features of the valid (agent, step) pairs of a block, in the order of `steps.valid.nonzero()`, and the new past.

        Args:
            scene: map and agents.
            steps: the block.
            past: what earlier blocks left; None = the block begins the scenario.
            hidden: True = the pair takes no part in the attention over time.
            goals: what agents are asked to do; None = nobody is asked anything.
        """
        rows = steps.valid.nonzero(as_tuple=True)
        first_row = 0 if past is None else past.sources[0].shape[0]
        row_of = torch.full(steps.valid.shape, -1, device=steps.valid.device)
        row_of[rows] = torch.arange(len(rows[0]), device=row_of.device)
        new_past = _extend(past, steps, torch.where(row_of >= 0, row_of + first_row, -1))

        poses = Poses(steps.position, steps.heading)[rows]
        x = self._embed_steps(scene, steps, rows, poses, goals)
        before = self._look_back(scene, new_past, steps, rows, poses, hidden)
        around = self._look_at_map(scene, rows, poses)
        pointers = self._point_at_goals(scene, rows, poses, goals)
        others = self._look_at_agents(scene, steps, rows, poses, row_of)
        sources = []
        for index, layers in enumerate(zip(self.time_layers, self.map_layers, self.agent_layers)):
            time_layer, map_layer, agent_layer = layers
            own = normalize(x)
            source = own if past is None else torch.cat([past.sources[index], own])
            sources.append(source)
            x = time_layer(x, source, before)
            x = map_layer(x, None, around, pointers=pointers)
            x = agent_layer(x, normalize(x), others)
        return x, Past(new_past.position, new_past.heading, new_past.row, tuple(sources))

    def _embed_steps(
        self, scene: Scene, steps: TokenSteps, rows: tuple[Tensor, ...], poses: Poses, goals: SeenGoals | None
    ) -> Float[Tensor, "R D"]:
        scenario, _, agent, _ = rows
        motion = steps.motion[rows]
        motion_values = torch.stack([motion.norm(dim=-1), angle_between(heading_vector(poses.heading), motion)], -1)
        known = scene.agent_features[scenario, agent]
        if goals is not None and isinstance(self.goal, GoalState):
            carriers, seen = self.goal.look(goals, poses, rows, seam_rad=self.config.seam_rad)
            known = known.index_add(0, carriers, seen.to(known.dtype))
        state = self.motion(motion_values, known)
        token = scene.token_features[scene.class_id[scenario, agent], steps.token_id[rows]]
        return self.fusion(torch.cat([token, state], -1))

    def _look_back(
        self,
        scene: Scene,
        past: Past,
        steps: TokenSteps,
        rows: tuple[Tensor, ...],
        poses: Poses,
        hidden: Bool[Tensor, "B N A K"] | None,
    ) -> Surroundings:
        """Up to `history_tokens` earlier steps of the same agent."""
        scenario, rollout, agent, step = rows
        before = past.row.shape[-1] - steps.valid.shape[-1]
        lag = torch.arange(1, self.config.history_tokens + 1, device=step.device)
        column = before + step[:, None] - lag  # [R, W]
        place = (scenario[:, None], rollout[:, None], agent[:, None], column.clamp(min=0))
        row = past.row[place]
        mask = (row >= 0) & (column >= 0)
        if hidden is not None:
            mask = mask & ~hidden[place] & ~hidden[rows][:, None]
        elif self.training and self.config.history_drop:
            mask = mask & (torch.rand(mask.shape, device=mask.device) >= self.config.history_drop)
        values = relative_pose(poses, Poses(past.position, past.heading)[place], seam_rad=self.config.seam_rad)
        values = torch.cat([values, -lag[:, None].expand(len(step), -1, 1).to(values.dtype)], -1)
        return surround(scene.relations.time, values, row.clamp(min=0), mask, dim=self.config.dim)

    def _look_at_map(self, scene: Scene, rows: tuple[Tensor, ...], poses: Poses) -> Surroundings:
        """Map tokens of the own scenario within reach."""
        neighbors = within(
            poses.position, rows[0], nowhere_unless(scene.map_mask, scene.map_position), None,
            radius_m=self.config.agent_map_radius_m, limit=self.config.max_agent_map_neighbors,
        )  # fmt: skip
        return self._surround(scene.relations.map, poses, scene.map_poses, neighbors, features=scene.map_features)

    def _point_at_goals(
        self, scene: Scene, rows: tuple[Tensor, ...], poses: Poses, goals: SeenGoals | None
    ) -> Pointers | None:
        """Each agent's goal polyline; None where the model does not see goals so, or nobody has one."""
        if goals is None or not isinstance(self.goal, GoalMark):
            return None
        polyline = goals.polyline[rows[:3]]
        carriers = (polyline >= 0).nonzero()[:, 0]
        token = polyline[carriers]
        values = relative_pose(poses[carriers], scene.map_poses[token[:, None]], seam_rad=self.config.seam_rad)[:, 0]
        # the embedding itself: its table ends where ordinary relations do
        return Pointers(carriers, *self.goal.mark(self.map_relation, values), scene.map_features[token])

    def _look_at_agents(
        self,
        scene: Scene,
        steps: TokenSteps,
        rows: tuple[Tensor, ...],
        poses: Poses,
        row_of: Int64[Tensor, "B N A K"],
    ) -> Surroundings:
        """Other agents of the same scenario, rollout and step within reach."""
        scenario, rollout, agent, step = rows
        candidates = nowhere_unless(steps.valid, steps.position).transpose(2, 3)  # [B, N, K, A, 2]
        _, num_rollouts, num_steps, _, _ = candidates.shape
        neighbors = within(
            poses.position, (scenario * num_rollouts + rollout) * num_steps + step, candidates.flatten(0, 2), agent,
            radius_m=self.config.agent_radius_m, limit=self.config.max_agent_neighbors,
        )  # fmt: skip
        row = row_of.transpose(2, 3).flatten()[neighbors.index].clamp(min=0)
        return self._surround(scene.relations.agent, poses, poses, Neighbors(row, neighbors.mask))

    def _surround(
        self,
        embedding: RelationEmbedding,
        poses: Poses,
        sources: Poses,
        neighbors: Neighbors,
        *,
        features: Float[Tensor, "S D"] | None = None,
    ) -> Surroundings:
        values = relative_pose(poses, sources[neighbors.index], seam_rad=self.config.seam_rad)
        return surround(embedding, values, neighbors.index, neighbors.mask, dim=self.config.dim, features=features)


def _goal_sight(config: SmartConfig) -> GoalState | GoalMark | None:
    match config.goal:
        case "concat":
            return GoalState(config.dim, config.num_frequencies)
        case "indication":
            return GoalMark(config.dim)
        case None:
            return None


def _tabulated(embedding: FourierEmbedding, reach_m: float, *more: Grid) -> RelationEmbedding:
    """A table of an embedding of (distance, bearing, turn, ...), its distances 3 mm apart at 1 m and 14 mm at 30 m.

    Not of one that is trained without dropout, where a gradient is taken to be exact: the embedding itself.
    """
    if not (embedding.is_frozen or embedding.training):
        return embedding
    root = math.sqrt(reach_m)
    distance = Grid(0.0, root, round(root * DISTANCES_PER_ROOT_M) + 1, of_roots=True)
    angle = Grid(-math.pi, math.pi, 2049)
    return TabulatedEmbedding.build(embedding, (distance, angle, angle, *more))


def _extend(past: Past | None, steps: TokenSteps, row: Int64[Tensor, "B N A K"]) -> Past:
    """The past with a block's poses appended; its sources are still those of the past."""
    if past is None:
        return Past(steps.position, steps.heading, row, ())
    return Past(
        torch.cat([past.position, steps.position], 3),
        torch.cat([past.heading, steps.heading], 3),
        torch.cat([past.row, row], 3),
        past.sources,
    )


class SmartNetwork(nn.Module):
    """Map encoder and agent decoder. `class_sizes`: tokens of each class's own head; without them all classes share one."""

    def __init__(self, config: SmartConfig, num_tokens: int, class_sizes: tuple[int, ...] = ()):
        super().__init__()
        self.map_encoder = MapEncoder(config)
        self.decoder = AgentDecoder(config, num_tokens, class_sizes)
        initialize(self)
        for part in self.decoder.goal_parts():
            part.start_blind()
