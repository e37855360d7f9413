"""SMART's layers at both ends: embeddings of continuous values, and heads.

Embeddings are small networks over learned Fourier features, and tables of these. Beside the plain head there is a head
per agent class, for vocabularies with classes of different sizes, and scores of tokens by how these continue a motion.

D width, n inputs, E rows (a row per relation), F frequencies, R agents, V tokens, C classes. Initialization: linear
maps Xavier-uniform with zero bias, embedding tables N(0, 0.02); frequencies are such a table, or log-spaced.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.policies.distributions import NEVER
from rlftsim.policies.smart.config import FrequencyInit
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, box_of_class

EPSILON = 1e-5
"""Added to variances before dividing by their root; the default of torch's layer norm."""
DISTANCES_PER_ROOT_M = 768
"""Grid points of a distance table per square root of a meter: 3 mm apart at 1 m, 14 mm at 30 m."""
LONGEST_PERIOD = 64.0
"""Meters (or radians) of the slowest log-spaced frequency; the fastest has a period of 1."""
NUM_ANGLES = 2049
"""Grid points of an angle table, from -pi to pi: 0.18 degrees apart."""
PERIODS = ((12.8, 0.05, 12), (3.2, 0.03, 10), (6.25, 0.06, 10))
"""Longest and shortest period and number of the frequencies of `ContinuationScores`: along and across the agent's
heading in lengths of its class's box, and of its heading in radians."""
LONGITUDINAL_AXIS = 0
"""Axis along the heading."""


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
    root = math.sqrt(max(reach_m, 1.0))  # a grid has two points
    distance = Grid(0.0, root, round(root * DISTANCES_PER_ROOT_M) + 1, of_roots=True)
    angle = Grid(-math.pi, math.pi, NUM_ANGLES)
    return TabulatedEmbedding.build(embedding, (distance, angle, angle, *extra_grids))


class ClassHeads(nn.ModuleList):
    """Features of R agents -> logits of the tokens of each agent's class, padded to V tokens."""

    def __init__(self, dim: int, class_sizes: tuple[int, ...], num_tokens: int):
        super().__init__(MlpLayer(dim, dim, size) for size in class_sizes)
        self.class_sizes = class_sizes
        self.num_tokens = num_tokens

    def forward(self, features: Float[Tensor, "R D"], class_id: Int64[Tensor, "R"]) -> Float[Tensor, "R V"]:
        """float32 logits; tokens that a class lacks get `NEVER`.

        Args:
            features: Decoder features of each agent, a row per agent.
            class_id: Class of each agent, an index into the heads; rows of padding classes are arbitrary.
        """
        logits = torch.full((len(features), self.num_tokens), NEVER, device=features.device)
        for index, (head, size) in enumerate(zip(self, self.class_sizes)):
            if features.device.type == "cpu":
                # each head sees the rows of a single class
                rows = (class_id == index).nonzero()[:, 0]
                logits[rows, :size] = head(features[rows]).float()
            else:
                # each head sees all rows: to leave some out, the host would wait for their number
                class_logits = functional.pad(head(features).float(), (0, self.num_tokens - size), value=NEVER)
                # padding, whose class has no head, gets arbitrary logits
                logits = torch.where((class_id >= index)[:, None], class_logits, logits)
        return logits


class ContinuationScores(nn.Module):
    """A second term of the logits: scores of tokens by changes of the agent's speed and direction.

    SMART's head has a free vector for each token and learns from every speed anew that agents mostly go on as
    before; speeds that few training scenarios have stay unknown, and agents fall back to common speeds. Here token v is
    scored by how much farther the end m_v lies along the heading than the end of the last token u, and by the end
    across the heading and the turn, which the road decides and not the last turn: a Fourier series

        sum over frequencies w of  a_w cos(w d) + b_w sin(w d),

    where d = m_v - m_u along the heading and d = m_v across the heading and in turn, and a and b are linear in the
    agent's features. A lesson about accelerating holds at any speed, and tokens that lead to nearly the same place are
    learned together. By the addition theorems this is the product of a key, which depends on v alone, and of a query
    that is turned by the phase of u, as in rotary position embeddings.
    """

    frequency: Float[Tensor, "F"]
    axis: Int64[Tensor, "F"]

    def __init__(self, dim: int):
        super().__init__()
        spaced = [torch.logspace(-math.log10(longest), -math.log10(shortest), n) for longest, shortest, n in PERIODS]
        axis = [torch.full_like(values, index, dtype=torch.int64) for index, values in enumerate(spaced)]
        self.register_buffer("frequency", 2 * math.pi * torch.cat(spaced), persistent=False)
        self.register_buffer("axis", torch.cat(axis), persistent=False)
        self.query = nn.Linear(dim, 2 * len(self.frequency), bias=False)

    def keys(self, ends: Float[Tensor, "C V 3"]) -> "TokenKeys":
        """Keys of all tokens; no weight takes part.

        Args:
            ends: Pose (x, y, heading) that each token leads to, meters and radians, in the agent's frame.
        """
        length, _ = box_of_class(torch.arange(len(ends), device=ends.device))
        unit = torch.stack([length, length, torch.ones_like(length)], -1)  # [C, 3]
        phase = (ends / unit[:, None])[..., self.axis] * self.frequency  # [C, V, F]
        return TokenKeys(
            keys=torch.cat([phase.cos(), phase.sin()], -1).transpose(0, 1).flatten(1),
            last_phase=torch.where(self.axis == LONGITUDINAL_AXIS, phase, 0.0),
        )

    def queries(
        self, hidden: Float[Tensor, "R D"], last_phase: Float[Tensor, "R F"], class_id: Int64[Tensor, "R"]
    ) -> Float[Tensor, "R CK"]:
        """Queries for the keys of all classes side by side: zero for keys of other classes, and all zero for padding.

        Args:
            hidden: Features that the last map of SMART's head reads, a row per agent.
            last_phase: Phase of the token that led to the current step, from `TokenKeys`, radians.
            class_id: Class of each agent, which selects the keys of the agent's query.
        """
        a, b = self.query(hidden).chunk(2, -1)  # [R, F]
        cos, sin = last_phase.cos(), last_phase.sin()
        query = torch.cat([a * cos - b * sin, a * sin + b * cos], -1)
        is_class = class_id[:, None] == torch.arange(len(CLASS_BOXES_M), device=class_id.device)
        return (is_class[..., None] * query[:, None]).flatten(1)


@dataclass(frozen=True, eq=False)
class TokenKeys:
    """Tokens of a vocabulary as `ContinuationScores` reads them (K = 2F)."""

    keys: Float[Tensor, "V CK"]
    """Cosines and sines of the phases of a token, the classes side by side."""
    last_phase: Float[Tensor, "C V F"]
    """Phase by which a token turns the query of the next decision: zero but along the heading."""
