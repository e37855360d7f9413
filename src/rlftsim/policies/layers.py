"""Building blocks of attention models over scenes: Fourier features and attention along relations.

D width, H heads, d size of a head. Initialisation: linear maps Xavier-uniform with zero bias, embeddings N(0, 0.02).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

EDGES_PER_PIECE = 8192


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
    """Continuous values [E, n] → [E, D] through learned frequencies: a small network for each input, summed, then one more map."""

    def __init__(self, num_inputs: int, dim: int, num_frequencies: int):
        super().__init__()
        width = 2 * num_frequencies + 1
        self.frequencies = nn.Embedding(num_inputs, num_frequencies)
        self.inputs = nn.ModuleList(
            nn.Sequential(nn.Linear(width, dim), nn.LayerNorm(dim), nn.ReLU(inplace=True), nn.Linear(dim, dim))
            for _ in range(num_inputs)
        )
        self.out = nn.Sequential(nn.LayerNorm(dim), nn.ReLU(inplace=True), nn.Linear(dim, dim))

    def forward(self, values: Float[Tensor, "E n"], extra: Float[Tensor, "E D"] | None = None) -> Float[Tensor, "E D"]:
        """Embedding of each row; `extra` (categorical embeddings) joins the sum over inputs."""
        total = self.embed_input(0, values[:, 0])
        for index in range(1, len(self.inputs)):
            total = total + self.embed_input(index, values[:, index])
        return self.out(total if extra is None else total + extra)

    def embed_input(self, index: int, values: Float[Tensor, "E"]) -> Float[Tensor, "E D"]:
        """What a single input adds to the sum."""
        angles = 2 * math.pi * values[:, None] * self.frequencies.weight[index]
        return self.inputs[index](torch.cat([angles.cos(), angles.sin(), values[:, None]], -1))

    @property
    def is_frozen(self) -> bool:
        """Whether no weight is trained."""
        return not any(weight.requires_grad for weight in self.parameters())


@dataclass(frozen=True)
class Grid:
    """Evenly spaced values of one input: `count` of them from `start` on, `spacing` apart."""

    start: float
    spacing: float
    count: int


@dataclass(frozen=True, eq=False)
class TabulatedEmbedding:
    """A frozen FourierEmbedding, looked up: each input's share is a function of one number, interpolated linearly on a grid.

    With distances every centimetre and 2 049 angles, log-probabilities move by about 1e-5. Values outside a grid count as its end.
    """

    table: Float[Tensor, "rows D"]
    start: Float[Tensor, "n"]
    spacing: Float[Tensor, "n"]
    last: Float[Tensor, "n"]
    first_row: Int64[Tensor, "n"]
    out: nn.Module

    @classmethod
    @torch.no_grad()
    def build(cls, embedding: FourierEmbedding, grids: tuple[Grid, ...]) -> "TabulatedEmbedding":
        """Evaluate each input's network on its grid."""
        device = embedding.frequencies.weight.device
        steps = [torch.arange(g.count, device=device) * g.spacing + g.start for g in grids]
        counts = torch.tensor([0, *(g.count for g in grids)], device=device)
        return cls(
            table=torch.cat([embedding.embed_input(i, values) for i, values in enumerate(steps)]),
            start=torch.tensor([g.start for g in grids], device=device),
            spacing=torch.tensor([g.spacing for g in grids], device=device),
            last=(counts[1:] - 1).float(),
            first_row=counts.cumsum(0)[:-1],
            out=embedding.out,
        )

    @torch.no_grad()
    def __call__(self, values: Float[Tensor, "E n"]) -> Float[Tensor, "E D"]:
        """Embedding of each row, in pieces that stay in the processor's cache."""
        return torch.cat([self._look_up(part) for part in values.split(EDGES_PER_PIECE)])

    def _look_up(self, values: Float[Tensor, "E n"]) -> Float[Tensor, "E D"]:
        place = torch.minimum(((values - self.start) / self.spacing).clamp(min=0), self.last)
        low = torch.minimum(place.floor(), (self.last - 1).clamp(min=0))
        share = place - low
        row = low.long() + self.first_row
        rows = torch.cat([row, row + (self.last > 0)], -1)
        total = functional.embedding_bag(
            rows, self.table, mode="sum", per_sample_weights=torch.cat([1 - share, share], -1)
        )
        return self.out(total)


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
