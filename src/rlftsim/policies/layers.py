"""Building blocks of attention models over scenes: Fourier features and attention along relations.

D width, H heads, d size of a head. Initialisation: linear maps Xavier-uniform with zero bias, embeddings N(0, 0.02).
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

FLOATS_PER_PIECE = {"cpu": 1 << 19}
"""Size of the relations that are worked on together: on a processor they fit its cache."""
FLOATS_PER_PIECE_ELSEWHERE = 1 << 26
WIDTHS, LEAST_WIDTH_STEP = 8, 8
"""Rows are worked on together whose numbers of neighbours differ by less than an eighth of the largest, or than eight."""
IMPOSSIBLE = -1e9
EPSILON = 1e-5
"""Added to variances before one is divided by their root."""


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
    return functional.layer_norm(x, x.shape[-1:], eps=EPSILON)


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
        total = self.embed_inputs(values)
        return self.out(total if extra is None else total + extra)

    def embed_inputs(self, values: Float[Tensor, "E n"]) -> Float[Tensor, "E D"]:
        """The sum over inputs."""
        total = self.embed_input(0, values[:, 0])
        for index in range(1, len(self.inputs)):
            total = total + self.embed_input(index, values[:, index])
        return total

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
    """Values of one input: `count` of them from `start` to `stop`, or of their square roots, so that small values lie closer."""

    start: float
    stop: float
    count: int
    of_roots: bool = False


@dataclass(frozen=True, eq=False)
class TabulatedEmbedding:
    """A FourierEmbedding, looked up: each input's share is a function of one number, interpolated linearly on a grid.

    There are far fewer grid points than relations, so this is also the fast way to train: gradients flow through the table.
    Values outside a grid count as its end.
    """

    table: Float[Tensor, "rows D"]
    start: Float[Tensor, "n"]
    spacing: Float[Tensor, "n"]
    last: Float[Tensor, "n"]
    of_roots: Bool[Tensor, "n"]
    first_row: Int64[Tensor, "n"]
    out: nn.Sequential

    @classmethod
    def build(cls, embedding: FourierEmbedding, grids: tuple[Grid, ...]) -> "TabulatedEmbedding":
        """Evaluate each input's network on its grid."""
        like = embedding.frequencies.weight
        steps = [torch.linspace(g.start, g.stop, g.count, dtype=like.dtype, device=like.device) for g in grids]
        steps = [v.square() if g.of_roots else v for v, g in zip(steps, grids)]
        counts = torch.tensor([0, *(g.count for g in grids)], device=like.device)
        return cls(
            table=torch.cat([embedding.embed_input(i, values) for i, values in enumerate(steps)]).to(like.dtype),
            start=like.new_tensor([g.start for g in grids]),
            spacing=like.new_tensor([(g.stop - g.start) / (g.count - 1) for g in grids]),
            last=(counts[1:] - 1).to(like.dtype),
            of_roots=torch.tensor([g.of_roots for g in grids], device=like.device),
            first_row=counts.cumsum(0)[:-1],
            out=embedding.out,
        )

    def __call__(self, values: Float[Tensor, "E n"]) -> Float[Tensor, "E D"]:
        """Embedding of each row."""
        return self.out(self.embed_inputs(values))

    def embed_inputs(self, values: Float[Tensor, "E n"]) -> Float[Tensor, "E D"]:
        """The sum over inputs."""
        values = torch.where(self.of_roots, values.abs().sqrt(), values)
        place = torch.minimum(((values - self.start) / self.spacing).clamp(min=0), self.last)
        low = torch.minimum(place.floor(), self.last - 1)
        share = place - low
        row = low.long() + self.first_row
        return functional.embedding_bag(
            torch.cat([row, row + 1], -1), self.table, mode="sum", per_sample_weights=torch.cat([1 - share, share], -1)
        )

    @property
    def is_frozen(self) -> bool:
        """Whether no weight is trained."""
        return not any(weight.requires_grad for weight in (self.table, *self.out.parameters()))


RelationEmbedding = FourierEmbedding | TabulatedEmbedding


@dataclass(frozen=True, eq=False)
class Piece:
    """Rows with about as many neighbours, r of them."""

    neighbors: Int64[Tensor, "r K"]
    """Rows of the sources; any valid row where the mask is False."""
    bias: Float[Tensor, "r 1 K"]
    """Added to scores: 0 for a neighbour, a large negative number for padding. Every row has a neighbour."""
    known: Float[Tensor, "r K W"]
    """Normalised embedding of each row's relation to each neighbour; behind it, where they are the same in all layers (W = 2D),
    normalised features of the neighbours. Finite nonsense for padding."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Whom rows attend to, shared by all layers: rows sorted by their number of neighbours and cut, so that little is padded."""

    rows: Int64[Tensor, "n"]
    """The rows that have neighbours, piece after piece."""
    pieces: tuple[Piece, ...]

    @property
    def sizes(self) -> list[int]:
        """Rows of each piece."""
        return [len(piece.bias) for piece in self.pieces]


@dataclass(frozen=True, eq=False)
class Pointers:
    """One thing each that some rows are pointed to, wherever it is: its relation to the row, as it is and with a mark."""

    rows: Int64[Tensor, "g"]
    """The rows that are pointed somewhere, each once."""
    relation: Float[Tensor, "g D"]
    """Normalised embedding of the relation without the mark."""
    marked: Float[Tensor, "g D"]
    """The same with the mark."""
    features: Float[Tensor, "g D"]
    """Normalised features of what is pointed to."""


def surround(
    embedding: RelationEmbedding,
    values: Float[Tensor, "R K n"],
    neighbors: Int64[Tensor, "R K"],
    mask: Bool[Tensor, "R K"],
    *,
    dim: int,
    features: Float[Tensor, "S D"] | None = None,
) -> Surroundings:
    """Embed relations.

    Args:
        embedding: of what describes a relation.
        values: what describes each row's relation to each neighbour.
        neighbors: rows of the sources; any valid row where the mask is False.
        mask: True = a neighbour.
        dim: D.
        features: normalised features of the sources, if they are the same in all layers.
    """
    columns = torch.arange(1, mask.shape[1] + 1, device=mask.device)
    width, order = (mask * columns).amax(-1).sort()
    widths = width.cpu().numpy()
    empty = int(np.searchsorted(widths, 1))
    rows = order[empty:]
    pieces = []
    pairs = FLOATS_PER_PIECE.get(mask.device.type, FLOATS_PER_PIECE_ELSEWHERE) // dim
    for cut in _cut(widths[empty:], pairs):
        part, of_part = rows[cut], slice(widths[empty:][cut].max(initial=1))
        index = neighbors[part, of_part]
        known = _describe(embedding, values[part, of_part], index, features)
        bias = torch.zeros_like(known[..., 0]).masked_fill_(~mask[part, of_part], IMPOSSIBLE)
        pieces.append(Piece(index, bias[:, None], known))
    return Surroundings(rows, tuple(pieces))


def _describe(
    embedding: RelationEmbedding,
    values: Float[Tensor, "r K n"],
    neighbors: Int64[Tensor, "r K"],
    features: Float[Tensor, "S D"] | None,
) -> Float[Tensor, "r K W"]:
    """What a piece knows. Where a gradient flows, relations are embedded again in the backward pass instead of stored."""
    is_constant = embedding.is_frozen and (features is None or not features.requires_grad)
    if is_constant or not torch.is_grad_enabled():
        return _describe_in_place(embedding, values, neighbors, features)

    def described() -> Float[Tensor, "r K D"]:
        return normalize(embedding(values.flatten(0, 1))).unflatten(0, values.shape[:2])

    known = checkpoint(described, use_reentrant=False, preserve_rng_state=False)
    return known if features is None else torch.cat([known, functional.embedding(neighbors, features)], -1)


def _describe_in_place(
    embedding: RelationEmbedding,
    values: Float[Tensor, "r K n"],
    neighbors: Int64[Tensor, "r K"],
    features: Float[Tensor, "S D"] | None,
) -> Float[Tensor, "r K W"]:
    """The same without gradient and copies: a last map whose outputs have mean zero leaves only a division to normalise."""
    last: nn.Linear = embedding.out[-1]  # type: ignore[assignment]
    hidden = embedding.out[:-1](embedding.embed_inputs(values.flatten(0, 1))).to(last.weight.dtype)
    dim = last.out_features
    known = hidden.new_empty(*values.shape[:2], dim if features is None else 2 * dim)
    relation = known.flatten(0, 1)[:, :dim]
    weight, bias = last.weight - last.weight.mean(0), last.bias - last.bias.mean()
    torch.addmm(bias, hidden, weight.mT, out=relation)
    variance = torch.linalg.vector_norm(relation, dim=-1, keepdim=True).square_() / dim
    relation *= variance.add_(EPSILON).rsqrt_()
    if features is not None:
        torch.index_select(features, 0, neighbors.flatten(), out=known.flatten(0, 1)[:, dim:])
    return known


def _cut(widths: np.ndarray, pairs: int) -> list[slice]:
    """Cut rows of increasing width into pieces of about so many pairs and of similar width; at least one piece, maybe empty."""
    if not len(widths):
        return [slice(0, 0)]
    step = max(math.ceil(widths[-1] / WIDTHS), LEAST_WIDTH_STEP)
    piece = (widths - 1) // step + widths.cumsum() // pairs
    cuts = [0, *(np.flatnonzero(np.diff(piece)) + 1).tolist(), len(widths)]
    return [slice(a, b) for a, b in itertools.pairwise(cuts)]


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
        source: Float[Tensor, "S D"] | None,
        around: Surroundings,
        *,
        pointers: Pointers | None = None,
    ) -> Float[Tensor, "R D"]:
        """New features of the rows.

        Args:
            x: features of the rows.
            source: normalised (see `normalize`) features of everything that can be a neighbour; None = `around` holds them.
            around: the neighbours of each row. A row without any receives a message of exactly zero.
            pointers: what some rows are pointed to.
        """
        target = self.target_norm(x)
        message = self._message(target, source, around)
        if pointers is not None:
            message = self._follow(message, target, pointers)
        gate = torch.sigmoid(self.gate(torch.cat([message, target], -1)))
        x = x + self.out_norm(self.out(message + gate * (self.skip(target) - message)))
        return x + self.feed_forward(x)

    def _message(
        self, target: Float[Tensor, "R D"], source: Float[Tensor, "S D"] | None, around: Surroundings
    ) -> Float[Tensor, "R inner"]:
        """Attention-weighted values of the neighbours, heads concatenated."""
        source_norm = self.source_norm or self.target_norm
        norms = (self.relation_norm, source_norm)
        values = (self.relation_value, self.source_value)
        keys = self._by_head((self.relation_key, self.source_key), norms) / math.sqrt(self.head_dim)
        projections = keys, self._by_head(values, norms).mT
        constant = torch.stack([value(norm.bias) for value, norm in zip(values, norms)]).sum(0)
        query = self.query(target[around.rows]).unflatten(-1, (self.num_heads, self.head_dim)).split(around.sizes)
        answers = [self._attend(*pair, *projections, source) for pair in zip(query, around.pieces)]
        answer = torch.cat([gathered for gathered, _ in answers])
        received = torch.cat([weight for _, weight in answers])
        answer = answer + received * constant.unflatten(-1, (self.num_heads, self.head_dim))
        message = target.new_zeros(len(target), self.num_heads * self.head_dim)
        return message.index_copy(0, around.rows, answer.flatten(-2))

    def _attend(
        self,
        query: Float[Tensor, "r H d"],
        piece: Piece,
        keys: Float[Tensor, "H d W"],
        values: Float[Tensor, "H W d"],
        source: Float[Tensor, "S D"] | None,
    ) -> tuple[Float[Tensor, "r H d"], Float[Tensor, "r H 1"]]:
        """Weighted sums of the neighbours' values, and of the weights."""
        asked = (query.transpose(0, 1) @ keys).transpose(0, 1)
        gathered, received = self._gather(asked, piece, source)
        return (gathered.transpose(0, 1) @ values).transpose(0, 1), received

    def _gather(
        self, asked: Float[Tensor, "r H W"], piece: Piece, source: Float[Tensor, "S D"] | None
    ) -> tuple[Float[Tensor, "r H W"], Float[Tensor, "r H 1"]]:
        """Weighted sums of the neighbours' relations and features, and of the weights."""
        known = (piece.known,) if source is None else (piece.known, functional.embedding(piece.neighbors, source))
        if not torch.is_grad_enabled() and not (self.training and self.dropout):  # what the fused kernel is fast at
            whole = (piece.known if source is None else torch.cat(known, -1))[:, None]
            bias = piece.bias[:, None]
            gathered = functional.scaled_dot_product_attention(asked[:, None], whole, whole, attn_mask=bias, scale=1.0)
            return gathered[:, 0], torch.ones_like(gathered[:, 0, :, :1])
        scores = piece.bias.expand(-1, self.num_heads, -1)
        for part, to_part in zip(known, asked.chunk(len(known), -1)):
            scores = torch.baddbmm(scores, to_part, part.mT)  # [r, H, K]
        weights = functional.dropout(torch.softmax(scores, -1), self.dropout, self.training)
        return torch.cat([weights @ part for part in known], -1), weights.sum(-1, keepdim=True)

    def _follow(
        self, message: Float[Tensor, "R inner"], target: Float[Tensor, "R D"], pointers: Pointers
    ) -> Float[Tensor, "R inner"]:
        """Messages of rows that are pointed somewhere, moved towards what is said from there.

        How far depends on what the mark adds to the score of the relation, s: by tanh(s / 2), the weight that a marked relation gets
        beyond that of an unmarked one if a row attends to these two. Without a mark that is exactly nothing.
        """
        norms = (self.relation_norm, self.source_norm or self.target_norm)
        values = (self.relation_value, self.source_value)
        own = message[pointers.rows].unflatten(-1, (self.num_heads, self.head_dim))
        query = self.query(target[pointers.rows]).unflatten(-1, (self.num_heads, self.head_dim))
        key = functional.linear((pointers.marked - pointers.relation) * norms[0].weight, self.relation_key.weight)
        score = (query * key.view_as(query)).sum(-1, keepdim=True) / math.sqrt(self.head_dim)
        parts = zip(values, norms, (pointers.marked, pointers.features))
        said = torch.stack([value(part * norm.weight + norm.bias) for value, norm, part in parts]).sum(0)
        change = torch.tanh(score / 2) * (said.view_as(own) - own)
        return message.index_add(0, pointers.rows, change.flatten(-2).to(message.dtype))

    def _by_head(self, maps: tuple[nn.Linear, ...], norms: tuple[nn.LayerNorm, ...]) -> Float[Tensor, "H d W"]:
        """Weights of maps of relations and sources with their norms' weights inside."""
        folded = torch.cat([linear.weight * norm.weight for linear, norm in zip(maps, norms)], -1)
        return folded.unflatten(0, (self.num_heads, self.head_dim))
