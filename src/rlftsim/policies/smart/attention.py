"""Attention of rows to their neighbors along relations.

R rows that attend, S sources, K neighbors of a row, D width, H heads, d size of a head (inner = H d), W width of the
features of an edge: D, or 2 D where the neighbors' features are the same in all layers and are stored beside the
relations.

Dropout draws masks from 16-bit integers. torch draws a random number for each element of a mask, four times as many.
Such masks are a tenth of a CAT-K update.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.autograd.function import Function, once_differentiable
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from rlftsim.policies.smart.embeddings import EPSILON, RelationEmbedding, normalize
from rlftsim.policies.smart.neighbors import RowGroups

CHANCES = 1 << 16
"""Values of an integer; probabilities are rounded to multiples of 1 / 65 536."""
FLOATS_PER_BLOCK = {"cpu": 1 << 19}
"""Floats of the relations that are processed together: on a processor they fit the cache."""
FLOATS_PER_BLOCK_ELSEWHERE = 1 << 26
MOST_ROWS_PER_BLOCK = 65535
"""Largest grid of the fused attention on CUDA (pytorch#142228)."""
WIDTHS, LEAST_WIDTH_STEP = 8, 8
"""Rows share a block if their numbers of neighbors differ by less than an eighth of the largest, or by less than
eight."""
IMPOSSIBLE = -1e9


def draw_dropout(x: Float[Tensor, "*shape"], probability: float) -> Float[Tensor, "*shape"]:
    """Independent factors: zero with a probability, else so large that the mean is 1.

    Args:
        x: Tensor with the shape, the type and the device of the factors; no value is read.
        probability: Chance in [0, 1) that a factor is zero, rounded to a multiple of 1 / 65 536.
    """
    num_dropped = round(probability * CHANCES)
    words = torch.empty((x.numel() + 3) // 4, dtype=torch.int64, device=x.device).random_(-(1 << 63), None)
    values = words.view(torch.int16)[: x.numel()].view(x.shape)
    factors = x.new_empty(x.shape)
    # zeros and ones of the type of x at once: conversion of a boolean mask would take longer than drawing it
    torch.ge(values, num_dropped - CHANCES // 2, out=factors)
    return factors.mul_(CHANCES / (CHANCES - num_dropped))


class Dropout(nn.Dropout):
    """torch's dropout with masks that are drawn faster."""

    def forward(self, input: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:  # torch's name
        """Each element zeroed with probability p and else scaled by 1 / (1 - p); in evaluation mode the input."""
        return input * draw_dropout(input, self.p) if self.training and self.p else input


@dataclass(frozen=True, eq=False)
class NeighborBlock:
    """r lists of similar numbers of neighbors, padded to K."""

    neighbors: Int64[Tensor, "r K"]
    """Rows of the sources; any valid row where the mask is False."""
    bias: Float[Tensor, "r 1 K"]
    """Added to attention scores: 0 for a neighbor, a large negative number for padding. Every row has a neighbor."""
    edge_features: Float[Tensor, "r K W"]
    """Normalized embedding of each row's relation to each neighbor, followed by the neighbor's normalized features
    if W = 2 D. Arbitrary finite numbers for padding."""
    num_sharing: int = 1
    """m: so many rows share each list and attend as a single row with m H heads. The block has r m rows."""


@dataclass(frozen=True, eq=False)
class Neighborhoods:
    """The neighbors of all rows, shared by all layers.

    Rows are sorted by the number of neighbors, so little is padded. Off the CPU, in closed loop, all rows are there in
    the given order, padded to the same width.
    """

    rows: Int64[Tensor, "n"] | None
    """The rows that have neighbors, block after block; None = all rows in order."""
    blocks: tuple[NeighborBlock, ...]
    gradients: "EdgeGradients | None"
    """Sums of the layers' gradients of the edge features; None where these are constants."""
    has_neighbor: Bool[Tensor, "R"] | None = None
    """True = the row has a neighbor, where all rows are there."""

    @property
    def sizes(self) -> list[int]:
        """Rows of each block."""
        return [len(block.neighbors) * block.num_sharing for block in self.blocks]


@dataclass(frozen=True, eq=False)
class GoalEdges:
    """A further source for each goal-conditioned row, at any distance: the map token nearest to the goal."""

    rows: Int64[Tensor, "g"]
    """The goal-conditioned rows, each once."""
    relation: Float[Tensor, "g D"]
    """Normalized embedding of the relation, as for ordinary sources."""
    goal_relation: Float[Tensor, "g D"]
    """`relation` with the goal embedding added."""
    features: Float[Tensor, "g D"]
    """Normalized features of the source."""


def build_neighborhoods(
    embedding: RelationEmbedding,
    values: Float[Tensor, "R K n"],
    neighbors: Int64[Tensor, "R K"],
    mask: Bool[Tensor, "R K"],
    *,
    dim: int,
    padded: bool = False,
    features: Float[Tensor, "S D"] | None = None,
    groups: RowGroups | None = None,
) -> Neighborhoods:
    """Embed relations and cut the lists into blocks.

    Args:
        embedding: Embedding of the n values of a relation, computed once for all layers.
        values: Values of each row's relation to each neighbor, such as distance and bearing, meters and radians.
        neighbors: Row of the sources of each neighbor; any valid row where the mask is False.
        mask: True = the entry is a neighbor, False = padding.
        dim: Width D of all features, which decides how many relations a block has.
        padded: Whether all rows keep order and width, so that blocks depend on shapes alone.
        features: Normalized features of the sources, if all layers read the same; None = each layer hands in others.
        groups: Rows that share each of the R lists; None = a list per row.
    """
    pairs = FLOATS_PER_BLOCK.get(mask.device.type, FLOATS_PER_BLOCK_ELSEWHERE) // dim
    if padded:
        size = min(max(pairs // mask.shape[1], 1), MOST_ROWS_PER_BLOCK)
        rows, cuts = None, [(slice(start, start + size), slice(None), 1) for start in range(0, len(mask), size)]
    else:
        rows, cuts = _sort(mask, pairs, groups)
    blocks = []
    for lists, columns, num_sharing in cuts:
        index = neighbors[lists, columns]  # [r, K]
        edge_features = _embed_edges(embedding, values[lists, columns], index, features)
        bias = torch.zeros_like(edge_features[..., 0]).masked_fill_(~mask[lists, columns], IMPOSSIBLE)
        blocks.append(NeighborBlock(index, bias[:, None], edge_features, num_sharing))
    is_trained = any(block.edge_features.requires_grad for block in blocks)
    gradients = EdgeGradients.from_blocks(blocks) if is_trained else None
    return Neighborhoods(rows, tuple(blocks), gradients, mask.any(-1) if padded else None)


def _sort(
    mask: Bool[Tensor, "R K"], pairs: int, groups: RowGroups | None
) -> tuple[Int64[Tensor, "n"], list[tuple[Int64[Tensor, "_"], slice, int]]]:
    """Rows that have neighbors, block after block, and each block's lists, columns and number of rows per list.

    A group whose size is no power of two is divided into groups of such sizes.
    """
    # 1. a list is as wide as the column of its last neighbor; lists without a neighbor are left out
    columns = torch.arange(1, mask.shape[1] + 1, device=mask.device)
    widths = (mask * columns).amax(-1).cpu().numpy()
    sizes = np.ones_like(widths) if groups is None else groups.sizes
    # 2. blocks of lists with as many rows, from the narrowest to the widest; of a divided group the smaller come first
    # torch's order of equal widths: dropout masks are drawn block after block, so a stored run goes on with its own
    order = torch.from_numpy(widths).sort().indices.numpy()
    lists, rows, shapes = [], [], []
    for count in (1 << power for power in range(int(sizes.max(initial=1)).bit_length())):
        selected = order[(sizes[order] & count > 0) & (widths[order] > 0)]
        starts = (sizes.cumsum() - sizes + (sizes & (count - 1)))[selected]
        lists.append(selected)
        rows.append((starts[:, None] + np.arange(count)).flatten())
        cuts = _cut(widths[selected], pairs) if len(selected) or count == 1 else []
        shapes += [(cut.stop - cut.start, slice(int(widths[selected[cut]].max(initial=1))), count) for cut in cuts]
    sorted_lists = torch.from_numpy(np.concatenate(lists)).to(mask.device)
    blocks = sorted_lists.split([num_lists for num_lists, _, _ in shapes])
    blocks = [(block, columns, count) for block, (_, columns, count) in zip(blocks, shapes)]
    return sorted_lists if groups is None else groups.rows[np.concatenate(rows)], blocks


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
    if not is_constant and torch.is_grad_enabled():

        def embed() -> Float[Tensor, "r K D"]:
            return normalize(embedding(values.flatten(0, 1))).unflatten(0, values.shape[:2])

        # the embedding draws no random numbers, so their state need not be restored
        relation = checkpoint(embed, use_reentrant=False, preserve_rng_state=False)
        return relation if features is None else torch.cat([relation, functional.embedding(neighbors, features)], -1)
    # the same without gradient and copies
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
    """Slices, at least one, of rows of increasing width: of about so many pairs, and of similar width."""
    if not len(widths):
        return [slice(0, 0)]
    step = max(math.ceil(widths[-1] / WIDTHS), LEAST_WIDTH_STEP)
    block = (widths - 1) // step + widths.cumsum() // pairs
    cuts = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(widths)]
    return [slice(a, b) for a, b in itertools.pairwise(cuts)]


@dataclass(frozen=True, eq=False)
class EdgeGradients:
    """Gradients of all blocks' edge features, which the attending layers add up in a single buffer per block.

    Autograd would make a tensor of that size in each layer and sum these. Instead each layer depends on a token and
    adds to the buffers in the backward pass. The token's node comes after all layers and hands the buffers on.
    """

    buffers: list[Float[Tensor, "_ _ W"] | None]
    """None = no layer has added a gradient."""
    token: Float[Tensor, ""]
    """A number without a meaning that depends on the edge features."""

    @classmethod
    def from_blocks(cls, blocks: Sequence[NeighborBlock]) -> "EdgeGradients":
        """Empty gradients of the edge features of blocks."""
        buffers: list[Tensor | None] = [None] * len(blocks)
        token = _HandOver.apply(buffers, *(block.edge_features for block in blocks))
        return cls(buffers, token)  # type: ignore[arg-type]


class _HandOver(Function):
    """A token that depends on tensors; the backward pass hands the gradients on that are in the buffers by then."""

    @staticmethod
    def forward(ctx: Any, buffers: list[Tensor | None], *tensors: Tensor) -> Tensor:
        ctx.buffers = buffers
        return tensors[0].new_zeros(())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, ...]:
        gradients = tuple(ctx.buffers)
        ctx.buffers[:] = [None] * len(gradients)  # the graph may be gone through again
        return None, *gradients


def gather_edges(
    queries: tuple[Float[Tensor, "n H _"], ...],
    source: Float[Tensor, "S D"] | None,
    neighborhoods: Neighborhoods,
    dropout: float,
) -> tuple[tuple[Float[Tensor, "n H _"], ...], Float[Tensor, "n H 1"]]:
    """Attention-weighted sums of edge features, and of sources if there are any, and sums of the weights.

    Args:
        queries: Queries in the space of edge features [n, H, W], and in the space of sources [n, H, D].
        source: Features of all sources; None = the edge features include the features of the neighbors.
        neighborhoods: Neighbors of the n rows, whose edge features are keys and values alike.
        dropout: Chance in [0, 1) that a weight is zeroed, as in training.
    """
    if torch.is_grad_enabled() or dropout:
        token = None if neighborhoods.gradients is None else neighborhoods.gradients.token
        # autocast would copy the edge features in each layer: here reading them costs more than computing with them
        with torch.autocast(queries[0].device.type, enabled=False):
            dtype = neighborhoods.blocks[0].edge_features.dtype
            tensors = (None if t is None else t.to(dtype) for t in (source, *queries))
            *sums, total = _GatherEdges.apply(neighborhoods, dropout, token, *tensors)  # type: ignore
        return tuple(sums), total
    # the fused kernel is faster, although relations and sources are copied together for it
    results = []
    for block_query, block in zip(torch.cat(queries, -1).split(neighborhoods.sizes), neighborhoods.blocks):
        spaces = _key_spaces(block.edge_features, block.neighbors, source)
        edges = (spaces[0] if source is None else torch.cat(spaces, -1))[:, None]  # [r, 1, K, 2D]
        query = _by_list(block_query, block.num_sharing * block_query.shape[1])[:, None]  # [r, 1, m H, 2D]
        bias = block.bias[:, None]
        result = functional.scaled_dot_product_attention(query, edges, edges, attn_mask=bias, scale=1.0)
        results.append(result.view(block_query.shape))
    gathered = torch.cat(results)  # [n, H, 2D]
    return gathered.split([q.shape[-1] for q in queries], -1), torch.ones_like(gathered[..., :1])


class _GatherEdges(Function):
    """`gather_edges` with a hand-written backward pass.

    With edge features E, queries q and scores s = q E^T: the weights are A = dropout(P), P = softmax(s), and the sums
    G = A E. Backward dA = dG E^T + d(sum of A), ds = A dA - P sum(A dA), dq = ds E and dE = A^T dG + ds^T q, which is
    a single product of factors that lie side by side. P and A of each block are stored.
    """

    @staticmethod
    def forward(ctx: Any, neighborhoods: Neighborhoods, dropout: float, *tensors: Any) -> tuple[Tensor, ...]:
        _, source, *queries = tensors  # the token, for its gradient, then tensors or None
        sums = [query.new_empty(query.shape) for query in queries]
        total = queries[0].new_empty(*queries[0].shape[:2], 1)
        saved, sizes = [], neighborhoods.sizes
        per_block = zip(neighborhoods.blocks, _split_rows(queries, sizes), _split_rows(sums, sizes), total.split(sizes))
        for block, block_queries, block_sums, block_total in per_block:
            edges = block.edge_features.detach()
            spaces = _key_spaces(edges, block.neighbors, source)
            num_heads = block.num_sharing * total.shape[1]
            scores = block.bias.expand(-1, num_heads, -1)
            for space, query in zip(spaces, block_queries):
                scores = torch.baddbmm(scores, _by_list(query, num_heads), space.mT)  # [r, m H, K]
            softmax = torch.softmax(scores, -1)
            weights = softmax * draw_dropout(softmax, dropout) if dropout else softmax
            for space, result in zip(spaces, block_sums):
                torch.bmm(weights, space, out=_by_list(result, num_heads))
            torch.sum(weights, -1, keepdim=True, out=_by_list(block_total, num_heads))
            saved.append((edges, block.neighbors, softmax, weights))
        # saved in this way, edge features go as soon as the backward pass is through
        ctx.save_for_backward(source, *queries, *itertools.chain(*saved))
        ctx.sizes, ctx.device_type = sizes, total.device.type
        ctx.buffers = None if neighborhoods.gradients is None else neighborhoods.gradients.buffers
        return *sums, total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *sum_grads, total_grad = grads
        source, *saved = ctx.saved_tensors
        queries, saved = saved[: len(sum_grads)], saved[len(sum_grads) :]
        _, _, edges_need_grad, source_needs_grad, *_ = ctx.needs_input_grad
        source_grad = torch.zeros_like(source) if source_needs_grad else None
        query_grads = [query.new_empty(query.shape) for query in queries]
        rows_of_blocks = (_split_rows(rows, ctx.sizes) for rows in (sum_grads, queries, query_grads))
        per_block = zip(zip(*[iter(saved)] * 4), *rows_of_blocks, total_grad.split(ctx.sizes))
        # As in the forward pass: a backward pass may be called under autocast.
        with torch.autocast(ctx.device_type, enabled=False):
            for index, (stored, block_sums, block_queries, block_grads, block_total) in enumerate(per_block):
                edges, neighbors, softmax, weights = stored
                spaces, num_heads = _key_spaces(edges, neighbors, source), weights.shape[1]
                # factors of gradients of the edges [r, 2 m H, W] and of the sources [r, 2 m H, D]
                pairs = ([_by_list(rows, num_heads) for rows in pair] for pair in zip(block_sums, block_queries))
                factors = [torch.cat(pair, 1) for pair in pairs]
                weight_grad = _by_list(block_total, num_heads).expand_as(weights)
                for space, factor in zip(spaces, factors):
                    weight_grad = torch.baddbmm(weight_grad, factor[:, :num_heads], space.mT)  # [r, m H, K]
                score_grad = weight_grad.mul_(weights)
                score_grad = torch.addcmul(score_grad, softmax, score_grad.sum(-1, keepdim=True), value=-1)
                for space, result in zip(spaces, block_grads):
                    torch.bmm(score_grad, space, out=_by_list(result, num_heads))
                by_key = torch.cat([weights, score_grad], 1).mT  # [r, K, 2 m H]
                if edges_need_grad:
                    buffer = ctx.buffers[index]
                    updated = torch.bmm(by_key, factors[0]) if buffer is None else buffer.baddbmm_(by_key, factors[0])
                    ctx.buffers[index] = updated
                if source_grad is not None:
                    source_grad.index_add_(0, neighbors.flatten(), (by_key @ factors[1]).flatten(0, 1))
        token_grad = total_grad.new_zeros(()) if edges_need_grad else None
        return None, None, token_grad, source_grad, *query_grads


def _key_spaces(edges: Tensor, neighbors: Tensor, source: Tensor | None) -> tuple[Tensor, ...]:
    """Edge features, and the neighbors' features if the edge features do not include these."""
    return (edges,) if source is None else (edges, functional.embedding(neighbors, source))


def _by_list(rows: Tensor, num_heads: int) -> Tensor:
    """Rows of a block [r m, H, _] as rows of the block's lists [r, m H, _], with m H heads; a view where possible."""
    return rows.reshape(-1, num_heads, rows.shape[-1])


def _split_rows(tensors: Sequence[Tensor], sizes: list[int]) -> Iterator[tuple[Tensor, ...]]:
    """The rows of each block, of all tensors."""
    return zip(*(tensor.split(sizes) for tensor in tensors))


@dataclass(frozen=True, eq=False)
class AttentionMaps:
    """A layer's maps between its heads and the spaces of relations and sources (2D), with the norms' weights inside."""

    to_key: Float[Tensor, "H d W"]
    """Divided by sqrt(d)."""
    to_value: Float[Tensor, "H W d"]
    constant: Float[Tensor, "H d"]
    """Term of a value that is the same for every neighbor: maps of the norms' biases, and biases of the maps."""


class RelationAttention(nn.Module):
    """Attention of rows to neighbors along relations, with a gate and a feed-forward network.

    Keys and values are linear in the neighbor's features and in the relation. So queries are projected into the
    spaces of these, and values are aggregated there before the projection. That is the same function as projecting
    every edge, with less work and no tensor of size edges x H x d. Norm weights are folded into the projections. Terms
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
            nn.LayerNorm(dim), nn.Linear(dim, 4 * dim), nn.ReLU(), Dropout(dropout),
            nn.Linear(4 * dim, dim), nn.LayerNorm(dim),
        )  # fmt: skip

    def forward(
        self,
        x: Float[Tensor, "R D"],
        source: Float[Tensor, "S D"] | None,
        neighborhoods: Neighborhoods,
        *,
        goal_edges: GoalEdges | None = None,
        maps: AttentionMaps | None = None,
    ) -> Float[Tensor, "R D"]:
        """New features of the rows.

        Args:
            x: Features of the rows before the layer, not normalized.
            source: Normalized (see `normalize`) features of all sources; None = the edge features of the neighborhoods
                include these.
            neighborhoods: Neighbors of each row. A row without a neighbor receives a message of exactly zero.
            goal_edges: Goal edges of goal-conditioned rows; None = no row has a goal polyline.
            maps: Result of `fold()` for the current weights; None = folded here.
        """
        target = self.target_norm(x)
        message = self._message(target, source, neighborhoods, self.fold() if maps is None else maps)
        if goal_edges is not None:
            message = self._apply_goal_edges(message, target, goal_edges)
        gate = torch.sigmoid(self.gate(torch.cat([message, target], -1)))
        x = x + self.out_norm(self.out(message + gate * (self.skip(target) - message)))
        return x + self.feed_forward(x)

    def fold(self) -> AttentionMaps:
        """Maps of the attention, which depend on weights alone."""
        norms = (self.relation_norm, self.source_norm or self.target_norm)
        values = (self.relation_value, self.source_value)
        to_key = self._by_head((self.relation_key, self.source_key), norms) / math.sqrt(self.head_dim)
        to_value = self._by_head(values, norms).mT
        constant = torch.stack([value(norm.bias) for value, norm in zip(values, norms)]).sum(0)
        return AttentionMaps(to_key, to_value, constant.unflatten(-1, (self.num_heads, self.head_dim)))

    def _message(
        self,
        target: Float[Tensor, "R D"],
        source: Float[Tensor, "S D"] | None,
        neighborhoods: Neighborhoods,
        maps: AttentionMaps,
    ) -> Float[Tensor, "R inner"]:
        """Attention-weighted values of the neighbors, heads concatenated."""
        # 1. attend. The heads are the batch axis of both projections: [H, n, d] @ [H, d, 2D]
        rows = neighborhoods.rows
        query = self.query(target if rows is None else target[rows])
        query = query.unflatten(-1, (self.num_heads, self.head_dim)).transpose(0, 1)
        num_spaces = 1 if source is None else 2
        queries = tuple((query @ to_key).transpose(0, 1) for to_key in maps.to_key.chunk(num_spaces, -1))
        sums, weight = gather_edges(queries, source, neighborhoods, self.dropout if self.training else 0.0)
        to_values = maps.to_value.chunk(num_spaces, 1)
        projected = [gathered.transpose(0, 1) @ to_value for gathered, to_value in zip(sums, to_values)]
        value = torch.stack(projected).sum(0).transpose(0, 1)  # [n, H, d]
        # weights sum to 1, unless dropout zeroed some
        value = value + weight * maps.constant
        # 2. back to all rows
        if rows is None:
            assert neighborhoods.has_neighbor is not None
            return torch.where(neighborhoods.has_neighbor[:, None], value.flatten(-2), 0.0)
        message = target.new_zeros(len(target), self.num_heads * self.head_dim)
        return message.index_copy(0, rows, value.flatten(-2))

    def _apply_goal_edges(
        self, message: Float[Tensor, "R inner"], target: Float[Tensor, "R D"], edges: GoalEdges
    ) -> Float[Tensor, "R inner"]:
        """Blend each goal-conditioned row's message with the value of the goal edge.

        The weight of the goal edge is tanh(s / 2), where s is the score that the goal embedding adds to the
        relation. By so much the weight of a goal relation exceeds the weight of an ordinary relation if a row attends
        to these two. A goal embedding of zero gives exactly zero.
        """
        norms = (self.relation_norm, self.source_norm or self.target_norm)
        start = message[edges.rows].unflatten(-1, (self.num_heads, self.head_dim))  # [g, H, d]
        query = self.query(target[edges.rows]).unflatten(-1, (self.num_heads, self.head_dim))
        # the score is linear in the relation, so the difference of relations gives the difference of scores
        key = functional.linear((edges.goal_relation - edges.relation) * norms[0].weight, self.relation_key.weight)
        score = (query * key.view_as(query)).sum(-1, keepdim=True) / math.sqrt(self.head_dim)  # [g, H, 1]
        terms = zip((self.relation_value, self.source_value), norms, (edges.goal_relation, edges.features))
        value = torch.stack([to_value(x * norm.weight + norm.bias) for to_value, norm, x in terms]).sum(0)
        change = torch.tanh(score / 2) * (value.view_as(start) - start)
        return message.index_add(0, edges.rows, change.flatten(-2).to(message.dtype))

    def _by_head(self, maps: tuple[nn.Linear, ...], norms: tuple[nn.LayerNorm, ...]) -> Float[Tensor, "H d W"]:
        """Weights of maps of relations and sources, with the weights of the norms inside."""
        folded = torch.cat([linear.weight * norm.weight for linear, norm in zip(maps, norms)], -1)
        return folded.unflatten(0, (self.num_heads, self.head_dim))
