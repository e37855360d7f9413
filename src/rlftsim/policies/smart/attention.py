"""Attention of rows to their neighbors along relations.

R rows that attend, S sources, K neighbors of a row, D width, H heads, d size of a head (inner = H d), W width of the
features of an edge: D, or 2 D where the neighbors' features are the same in all layers and are stored beside the
relations.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from rlftsim.policies.smart.embeddings import EPSILON, RelationEmbedding, normalize

FLOATS_PER_BLOCK = {"cpu": 1 << 19}
"""Floats of the relations that are processed together: on a processor they fit its cache."""
FLOATS_PER_BLOCK_ELSEWHERE = 1 << 26
WIDTHS, LEAST_WIDTH_STEP = 8, 8
"""Rows share a block if their numbers of neighbors differ by less than an eighth of the largest, or by less than
eight."""
IMPOSSIBLE = -1e9


@dataclass(frozen=True, eq=False)
class NeighborBlock:
    """r rows with similar numbers of neighbors, padded to K."""

    neighbors: Int64[Tensor, "r K"]
    """Rows of the sources; any valid row where the mask is False."""
    bias: Float[Tensor, "r 1 K"]
    """Added to attention scores: 0 for a neighbor, a large negative number for padding. Every row has a neighbor."""
    edge_features: Float[Tensor, "r K W"]
    """Normalized embedding of each row's relation to each neighbor, followed by the neighbor's normalized features
    if W = 2 D. Arbitrary finite numbers for padding."""


@dataclass(frozen=True, eq=False)
class Neighborhoods:
    """The neighbors of all rows, shared by all layers.

    Rows are sorted by their number of neighbors, so little is padded.
    """

    rows: Int64[Tensor, "n"]
    """The rows that have neighbors, block after block."""
    blocks: tuple[NeighborBlock, ...]

    @property
    def sizes(self) -> list[int]:
        """Rows of each block."""
        return [len(block.bias) for block in self.blocks]


@dataclass(frozen=True, eq=False)
class GoalEdges:
    """For each goal-conditioned row one more source, at any distance: the map token nearest to its goal."""

    rows: Int64[Tensor, "g"]
    """The goal-conditioned rows, each once."""
    relation: Float[Tensor, "g D"]
    """Normalized embedding of the relation, as of any other source."""
    goal_relation: Float[Tensor, "g D"]
    """The same with the goal embedding added."""
    features: Float[Tensor, "g D"]
    """Normalized features of the source."""


def build_neighborhoods(
    embedding: RelationEmbedding,
    values: Float[Tensor, "R K n"],
    neighbors: Int64[Tensor, "R K"],
    mask: Bool[Tensor, "R K"],
    *,
    dim: int,
    features: Float[Tensor, "S D"] | None = None,
) -> Neighborhoods:
    """Embed relations and cut the rows into blocks.

    Args:
        embedding: of the n values of a relation.
        values: of each row's relation to each neighbor.
        neighbors: rows of the sources; any valid row where the mask is False.
        mask: True = a neighbor.
        dim: D.
        features: normalized features of the sources, if they are the same in all layers.
    """
    # a row's width is the place of its last neighbor; rows without any are left out
    columns = torch.arange(1, mask.shape[1] + 1, device=mask.device)
    width, order = (mask * columns).amax(-1).sort()
    widths = width.cpu().numpy()
    empty = int(np.searchsorted(widths, 1))
    rows, widths = order[empty:], widths[empty:]
    blocks = []
    pairs = FLOATS_PER_BLOCK.get(mask.device.type, FLOATS_PER_BLOCK_ELSEWHERE) // dim
    for cut in _cut(widths, pairs):
        part, kept = rows[cut], slice(widths[cut].max(initial=1))
        index = neighbors[part, kept]  # [r, K]
        edge_features = _embed_edges(embedding, values[part, kept], index, features)
        bias = torch.zeros_like(edge_features[..., 0]).masked_fill_(~mask[part, kept], IMPOSSIBLE)
        blocks.append(NeighborBlock(index, bias[:, None], edge_features))
    return Neighborhoods(rows, tuple(blocks))


def _embed_edges(
    embedding: RelationEmbedding,
    values: Float[Tensor, "r K n"],
    neighbors: Int64[Tensor, "r K"],
    features: Float[Tensor, "S D"] | None,
) -> Float[Tensor, "r K W"]:
    """Edge features of a block.

    Where a gradient flows, relations are embedded again in the backward pass instead of stored.
    """
    is_constant = embedding.is_frozen and (features is None or not features.requires_grad)
    if is_constant or not torch.is_grad_enabled():
        return _embed_edges_in_place(embedding, values, neighbors, features)

    def embed() -> Float[Tensor, "r K D"]:
        return normalize(embedding(values.flatten(0, 1))).unflatten(0, values.shape[:2])

    # the embedding draws no random numbers, so their state need not be restored
    relation = checkpoint(embed, use_reentrant=False, preserve_rng_state=False)
    return relation if features is None else torch.cat([relation, functional.embedding(neighbors, features)], -1)


def _embed_edges_in_place(
    embedding: RelationEmbedding,
    values: Float[Tensor, "r K n"],
    neighbors: Int64[Tensor, "r K"],
    features: Float[Tensor, "S D"] | None,
) -> Float[Tensor, "r K W"]:
    """The same without gradient and copies."""
    last: nn.Linear = embedding.out[-1]  # type: ignore[assignment]
    hidden = embedding.out[:-1](embedding.embed_inputs(values.flatten(0, 1))).to(last.weight.dtype)  # [rK, D]
    dim = last.out_features
    edge_features = hidden.new_empty(*values.shape[:2], dim if features is None else 2 * dim)
    relation = edge_features.flatten(0, 1)[:, :dim]  # a view
    # subtracting the mean over outputs from the last map's weights makes its outputs mean zero,
    # so that only the division is left of the normalization
    weight, bias = last.weight - last.weight.mean(0), last.bias - last.bias.mean()
    torch.addmm(bias, hidden, weight.mT, out=relation)
    variance = torch.linalg.vector_norm(relation, dim=-1, keepdim=True).square_() / dim
    relation *= variance.add_(EPSILON).rsqrt_()
    if features is not None:
        torch.index_select(features, 0, neighbors.flatten(), out=edge_features.flatten(0, 1)[:, dim:])
    return edge_features


def _cut(widths: np.ndarray, pairs: int) -> list[slice]:
    """Slices of rows of increasing width, of about so many pairs and of similar width.

    At least one slice, maybe empty.
    """
    if not len(widths):
        return [slice(0, 0)]
    step = max(math.ceil(widths[-1] / WIDTHS), LEAST_WIDTH_STEP)
    block = (widths - 1) // step + widths.cumsum() // pairs
    cuts = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(widths)]
    return [slice(a, b) for a, b in itertools.pairwise(cuts)]


class RelationAttention(nn.Module):
    """Attention of rows to their neighbors along relations, with a gate and a feed-forward part.

    Keys and values are linear in the neighbor's features and in the relation. So queries are projected into their
    spaces, and values are aggregated there before they are projected. That is the same function as projecting every
    edge, with less work and no tensor of size edges x H x d. Norm weights are folded into the projections. Terms
    that are constant over the neighbors cancel in the softmax of the keys and are added once for the values.
    """

    def __init__(self, dim: int, num_heads: int, head_dim: int, dropout: float, *, separate_source_norm: bool = False):
        super().__init__()
        inner = num_heads * head_dim
        self.num_heads, self.head_dim, self.dropout = num_heads, head_dim, dropout
        self.target_norm = nn.LayerNorm(dim)
        self.source_norm = nn.LayerNorm(dim) if separate_source_norm else None
        self.relation_norm = nn.LayerNorm(dim)
        self.query = nn.Linear(dim, inner)
        self.source_key = nn.Linear(dim, inner, bias=False)
        self.relation_key = nn.Linear(dim, inner, bias=False)
        self.source_value = nn.Linear(dim, inner)
        self.relation_value = nn.Linear(dim, inner)
        self.skip = nn.Linear(dim, inner)
        self.gate = nn.Linear(inner + dim, inner)
        self.out = nn.Linear(inner, dim)
        self.out_norm = nn.LayerNorm(dim)
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(dim),
            nn.Linear(dim, 4 * dim),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(4 * dim, dim),
            nn.LayerNorm(dim),
        )

    def forward(
        self,
        x: Float[Tensor, "R D"],
        source: Float[Tensor, "S D"] | None,
        neighborhoods: Neighborhoods,
        *,
        goal_edges: GoalEdges | None = None,
    ) -> Float[Tensor, "R D"]:
        """New features of the rows.

        Args:
            x: features of the rows.
            source: normalized (see `normalize`) features of all sources; None = they are in the neighborhoods' edge
                features.
            neighborhoods: the neighbors of each row. A row without any receives a message of exactly zero.
            goal_edges: of goal-conditioned rows.
        """
        target = self.target_norm(x)
        message = self._message(target, source, neighborhoods)
        if goal_edges is not None:
            message = self._apply_goal_edges(message, target, goal_edges)
        gate = torch.sigmoid(self.gate(torch.cat([message, target], -1)))
        x = x + self.out_norm(self.out(message + gate * (self.skip(target) - message)))
        return x + self.feed_forward(x)

    def _message(
        self, target: Float[Tensor, "R D"], source: Float[Tensor, "S D"] | None, neighborhoods: Neighborhoods
    ) -> Float[Tensor, "R inner"]:
        """Attention-weighted values of the neighbors, heads concatenated."""
        source_norm = self.source_norm or self.target_norm
        norms = (self.relation_norm, source_norm)
        values = (self.relation_value, self.source_value)
        # 1. projections of edge features (relation, source) [H, d, 2D] and [H, 2D, d], norm weights and 1 / sqrt(d)
        # inside
        to_key = self._by_head((self.relation_key, self.source_key), norms) / math.sqrt(self.head_dim)
        to_value = self._by_head(values, norms).mT
        # 2. the part of a value that is the same for every neighbor [inner]: maps of the norms' biases, and the
        # maps' own
        constant = torch.stack([value(norm.bias) for value, norm in zip(values, norms)]).sum(0)
        # 3. attend block by block
        query = self.query(target[neighborhoods.rows]).unflatten(-1, (self.num_heads, self.head_dim))  # [n, H, d]
        results = [
            self._attend(block_query, block, to_key, to_value, source)
            for block_query, block in zip(query.split(neighborhoods.sizes), neighborhoods.blocks)
        ]
        value = torch.cat([block_value for block_value, _ in results])
        weight = torch.cat([block_weight for _, block_weight in results])
        # weights sum to 1, unless dropout zeroed some
        value = value + weight * constant.unflatten(-1, (self.num_heads, self.head_dim))
        # 4. back to all rows
        message = target.new_zeros(len(target), self.num_heads * self.head_dim)
        return message.index_copy(0, neighborhoods.rows, value.flatten(-2))

    def _attend(
        self,
        query: Float[Tensor, "r H d"],
        block: NeighborBlock,
        to_key: Float[Tensor, "H d W"],
        to_value: Float[Tensor, "H W d"],
        source: Float[Tensor, "S D"] | None,
    ) -> tuple[Float[Tensor, "r H d"], Float[Tensor, "r H 1"]]:
        """Weighted sums of the neighbors' values, without their constant part, and sums of the weights."""
        # the heads are the batch axis of both products: [H, r, d] @ [H, d, W]
        edge_query = (query.transpose(0, 1) @ to_key).transpose(0, 1)  # [r, H, W]
        gathered, weight = self._gather(edge_query, block, source)
        return (gathered.transpose(0, 1) @ to_value).transpose(0, 1), weight

    def _gather(
        self, query: Float[Tensor, "r H W"], block: NeighborBlock, source: Float[Tensor, "S D"] | None
    ) -> tuple[Float[Tensor, "r H W"], Float[Tensor, "r H 1"]]:
        """Weighted sums of edge features (relations, then sources), and sums of the weights."""
        parts = (block.edge_features,)
        if source is not None:
            parts = (block.edge_features, functional.embedding(block.neighbors, source))
        # without gradient and dropout the fused kernel is faster, although relations and sources are copied
        # together for it
        if not torch.is_grad_enabled() and not (self.training and self.dropout):
            whole = (block.edge_features if source is None else torch.cat(parts, -1))[:, None]  # [r, 1, K, W]
            bias = block.bias[:, None]
            gathered = functional.scaled_dot_product_attention(query[:, None], whole, whole, attn_mask=bias, scale=1.0)
            return gathered[:, 0], torch.ones_like(gathered[:, 0, :, :1])
        scores = block.bias.expand(-1, self.num_heads, -1)
        for part, part_query in zip(parts, query.chunk(len(parts), -1)):
            scores = torch.baddbmm(scores, part_query, part.mT)  # [r, H, K]
        weights = functional.dropout(torch.softmax(scores, -1), self.dropout, self.training)
        return torch.cat([weights @ part for part in parts], -1), weights.sum(-1, keepdim=True)

    def _apply_goal_edges(
        self, message: Float[Tensor, "R inner"], target: Float[Tensor, "R D"], edges: GoalEdges
    ) -> Float[Tensor, "R inner"]:
        """Blend each goal-conditioned row's message with the value of its goal edge.

        The weight of the goal edge is tanh(s / 2), where s is the score that the goal embedding adds to the
        relation. By so much the weight of a goal relation exceeds that of an ordinary one if a row attends to these
        two. A goal embedding of zero gives exactly zero.
        """
        norms = (self.relation_norm, self.source_norm or self.target_norm)
        own = message[edges.rows].unflatten(-1, (self.num_heads, self.head_dim))  # [g, H, d]
        query = self.query(target[edges.rows]).unflatten(-1, (self.num_heads, self.head_dim))
        # the score is linear in the relation, so the difference of relations gives the difference of scores
        key = functional.linear((edges.goal_relation - edges.relation) * norms[0].weight, self.relation_key.weight)
        score = (query * key.view_as(query)).sum(-1, keepdim=True) / math.sqrt(self.head_dim)  # [g, H, 1]
        parts = zip((self.relation_value, self.source_value), norms, (edges.goal_relation, edges.features))
        value = torch.stack([to_value(part * norm.weight + norm.bias) for to_value, norm, part in parts]).sum(0)
        change = torch.tanh(score / 2) * (value.view_as(own) - own)
        return message.index_add(0, edges.rows, change.flatten(-2).to(message.dtype))

    def _by_head(self, maps: tuple[nn.Linear, ...], norms: tuple[nn.LayerNorm, ...]) -> Float[Tensor, "H d W"]:
        """Weights of maps of relations and sources with their norms' weights inside."""
        folded = torch.cat([linear.weight * norm.weight for linear, norm in zip(maps, norms)], -1)
        return folded.unflatten(0, (self.num_heads, self.head_dim))
