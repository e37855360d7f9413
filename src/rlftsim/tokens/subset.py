"""Some tokens of a vocabulary as a vocabulary: those that a small model gets, of a large model's.

C classes, V tokens of the small vocabulary, W of the large one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.agent_tokens import corner_distances, tokenize_agents
from rlftsim.tokens.vocabulary import STILL_TOKEN, Vocabulary, class_of_type

RARE = 1e-5
"""Added to the frequency of a token, so that motions are kept, too, that no log has."""


@dataclass(frozen=True, eq=False)
class SharedTokens:
    """Tokens of a small vocabulary among those of a large one."""

    in_large: Int64[Tensor, "C V"]
    """The same token of the large vocabulary."""
    in_small: Int64[Tensor, "C W"]
    """The nearest token of the small vocabulary."""

    @classmethod
    def find(cls, small: Vocabulary, large: Vocabulary) -> "SharedTokens":
        """Where the tokens of either vocabulary are in the other.

        Raises:
            ConfigError: A token of the small vocabulary is none of the large one.
        """
        in_large, in_small = [], []
        tables = (small.end_corners(), small.token_mask, large.end_corners(), large.token_mask)
        for ends, exists, large_ends, large_exists in zip(*tables):
            distance = corner_distances(large_ends, ends).masked_fill(~exists, torch.inf)  # [W, V]
            in_small.append(distance.argmin(1))
            distance = distance.masked_fill(~large_exists[:, None], torch.inf)
            in_large.append(torch.where(exists, distance.argmin(0), STILL_TOKEN))
            if (distance.amin(0)[exists] > 0).any():
                raise ConfigError("the student has tokens that the teacher lacks: make one by `rlftsim distill`.")
        return cls(torch.stack(in_large), torch.stack(in_small))

    def to_large(self, token_id: Int64[Tensor, "B N A *L"], object_type: Int64[Tensor, "B A"]) -> Tensor:
        """Ids in the large vocabulary of tokens of the small one.

        Args:
            token_id: Ids of tokens of the small vocabulary, each within the class of the agent, of N rollouts.
            object_type: Object type of each agent, which decides the class.
        """
        return self.in_large[_spread(class_of_type(object_type), token_id), token_id]

    def to_small(self, token_id: Int64[Tensor, "B N A *L"], object_type: Int64[Tensor, "B A"]) -> Tensor:
        """Ids of the tokens of the small vocabulary that are nearest to tokens of the large one.

        Args:
            token_id: Ids of tokens of the large vocabulary, each within the class of the agent, of N rollouts.
            object_type: Object type of each agent, which decides the class.
        """
        return self.in_small[_spread(class_of_type(object_type), token_id), token_id]

    def project(self, probability: Float[Tensor, "R W"], object_type: Int64[Tensor, "R"]) -> Float[Tensor, "R V"]:
        """Probabilities of the small vocabulary's tokens: each token of the large one counts for the nearest.

        Args:
            probability: Probabilities of R elements over the tokens of the large vocabulary.
            object_type: Object type of the agent of each element, which decides the class of the tokens.
        """
        projected = probability.new_zeros(len(probability), self.in_large.shape[1])
        return projected.scatter_add_(1, self.in_small[class_of_type(object_type)], probability)


def _spread(class_id: Int64[Tensor, "B A"], token_id: Int64[Tensor, "B N A *L"]) -> Tensor:
    """Classes in the shape of tokens."""
    return class_id.view(len(class_id), 1, -1, *[1] * (token_id.dim() - 3)).expand(token_id.shape)


def choose_tokens(vocabulary: Vocabulary, scenarios: Scenarios, num_tokens: int) -> Vocabulary:
    """Vocabulary of the tokens of each class to which the logged motions are nearest, by the sum of squares.

    Args:
        vocabulary: Large vocabulary; of a class with fewer tokens all are kept.
        scenarios: Training scenarios, at least one; the tokens of all logged tracks are counted.
        num_tokens: Number of tokens of each class, at least 1: that which stands still is always there.
    """
    counts = torch.zeros(vocabulary.token_mask.shape, dtype=torch.float64)
    for index in range(len(scenarios)):
        batch = collate([scenarios[index]])
        tokens = tokenize_agents(batch, vocabulary)
        class_id = class_of_type(batch.object_type)[..., None].expand(tokens.token_id.shape)
        counts.index_put_((class_id[tokens.valid], tokens.token_id[tokens.valid]), counts.new_ones(()), accumulate=True)
    num_tokens = min(num_tokens, vocabulary.num_tokens)
    token_id = torch.zeros(len(counts), num_tokens, dtype=torch.int64)
    exists = torch.zeros_like(token_id, dtype=torch.bool)
    for index, (ends, mask, count) in enumerate(zip(vocabulary.end_corners(), vocabulary.token_mask, counts)):
        frequency = count / count.sum().clamp(min=1) + RARE
        selected = _cover(corner_distances(ends, ends).double(), mask, frequency, num_tokens)
        token_id[index, : len(selected)], exists[index, : len(selected)] = torch.tensor(selected), True
    shape = (-1, -1, *vocabulary.corners.shape[2:])
    corners = vocabulary.corners.gather(1, token_id[..., None, None, None].expand(shape))
    corners = torch.where(exists[..., None, None, None], corners, 0.0)
    origin = f"{num_tokens} tokens of each class of: {vocabulary.origin}"
    return replace(vocabulary, corners=corners, token_mask=exists, origin=origin)


def _cover(
    distance: Float[Tensor, "W W"], exists: Bool[Tensor, "W"], weight: Float[Tensor, "W"], num_tokens: int
) -> Sequence[int]:
    """Tokens that leave a small weighted sum of squared distances to the nearest of these, picked in turn; sorted."""
    squared, selected = distance.square(), [STILL_TOKEN]
    nearest = squared[STILL_TOKEN]
    for _ in range(min(num_tokens, int(exists.sum())) - 1):
        gain = ((nearest[:, None] - squared).clamp(min=0) * (weight * exists)[:, None]).sum(0)
        gain[~exists] = -torch.inf
        gain[selected] = -torch.inf
        selected.append(int(gain.argmax()))
        nearest = torch.minimum(nearest, squared[selected[-1]])
    return sorted(selected)
