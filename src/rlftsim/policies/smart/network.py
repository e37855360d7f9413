"""The network of SMART: a map encoder and a decoder over agents and token steps.

B scenarios, N rollouts, A agents, K token steps of a block, M map tokens, D width. Everything that attends is a *row*: one valid
(scenario, rollout, agent, step), flattened. The decoder works on a block of steps given what came before, so the history (once per
scenario), a single step of a rollout and all steps of a scoring pass go through the same code.
"""

import math
from collections.abc import Callable
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
    RelationAttention,
    TabulatedEmbedding,
    initialize,
    normalize,
)
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.heads import ClassHeads
from rlftsim.policies.smart.neighbors import Neighbors, Poses, nearest_within, pad_lists, relative_pose
from rlftsim.tokens.map_tokens import NUM_KINDS, NUM_LIGHTS, NUM_TYPES, MapTokens
from rlftsim.tokens.vocabulary import CLASS_NAMES

MAX_LOOK_BACK_M = 160.0
"""Farthest that anybody gets while it is remembered (3 s at 50 m/s), for tables."""


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


RelationEmbedding = Callable[[Float[Tensor, "E n"]], Float[Tensor, "E D"]]


@dataclass(frozen=True, eq=False)
class Relations:
    """How the decoder embeds relations: the networks themselves while they are trained, tables of them once they are frozen."""

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
        neighbors = self._neighbors(tokens)
        poses = Poses(tokens.position.flatten(0, 1), tokens.heading.flatten())
        embedding = _tabulated(self.relation, self.config.map_radius_m)
        relation = relation_features(embedding, poses[rows], poses, neighbors, seam_rad=self.config.seam_rad)
        updated = x[rows]
        for layer in self.layers:
            source = x.index_copy(0, rows, normalize(updated))
            updated = layer(updated, source, relation, neighbors.index, neighbors.mask)
        return x.index_copy(0, rows, updated)

    def _neighbors(self, tokens: MapTokens) -> Neighbors:
        lists = []
        width = tokens.token_mask.shape[1]
        for b, (position, mask) in enumerate(zip(tokens.position, tokens.token_mask)):
            count = int(mask.sum())
            own = position[:count]
            other = ~torch.eye(count, dtype=torch.bool, device=own.device)
            index, near = nearest_within(
                own, own, other, radius_m=self.config.map_radius_m, limit=self.config.max_map_neighbors
            )
            lists.append(Neighbors(index + b * width, near))
        return pad_lists(lists)


def relation_features(
    embedding: RelationEmbedding, rows: Poses, sources: Poses, neighbors: Neighbors, *, seam_rad: float
) -> Float[Tensor, "R K D"]:
    """Normalised embedding of the relation of each row [R] to each of its neighbours among the sources [S]; zero where there is none."""
    values = relative_pose(rows, sources[neighbors.index], seam_rad=seam_rad)
    return _embed_where(embedding, values, neighbors.mask)


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

    def relations(self) -> Relations:
        """The relation embeddings, tabulated where nothing in them is trained."""
        lag = Grid(-float(self.config.history_tokens), 1.0, self.config.history_tokens + 1)
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
        self, scene: Scene, steps: TokenSteps, past: Past | None, hidden: Bool[Tensor, "B N A K"] | None = None
    ) -> tuple[Float[Tensor, "R D"], Past]:
        """Features of the valid (agent, step) pairs of a block, in the order of `steps.valid.nonzero()`, and the new past.

        Args:
            scene: map and agents.
            steps: the block.
            past: what earlier blocks left; None = the block begins the scenario.
            hidden: True = the pair takes no part in the attention over time.
        """
        rows = steps.valid.nonzero(as_tuple=True)
        first_row = 0 if past is None else past.sources[0].shape[0]
        row_of = torch.full(steps.valid.shape, -1, device=steps.valid.device)
        row_of[rows] = torch.arange(len(rows[0]), device=row_of.device)
        new_past = _extend(past, steps, torch.where(row_of >= 0, row_of + first_row, -1))

        x = self._embed_steps(scene, steps, rows)
        time, time_relation = self._look_back(scene, new_past, steps, rows, hidden)
        around, map_relation = self._look_at_map(scene, steps, rows)
        others, agent_relation = self._look_at_agents(scene, steps, rows, row_of)
        sources = []
        for index, layers in enumerate(zip(self.time_layers, self.map_layers, self.agent_layers)):
            time_layer, map_layer, agent_layer = layers
            own = normalize(x)
            source = own if past is None else torch.cat([past.sources[index], own])
            sources.append(source)
            x = time_layer(x, source, time_relation, time.index, time.mask)
            x = map_layer(x, scene.map_features, map_relation, around.index, around.mask)
            x = agent_layer(x, normalize(x), agent_relation, others.index, others.mask)
        return x, Past(new_past.position, new_past.heading, new_past.row, tuple(sources))

    def _embed_steps(self, scene: Scene, steps: TokenSteps, rows: tuple[Tensor, ...]) -> Float[Tensor, "R D"]:
        scenario, _, agent, _ = rows
        motion, heading = steps.motion[rows], steps.heading[rows]
        motion_values = torch.stack([motion.norm(dim=-1), angle_between(heading_vector(heading), motion)], -1)
        state = self.motion(motion_values, scene.agent_features[scenario, agent])
        token = scene.token_features[scene.class_id[scenario, agent], steps.token_id[rows]]
        return self.fusion(torch.cat([token, state], -1))

    def _look_back(
        self,
        scene: Scene,
        past: Past,
        steps: TokenSteps,
        rows: tuple[Tensor, ...],
        hidden: Bool[Tensor, "B N A K"] | None,
    ) -> tuple[Neighbors, Float[Tensor, "R W D"]]:
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
        neighbors = Neighbors(row.clamp(min=0), mask)
        values = relative_pose(
            Poses(steps.position, steps.heading)[rows],
            Poses(past.position, past.heading)[place],
            seam_rad=self.config.seam_rad,
        )
        values = torch.cat([values, -lag[:, None].expand(len(step), -1, 1).to(values.dtype)], -1)
        return neighbors, _embed_where(scene.relations.time, values, mask)

    def _look_at_map(
        self, scene: Scene, steps: TokenSteps, rows: tuple[Tensor, ...]
    ) -> tuple[Neighbors, Float[Tensor, "R W D"]]:
        """Map tokens of the own scenario within reach."""
        lists = []
        width = scene.map_mask.shape[1]
        position = steps.position[rows]
        counts = torch.bincount(rows[0], minlength=len(scene.map_mask)).tolist()
        for b, part in enumerate(position.split(counts)):
            index, near = nearest_within(
                part, scene.map_position[b][scene.map_mask[b]], None,
                radius_m=self.config.agent_map_radius_m, limit=self.config.max_agent_map_neighbors,
            )  # fmt: skip
            lists.append(Neighbors(index + b * width, near))
        neighbors = pad_lists(lists)
        sources = Poses(scene.map_position.flatten(0, 1), scene.map_heading.flatten())
        return neighbors, relation_features(
            scene.relations.map,
            Poses(steps.position, steps.heading)[rows],
            sources,
            neighbors,
            seam_rad=self.config.seam_rad,
        )

    def _look_at_agents(
        self, scene: Scene, steps: TokenSteps, rows: tuple[Tensor, ...], row_of: Int64[Tensor, "B N A K"]
    ) -> tuple[Neighbors, Float[Tensor, "R W D"]]:
        """Other agents of the same scenario, rollout and step within reach."""
        position = steps.position.transpose(2, 3)  # [B, N, K, A, 2]
        valid = steps.valid.transpose(2, 3)
        other = ~torch.eye(valid.shape[-1], dtype=torch.bool, device=valid.device)
        index, near = nearest_within(
            position, position, valid[..., None, :] & valid[..., None] & other,
            radius_m=self.config.agent_radius_m, limit=self.config.max_agent_neighbors,
        )  # fmt: skip
        scenario, rollout, agent, step = rows
        index, near = index[scenario, rollout, step, agent], near[scenario, rollout, step, agent]
        neighbors = Neighbors(row_of[scenario[:, None], rollout[:, None], index, step[:, None]].clamp(min=0), near)
        poses = Poses(steps.position, steps.heading)[rows]
        return neighbors, relation_features(
            scene.relations.agent, poses, poses, neighbors, seam_rad=self.config.seam_rad
        )


def _tabulated(embedding: FourierEmbedding, reach_m: float, *more: Grid) -> RelationEmbedding:
    """A table of an embedding of (distance, bearing, turn, ...) if it is frozen, else the embedding itself."""
    angle = Grid(-math.pi, 2 * math.pi / 2048, 2049)
    grids = (Grid(0.0, 0.01, round(reach_m * 100) + 1), angle, angle, *more)
    return TabulatedEmbedding.build(embedding, grids) if embedding.is_frozen else embedding


def _embed_where(
    embedding: RelationEmbedding, values: Float[Tensor, "R K n"], mask: Bool[Tensor, "R K"]
) -> Float[Tensor, "R K D"]:
    """Normalised embedding of relations, zero where there is none."""
    embedded = normalize(embedding(values[mask]))
    return embedded.new_zeros(*mask.shape, embedded.shape[-1]).masked_scatter(mask[..., None], embedded)


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
