"""Building blocks of attention models over scenes: Fourier features and attention along relations.

D width, H heads, d size of a head. Initialisation: linear maps Xavier-uniform with zero bias, embeddings N(0, 0.02).
"""

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional


def initialize(module: nn.Module) -> None:
    """Draw the weights of linear maps and embedding tables inside a module anew."""
    for part in module.modules():
        if isinstance(part, nn.Linear):
            nn.init.xavier_uniform_(part.weight)
            if part.bias is not None:
                nn.init.zeros_(part.bias)
        elif isinstance(part, nn.Embedding):
            nn.init.normal_(part.weight, std=0.02)


def normalize(x: Float[Tensor, "... D"]) -> Float[Tensor, "... D"]:
    """Layer norm without weights: shared by all layers that look at the same values, each folds its own weights in."""
    return functional.layer_norm(x, x.shape[-1:])


class MlpEmbedding(nn.Sequential):
    """Continuous values [..., n] → [..., D]: three linear maps, the first two with norm and ReLU. The inner width is 128."""

    def __init__(self, num_inputs: int, dim: int):
        super().__init__(
            nn.Linear(num_inputs, 128), nn.LayerNorm(128), nn.ReLU(),
            nn.Linear(128, dim), nn.LayerNorm(dim), nn.ReLU(),
            nn.Linear(dim, dim),
        )  # fmt: skip


class MlpLayer(nn.Sequential):
    """[..., n] → [..., m] through one hidden layer of width D with norm and ReLU."""

    def __init__(self, num_inputs: int, dim: int, num_outputs: int):
        super().__init__(nn.Linear(num_inputs, dim), nn.LayerNorm(dim), nn.ReLU(), nn.Linear(dim, num_outputs))


class FourierEmbedding(nn.Module):
    """Continuous values [..., n] → [..., D] through learned frequencies; one small network an input, summed, then one more map.

    The n networks are stored side by side ([n, in, out]), so that one batched product serves them all.
    """

    def __init__(self, num_inputs: int, dim: int, num_frequencies: int):
        super().__init__()
        width = 2 * num_frequencies + 1
        self.frequencies = nn.Parameter(0.02 * torch.randn(num_inputs, num_frequencies))
        self.first_weight = nn.Parameter(torch.empty(num_inputs, width, dim))
        self.first_bias = nn.Parameter(torch.zeros(num_inputs, 1, dim))
        self.norm_weight = nn.Parameter(torch.ones(num_inputs, 1, dim))
        self.norm_bias = nn.Parameter(torch.zeros(num_inputs, 1, dim))
        self.second_weight = nn.Parameter(torch.empty(num_inputs, dim, dim))
        self.second_bias = nn.Parameter(torch.zeros(num_inputs, 1, dim))
        self.out = nn.Sequential(nn.LayerNorm(dim), nn.ReLU(), nn.Linear(dim, dim))
        for weight in (self.first_weight, self.second_weight):
            for part in weight.data:
                nn.init.xavier_uniform_(part)

    def forward(self, values: Float[Tensor, "E n"], extra: Float[Tensor, "E D"] | None = None) -> Float[Tensor, "E D"]:
        """Embedding of each row; `extra` (categorical embeddings) joins the sum over inputs."""
        angles = 2 * math.pi * values.t()[..., None] * self.frequencies[:, None]  # [n, E, F]
        features = torch.cat([angles.cos(), angles.sin(), values.t()[..., None]], -1)
        hidden = torch.baddbmm(self.first_bias, features, self.first_weight)
        hidden = functional.relu(torch.addcmul(self.norm_bias, normalize(hidden), self.norm_weight))
        total = torch.baddbmm(self.second_bias, hidden, self.second_weight).sum(0)
        return self.out(total if extra is None else total + extra)


class RelationAttention(nn.Module):
    """Attention of rows to their neighbours along relations, with a gate and a feed-forward part.

    Keys and values are linear in the neighbour's features and in the relation, so queries are projected into their spaces
    and values are aggregated there before they are projected: the same function as projecting every edge, with less work
    and no tensor of size edges x H x d. Norm weights are folded into the projections; what is constant over the neighbours
    cancels in the softmax of the keys and is added once for the values.
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
        source: Float[Tensor, "S D"],
        relation: Float[Tensor, "R K D"],
        neighbors: Int64[Tensor, "R K"],
        neighbor_mask: Bool[Tensor, "R K"],
    ) -> Float[Tensor, "R D"]:
        """New features of the rows.

        Args:
            x: features of the rows.
            source: normalised (see `normalize`) features of everything that can be a neighbour.
            relation: normalised embedding of each row's relation to each neighbour.
            neighbors: rows of `source`; any valid row where the mask is False.
            neighbor_mask: True = a neighbour. A row without any receives a message of exactly zero.
        """
        target = self.target_norm(x)
        message = self._message(target, source[neighbors], relation, neighbor_mask)
        gate = torch.sigmoid(self.gate(torch.cat([message, target], -1)))
        x = x + self.out_norm(self.out(message + gate * (self.skip(target) - message)))
        return x + self.feed_forward(x)

    def _message(
        self,
        target: Float[Tensor, "R D"],
        source: Float[Tensor, "R K D"],
        relation: Float[Tensor, "R K D"],
        mask: Bool[Tensor, "R K"],
    ) -> Float[Tensor, "R inner"]:
        """Attention-weighted values of the neighbours, heads concatenated."""
        source_norm = self.source_norm or self.target_norm
        query = self.query(target).unflatten(-1, (self.num_heads, self.head_dim)) / math.sqrt(self.head_dim)
        to_source, to_relation = (
            torch.einsum("rhd,hdD->rhD", query, self._by_head(key.weight * norm.weight))
            for key, norm in ((self.source_key, source_norm), (self.relation_key, self.relation_norm))
        )
        scores = torch.baddbmm(to_source @ source.mT, to_relation, relation.mT)  # [R, H, K]
        weights = torch.softmax(scores.masked_fill(~mask[:, None], -1e9), -1) * mask[:, None]
        weights = functional.dropout(weights, self.dropout, self.training)
        message = torch.zeros_like(query)
        for values, projection, norm in (
            (source, self.source_value, source_norm),
            (relation, self.relation_value, self.relation_norm),
        ):
            constant = projection(norm.bias).unflatten(-1, (self.num_heads, self.head_dim))
            gathered = weights @ values  # [R, H, D]
            message = message + torch.einsum("rhD,hdD->rhd", gathered, self._by_head(projection.weight * norm.weight))
            message = message + weights.sum(-1, keepdim=True) * constant
        return message.flatten(-2)

    def _by_head(self, weight: Float[Tensor, "inner D"]) -> Float[Tensor, "H d D"]:
        return weight.unflatten(0, (self.num_heads, self.head_dim))
