"""Attention to the K nearest tokens with relative poses (KNARPE), and the layers made of it.

out_i = W_o sum_j a_ij (v_j + W_v e_ij),  a_ij = softmax_j(q_i (k_j + W_k e_ij) / sqrt(d))

for the neighbors j of token i, where e_ij is the embedding of j's pose in the frame of i. Source: Zhang et al.,
"Real-Time Motion Prediction via Heterogeneous Polyline Transformer with Relative Pose Encoding", NeurIPS 2023.

Shapes: S queries, M targets, K neighbors, H heads of width d, D = H d, E width of an embedding. `*g` are leading axes
of the queries; the targets' axes `*h` are the first of `*g`. A pose is x, y (m) and heading (rad).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.geometry import rotate, square_norm


@dataclass(frozen=True, eq=False)
class Neighbors:
    """The nearest targets of each source, in no particular order."""

    index: Int64[Tensor, "*g S K"]
    valid: Bool[Tensor, "*g S K"]
    """False = beyond the radius, or no valid target."""
    embedding: Float[Tensor, "*g S K E"]
    """Embedding of the targets' poses in the frames of the sources."""

    def over_time(self, num_steps: int) -> "Neighbors":
        """The same neighbors at several steps [B, T, S, K], for tokens [B, S] that do not move."""
        tensors = (self.index, self.valid, self.embedding)
        return Neighbors(*(v[:, None].expand(-1, num_steps, *v.shape[1:]) for v in tensors))


def relative_pose(pose: Float[Tensor, "*#g 3"], frame: Float[Tensor, "*#g 3"]) -> Float[Tensor, "*g 3"]:
    """Poses in the frames of other poses; headings are not wrapped.

    Args:
        pose: Poses in any frame.
        frame: Poses of the new frames, given in the frame of `pose`.
    """
    position = rotate(pose[..., :2] - frame[..., :2], -frame[..., 2])
    return torch.cat([position, (pose[..., 2] - frame[..., 2])[..., None]], -1)


def pose_embedding(pose: Float[Tensor, "*g 3"], size: int) -> Float[Tensor, "*g E"]:
    """Sines and cosines of poses: a quarter of the numbers for x, a quarter for y, half for the heading.

    Args:
        pose: Relative poses, m and rad.
        size: Width E of the embedding, a multiple of 8.
    """
    step = torch.arange(size // 8, device=pose.device, dtype=pose.dtype)
    frequency = 1.0 / 1000.0 ** (2 * step / (size // 4))  # from 1 rad/m down to about 1 rad/km
    harmonic = torch.arange(1, size // 4 + 1, device=pose.device, dtype=pose.dtype)
    x, y = pose[..., 0, None] * frequency, pose[..., 1, None] * frequency
    heading = pose[..., 2, None] * harmonic
    return torch.cat([x.cos(), x.sin(), y.cos(), y.sin(), heading.cos(), heading.sin()], -1)


@torch.no_grad()
def find_neighbors(
    source: Float[Tensor, "*g S 3"],
    target: Float[Tensor, "*h M 3"],
    target_mask: Bool[Tensor, "*h M"],
    *,
    count: int,
    radius_m: float,
    size: int,
) -> Neighbors:
    """The K nearest targets of each source, fewer where there are fewer targets.

    Args:
        source: Poses that look for neighbors.
        target: Poses of the candidates; the leading axes are the first axes of the sources.
        target_mask: True = the candidate exists.
        count: Number K of neighbors.
        radius_m: Distance beyond which a neighbor is not valid.
        size: Width E of the embedding, a multiple of 8.
    """
    # Targets of [B, M, 3] serve sources of [B, T, N, S, 3].
    extra = source.dim() - target.dim()
    lead = target.shape[:-2]
    target = target.view(*lead, *[1] * extra, *target.shape[-2:])
    mask = target_mask.view(*lead, *[1] * extra, target_mask.shape[-1])
    offset = target[..., None, :, :2] - source[..., :, None, :2]  # [*g, S, M, 2]
    distance = square_norm(offset).sqrt().masked_fill(~mask[..., None, :], torch.inf)
    nearest = distance.topk(min(count, distance.shape[-1]), dim=-1, largest=False, sorted=False)
    index = nearest.indices  # [*g, S, K]
    expanded = target[..., None, :, :].expand(*distance.shape, 3)
    pose = expanded.gather(-2, index[..., None].expand(*index.shape, 3))  # [*g, S, K, 3]
    embedding = pose_embedding(relative_pose(pose, source[..., None, :]), size)
    return Neighbors(index, nearest.values <= radius_m, embedding)


@dataclass(frozen=True, eq=False)
class KeyValues:
    """Projected targets, computed once for all queries."""

    keys: Float[Tensor, "*h H M d"]
    values: Float[Tensor, "*h H M d"]

    def select_steps(self, steps: slice) -> "KeyValues":
        """Keys and values of a range of steps, where the second axis is time."""
        return KeyValues(self.keys[:, steps], self.values[:, steps])


class PoseAttention(nn.Module):
    """Multi-head attention to neighbors, whose relative poses add to keys and values."""

    def __init__(self, dim: int, num_heads: int, dropout: float):
        super().__init__()
        self.num_heads = num_heads
        self.query = nn.Linear(dim, dim)
        self.key_value = nn.Linear(dim, 2 * dim)
        self.relation = nn.Linear(dim, 2 * dim)
        self.out = nn.Linear(dim, dim)
        self.dropout = nn.Dropout(dropout)
        # A single matrix of 3 D rows would be drawn from a narrower range.
        bound = math.sqrt(6 / (4 * dim))
        for layer in (self.query, self.key_value):
            nn.init.uniform_(layer.weight, -bound, bound)
        nn.init.xavier_uniform_(self.out.weight)
        for layer in (self.query, self.key_value, self.out):
            nn.init.zeros_(layer.bias)

    def project(self, targets: Float[Tensor, "*h M D"]) -> KeyValues:
        """Keys and values of targets."""
        split = self.key_value(targets).unflatten(-1, (2, self.num_heads, -1))  # [*h, M, 2, H, d]
        keys, values = split.unbind(-3)
        return KeyValues(keys.transpose(-2, -3), values.transpose(-2, -3))

    def forward(
        self, queries: Float[Tensor, "*g S D"], sources: Sequence[tuple[KeyValues, Neighbors]]
    ) -> Float[Tensor, "*g S D"]:
        """Attention to neighbors from one or several sources, in a single softmax; 0 for a query without neighbors.

        Args:
            queries: Normalized features of the tokens that attend.
            sources: Targets of each source, and the queries' neighbors among these targets.
        """
        heads, rows = self.num_heads, queries.shape[:-1]  # rows = [*g, S]
        query = self.query(queries).unflatten(-1, (heads, -1)) / math.sqrt(queries.shape[-1] // heads)
        key_relation, value_relation = self.relation.weight.unflatten(0, (2, heads, -1))  # [H, d, E] each
        # Embeddings are never projected: q (W e) = (W^T q) e. The bias of W_k drops out of the softmax.
        pose_query = torch.einsum("...hd,hde->...he", query, key_relation)  # [*g, S, H, E]
        logits = []
        for targets, neighbors in sources:
            # All pairs by one matrix product are cheaper than copies of each neighbor's key.
            # Axes of the queries that the keys do not have are merged into R rows.
            merged = query.reshape(*targets.keys.shape[:-3], -1, *query.shape[-2:]).transpose(-2, -3)
            dense = merged @ targets.keys.transpose(-1, -2)  # [*h, H, R, M]
            picked = dense.gather(-1, _merge_index(neighbors.index, dense))  # [*h, H, R, K]
            content = picked.transpose(-2, -3).reshape(*rows, heads, picked.shape[-1])  # [*g, S, H, K]
            pose = pose_query @ neighbors.embedding.transpose(-1, -2)
            logits.append((content + pose).masked_fill(~neighbors.valid[..., None, :], -torch.inf))
        joined = torch.cat(logits, -1)  # [*g, S, H, all K]
        is_alone = joined.isneginf().all(-1, keepdim=True)
        weights = self.dropout(torch.softmax(joined.masked_fill(is_alone, 0.0), -1))
        weights_by_source = weights.split([block.shape[-1] for block in logits], -1)
        out = weights.sum(-1, keepdim=True) * self.relation.bias.unflatten(0, (2, heads, -1))[1]  # [*g, S, H, d]
        for weight, (targets, neighbors) in zip(weights_by_source, sources):
            pose_value = weight @ neighbors.embedding.to(weight.dtype)  # [*g, S, H, E]
            out = out + torch.einsum("...he,hde->...hd", pose_value, value_relation)
            merged = weight.flatten(targets.keys.dim() - 3, -3).transpose(-2, -3)  # [*h, H, R, K]
            dense = merged.new_zeros(*merged.shape[:-1], targets.keys.shape[-2])
            dense = dense.scatter(-1, _merge_index(neighbors.index, dense), merged)  # [*h, H, R, M]
            out = out + (dense @ targets.values.to(dense.dtype)).transpose(-2, -3).reshape(out.shape)
        out = self.out(out.masked_fill(is_alone, 0.0).flatten(-2))
        return out.masked_fill(is_alone[..., 0, :], 0.0)


def _merge_index(index: Int64[Tensor, "*g S K"], dense: Float[Tensor, "*h H R M"]) -> Int64[Tensor, "*h H R K"]:
    """Neighbors of merged rows, without copies for the heads."""
    *lead, heads, rows, _ = dense.shape
    return index.reshape(*lead, 1, rows, index.shape[-1]).expand(*lead, heads, rows, index.shape[-1])


class FeedForward(nn.Module):
    """Two linear layers with ReLU between, pre-normalized, with residual."""

    def __init__(self, dim: int, dropout: float):
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.wide = nn.Linear(dim, 4 * dim)
        self.narrow = nn.Linear(4 * dim, dim)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Float[Tensor, "*g D"]) -> Float[Tensor, "*g D"]:
        """Features of the same tokens."""
        hidden = self.dropout(functional.relu(self.wide(self.norm(x))))
        return x + self.dropout(self.narrow(hidden))


class SelfLayer(nn.Module):
    """Layer in which tokens attend to neighbors of the same type."""

    def __init__(self, dim: int, num_heads: int, dropout: float):
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.attention = PoseAttention(dim, num_heads, dropout)
        self.dropout = nn.Dropout(dropout)
        self.feed_forward = FeedForward(dim, dropout)

    def forward(
        self, x: Float[Tensor, "*g S D"], mask: Bool[Tensor, "*g S"], neighbors: Neighbors
    ) -> Float[Tensor, "*g S D"]:
        """Features after the layer, 0 for tokens that do not exist.

        Args:
            x: Features of the tokens, D numbers each.
            mask: True = the token exists; other tokens get features of 0.
            neighbors: Neighbors of each token among the tokens.
        """
        normal = self.norm(x)
        x = x + self.dropout(self.attention(normal, [(self.attention.project(normal), neighbors)]))
        return torch.where(mask[..., None], self.feed_forward(x), 0.0)


class DecoderLayer(nn.Module):
    """Layer in which tokens attend to neighbors of the same type, then to neighbors from other sources."""

    def __init__(self, dim: int, num_heads: int, dropout: float):
        super().__init__()
        self.own_norm = nn.LayerNorm(dim)
        self.own_attention = PoseAttention(dim, num_heads, dropout)
        self.norm = nn.LayerNorm(dim)
        self.target_norm = nn.LayerNorm(dim)
        self.attention = PoseAttention(dim, num_heads, dropout)
        self.dropout = nn.Dropout(dropout)
        self.feed_forward = FeedForward(dim, dropout)

    def project(self, targets: Float[Tensor, "*h M D"]) -> KeyValues:
        """Keys and values of tokens from another source."""
        return self.attention.project(self.target_norm(targets))

    def forward(
        self,
        x: Float[Tensor, "*g S D"],
        mask: Bool[Tensor, "*g S"],
        neighbors: Neighbors,
        sources: Sequence[tuple[KeyValues, Neighbors]],
    ) -> Float[Tensor, "*g S D"]:
        """Features after the layer, 0 for tokens that do not exist.

        Args:
            x: Features of the tokens, D numbers each.
            mask: True = the token exists; other tokens get features of 0.
            neighbors: Neighbors of each token among the tokens.
            sources: Targets of other types, from this layer's `project`, and the tokens' neighbors among these.
        """
        normal = self.own_norm(x)
        x = x + self.dropout(self.own_attention(normal, [(self.own_attention.project(normal), neighbors)]))
        x = x + self.dropout(self.attention(self.norm(x), sources))
        return torch.where(mask[..., None], self.feed_forward(x), 0.0)


class PolylineEncoder(nn.Module):
    """Encoder of a sequence in a single feature: three layers of each element and the maximum over all elements."""

    def __init__(self, dim: int, dropout: float):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(dim, dim // 2) for _ in range(3))
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Float[Tensor, "*g P D"], mask: Bool[Tensor, "*g P"]) -> Float[Tensor, "*g D"]:
        """Features of sequences; 0 for those without elements.

        Args:
            x: Features of the elements, P per sequence.
            mask: True = the element exists.
        """
        first, *further_layers = (cast(nn.Linear, layer) for layer in self.layers)
        features = self.dropout(functional.relu(first(x)))  # [*g, P, D/2]
        maximum = _masked_max(features, mask)
        for layer in further_layers:
            # The linear layer of [features, maximum] in two terms; the second is computed once for a sequence.
            weight, maximum_weight = layer.weight.chunk(2, dim=-1)
            hidden = functional.linear(features, weight, layer.bias)
            hidden = hidden + functional.linear(maximum, maximum_weight)[..., None, :]
            features = self.dropout(functional.relu(hidden))
            maximum = _masked_max(features, mask)
        # The maximum of [features, maximum] over the elements is the maximum, twice.
        return torch.cat([maximum, maximum], -1)


def _masked_max(x: Float[Tensor, "*g P C"], mask: Bool[Tensor, "*g P"]) -> Float[Tensor, "*g C"]:
    # Values are not negative after ReLU, so 0 for elements that do not exist changes no maximum.
    return torch.where(mask[..., None], x, 0.0).amax(-2)
