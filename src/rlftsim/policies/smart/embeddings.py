"""Embeddings of continuous values: small networks over learned Fourier features, and tables of these.

D width, n inputs, E rows (a row per relation), F frequencies. Initialization: linear maps Xavier-uniform with zero
bias, embedding tables N(0, 0.02); frequencies are such a table, or log-spaced.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.policies.smart.config import FrequencyInit

EPSILON = 1e-5
"""Added to variances before dividing by their root; the default of torch's layer norm."""
DISTANCES_PER_ROOT_M = 768
"""Grid points of a distance table per square root of a meter: 3 mm apart at 1 m, 14 mm at 30 m."""
LONGEST_PERIOD = 64.0
"""Meters (or radians) of the slowest log-spaced frequency; the fastest has a period of 1."""
NUM_ANGLES = 2049
"""Grid points of an angle table, from -pi to pi: 0.18 degrees apart."""


def initialize(module: nn.Module, frequency_init: FrequencyInit) -> None:
    """Draw the weights of all linear maps and embedding tables inside a module anew, in the order of `modules()`.

    Args:
        module: Complete network; weights are overwritten in place.
        frequency_init: "normal" draws the frequencies of Fourier embeddings like any other table. Almost all of these
            have periods of tens of meters, which cannot tell a lane from the next. "log_spaced" sets periods from 64
            down to 1, the same for every input.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        elif isinstance(layer, nn.Embedding):
            nn.init.normal_(layer.weight, std=0.02)
    if frequency_init == "log_spaced":
        for layer in module.modules():
            if isinstance(layer, FourierEmbedding):
                weight = layer.frequencies.weight  # [n, F]
                with torch.no_grad():
                    weight.copy_(torch.logspace(-math.log10(LONGEST_PERIOD), 0.0, weight.shape[1]).expand_as(weight))


def normalize(x: Float[Tensor, "... D"]) -> Float[Tensor, "... D"]:
    """Layer norm without weights.

    Computed once for all layers that read x; each layer folds the weights of a norm in.
    """
    return functional.layer_norm(x, x.shape[-1:], eps=EPSILON)


class MlpEmbedding(nn.Sequential):
    """Continuous values [..., n] -> [..., D]: three linear maps, the first two with norm and ReLU.

    The inner width is 128.
    """

    def __init__(self, num_inputs: int, dim: int):
        super().__init__(
            nn.Linear(num_inputs, 128), nn.LayerNorm(128), nn.ReLU(),
            nn.Linear(128, dim), nn.LayerNorm(dim), nn.ReLU(),
            nn.Linear(dim, dim),
        )  # fmt: skip


class MlpLayer(nn.Sequential):
    """[..., n] -> [..., m] through a hidden layer of width D with norm and ReLU."""

    def __init__(self, num_inputs: int, dim: int, num_outputs: int):
        super().__init__(nn.Linear(num_inputs, dim), nn.LayerNorm(dim), nn.ReLU(), nn.Linear(dim, num_outputs))


class FourierEmbedding(nn.Module):
    """Continuous values [E, n] -> [E, D] through learned frequencies.

    Each input has a small network. The outputs of these networks are summed and go through a last map.
    """

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
        """Embedding of each row.

        Args:
            values: Inputs of each row, in meters and radians.
            extra: Categorical embeddings that join the sum over inputs, before the last map.
        """
        total = self.embed_inputs(values)
        return self.out(total if extra is None else total + extra)

    def embed_inputs(self, values: Float[Tensor, "E n"]) -> Float[Tensor, "E D"]:
        """Sum over inputs, before the last map."""
        terms = (self.embed_input(index, column) for index, column in enumerate(values.unbind(-1)))
        return sum(terms, next(terms))

    def embed_input(self, index: int, values: Float[Tensor, "E"]) -> Float[Tensor, "E D"]:
        """Term of the sum that a single input adds.

        Args:
            index: Number of the input, from 0 to n - 1.
            values: Value of this input in each row.
        """
        angles = 2 * math.pi * values[:, None] * self.frequencies.weight[index]  # [E, F]
        return self.inputs[index](torch.cat([angles.cos(), angles.sin(), values[:, None]], -1))

    @property
    def is_frozen(self) -> bool:
        """True if no weight is trained."""
        return not any(weight.requires_grad for weight in self.parameters())


@dataclass(frozen=True)
class Grid:
    """Values of an input: `count` of them from `start` to `stop`."""

    start: float
    stop: float
    count: int
    of_roots: bool = False
    """start and stop are square roots, and the points are equally spaced in the root: small values lie closer
    together."""


@dataclass(frozen=True, eq=False)
class TabulatedEmbedding:
    """A FourierEmbedding as a lookup table, interpolated linearly: each input's term is a function of a single number.

    There are far fewer grid points than relations, so this is also the fast way to train: gradients flow through
    the table. A value outside a grid counts as the end of the grid.
    """

    table: Float[Tensor, "rows D"]
    """Terms at the grid points of all inputs, one input after the other."""
    start: Float[Tensor, "n"]
    spacing: Float[Tensor, "n"]
    last: Float[Tensor, "n"]
    """Index of each input's last grid point."""
    of_roots: Bool[Tensor, "n"]
    first_row: Int64[Tensor, "n"]
    """Row of the table at which each input begins."""
    out: nn.Sequential

    @classmethod
    def build(cls, embedding: FourierEmbedding, grids: tuple[Grid, ...]) -> "TabulatedEmbedding":
        """Table of an embedding.

        Args:
            embedding: Embedding to evaluate on the grids, with gradient.
            grids: Grid of each input, in the order of the embedding's inputs.
        """
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
        """Sum over inputs, before the last map."""
        values = torch.where(self.of_roots, values.abs().sqrt(), values)
        # fractional index into each input's grid [E, n], and the grid point below it
        grid_index = torch.minimum(((values - self.start) / self.spacing).clamp(min=0), self.last)
        low = torch.minimum(grid_index.floor(), self.last - 1)
        upper = grid_index - low  # weight of the upper neighbor
        row = low.long() + self.first_row
        # one bag per relation: both neighbors of every input, weighted; no tensor [E, 2n, D] is made
        return functional.embedding_bag(
            torch.cat([row, row + 1], -1), self.table, mode="sum", per_sample_weights=torch.cat([1 - upper, upper], -1)
        )

    @property
    def is_frozen(self) -> bool:
        """True if no weight is trained."""
        return not any(weight.requires_grad for weight in (self.table, *self.out.parameters()))


RelationEmbedding = FourierEmbedding | TabulatedEmbedding


def tabulate(embedding: FourierEmbedding, reach_m: float, *extra_grids: Grid) -> RelationEmbedding:
    """Table of an embedding of relations, or the unchanged embedding while training without dropout.

    In that case a gradient has to be exact, and interpolation is not.

    Args:
        embedding: Embedding of (distance, bearing, difference of heading, ...), meters and radians.
        reach_m: Largest distance of the table, meters; larger distances count as this distance.
        extra_grids: Grids of the inputs that follow these three.
    """
    if not (embedding.is_frozen or embedding.training):
        return embedding
    root = math.sqrt(reach_m)
    distance = Grid(0.0, root, round(root * DISTANCES_PER_ROOT_M) + 1, of_roots=True)
    angle = Grid(-math.pi, math.pi, NUM_ANGLES)
    return TabulatedEmbedding.build(embedding, (distance, angle, angle, *extra_grids))
