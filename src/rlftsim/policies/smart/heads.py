"""Further heads of SMART: a head per agent class, for vocabularies with classes of different sizes, and scores of
tokens by how these continue a motion."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.policies.distributions import NEVER
from rlftsim.policies.smart.embeddings import MlpLayer
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, box_of_class

PERIODS = ((12.8, 0.05, 12), (3.2, 0.03, 10), (6.25, 0.06, 10))
"""Longest and shortest period and number of the frequencies of `ContinuationScores`: along and across the agent's
heading in lengths of its class's box, and of its heading in radians."""
LONGITUDINAL_AXIS = 0
"""Axis along the heading."""


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
